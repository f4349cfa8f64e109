"""Twins of the k nearest points, and of what they make of a point: normals, outliers, and the bilateral filter of paper
B, eq. 3 to 5, along the normal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

ROWS_AT_ONCE = 256

_SPARE = 16
"""Further candidates that the tree is asked for: ties of float32 distances may be among them."""

ROUNDING = 1e-5
"""Share by which a distance of the tree, in float64, may differ from one in float32 without a doubt about the order."""


def float32_distances(differences: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the lengths of (..., 3) float32 vectors: x x + y y, + z z, then the root, rounded to float32 each."""
    x, y, z = np.moveaxis(np.asarray(differences, dtype=np.float32), -1, 0)
    squares: NDArray[np.float32] = x * x + y * y
    squares += z * z
    roots: NDArray[np.float32] = np.sqrt(squares)
    return roots


def _order(
    distances: NDArray[np.float32], numbers: NDArray[np.int64], k: int
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Sort each row by (distance, number) and return its first `k`."""
    by_number = np.argsort(numbers, axis=1, kind="stable")
    by_distance = np.argsort(np.take_along_axis(distances, by_number, axis=1), axis=1, kind="stable")
    nearest = np.take_along_axis(by_number, by_distance[:, :k], axis=1)
    ordered = np.take_along_axis(numbers, nearest, axis=1).astype(np.int32)
    return ordered, np.take_along_axis(distances, nearest, axis=1)


def find_neighbours(points: NDArray[np.float32], k: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the `k` nearest points of each point, itself among them, (n, k), and their `float32_distances` in mm.

    They ascend by (distance, index); of points at the same place the lowest index comes first.
    """
    n = len(points)
    points = np.asarray(points, dtype=np.float32)
    if n <= 2 * (k + _SPARE):
        return _compare_all(points, np.arange(n), k)
    from scipy.spatial import cKDTree

    far, numbers = cKDTree(points.astype(np.float64)).query(points.astype(np.float64), k + _SPARE)
    indices, nearest = _order(float32_distances(points[numbers] - points[:, None]), numbers, k)
    doubtful = np.flatnonzero(~(nearest[:, -1].astype(np.float64) * (1.0 + ROUNDING) < far[:, -1]))
    for first in range(0, len(doubtful), ROWS_AT_ONCE):
        rows = doubtful[first : first + ROWS_AT_ONCE]
        indices[rows], nearest[rows] = _compare_all(points, rows, k)
    return indices, nearest


def _compare_all(
    points: NDArray[np.float32], rows: NDArray[np.intp], k: int
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    distances = float32_distances(points[None] - points[rows, None])
    return _order(distances, np.broadcast_to(np.arange(len(points)), distances.shape), k)


NO_WIDTH = 4e-6
"""Sum of the products of two eigenvalues, as a share of the squared trace, up to which points lie in a line."""

DOUBTFUL_COSINE = 0.2
"""Below this cosine between normal and gradient, the gradient itself is taken."""


def principal_axes(
    points: NDArray[np.floating], indices: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest principal axis of the neighbours of each point, itself among them, and the eigenvalues, (m,
    3) both.

    Axes are unit vectors, which of both directions is not defined; zero for points in a line or at one place.  The
    eigenvalues are those of the covariance (population), ascending, mm2.
    """
    near = np.asarray(points, dtype=np.float64)[indices]
    away = near - near.mean(axis=1, keepdims=True)
    eigenvalues, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away) / indices.shape[1])
    eigenvalues = np.maximum(eigenvalues, 0.0)
    low, middle, high = eigenvalues.T
    has_plane = low * middle + low * high + middle * high > NO_WIDTH * eigenvalues.sum(axis=1) ** 2
    return np.where(has_plane[:, None], axes[:, :, 0], 0.0), eigenvalues


def orient_by_gradients(
    axes: NDArray[np.floating], gradients: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Turn normals towards lower HU; near a right angle they are the direction of falling HU, and doubtful."""
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


def mean_distances(distances: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean distance of each point to its others: distances (n, k) without the first, its own."""
    return distances[:, 1:].astype(np.float64).mean(axis=1)


def find_outliers(distances: NDArray[np.floating], deviations: float) -> NDArray[np.bool_]:
    """Return True where a mean distance exceeds the mean of all by more than `deviations` standard deviations."""
    means = mean_distances(distances)
    outliers: NDArray[np.bool_] = means > means.mean() + deviations * means.std(ddof=1)
    return outliers


_LEAST_RANGE_MM = 1e-6
"""Where sigma_s is smaller, the neighbours lie in the plane already, and the point stays."""


def filter_scales(
    points: NDArray[np.floating], normals: NDArray[np.floating], indices: NDArray[np.integer], range_factor: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sigma_c, the distance to the kth neighbour, and sigma_s, `range_factor` deviations along the normal."""
    away = points[:, None].astype(np.float64) - points.astype(np.float64)[indices]
    heights = np.einsum("nki,ni->nk", away, normals)
    return np.linalg.norm(away[:, -1], axis=1), range_factor * heights.std(axis=1)


def bilateral_factors(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    indices: NDArray[np.integer],
    sigma_c: NDArray[np.floating],
    sigma_s: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Return beta of paper B, eq. 3: the mean height of each point over its neighbours, in mm.

    beta = sum_j Wc(abs(p - p_j)) Ws(abs(h_j)) h_j / sum_j Wc Ws, h_j = <p - p_j, n>, with Gaussians Wc of sigma_c and
    Ws of sigma_s (eq. 4 and 5).  The filtered point is p - beta n: the sign that is printed, +, takes it away from its
    neighbours.
    """
    away = points[:, None].astype(np.float64) - points.astype(np.float64)[indices]
    heights = np.einsum("nki,ni->nk", away, normals)
    moves = (sigma_s >= _LEAST_RANGE_MM) & (sigma_c > 0.0)
    sigma_c, sigma_s = np.where(moves, sigma_c, 1.0), np.where(moves, sigma_s, 1.0)
    squares = np.einsum("nki,nki->nk", away, away)
    weights = np.exp(-squares / (2.0 * sigma_c**2)[:, None] - heights**2 / (2.0 * sigma_s**2)[:, None])
    factors: NDArray[np.float64] = np.where(moves, (weights * heights).sum(axis=1) / weights.sum(axis=1), 0.0)
    return factors


def cell_factors(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    cells: NDArray[np.integer],
    sigma_c: NDArray[np.floating],
    sigma_s: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Return beta with sums over all points of a point's cell in place of its neighbours."""
    factors = np.zeros(len(points))
    order = np.argsort(cells, kind="stable")
    for in_cell in np.split(order, np.flatnonzero(np.diff(cells[order])) + 1):
        among = np.tile(np.arange(len(in_cell)), (len(in_cell), 1))
        of_cell = (array[in_cell] for array in (sigma_c, sigma_s))
        factors[in_cell] = bilateral_factors(points[in_cell], normals[in_cell], among, *of_cell)
    return factors


def denoise_points(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    indices: NDArray[np.integer],
    range_factor: float = 2.0,
    sign: float = -1.0,
) -> NDArray[np.float64]:
    """Return the points after one pass of the filter; `sign` = +1 is what the paper prints."""
    sigma_c, sigma_s = filter_scales(points, normals, indices, range_factor)
    factors = bilateral_factors(points, normals, indices, sigma_c, sigma_s)
    return points.astype(np.float64) + sign * factors[:, None] * normals
