"""Small shifts of vertices that do not spoil the surface, and the volume of its components."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.coordinates import as_stored, find_coincident
from clrecon.mesh.connectivity import Fans, find_used, number_used, order_by_number
from clrecon.mesh.intersections import find_beside, find_boxes, find_boxes_beside, find_changed_intersections
from clrecon.mesh.triangles import cross_products
from clrecon.system.pieces import find_bounds

_ROUNDS = 40
"""Most rounds of taking steps back; each halves steps or widens the place, and CT needs 2 to 5."""

_SMALLEST_SHARE = 0.2
"""Least share of a step after halving; a step that would be shorter is not made at all."""

_IN_A_BLOCK, _CELL_SHARE = 64, 0.25
"""Triangles near each other that are sorted out together, and the cells by which they are put in order, for each."""

_ROUNDS_OF_ITS_OWN = 3
"""After this many rounds the vertices around an offending place are taken back too."""

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


def enclosed_mm3(
    vertices: Float64Array, triangles: NDArray[np.uint32], count: int, labels: NDArray[np.int64]
) -> Float64Array:
    """Return the volume of each component, vertices in mm near 0: negative for walls of cavities."""
    six_volumes = np.zeros(count)
    for piece, corner, cross in cross_products(vertices, triangles, np.zeros(3), max(count, 1 << 14)):
        six_volumes += np.bincount(labels[triangles[piece, 0]], np.einsum("ij,ij->j", corner, cross), count)
    return six_volumes / 6.0


class Marks(Protocol):
    """Triangles of a surface, and of it changed, that may touch another one or have no area, and those that cut one.

    All that touch another one, or have no area, are among them.
    """

    def look(self) -> tuple[IntArray, IntArray]: ...
    def look_again(self, vertices: NDArray[np.float32], changed: IntArray, /) -> tuple[IntArray, IntArray]: ...


Follow = Callable[..., Marks | None]
"""Returns marks of triangles, or of some rows of these, before vertices are moved; None where nothing marks."""


def follow_none(vertices: NDArray[np.floating], triangles: NDArray[np.uint32], rows: IntArray | None = None) -> None:
    """Return no marks: all triangles are looked at, and then what lies near to changed ones."""


def move_vertices(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    step: Float64Array,
    find_changed: Callable[[NDArray[np.floating], Float64Array], IntArray] | None = None,
    fans: Fans | None = None,
    follow: Follow = follow_none,
) -> tuple[NDArray[np.floating], int]:
    """Move vertices, but by less or not at all where triangles would cut, lose their area or share a place.

    All triangles are looked at once, and then those around what is taken back.

    follow: Where it returns marks of a surface, only the triangles that these name are looked at.
    find_changed: Given places and the share of each step that is made, finds vertices that are not to move at all.
    Returns:
    vertices: As stored.  Faults that existed before may remain.
    taken_back: Number of vertices that were not moved by the full step.
    """
    share = np.ones(len(vertices))
    moved = as_stored(np.add(vertices, step, out=np.empty_like(vertices), casting="same_kind"))
    marks = follow(moved, triangles)
    changed = np.ones(len(triangles), dtype=bool)
    spoilt: IntArray = (
        _find_spoilt(moved, triangles, changed)
        if marks is None
        else _find_spoilt_among(*marks.look(), moved, triangles, changed)
    )
    near: _Near | None = None
    for turn in range(_ROUNDS):
        if turn >= _ROUNDS_OF_ITS_OWN and fans is not None:
            spoilt = find_used(triangles[fans.touching(spoilt)], len(vertices))
        spoilt = spoilt[share[spoilt] > 0.0]
        if len(spoilt):
            share[spoilt] *= 0.5
            share[spoilt[share[spoilt] < _SMALLEST_SHARE]] = 0.0
        elif find_changed is not None:
            spoilt = find_changed(moved, share)
            spoilt = spoilt[share[spoilt] > 0.0]
            share[spoilt] = 0.0
        if len(spoilt) == 0:
            break
        fans = fans or Fans(triangles, len(moved))
        moved[spoilt] = vertices[spoilt] + share[spoilt, None] * step[spoilt]
        rows = fans.touching(spoilt)
        changed = np.zeros(len(triangles), dtype=bool)
        changed[rows] = True
        if marks is None:
            near = near or _Near(vertices, moved, triangles)
            spoilt = near.find_spoilt(changed)
        else:
            spoilt = _find_spoilt_among(*marks.look_again(moved, rows), moved, triangles, changed)
    return moved, int(np.count_nonzero(share < 1.0))


class _Near:
    """Search for what is spoilt around vertices that were taken back, from `moved` towards `vertices`, in mm."""

    def __init__(self, vertices: NDArray[np.floating], moved: NDArray[np.floating], triangles: NDArray[np.uint32]):
        self._moved, self._triangles = moved, triangles
        low, high = np.minimum(vertices, moved), np.maximum(vertices, moved)
        start, end = find_bounds(low)
        size = float(np.cbrt(np.prod(end - start + 1e-3) / (_CELL_SHARE * len(triangles))))
        x, y, z = ((column / size).astype(np.int32) for column in (low - start).T)
        cell = (x * (y.max() + 1) + y) * (z.max() + 1) + z
        self._order = order_by_number(cell.take(triangles[:, 0]))
        rows = triangles.take(self._order, axis=0)
        starts = np.arange(0, len(rows), _IN_A_BLOCK)
        self._low = np.minimum.reduceat(find_boxes(low, rows)[0], starts)
        self._high = np.maximum.reduceat(find_boxes(high, rows)[1], starts)

    def find_spoilt(self, changed: NDArray[np.bool_]) -> IntArray:
        """Find the vertices of spoilt triangles after these triangles have changed."""
        moved = self._moved
        boxes = find_boxes(moved, self._triangles[changed])
        pieces = find_boxes_beside(self._low, self._high, *boxes)
        rows = np.sort(self._order[np.repeat(pieces, _IN_A_BLOCK)[: len(changed)]])
        rows = rows[find_beside(moved, self._triangles[rows], changed[rows])]
        return _find_spoilt_among(rows, rows[:0], moved, self._triangles, changed)


def _find_spoilt_among(
    rows: IntArray,
    cut: IntArray,
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    changed: NDArray[np.bool_],
) -> IntArray:
    """Do what `_find_spoilt` does among some rows of the triangles, beside which others surely cut each other."""
    used, corners = number_used(triangles[rows], len(vertices))
    spoilt = used[_find_spoilt(vertices[used], corners, changed[rows])] if len(rows) else rows
    return find_used(np.concatenate([spoilt, triangles[cut].reshape(-1)]), len(vertices))


def _find_spoilt(vertices: NDArray[np.floating], triangles: NDArray[np.uint32], look_at: NDArray[np.bool_]) -> IntArray:
    """Find vertices of triangles without area, of triangles that cut each other, and vertices that coincide."""
    flat = [
        where.start + np.flatnonzero(~cross.any(axis=0))
        for where, _, cross in cross_products(vertices, triangles, np.zeros(3))
    ]
    cut = triangles[find_changed_intersections(vertices, triangles, look_at)]
    suspects = [triangles[np.concatenate(flat)].reshape(-1), cut.reshape(-1), find_coincident(vertices)]
    return find_used(np.concatenate(suspects).astype(np.int64), len(vertices))
