"""Self-intersections: triangles of a surface that cut each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.mesh.triangles import corner_edges, cross_product
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads, local_origin
from clrecon.system.progress import Steps

_CELLS_A_TRIANGLE = 8
"""Largest mean number of cells for a triangle; cells are enlarged until it holds."""

_PIECE = 1 << 16
"""Pairs of triangles in one cell that are examined together."""

_FEW = 0.05
"""Share of changed triangles up to which it is faster to search only around them."""

_FEWEST_CELLS = 1 << 12
_MOST_CELLS = 1 << 22
_CELLS_FOR_ONE = 64
"""Coarse cells of a surface: so many for a triangle within these bounds, and none smaller than changed ones are."""

_ROUNDING = 2.0**-50
"""Share of the sum of its absolute terms that the rounding of a volume or an area does not reach (Shewchuk 1997)."""


def find_self_intersections(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    changed: NDArray[np.bool_] | None = None,
    *,
    steps: Steps | None = None,
) -> NDArray[np.int64]:
    """Find the pairs of triangles, shape (k, 2), that cut each other, as CGAL counts them.

    Two triangles cut each other when they have a point in common, touch or overlap in one plane.  Of two with a common
    corner only the edges opposite to it can reach the other triangle.  Two with a common edge cut each other when they
    lie in one plane on the same side of it.  Corners at the same place are common; triangles with three common corners,
    without area, or with a corner that is not finite, are left out.  The signs of all volumes and areas are exact.

    changed: Only pairs with one of these triangles are examined.
    """
    sound = np.isfinite(vertices).all(axis=1)
    if not sound.all():
        vertices = np.where(sound[:, None], vertices, 0.0)
    if len(triangles) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    columns = np.ascontiguousarray((vertices - local_origin(vertices)).T)
    corners = np.ascontiguousarray(triangles.T)
    points = [columns.take(corner, axis=1) for corner in corners]
    planes = _Planes.of(vertices, triangles, points)
    has_area = np.asarray(planes.normal.any(axis=0))
    flat = np.flatnonzero(~has_area)
    has_area[flat] = _has_area(vertices[triangles[flat].T].astype(np.float64))
    if not (sound.all() and has_area.all()):  # thousands at one place would all be paired
        rows = np.flatnonzero(has_area & sound[triangles].all(axis=1))
        changed = None if changed is None else changed[rows]
        if steps is not None:
            steps.take(len(triangles) - len(rows))
        return rows[find_self_intersections(vertices, triangles[rows], changed, steps=steps)]
    entries = _enter(np.minimum.reduce(points), np.maximum.reduce(points))
    pieces = entries.pieces()
    close = [np.zeros((0, 2), dtype=np.int64)] * (len(pieces) - 1)

    def pair_entries(span: slice) -> None:
        left, right = entries.overlapping(slice(pieces[span.start], pieces[span.start + 1]), changed)
        common = np.zeros(len(left), dtype=np.int8)
        for corner in corners:
            number = corner.take(left)
            for second in corners:
                common += number == second.take(right)
        close[span.start] = np.column_stack(planes.not_apart(points, left, right, common))

    def count_piece(piece: slice) -> None:
        if steps is not None:
            first, end = (len(triangles) * n // len(close) for n in (piece.start, piece.stop))
            steps.take(end - first)

    in_threads(pair_entries, len(close), 1, count_piece)
    return _leave_cut(vertices, triangles, np.concatenate(close)) if close else np.zeros((0, 2), dtype=np.int64)


def _leave_cut(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], pairs: NDArray[np.int64]
) -> NDArray[np.int64]:
    cut = np.zeros(len(pairs), dtype=bool)

    def test_pairs(span: slice) -> None:
        corners = triangles[pairs[span].T].transpose(0, 2, 1)  # of which triangle, corner, pair
        left, right = vertices[corners].astype(np.float64)
        rows = np.flatnonzero(_cut_pairs(left, right, corners[0][:, None] == corners[1]))
        # Corners at one place count as the same: only pairs that cut each other otherwise can have some.
        left, right = vertices[corners[:, :, rows]].astype(np.float64)
        rows = rows[_cut_pairs(left, right, (left[:, None] == right).all(axis=3)) & _has_area(left) & _has_area(right)]
        cut[span.start + rows] = True

    in_threads(test_pairs, len(pairs), _PIECE)
    return pairs[cut]


def find_changed_intersections(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], changed: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Find the pairs of triangles that cut each other of which one changed."""
    if not changed.any():
        return np.zeros((0, 2), dtype=np.int64)
    if np.count_nonzero(changed) > _FEW * len(triangles):
        return find_self_intersections(vertices, triangles, None if changed.all() else changed)
    rows = np.flatnonzero(find_beside(vertices, triangles, changed))
    return rows[find_self_intersections(vertices, triangles[rows], changed[rows])]


