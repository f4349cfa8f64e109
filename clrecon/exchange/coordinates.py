"""The storage type of vertex coordinates: float32 near the origin, float64 far from it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.precision import float32_step, is_far

__all__ = ["as_stored", "find_coincident", "rounded_apart", "rounding_step"]


_MOST_STEPS_APART = 64


def as_stored(points: NDArray[Any]) -> NDArray[np.floating]:
    """Convert coordinates to the type in which a `Mesh` keeps them.

    Parameters
    ----------
    points : ndarray, shape (n, 3), mm

    Returns
    -------
    ndarray, shape (n, 3), C-contiguous
        float32; float64 where they are not float32 already and lie so far from the origin that float32 would round
        them by more than 2e-4 mm, see `clrecon.geometry.precision`.
    """
    dtype = np.float64 if points.dtype != np.float32 and is_far(points) else np.float32
    return np.ascontiguousarray(points, dtype=dtype)


def rounding_step(vertices: NDArray[np.floating]) -> float:
    """Return the step, in mm, to which coordinates of vertices have been rounded.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), float32 or float64, mm

    Returns
    -------
    float
        The step of float32 at the largest coordinate.  float64 vertices were computed in float32 relative to a point
        near their centre: the step there.
    """
    if len(vertices) == 0:
        return 0.0
    low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
    largest = np.abs([low, high]).max() if vertices.dtype == np.float32 else 0.5 * (high - low).max()
    return float32_step(float(largest))


def find_coincident(vertices: NDArray[np.floating]) -> NDArray[np.int64]:
    """Find the vertices that coincide with another vertex.

    When a file without indices, such as STL, is read, these are joined: a surface that is closed by index can then be
    open.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), float32 or float64

    Returns
    -------
    ndarray, shape (k,), int64
        All vertices of each such place, in order of the place's coordinates.
    """
    # Sums of scrambled coordinates, as in count_duplicate_faces: only vertices with equal sums are compared in full.
    mixed = np.zeros(len(vertices), dtype=np.uint64)
    for column in vertices.T:
        bits = (column + column.dtype.type(0)).view(f"u{column.dtype.itemsize}")  # + 0 turns -0 into 0
        mixed = (mixed ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    ordered = np.sort(mixed)
    repeated = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(repeated) == 0:
        return np.zeros(0, dtype=np.int64)
    suspects = np.flatnonzero(np.isin(mixed, repeated))
    suspects = suspects[np.lexsort(vertices[suspects].T[::-1])]
    same = (vertices[suspects[1:]] == vertices[suspects[:-1]]).all(axis=1)
    return suspects[np.concatenate([same, [False]]) | np.concatenate([[False], same])]


def rounded_apart(vertices: NDArray[np.floating]) -> NDArray[np.float32]:
    """Round vertices to float32 so that no two coincide unless they did before.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), float32 or float64, mm

    Returns
    -------
    ndarray, shape (n, 3), float32
        The nearest values; where several vertices round to one place, all but the first are moved by steps of float32.
    """
    rounded = vertices.astype(np.float32)
    if vertices.dtype == np.float32:
        return rounded
    together = np.zeros(len(vertices), dtype=bool)
    together[find_coincident(vertices)] = True
    for turn in range(_MOST_STEPS_APART):
        meeting = find_coincident(rounded)
        meeting = meeting[~together[meeting]]
        again = np.concatenate([[False], (rounded[meeting[1:]] == rounded[meeting[:-1]]).all(axis=1)])
        going = meeting[again[: len(meeting)]]
        if len(going) == 0:
            break
        axis = (turn + np.arange(len(going))) % 3
        rounded[going, axis] = np.nextafter(rounded[going, axis], np.float32(np.inf))
    return rounded
