"""Twin of `clrecon.operators.points.neighbours`: the k nearest points of each point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROWS_AT_ONCE = 256

SPARE = 16
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
    distances, numbers = (
        np.take_along_axis(distances, by_number, axis=1),
        np.take_along_axis(numbers, by_number, axis=1),
    )
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :k]
    return (
        np.take_along_axis(numbers, nearest, axis=1).astype(np.int32),
        np.take_along_axis(distances, nearest, axis=1),
    )


def find_neighbours(points: NDArray[np.float32], k: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the `k` nearest points of each point, itself among them.

    points: ndarray, shape (n, 3), float32. mm, relative to a place that is near enough for float32.
    k: At most n.

    Returns:
    indices: ndarray, shape (n, k), int32. Ascending by (distance, index).  Of points at the same place the lowest index
        comes first.
    distances: ndarray, shape (n, k), float32. mm, see `float32_distances`.
    """
    n = len(points)
    points = np.asarray(points, dtype=np.float32)
    if n <= 2 * (k + SPARE):
        return _compare_all(points, np.arange(n), k)
    from scipy.spatial import cKDTree

    tree = cKDTree(points.astype(np.float64))
    far, numbers = tree.query(points.astype(np.float64), k + SPARE)
    distances = float32_distances(points[numbers] - points[:, None])
    indices, nearest = _order(distances, numbers, k)
    doubtful = np.flatnonzero(~(nearest[:, -1].astype(np.float64) * (1.0 + ROUNDING) < far[:, -1]))
    for first in range(0, len(doubtful), ROWS_AT_ONCE):
        rows = doubtful[first : first + ROWS_AT_ONCE]
        indices[rows], nearest[rows] = _compare_all(points, rows, k)
    return indices, nearest


def _compare_all(
    points: NDArray[np.float32], rows: NDArray[np.intp], k: int
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Compare some points with all."""
    distances = float32_distances(points[None] - points[rows, None])
    return _order(distances, np.broadcast_to(np.arange(len(points)), distances.shape), k)
