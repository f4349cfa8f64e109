"""Search for triangles of a surface by place: the nearest to each point, the first on each line.

A tree of boxes (Ericson 2005, chapter 6): triangles in the order of a curve through space (Morton 1966), some to a
leaf, `_FAN` boxes to the next above.  Points and lines go down it together, level by level.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.triangles import cross_product
from clrecon.system.pieces import find_bounds, in_threads

_LEAF, _FAN = 2, 8
"""Triangles in a leaf, and boxes in a node."""

_STARTS = 3
"""Leaves beside a point on the curve that are looked at first: with three a fifth as many are near as with one."""

_MANY = 8
"""Boxes for each point from which on it pays to ask in which of them the surface surely is near."""

PIECE, MOST_PAIRS = 1 << 11, 1 << 18
"""Points that go down together, and pairs of a point and a box beyond which they part: each point far from a surface is
about as near to many of its boxes."""

_CURVE_BITS = 10
"""Bits of a place along each axis, by which triangles are put in order."""

_REACHES = (1 / 64, 1 / 16, 1 / 4, 1.0)
"""Shares of a line that are searched in turn: the first triangle is near, most boxes on the line are not."""

_LEAST_SINE = 1e-5
"""Sine of the angle between two edges below which a triangle is as good as its edges: its plane is not known."""

BESIDE = 1e-9
"""Share of a triangle by which a line may miss it: no line passes between two triangles with a common edge."""

Points = NDArray[np.float64]
Columns = NDArray[np.float64]
"""Shape (3, k): one row each for x, y, z."""


class TriangleTree:
    """The tree of a surface with at least one triangle.

    vertices: ndarray, shape (n, 3). mm, near zero: digits of coordinates far from it are lost.
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]):
        self._columns = np.ascontiguousarray(vertices.T, dtype=np.float64)
        self._triangles = triangles
        # Rounded outwards: no triangle is left out for the digits of its box.
        lows, highs = np.empty((2, 3, len(triangles)), np.float32)
        middles = np.empty_like(lows)  # twice as far from zero

        def bound_piece(piece: slice) -> None:
            corners = triangles[piece].T.astype(np.intp)
            for axis, column in enumerate(self._columns):
                a, b, c = column.take(corners, mode="clip")
                low, high = lows[axis, piece], highs[axis, piece]
                np.nextafter(np.minimum(np.minimum(a, b), c), -np.inf, out=low, dtype=np.float32)
                np.nextafter(np.maximum(np.maximum(a, b), c), np.inf, out=high, dtype=np.float32)
                np.add(low, high, out=middles[axis, piece])

        in_threads(bound_piece, len(triangles))
        self._slack = 2.0 * float(np.spacing(np.abs(lows).max() + np.abs(highs).max()))
        self._curve = Curve(middles)
        codes = np.empty(len(triangles), np.uint32)

        def place_piece(piece: slice) -> None:
            codes[piece] = self._curve.codes(middles[:, piece])

        in_threads(place_piece, len(triangles))
        order = np.argsort(codes, kind="stable")  # mostly in order already
        order = np.concatenate([order, np.full(-len(order) % _LEAF, order[-1])])
        self._rows, self._firsts = order.reshape(-1, _LEAF), codes[order[::_LEAF]]
        of_leaves = np.ascontiguousarray(self._rows.T)  # numpy takes the least along a short last axis slowly
        lows = np.array([column.take(of_leaves).min(axis=0) for column in lows])
        highs = np.array([column.take(of_leaves).max(axis=0) for column in highs])
        self._levels: list[NDArray[np.float32]] = []
        while not self._levels or len(self._levels[0]) > 1:
            empty = ((0, 0), (0, -lows.shape[1] % _FAN))
            lows = np.pad(lows, empty, constant_values=np.inf).reshape(3, -1, _FAN)
            highs = np.pad(highs, empty, constant_values=-np.inf).reshape(3, -1, _FAN)
            self._levels.insert(0, np.ascontiguousarray(np.concatenate([lows, highs]).swapaxes(0, 1)))
            lows, highs = lows.min(axis=2), highs.max(axis=2)

    def nearest(self, points: Points) -> tuple[Points, NDArray[np.int64], NDArray[np.float64]]:
        """Return the nearest places of the surface (k, 3), the rows of their triangles and the distances in mm."""
        places, rows = np.empty((len(points), 3)), np.empty(len(points), np.int64)
        squares = np.empty(len(points))

        def search_piece(piece: slice) -> None:
            places[piece], rows[piece], squares[piece] = self._find_nearest(points[piece])

        in_threads(search_piece, len(points), PIECE)
        return places, rows, np.sqrt(squares)

    def first_hits(self, starts: Points, ends: Points) -> Points:
        """Return where lines from `starts` to `ends`, shape (k, 3), first meet the surface; NaN where they do not."""
        shares = np.full(len(starts), np.inf)

        def follow_piece(piece: slice) -> None:
            for reach in _REACHES:
                left = np.flatnonzero(np.isinf(shares[piece]))
                lines = starts[piece][left], ends[piece][left] - starts[piece][left]
                shares[piece][left] = self._find_first(*lines, reach)

        in_threads(follow_piece, len(starts), PIECE)
        return np.where(np.isinf(shares), np.nan, shares)[:, None] * (ends - starts) + starts

    def _find_nearest(self, points: Points) -> tuple[Points, NDArray[np.int64], NDArray[np.float64]]:
        columns, count = np.ascontiguousarray(points.T), len(points)
        nearest = np.empty((count, 3)), np.empty(count, np.int64), np.full(count, np.inf)

        def look_at(items: NDArray[np.intp], leaves: NDArray[np.intp]) -> None:
            candidates = self._measure(columns[:, items], leaves)
            here, best = _least_of(items, candidates[2])
            nearer = candidates[2][best] < nearest[2][here]
            for values, others in zip(nearest, candidates, strict=True):
                values[here[nearer]] = others[best[nearer]]

        ahead = np.searchsorted(self._firsts, self._curve.codes(2.0 * columns), side="right")
        starts = np.clip(ahead[:, None] - np.arange(_STARTS), 0, len(self._rows) - 1)
        look_at(np.arange(count).repeat(_STARTS), starts.ravel())
        pairs = self._descend(
            lambda items, boxes: _squares_to_boxes(columns[:, items], boxes),
            nearest[2].copy(),
            lambda items, boxes: _squares_to_contents(columns[:, items], boxes, self._slack),
        )
        if pairs is None:
            halves = [self._find_nearest(half) for half in np.array_split(points, 2)]
            places, rows, squares = (np.concatenate(both) for both in zip(*halves, strict=True))
            return places, rows, squares
        items, leaves, bounds = pairs
        near = bounds < nearest[2][items]
        look_at(items[near], leaves[near])
        return nearest

    def _measure(
        self, columns: Columns, leaves: NDArray[np.intp]
    ) -> tuple[Points, NDArray[np.int64], NDArray[np.float64]]:
        """Return the places nearest to points on the triangles of one leaf each, with rows and squares."""
        rows = self._rows[leaves].reshape(-1)
        a, b, c = self._corners(rows)
        b -= a
        c -= a
        away = (columns[:, :, None] - a.reshape(3, -1, _LEAF)).reshape(3, -1)
        u, v, gain = nearest_shares(away, b, c)
        gain += np.einsum("ij,ij->j", away, away)
        best = _LEAF * np.arange(len(leaves)) + gain.reshape(-1, _LEAF).argmin(axis=1)
        places = a[:, best] + u[best] * b[:, best] + v[best] * c[:, best]
        away = columns - places
        return places.T, rows[best], np.einsum("ij,ij->j", away, away)

    def _corners(self, rows: NDArray[np.intp]) -> tuple[Columns, ...]:
        return tuple(self._columns.take(corner, axis=1, mode="clip") for corner in self._triangles.take(rows, axis=0).T)

    def _find_first(self, starts: Points, ways: Points, reach: float) -> NDArray[np.float64]:
        """Return the share of each way at which a line first meets the surface, infinity beyond `reach`."""
        begin, direction = np.ascontiguousarray(starts.T), np.ascontiguousarray(ways.T)
        direction[direction == 0.0] = np.finfo(float).tiny
        pairs = self._descend(
            lambda items, boxes: _enter_boxes(begin[:, items], direction[:, items], boxes), np.full(len(starts), reach)
        )
        if pairs is None:
            halves = zip(np.array_split(starts, 2), np.array_split(ways, 2), strict=True)
            return np.concatenate([self._find_first(*half, reach) for half in halves])
        items, rows = pairs[0].repeat(_LEAF), self._rows[pairs[1]].reshape(-1)
        a, b, c = self._corners(rows)
        shares = _shares_of_lines(begin[:, items], ways.T[:, items], a, b - a, c - a)
        shares[~(shares <= reach)] = np.inf
        first_shares = np.full(len(starts), np.inf)
        items, best = _least_of(items, shares)
        first_shares[items] = shares[best]
        return first_shares

    def _descend(
        self,
        lowest: Callable[[NDArray[np.intp], NDArray[np.float32]], NDArray[np.float64]],
        limits: NDArray[np.float64],
        highest: Callable[[NDArray[np.intp], NDArray[np.float32]], NDArray[np.float64]] | None = None,
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]] | None:
        """Return pairs of an item and a leaf, in the order of items, and their bounds; None: too many for one piece.

        lowest: Bounds of items in the boxes (k, 6, `_FAN`) of a node, which they go down where these are below limits.
        highest: Bounds for boxes (k, 6) below which they surely hold an answer: no limit needs to be higher.
        """
        items = np.arange(len(limits))
        nodes, bounds = np.zeros(len(limits), np.intp), np.zeros(len(limits))
        for level in self._levels:
            boxes = level.take(nodes, axis=0)
            every = lowest(items, boxes)
            near = np.flatnonzero(every <= limits.take(items)[:, None])
            pair, child = near // _FAN, near % _FAN
            items = items.take(pair)
            nodes = _FAN * nodes.take(pair) + child
            bounds = every.ravel().take(near)
            if highest is not None and len(items) > _MANY * len(limits):
                some, best = _least_of(items, far := highest(items, boxes[pair, :, child]))
                limits[some] = np.minimum(limits[some], far[best])
            if len(items) > MOST_PAIRS and len(limits) > 1:
                return None
        return items, nodes, bounds


