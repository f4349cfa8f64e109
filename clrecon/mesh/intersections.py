"""Self-intersections: triangles of a surface that cut each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clrecon.system.pieces import chunks, local_origin

__all__ = ["count_self_intersections", "find_beside", "find_self_intersections"]

_CELLS_A_TRIANGLE = 8
"""Largest mean number of cells for a triangle; cells are enlarged until it holds."""

_PIECE = 1 << 14

_FEW = 0.05
"""Share of changed triangles up to which it is faster to search only around them."""

Float64Array = NDArray[np.float64]
Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]


def count_self_intersections(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> int:
    """Count the pairs of triangles that cut each other, see `find_self_intersections`."""
    return len(find_self_intersections(vertices, triangles))


def find_self_intersections(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], changed: NDArray[np.bool_] | None = None
) -> NDArray[np.int64]:
    """Find the pairs of triangles that cut each other.

    Two triangles cut each other when an edge of one passes through the inside of the other (Moeller 1997 for the
    general case). Pairs that share a vertex are not examined, and pairs that touch or lie in one plane do not count.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32
    changed : ndarray, shape (m,), bool, optional
        Only pairs with one of these are examined.

    Returns
    -------
    ndarray, shape (k, 2), int64
        Numbers of triangles.
    """
    found = [np.zeros((0, 2), dtype=np.int64)]
    if len(triangles):
        points = (vertices - local_origin(vertices))[triangles.T]  # corner, triangle, axis
        low, high = (np.ascontiguousarray(end.T) for end in (points.min(axis=0), points.max(axis=0)))
        corners = np.ascontiguousarray(triangles.T)
        for one, other in _neighbours(low, high):
            if changed is not None:
                looked_at = changed.take(one) | changed.take(other)
                one, other = one[looked_at], other[looked_at]
            for axis in range(3):
                overlap = low[axis].take(one) <= high[axis].take(other)
                overlap &= low[axis].take(other) <= high[axis].take(one)
                one, other = one[overlap], other[overlap]
            apart = np.ones(len(one), dtype=bool)
            for corner in corners:
                number = corner.take(one)
                for second in corners:
                    apart &= number != second.take(other)
            one, other = one[apart], other[apart]
            for where in chunks(len(one), _PIECE):
                cut = _cut(points[:, one[where]], points[:, other[where]])
                found.append(np.column_stack([one[where][cut], other[where][cut]]))
    return np.concatenate(found)


def find_beside(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], changed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find the changed triangles and those that can touch one of them.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32
    changed : ndarray, shape (m,), bool

    Returns
    -------
    ndarray, shape (m,), bool
    """
    if np.count_nonzero(changed) > _FEW * len(triangles):
        return np.ones(len(triangles), dtype=bool)
    if not changed.any():
        return changed
    from scipy.spatial import cKDTree

    corners = vertices[triangles]
    centres = corners.mean(axis=1, dtype=np.float64)
    reach = 2.0 * float(np.linalg.norm(corners - centres[:, None], axis=2).max())
    return np.isfinite(cKDTree(centres[changed]).query(centres, distance_upper_bound=reach, workers=-1)[0])


def _neighbours(low: Float64Array, high: Float64Array) -> Iterator[Pairs]:
    """Find pairs of triangles whose boxes, shape (3, m), share a cell of a grid, each pair once."""
    start = low.min(axis=1)[:, None]
    size = 1.5 * float(np.median((high - low).max(axis=0))) or 1.0
    while True:
        first, last = ((corner - start) // size for corner in (low, high))
        cells = (last - first + 1).prod(axis=0)
        if cells.sum() <= _CELLS_A_TRIANGLE * low.shape[1]:
            break
        size *= 1.25
    first, last = first.astype(np.int32), last.astype(np.int32)
    triangle, cell = _enter_into_cells(first, last)
    shape = cell.max(axis=1).astype(np.int64) + 1
    key = (cell[2] * shape[1] + cell[1]) * shape[0] + cell[0]
    order = np.argsort(key, kind="stable")
    key, triangle, cell = key[order], triangle[order], cell[:, order]
    places = np.arange(len(key))
    step = 0
    while len(places):
        step += 1
        places = places[: np.searchsorted(places, len(key) - step)]
        places = places[key.take(places) == key.take(places + step)]
        for where in chunks(len(places), 1 << 16):
            here = places[where]
            one, other = triangle.take(here), triangle.take(here + step)
            # Of the cells that both share, exactly one holds the lowest corner of the intersection of their boxes.
            for axis in range(3):
                both = np.maximum(first[axis].take(one), first[axis].take(other))
                once = both == cell[axis].take(here)
                here, one, other = here[once], one[once], other[once]
            yield one, other


def _enter_into_cells(first: NDArray[np.int32], last: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """List all cells that each triangle's box, shape (3, m), meets: triangle, shape (e,), and cell, shape (3, e)."""
    span = last - first + 1
    count = span.prod(axis=0, dtype=np.int64)
    triangle = np.repeat(np.arange(first.shape[1]), count)
    number = (np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)).astype(np.int32)
    cell = first.take(triangle, axis=1)
    for axis in range(3):
        along = span[axis].take(triangle)
        cell[axis] += number % along
        number //= along
    return triangle, cell


def _cut(one: Float64Array, other: Float64Array) -> NDArray[np.bool_]:
    """True where an edge of one triangle passes through the inside of the other; corners have shape (3, k, 3)."""
    found = np.zeros(one.shape[1], dtype=bool)
    rows = np.arange(one.shape[1])
    for _ in range(2):
        sides = np.stack([_volume(other[0], other[1], other[2], corner) for corner in one])
        # A triangle wholly on one side of the other's plane cannot have edges that cut the other.
        astride = (sides > 0.0).any(axis=0) & (sides < 0.0).any(axis=0)
        rows, one, other, sides = rows[astride], one[:, astride], other[:, astride], sides[:, astride]
        for a, b in ((0, 1), (1, 2), (2, 0)):
            through = np.flatnonzero(((sides[a] > 0.0) & (sides[b] < 0.0)) | ((sides[a] < 0.0) & (sides[b] > 0.0)))
            p, q = one[a][through], one[b][through]
            turns = [_volume(p, q, other[c][through], other[(c + 1) % 3][through]) for c in range(3)]
            inside = np.all([turn > 0.0 for turn in turns], axis=0) | np.all([turn < 0.0 for turn in turns], axis=0)
            found[rows[through]] |= inside
        one, other = other, one
    return found


def _volume(a: Float64Array, b: Float64Array, c: Float64Array, d: Float64Array) -> Float64Array:
    """Return six times the signed volume of a tetrahedron."""
    (px, py, pz), (qx, qy, qz), (rx, ry, rz) = ((corner - a).T for corner in (b, c, d))
    return px * (qy * rz - qz * ry) + py * (qz * rx - qx * rz) + pz * (qx * ry - qy * rx)
