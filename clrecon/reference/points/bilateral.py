"""Twin of `clrecon.operators.points.denoising`: the bilateral filter of paper B, eq. 3 to 5, along the normal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_RANGE_MM = 1e-6
"""Where sigma_s is smaller, the neighbours lie in the plane already, and the point stays."""


def filter_scales(
    points: NDArray[np.floating], normals: NDArray[np.floating], indices: NDArray[np.integer], range_factor: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sigma_c and sigma_s of each point.

    Returns:
    sigma_c: ndarray, shape (n,), mm. Distance to the kth neighbour.
    sigma_s: ndarray, shape (n,), mm. `range_factor` times the standard deviation (population) of the neighbours'
        projections on the normal.
    """
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
    moves = (sigma_s >= LEAST_RANGE_MM) & (sigma_c > 0.0)
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
    for own in np.split(order, np.flatnonzero(np.diff(cells[order])) + 1):
        among = np.broadcast_to(own, (len(own), len(own)))
        away = points[own][:, None].astype(np.float64) - points.astype(np.float64)[among]
        heights = np.einsum("nki,ni->nk", away, normals[own])
        moves = (sigma_s[own] >= LEAST_RANGE_MM) & (sigma_c[own] > 0.0)
        far, high = np.where(moves, sigma_c[own], 1.0)[:, None], np.where(moves, sigma_s[own], 1.0)[:, None]
        weights = np.exp(-np.einsum("nki,nki->nk", away, away) / (2.0 * far**2) - heights**2 / (2.0 * high**2))
        factors[own] = np.where(moves, (weights * heights).sum(axis=1) / weights.sum(axis=1), 0.0)
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