class Curve:
    """A Morton curve through the box around points (3, k)."""

    def __init__(self, columns: NDArray[np.floating]):
        self._low, high = (end[:, None] for end in find_bounds(columns.T))
        size = np.where(high > self._low, high - self._low, np.inf)
        self._steps = (2**_CURVE_BITS - 1) / size
        number = np.arange(2**_CURVE_BITS, dtype=np.uint32)
        self._spread = np.bitwise_or.reduce([(number >> bit & 1) << 3 * bit for bit in range(_CURVE_BITS)])

    def codes(self, columns: NDArray[np.floating]) -> NDArray[np.uint32]:
        """Return the place on the curve of each point, (k,); of those beside the box that of its border."""
        codes = np.zeros(columns.shape[1], np.uint32)
        for axis, column in enumerate(columns):
            cells = np.clip((column - self._low[axis]) * self._steps[axis], 0, 2**_CURVE_BITS - 1)
            codes |= self._spread[cells.astype(np.intp)] << np.uint32(axis)
        return codes


def _squares_to_boxes(columns: NDArray[np.floating], boxes: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return squared distances (k, `_FAN`) of points (3, k) from boxes (k, 6, `_FAN`); infinity for empty ones."""
    squares = np.zeros((len(boxes), _FAN))
    for axis, column in enumerate(columns):
        away = boxes[:, axis] - column[:, None]
        np.maximum(away, column[:, None] - boxes[:, axis + 3], out=away)
        np.maximum(away, 0.0, out=away)
        squares += np.square(away, out=away)
    return squares


def _squares_to_contents(columns: Columns, boxes: NDArray[np.float32], slack: float) -> NDArray[np.float64]:
    """Return squared distances (k,) from points (3, k) within which boxes (k, 6) surely have a place of the surface.

    Each face of a box touches a triangle, to `slack` mm.  So the nearer face along an axis has a place, at most as far
    across that axis as the farthest corner (Roussopoulos, Kelley and Vincent 1995).
    """
    to_low = np.abs(columns - boxes[:, :3].T)
    to_high = np.abs(columns - boxes[:, 3:].T)
    near, far = np.minimum(to_low, to_high) + slack, np.maximum(to_low, to_high)
    far *= far
    near *= near
    near -= far
    return np.minimum(np.minimum(near[0], near[1]), near[2]) + (far[0] + far[1] + far[2])


def _enter_boxes(begin: Columns, direction: Columns, boxes: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the share of its way at which each line (3, k) enters boxes (k, 6, `_FAN`), infinity if it does not."""
    enter, leave = np.zeros((len(boxes), _FAN)), np.full((len(boxes), _FAN), np.inf)
    with np.errstate(over="ignore"):
        for axis in range(3):
            sides = [(boxes[:, side] - begin[axis, :, None]) / direction[axis, :, None] for side in (axis, axis + 3)]
            np.maximum(enter, np.minimum(*sides), out=enter)
            np.minimum(leave, np.maximum(*sides), out=leave)
    return np.where((enter <= leave) & (boxes[:, 0] <= boxes[:, 3]), enter, np.inf)


def nearest_shares(
    away: Columns, b: Columns, c: Columns
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the shares of the edges b and c (3, k) from a corner whose sum is the place nearest to a point, `away`
    from the corner, and by how much this is nearer than the corner, as a negative difference of squares.
    """
    bb, bc, cc, to_b, to_c = (np.einsum("ij,ij->j", *pair) for pair in ((b, b), (b, c), (c, c), (b, away), (c, away)))
    square = bb * cc - bc * bc
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (cc * to_b - bc * to_c) / square, (bb * to_c - bc * to_b) / square
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (square > _LEAST_SINE**2 * bb * cc)
        gain = -u * to_b - v * to_c
        rest = np.flatnonzero(~inside)
        bb, bc, cc, to_b, to_c = (each[rest] for each in (bb, bc, cc, to_b, to_c))
        dd, to_d = bb + cc - 2.0 * bc, to_c - to_b + bb - bc  # of the third edge, from b to c
        on_b, on_c, on_d = (
            np.clip(np.nan_to_num(to / own), 0.0, 1.0) for to, own in ((to_b, bb), (to_c, cc), (to_d, dd))
        )
    gains = np.stack(
        [
            on_b * (on_b * bb - 2.0 * to_b),
            on_c * (on_c * cc - 2.0 * to_c),
            on_d * (on_d * dd - 2.0 * to_d) + bb - 2.0 * to_b,
        ]
    )
    edge = gains.argmin(axis=0)
    u[rest], v[rest] = np.choose(edge, (on_b, 0.0, 1.0 - on_d)), np.choose(edge, (0.0, on_c, on_d))
    gain[rest] = gains.min(axis=0)
    return u, v, gain


def _shares_of_lines(begin: Columns, direction: Columns, a: Columns, b: Columns, c: Columns) -> NDArray[np.float64]:
    """Return the share of its way at which each line meets its triangle, else infinity (Moeller and Trumbore 1997).

    b, c: The edges from the corner a.
    """
    across = cross_product(direction, c)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1.0 / np.einsum("ij,ij->j", b, across)
        there = begin - a
        u = np.einsum("ij,ij->j", there, across) * inverse
        across = cross_product(there, b)
        v = np.einsum("ij,ij->j", direction, across) * inverse
        share = np.einsum("ij,ij->j", c, across) * inverse
        meets = (u >= -BESIDE) & (v >= -BESIDE) & (u + v <= 1.0 + BESIDE) & (share >= 0.0)
    return np.where(meets, share, np.inf)


def _least_of(items: NDArray[np.intp], values: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the items, of ascending ones given, and for each the row of its least value, the first of equals."""
    first = np.flatnonzero(np.diff(items, prepend=-1))
    if not len(first):
        return items, first
    least = np.minimum.reduceat(values, first)
    group = np.repeat(np.arange(len(first)), np.diff(first, append=len(items)))
    equal = np.flatnonzero(values == least[group])[::-1]  # backwards: the first of equals wins
    best = np.empty(len(first), np.intp)
    best[group[equal]] = equal
    return items[first], best
