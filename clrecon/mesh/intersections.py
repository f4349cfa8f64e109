"""Self-intersections: triangles of a surface that cut each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.system.pieces import in_threads, local_origin
from clrecon.system.progress import Steps

__all__ = [
    "FindCrossings", "count_self_intersections", "find_beside", "find_changed_intersections", "find_self_intersections",
]  # fmt: skip

_CELLS_A_TRIANGLE = 8
"""Largest mean number of cells for a triangle; cells are enlarged until it holds."""

_PIECE = 1 << 16
"""Pairs of triangles in one cell that are examined together."""

_FEW = 0.05
"""Share of changed triangles up to which it is faster to search only around them."""

_CELLS_A_SIDE = 128
"""Coarse cells along the longest side of a surface."""

Float64Array = NDArray[np.float64]
FindCrossings = Callable[..., NDArray[np.int64]]
"""Finds pairs of triangles that cut each other, from the same arguments as `find_self_intersections`."""


def count_self_intersections(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> int:
    """Count the pairs of triangles that cut each other, see `find_self_intersections`."""
    return len(find_self_intersections(vertices, triangles))


def find_self_intersections(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    changed: NDArray[np.bool_] | None = None,
    *,
    steps: Steps | None = None,
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
    steps : Steps, optional
        Counts the triangles.

    Returns
    -------
    ndarray, shape (k, 2), int64
        Numbers of triangles.
    """
    if len(triangles) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    points = vertices[triangles.T]  # corner, triangle, axis
    points = points - local_origin(points.reshape(-1, 3))
    corners = np.ascontiguousarray(triangles.T)
    entries = _enter(*(np.ascontiguousarray(end.T) for end in (points.min(axis=0), points.max(axis=0))))
    pieces = entries.pieces()
    found = [np.zeros((0, 2), dtype=np.int64)] * (len(pieces) - 1)

    def work(where: slice) -> None:
        one, other = entries.overlapping(slice(pieces[where.start], pieces[where.start + 1]), changed)
        apart = np.ones(len(one), dtype=bool)
        for corner in corners:
            number = corner.take(one)
            for second in corners:
                apart &= number != second.take(other)
        one, other = one[apart], other[apart]
        if len(one) == 0:
            return
        cut = _cut(points[:, one], points[:, other])
        found[where.start] = np.column_stack([one[cut], other[cut]])

    def count(piece: slice) -> None:
        if steps is not None:
            first, end = (len(triangles) * n // len(found) for n in (piece.start, piece.stop))
            steps.take(end - first)

    in_threads(work, len(found), 1, count)
    return np.concatenate(found) if found else np.zeros((0, 2), dtype=np.int64)


def find_changed_intersections(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    changed: NDArray[np.bool_],
    find_crossings: FindCrossings = find_self_intersections,
) -> NDArray[np.int64]:
    """Find the pairs of triangles that cut each other and of which one has changed.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), mm
    triangles : ndarray, shape (m, 3), uint32
    changed : ndarray, shape (m,), bool
    find_crossings : callable
        `find_self_intersections`, or what finds the same elsewhere.  It is not needed where few have changed.

    Returns
    -------
    ndarray, shape (k, 2), int64
        As of `find_self_intersections`.
    """
    if not changed.any():
        return np.zeros((0, 2), dtype=np.int64)
    if np.count_nonzero(changed) > _FEW * len(triangles):
        return find_crossings(vertices, triangles, None if changed.all() else changed)
    rows = np.flatnonzero(find_beside(vertices, triangles, changed))
    return rows[find_self_intersections(vertices, triangles[rows], changed[rows])]


def find_beside(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], changed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find the changed triangles and those that can touch one of them: whose box shares a coarse cell with one.

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
    columns = np.ascontiguousarray(vertices.T)
    # "clip" avoids checking each index, which takes longer than the look-up.
    one, two, three = (columns.take(corner, axis=1, mode="clip") for corner in triangles.T.astype(np.intp))
    low, high = np.minimum(np.minimum(one, two), three), np.maximum(np.maximum(one, two), three)
    start = low.min(axis=1)[:, None]
    size = float((high.max(axis=1)[:, None] - start).max()) / _CELLS_A_SIDE or 1.0
    first, last = (((corner - start) / size).astype(np.int32) for corner in (low, high))
    # Of each box the number of cells with a changed triangle, from sums over all cells below and before (Crow 1984).
    _, cell = _enter_into_cells(first[:, changed], last[:, changed])
    sums = np.zeros(last.max(axis=1) + 2, dtype=np.int32)
    sums[tuple(cell + 1)] = 1
    for axis in range(3):
        np.cumsum(sums, axis=axis, out=sums)
    last += 1
    steps = np.array([sums.shape[1] * sums.shape[2], sums.shape[2], 1], dtype=np.int32)[:, None]
    x, y, z = zip(first * steps, last * steps, strict=True)
    count = np.zeros(len(triangles), dtype=np.int32)
    for corner in np.ndindex(2, 2, 2):
        here = sums.take(x[corner[0]] + y[corner[1]] + z[corner[2]], mode="clip")
        count += here if sum(corner) % 2 else -here
    return np.asarray(count > 0)


@dataclass(frozen=True)
class _Entries:
    """Triangles in the cells of a grid, those of a cell side by side: a triangle is in all cells that its box meets.

    Attributes
    ----------
    triangle : ndarray, shape (e,), int64
    cell : ndarray, shape (3, e), int32
    later : ndarray, shape (e,), int64
        Number of entries of the same cell that follow.
    low, high : ndarray, shape (3, e), float32, mm
        Box of the triangle, rounded outward.
    first : ndarray, shape (3, m), int32
        Lowest cell of each triangle.
    """

    triangle: NDArray[np.int64]
    cell: NDArray[np.int32]
    later: NDArray[np.int64]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    first: NDArray[np.int32]

    def pieces(self) -> NDArray[np.int64]:
        """Return the entries at which pieces of about `_PIECE` pairs begin, and the number of entries."""
        pairs = np.cumsum(self.later)
        begin = np.searchsorted(pairs, np.arange(0, int(pairs[-1]), _PIECE), side="right")
        return np.unique(np.append(begin, len(pairs)))

    def overlapping(
        self, where: slice, changed: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Find the pairs of triangles whose boxes overlap and that begin at one of these entries, each once."""
        count = self.later[where]
        here = np.repeat(np.arange(where.start, where.stop), count)
        there = np.arange(len(here)) - np.repeat(np.cumsum(count) - count, count) + here + 1
        if changed is not None:
            either = changed.take(self.triangle.take(here)) | changed.take(self.triangle.take(there))
            here, there = here[either], there[either]
        for low, high in zip(self.low, self.high, strict=True):
            overlap = low.take(here) <= high.take(there)
            overlap &= low.take(there) <= high.take(here)
            here, there = here[overlap], there[overlap]
        one, other = self.triangle.take(here), self.triangle.take(there)
        # Of the cells that both share, exactly one holds the lowest corner of the intersection of their boxes.
        once = np.ones(len(one), dtype=bool)
        for first, cell in zip(self.first, self.cell, strict=True):
            once &= np.maximum(first.take(one), first.take(other)) == cell.take(here)
        return one[once], other[once]


def _enter(low: Float64Array, high: Float64Array) -> _Entries:
    """Enter triangles, by their boxes of shape (3, m), into the cells of a grid."""
    start = low.min(axis=1)[:, None]
    size = float(np.median((high - low).max(axis=0))) or 1.0
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
    ends = np.append(np.flatnonzero(key[1:] != key[:-1]) + 1, len(key))
    later = np.repeat(ends, np.diff(ends, prepend=0)) - 1 - np.arange(len(key))
    below, above = np.nextafter(low.astype(np.float32), -np.inf), np.nextafter(high.astype(np.float32), np.inf)
    return _Entries(triangle, cell, later, below.take(triangle, axis=1), above.take(triangle, axis=1), first)


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