def find_beside(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], changed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find the changed triangles and those that can touch one of them: whose box shares a coarse cell with one."""
    low, high = find_boxes(vertices, triangles)
    return find_boxes_beside(low, high, low[changed], high[changed])


def find_boxes(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the lowest and the highest coordinates of each triangle, shape (m, 3)."""
    low, high = (np.empty((3, len(triangles)), vertices.dtype).T for _ in range(2))  # columns are looked at

    def bound_triangles(span: slice) -> None:
        first, two, three = (vertices.take(corners, axis=0) for corners in triangles[span].T)
        np.minimum(np.minimum(first, two), three, out=low[span])
        np.maximum(np.maximum(first, two), three, out=high[span])

    in_threads(bound_triangles, len(triangles))
    return low, high


def find_boxes_beside(
    low: NDArray[np.floating],
    high: NDArray[np.floating],
    some_low: NDArray[np.floating],
    some_high: NDArray[np.floating],
) -> NDArray[np.bool_]:
    """Find the boxes, shape (m, 3), that share a coarse cell with one of some, which lie within all of them."""
    if len(some_low) == 0:
        return np.zeros(len(low), dtype=bool)
    low, high, some_low, some_high = (np.ascontiguousarray(corner.T) for corner in (low, high, some_low, some_high))
    start = low.min(axis=1)[:, None]
    length = high.max(axis=1).astype(np.float64) - start[:, 0]
    size = float((some_high - some_low).max(axis=0).mean()) or float(length.max()) or 1.0
    most = min(max(_CELLS_FOR_ONE * min(low.shape[1], 8 * some_low.shape[1]), _FEWEST_CELLS), _MOST_CELLS)
    while (length / size + 1.0).prod() > most:
        size *= 1.25
    first, last, some_first, some_last = (
        ((corner - start) / size).astype(np.int32) for corner in (low, high, some_low, some_high)
    )
    # Of each box the number of cells with one of some, from sums over all cells below and before (Crow 1984).
    _, cell = _enter_into_cells(some_first, some_last)
    sums = np.zeros(last.max(axis=1) + 2, dtype=np.int32)
    sums[tuple(cell + 1)] = 1
    for axis in range(3):
        np.cumsum(sums, axis=axis, out=sums)
    last += 1
    steps = np.array([sums.shape[1] * sums.shape[2], sums.shape[2], 1], dtype=np.int32)[:, None]
    x, y, z = zip(first * steps, last * steps, strict=True)
    count = np.zeros(low.shape[1], dtype=np.int32)
    for corner in np.ndindex(2, 2, 2):
        here = sums.take(x[corner[0]] + y[corner[1]] + z[corner[2]], mode="clip")
        count += here if sum(corner) % 2 else -here
    return np.asarray(count > 0)


@dataclass(frozen=True)
class _Entries:
    """Triangles in the cells of a grid, those of a cell side by side: a triangle is in all cells that its box meets.

    triangle: ndarray, shape (e,), int64
    cell: ndarray, shape (3, e), int32
    later: Number of entries of the same cell that follow.
    low, high: ndarray, shape (3, e), float32, mm. Box of the triangle, rounded outward.
    first: ndarray, shape (3, m), int32. Lowest cell of each triangle.
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
        self, span: slice, changed: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Find the pairs of triangles whose boxes overlap and that begin at one of these entries, each once."""
        count = self.later[span]
        here = np.repeat(np.arange(span.start, span.stop), count)
        there = np.arange(len(here)) - np.repeat(np.cumsum(count) - count, count) + here + 1
        if changed is not None:
            either = changed.take(self.triangle.take(here)) | changed.take(self.triangle.take(there))
            here, there = here[either], there[either]
        for low, high in zip(self.low, self.high, strict=True):
            overlap = low.take(here) <= high.take(there)
            overlap &= low.take(there) <= high.take(here)
            here, there = here[overlap], there[overlap]
        left, right = self.triangle.take(here), self.triangle.take(there)
        # Of the cells that both share, exactly one holds the lowest corner of the intersection of their boxes.
        once = np.ones(len(left), dtype=bool)
        for first, cell in zip(self.first, self.cell, strict=True):
            once &= np.maximum(first.take(left), first.take(right)) == cell.take(here)
        return left[once], right[once]


