"""Twin of `clrecon.operators.points.normals`: the smallest principal axis of each point's neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

NO_WIDTH = 4e-6
"""Sum of the products of two eigenvalues, as a share of the squared trace, up to which points lie in a line."""

DOUBTFUL_COSINE = 0.2
"""Below this cosine between normal and gradient, the gradient itself is taken."""


def principal_axes(
    points: NDArray[np.floating], indices: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest principal axis of the neighbours of each point, and the eigenvalues.

    points: ndarray, shape (n, 3), mm
    indices: ndarray, shape (m, k). Neighbours, the point itself among them.

    Returns:
    axes: ndarray, shape (m, 3), float64. Unit vectors, which of both directions is not defined; zero for points in a
        line or at one place.
    eigenvalues: ndarray, shape (m, 3), float64. Of the covariance (population), ascending, mm2.
    """
    near = np.asarray(points, dtype=np.float64)[indices]
    away = near - near.mean(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", away, away) / indices.shape[1]
    eigenvalues, axes = np.linalg.eigh(covariance)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    low, middle, high = eigenvalues.T
    has_plane = low * middle + low * high + middle * high > NO_WIDTH * eigenvalues.sum(axis=1) ** 2
    return np.where(has_plane[:, None], axes[:, :, 0], 0.0), eigenvalues


def orient_by_gradients(
    axes: NDArray[np.floating], gradients: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Turn normals towards lower HU.

    axes: ndarray, shape (n, 3). Unit vectors of any direction.
    gradients: ndarray, shape (n, 3). HU per mm, LPS; zero or NaN where there is none.

    Returns:
    normals: ndarray, shape (n, 3). Where the axis and the gradient are nearly at a right angle, the direction of
        falling HU itself.
    doubtful: ndarray, shape (n,), bool. True for these.
    """
    length = np.linalg.norm(gradients, axis=1)
    known = length > 0.0
    down = np.divide(-gradients, length[:, None], out=np.zeros_like(axes), where=known[:, None])
    cosines = np.einsum("ni,ni->n", axes, down)
    doubtful = known & (np.abs(cosines) < DOUBTFUL_COSINE)
    normals = np.where((cosines < 0.0)[:, None], -axes, axes)
    normals[doubtful] = down[doubtful]
    return normals, doubtful


def orient_from(axes: NDArray[Any], points: NDArray[Any], viewpoint: NDArray[np.float64]) -> NDArray[Any]:
    """Turn normals away from a point inside: outward."""
    inward = np.einsum("ni,ni->n", axes, points - viewpoint) < 0.0
    return np.where(inward[:, None], -axes, axes)
