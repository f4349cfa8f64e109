"""The box of what a picture can show of a volume, for cameras that fit it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.geometry.volume import Volume
from clrecon.rendering.views.camera import box_corners
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import checked_vector

SMALLEST_SIDE_MM = 1e-3
"""Least side of a box, so that its affine can be inverted."""


class ShownLabels(NamedTuple):
    """Labels on the grid of a volume, (nk, nj, ni), and for each number whether its voxels are shown."""

    voxels: NDArray[np.integer]
    shown: NDArray[np.bool_]


def find_seen_box(
    volume: Volume,
    band: tuple[float, float] = (-math.inf, math.inf),
    *,
    clip: Clip | None = None,
    labels: ShownLabels | None = None,
    slices: Iterable[int] | None = None,
) -> Grid | None:
    """Return the box along the patient's axes around everything that a picture can show of a volume.

    A trilinear value within a band of HU needs a voxel at its low end or above and one at its high end or below, both
    around its place.  So the box holds what lies within a voxel of both kinds: it can be larger than what is seen, and
    is never smaller.

    band: (low, high). HU that are shown, infinite where it has no end.
    labels: Voxels of labels that are not shown do not count.
    slices: Only these slices are shown.

    Returns: One voxel that fills the box; None where nothing can be seen.
    """
    chosen = range(volume.shape_ijk[2]) if slices is None else sorted(slices)
    reach = 1.0 if slices is None else 0.0
    ends = [(np.greater_equal, band[0]), (np.less_equal, band[1])]
    tests = [(test, end) for test, end in ends if math.isfinite(end)]
    places: list[list[tuple[int, ...]]] = [[] for _ in range(max(len(tests), 1))]
    origins = volume.slice_origins()
    for k in chosen:
        layer = volume.voxels[k]
        there = _kept(volume, origins[k], clip)
        if labels is not None:
            shown = labels.shown[labels.voxels[k]]
            there = shown if there is None else there & shown
        for number in range(len(places)):
            seen = tests[number][0](layer, tests[number][1]) if tests else np.ones(layer.shape, dtype=bool)
            extent = _extent(seen if there is None else seen & there)
            if extent is not None:
                places[number].append((k, *extent))
        volume.release_slices(k, k + 1)
    boxes = [_corners(volume, np.array(found, dtype=np.float64), reach) for found in places if found]
    if len(boxes) < len(places):
        return None
    low = np.max([box.min(axis=0) for box in boxes], axis=0)
    high = np.min([box.max(axis=0) for box in boxes], axis=0)
    for normal, offset in [] if clip is None else [(plane[:3], plane[3]) for plane in clip.planes]:
        axis = int(np.abs(normal).argmax())
        if abs(normal[axis]) > 1.0 - 1e-12:
            low[axis] = max(low[axis], offset) if normal[axis] > 0 else low[axis]
            high[axis] = min(high[axis], -offset) if normal[axis] < 0 else high[axis]
    if (high < low).any():
        return None
    affine = np.diag([*np.maximum(high - low, SMALLEST_SIDE_MM), 1.0])
    affine[:3, 3] = 0.5 * (low + high)
    return Grid(np.zeros((1, 1, 1), np.int8), affine)


def check_center(center: object, shown: Grid) -> tuple[float, float, float]:
    """Return the centre of a picture, three numbers in LPS mm."""
    point = checked_vector("the centre of a picture", center)  # type: ignore[arg-type]
    corners = box_corners(shown)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (np.array(point) < low - 1e-6).any() or (np.array(point) > high + 1e-6).any():
        box = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True))
        place = ", ".join(f"{value:g}" for value in point)
        raise UsageError(
            f"the centre of the picture ({place}) lies outside of what is shown, which runs from {box} LPS mm (are the"
            " numbers RAS?)"
        )
    return point


def _kept(volume: Volume, origin: Float64Array, clip: Clip | None) -> NDArray[np.bool_] | None:
    """Return the voxels of a slice (nj, ni) of which a clip leaves something; None for all."""
    if clip is None:
        return None
    ni, nj, _ = volume.shape_ijk
    columns = volume.affine[:3, :3]
    kept = np.ones((nj, ni), dtype=bool)
    for plane in clip.planes:
        along_i, along_j, along_k = plane[:3] @ columns
        reach = abs(along_i) + abs(along_j) + abs(along_k)  # a voxel shows as far as to its neighbours
        kept &= (np.arange(nj) * along_j)[:, None] + np.arange(ni) * along_i >= plane[3] - plane[:3] @ origin - reach
    return kept


def _extent(seen: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Return the first and last column and row of the marked voxels of a slice, None without any."""
    columns = np.flatnonzero(seen.any(axis=0))
    if not len(columns):
        return None
    rows = np.flatnonzero(seen.any(axis=1))
    return int(columns[0]), int(columns[-1]), int(rows[0]), int(rows[-1])


def _corners(volume: Volume, found: Float64Array, reach: float) -> Float64Array:
    """Return the corners of the extents (k, i0, i1, j0, j1) of slices, LPS mm, larger by a voxel within the volume."""
    most = np.array(volume.shape_ijk) - 0.5
    k, low_i, high_i, low_j, high_j = found.T
    ends = [
        (np.maximum(low_i - 1.0, -0.5), np.minimum(high_i + 1.0, most[0])),
        (np.maximum(low_j - 1.0, -0.5), np.minimum(high_j + 1.0, most[1])),
        (np.maximum(k - reach, -0.5), np.minimum(k + reach, most[2])),
    ]
    points = [np.column_stack((i, j, at)) for i in ends[0] for j in ends[1] for at in ends[2]]
    return volume.ijk_to_lps(np.concatenate(points))