@dataclass(frozen=True)
class _Planes:
    """Planes (3, m) of triangles: a corner x is surely above if normal . x - offset > slack, below if < -slack."""

    normal: Float64Array
    offset: Float64Array
    slack: Float64Array

    @classmethod
    def of(
        cls, vertices: NDArray[np.floating], triangles: NDArray[np.uint32], points: Sequence[Float64Array]
    ) -> _Planes:
        """Return the planes of triangles whose corners, relative to one origin, are `points`, three of shape (3, m)."""
        normal, slack = np.empty((3, len(triangles))), np.empty(len(triangles))
        farthest = max(float(np.abs(corner).max()) for corner in points)
        for piece, _, p, q in corner_edges(vertices, triangles, np.zeros(3)):
            normal[:, piece] = cross_product(p, q)
            slack[piece] = 2.0**-46 * farthest * np.abs(p).sum(axis=0) * np.abs(q).sum(axis=0)
        return cls(normal, np.einsum("am,am->m", normal, points[0]), slack)

    def not_apart(
        self,
        points: Sequence[Float64Array],
        left: NDArray[np.int64],
        right: NDArray[np.int64],
        common: NDArray[np.int8],
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Leave out pairs of which one, but for its common corners, lies surely on one side of the other's plane."""
        for _ in range(2):
            normal, offset = self.normal.take(right, axis=1), self.offset.take(right)
            slack = self.slack.take(right)
            above, below = common.copy(), common.copy()
            for corner in points:
                side = -offset
                for along, row in zip(normal, corner, strict=True):
                    side += along * row.take(left)
                above += side > slack
                below += side < -slack
            near = np.flatnonzero((above != 3) & (below != 3))
            left, right = right.take(near), left.take(near)
            common = common.take(near)
        return left, right


def _enter(low: Float64Array, high: Float64Array) -> _Entries:
    """Enter triangles, by their boxes of shape (3, m), into the cells of a grid."""
    start = low.min(axis=1)[:, None]
    size = float(np.median((high - low).max(axis=0))) or 1.0
    first, last = ((corner - start) // size for corner in (low, high))
    while (last - first + 1).prod(axis=0).sum() > _CELLS_A_TRIANGLE * low.shape[1]:
        size *= 1.25
        first, last = ((corner - start) // size for corner in (low, high))
    first, last = first.astype(np.int32), last.astype(np.int32)
    triangle, cell = _enter_into_cells(first, last)
    shape = cell.max(axis=1).astype(np.int64) + 1
    key = (cell[2] * shape[1] + cell[1]) * shape[0] + cell[0]
    order = np.argsort(key, kind="stable")
    key, triangle = key.take(order), triangle.take(order)
    cell = cell.take(order, axis=1)  # rows side by side
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


def _cut_pairs(left: Float64Array, right: Float64Array, same: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True where triangles cut each other; corners have shape (3, k, 3), and `same` (3, 3, k) says which are one."""
    is_cut = np.zeros(left.shape[1], dtype=bool)
    common = same.sum(axis=(0, 1))
    rows = np.flatnonzero(common == 0)
    is_cut[rows] = _meet(left[:, rows], right[:, rows])
    for count, meet in ((1, partial(_meet, edges=((1, 2),))), (2, _fold)):
        rows = np.flatnonzero(common == count)
        # First comes the common corner, or the one that is not common.
        first = [(same[:, :, rows].any(axis=axis) == (count == 1)).argmax(axis=0) for axis in (1, 0)]
        order = [(np.arange(3)[:, None] + start) % 3 for start in first]
        is_cut[rows] = meet(left[order[0], rows], right[order[1], rows])
    return is_cut


def _meet(
    left: Float64Array, right: Float64Array, edges: tuple[tuple[int, int], ...] = ((0, 1), (1, 2), (2, 0))
) -> NDArray[np.bool_]:
    """True where one of these edges of either triangle has a point of the other triangle."""
    meets = np.zeros(left.shape[1], dtype=bool)
    rows = np.arange(left.shape[1])
    ends = sorted(set(chain(*edges)))
    for _ in range(2):
        sides = np.zeros((3, len(rows)), dtype=np.int8)
        for end in ends:
            sides[end] = _side(right[0], right[1], right[2], left[end])
        # A triangle wholly on one side of the other's plane cannot meet the other.
        astride = (sides[ends] <= 0).any(axis=0) & (sides[ends] >= 0).any(axis=0)
        rows, left = rows[astride], left[:, astride]
        right, sides = right[:, astride], sides[:, astride]
        for a, b in edges:
            through = np.flatnonzero((sides[a] * sides[b] <= 0) & (sides[a] != sides[b]))
            p, q = left[a][through], left[b][through]
            turns = np.array([_side(p, q, right[c][through], right[(c + 1) % 3][through]) for c in range(3)])
            meets[rows[through]] |= (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
            within = np.flatnonzero((sides[a] == 0) & (sides[b] == 0))
            meets[rows[within]] |= _meet_in_plane(left[a][within], left[b][within], right[:, within])
        left, right = right, left
    return meets


def _fold(left: Float64Array, right: Float64Array) -> NDArray[np.bool_]:
    """True where triangles with a common edge, opposite to their first corners, lie in one plane on one side of it."""
    folds = _side(left[0], left[1], left[2], right[0]) == 0
    rows = np.flatnonzero(folds)
    axis = _steepest(left[:, rows])
    u, v, third, its = (_project(corner[rows], axis) for corner in (left[1], left[2], left[0], right[0]))
    folds[rows] = _turn(u, v, third) * _turn(u, v, its) > 0
    return folds


def _meet_in_plane(p: Float64Array, q: Float64Array, triangle: Float64Array) -> NDArray[np.bool_]:
    """True where edges from p to q have a point of the triangle in whose plane they lie."""
    axis = _steepest(triangle)
    p, q, *corners = (_project(points, axis) for points in (p, q, *triangle))
    turns = np.array([_turn(p, q, corner) for corner in corners])
    apart = (turns > 0).all(axis=0) | (turns < 0).all(axis=0)
    inside = _turn(*corners)
    for u, v in ((0, 1), (1, 2), (2, 0)):
        apart |= np.all([_turn(corners[u], corners[v], end) * inside < 0 for end in (p, q)], axis=0)
    return np.asarray(~apart)


def _has_area(triangle: Float64Array) -> NDArray[np.bool_]:
    """True for triangles, shape (3, k, 3), whose corners do not lie on one line."""
    axes = np.arange(3)[:, None] * np.ones(triangle.shape[1], dtype=np.int64)
    return np.any([_turn(*(_project(corner, axis) for corner in triangle)) != 0 for axis in axes], axis=0)


def _steepest(triangle: Float64Array) -> NDArray[np.int64]:
    """Return the axis, shape (k,), along which each triangle, shape (3, k, 3), looks largest."""
    return np.abs(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])).argmax(axis=1)


def _project(points: Float64Array, axis: NDArray[np.int64]) -> Float64Array:
    """Return the two other coordinates of points, shape (k, 3), as rows of shape (2, k)."""
    row = np.arange(len(points))
    return np.stack([points[row, (axis + 1) % 3], points[row, (axis + 2) % 3]])


def _turn(a: Float64Array, b: Float64Array, c: Float64Array) -> NDArray[np.int8]:
    """Return on which side of the line from a to b, shape (2, k), c lies: -1, 0 or 1, exactly."""
    return _sign(_area, a, b, c)


def _side(a: Float64Array, b: Float64Array, c: Float64Array, d: Float64Array) -> NDArray[np.int8]:
    """Return on which side of the plane through a, b and c, shape (k, 3), d lies: -1, 0 or 1, exactly."""
    return _sign(_volume, a.T, b.T, c.T, d.T)


def _sign(measure: Callable[..., tuple[Any, Any]], *points: Float64Array) -> NDArray[np.int8]:
    """Return the sign of a measure, exactly: where it is small beside the sum of its terms, from whole numbers."""
    value, terms = measure(*points)
    sign = np.sign(value).astype(np.int8)
    unsure = np.flatnonzero(np.abs(value) < _ROUNDING * terms)
    if len(unsure):
        part, power = np.frexp(np.stack(points)[..., unsure])
        whole = np.ldexp(part, 53).astype(np.int64).astype(object) << (power - power.min()).astype(object)
        sign[unsure] = np.sign(measure(*whole)[0]).astype(np.int8)
    return sign


def _area(a: Any, b: Any, c: Any) -> tuple[Any, Any]:
    """Return twice the signed area of a triangle, and the sum of its absolute terms."""
    (px, py), (qx, qy) = b - a, c - a
    return px * qy - py * qx, abs(px * qy) + abs(py * qx)


def _volume(a: Any, b: Any, c: Any, d: Any) -> tuple[Any, Any]:
    """Return six times the signed volume of a tetrahedron, and the sum of its absolute terms."""
    (px, py, pz), (qx, qy, qz) = b - a, c - a
    rx, ry, rz = d - a
    x, y = (qy * rz, qz * ry), (qz * rx, qx * rz)
    z = (qx * ry, qy * rx)
    value = px * (x[0] - x[1]) + py * (y[0] - y[1]) + pz * (z[0] - z[1])
    return value, sum(abs(p) * (abs(one) + abs(other)) for p, (one, other) in zip((px, py, pz), (x, y, z), strict=True))
