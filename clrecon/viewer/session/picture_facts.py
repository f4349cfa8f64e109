"""What belongs to the pictures of a view: when each is stale, and which pieces of lines nothing hides in it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from clrecon.geometry.affine import Float64Array
from clrecon.rendering import Rendering
from clrecon.viewer.model.state import ViewState

SCENE, SLICES = "scene", ("axial", "coronal", "sagittal")
VIEWS = (SCENE, *SLICES, "curve")
"""The picture in three dimensions, the three slices, and the reformation along the points of the curve tool."""

REST_SECONDS = 0.2
"""After the last change until pictures are drawn sharp."""

_STEPS = 64
"""Places on each line that are compared with the picture's depth."""

_BEFORE_MM, _BEFORE_PIXELS = 0.5, 2.0
"""By which a place may lie behind what is seen at its pixel: measures begin on the surface."""


def picture_key(state: ViewState, view: str) -> Hashable:
    """Return what the picture of a view depends on: equal keys, equal pictures."""
    looks = tuple(part for part in state.parts if not part.is_plain)  # the others are drawn as if they were not known
    parts = (looks, (state.parts_at, state.parts_table) if looks else None)
    if view == SCENE:
        cut = (state.clips, state.clip_box)
        return (state.camera, state.mode, state.iso_value, state.picture_window, state.table, parts, cut)
    if view in SLICES:
        return (state.cross, state.window, state.table, parts)
    return (state.curve, state.window, state.table)


def seen_pieces(rendering: Rendering, lines: Sequence[Float64Array], *, expected: bool) -> list[list[list[float]]]:
    """Return the ends of the pieces of lines (n, 3) that nothing in a picture hides, by its depths or expected ones."""
    camera, size = rendering.camera, rendering.size
    assert camera is not None
    depth = rendering.expected_depth if expected else rendering.depth
    slack = _BEFORE_MM + _BEFORE_PIXELS * camera.pixel_mm(size)
    pieces: list[list[list[float]]] = []
    for line in lines:
        for start, end in zip(line[:-1], line[1:], strict=True):
            places = start + np.linspace(0.0, 1.0, _STEPS)[:, None] * (end - start)
            pixels, depths = camera.project(places, size)
            known = np.isfinite(pixels).all(axis=1)
            column, row = np.where(known[:, None], np.floor(pixels), 0).astype(np.int64).T
            inside = known & (column >= 0) & (row >= 0) & (column < size[0]) & (row < size[1])
            surface = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
            seen = ~(inside & (depths > surface + slack))  # beside NaN, where nothing is hit, all is seen
            ends = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
            pieces += [np.round(places[[a, b - 1]], 3).tolist() for a, b in ends.reshape(-1, 2) if b - a > 1]
    return pieces
