"""Circles and boxes on slices: their points, and the mean and deviation of the HU of the voxels in them.

A circle is three points: its middle and two on it, a quarter apart.  A box is its four corners, one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.directions import as_point
from clrecon.rendering.views.reformation import finest_step
from clrecon.viewer.model.measures import REGIONS, Measure, Point
from clrecon.viewer.model.planes import layers_across, near_layers

_LEAST_MM, _SKEW = 1e-3, 1e-4
"""Shortest side or radius, and the share of it by which points may lie beside their places."""


def place_region(kind: str, first: Point, second: Point, right: Float64Array, up: Float64Array) -> list[Point]:
    """Return the points of a region by two clicks on a slice: middle and edge of a circle, two corners of a box.

    right, up: (3,). Of the slice on which the second click was made; the first is moved into its plane.
    """
    forward, end = np.cross(up, right), np.array(second)
    begin = np.array(first) + ((end - np.array(first)) @ forward) * forward
    across = end - begin
    if kind == "circle":
        return [as_point(begin), second, as_point(begin + np.cross(forward, across))]
    return [as_point(begin), as_point(begin + (across @ right) * right), second, as_point(begin + (across @ up) * up)]


def measure_region(
    volume: Volume, kind: str, points: Sequence[Point], name: str = "", thickness_mm: float = 0.0
) -> Measure:
    """Measure the voxels whose centres lie in a region: in the layer of its plane, or so many mm about it."""
    places = np.array(points, dtype=np.float64)
    corner, sides, lengths = _find_sides(kind, places)
    values = _take_voxels(volume, kind, corner, sides, lengths, thickness_mm)
    if not len(values):
        raise UsageError(f"no voxel of the scan has its centre in this {kind}: make it larger, or draw it on the scan")
    area = np.pi * lengths[0] ** 2 if kind == "circle" else lengths[0] * lengths[1]
    mean = float(values.mean())
    deviation = float(values.std(ddof=1)) if len(values) > 1 else None
    text = f"{mean:.0f} HU" if deviation is None else f"{mean:.0f} ± {deviation:.0f} HU"
    return Measure(
        kind=kind, points=tuple(points), value=round(mean, 3), unit="HU", text=text, name=name,
        sd=None if deviation is None else round(deviation, 3), voxels=len(values), area_mm2=round(float(area), 3),
        thickness_mm=thickness_mm,
    )  # fmt: skip


def _find_sides(kind: str, places: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the middle of a circle or a corner of a box, two unit vectors (2, 3) from it and their lengths (2,)."""
    if places.shape != (REGIONS[kind], 3):
        raise UsageError(f"a {kind} has {REGIONS[kind]} points, not {len(places)}")
    ends = places[[1, 2]] if kind == "circle" else places[[1, 3]]
    sides = ends - places[0]
    lengths = np.linalg.norm(sides, axis=1)
    if lengths.min() < _LEAST_MM:
        raise UsageError(f"the {kind} has no area: its two points lie in one place, or on one line of the slice")
    skew = abs(sides[0] @ sides[1]) / lengths.min()
    if kind == "circle":
        skew = max(skew, abs(lengths[0] - lengths[1]))
    else:
        skew = max(skew, float(np.linalg.norm(places[0] + sides.sum(axis=0) - places[2])))
    if skew > _SKEW * lengths.max():
        wanted = "a middle and two points a quarter apart" if kind == "circle" else "four corners at right angles"
        raise UsageError(f"the points of a {kind} are {wanted}")
    return places[0], sides / lengths[:, None], lengths


def _take_voxels(
    volume: Volume, kind: str, corner: Float64Array, sides: Float64Array, lengths: Float64Array, thickness: float
) -> Float64Array:
    """Return the HU (n,) of the voxels in a region: one of each column through its plane, or all of a thick slice."""
    normal = np.cross(*sides)
    axis, _ = layers_across(volume, normal)
    columns = _find_columns(volume, axis, corner, sides, lengths, kind, thickness * normal)
    middle = columns.copy()
    middle[:, axis] = 0.5 * (volume.shape_ijk[axis] - 1)
    places = volume.ijk_to_lps(middle)
    step = volume.affine[:3, axis]
    feet = places - (((places - corner) @ normal) / (step @ normal))[:, None] * step
    columns[:, axis] = near_layers(volume, feet)[:, axis]
    reach = int(np.ceil(0.5 * thickness / finest_step(volume))) + 1 if thickness else 0
    layers_hu: list[Float64Array] = []
    for layer in range(-reach, reach + 1):
        index = columns.copy()
        index[:, axis] += layer
        inside = (index[:, axis] >= 0) & (index[:, axis] < volume.shape_ijk[axis])
        away = volume.ijk_to_lps(index) - corner
        if thickness:
            inside &= np.abs(away @ normal) <= 0.5 * thickness + _LEAST_MM
        inside &= _lies_within(kind, away @ sides.T, lengths)
        i, j, k = index[inside].astype(np.int64).T
        layers_hu.append(volume.voxels[k, j, i].astype(np.float64))
    return np.concatenate(layers_hu)


def _lies_within(kind: str, along: Float64Array, lengths: Float64Array) -> NDArray[np.bool_]:
    """Tell which places (n, 2), mm along the sides, lie in a region; its border is part of it."""
    if kind == "circle":
        return np.asarray(np.hypot(*along.T) <= lengths[0] + 1e-9)
    return np.asarray(((along >= -1e-9) & (along <= lengths + 1e-9)).all(axis=1))


def _find_columns(
    volume: Volume,
    axis: int,
    corner: Float64Array,
    sides: Float64Array,
    lengths: Float64Array,
    kind: str,
    thick: Float64Array,
) -> Float64Array:
    """Return the index (n, 3) of a voxel of each column along an axis that may meet a region."""
    shares = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)] if kind == "circle" else [(0, 0), (0, 1), (1, 0), (1, 1)])
    ends = corner + shares @ (sides * lengths[:, None])
    ends = volume.lps_to_ijk(np.concatenate([ends - 0.5 * thick, ends + 0.5 * thick]))
    others = [each for each in range(3) if each != axis]
    last = np.array(volume.shape_ijk) - 1
    low = np.clip(np.floor(ends.min(axis=0)) - 1, 0, last + 1)
    high = np.clip(np.ceil(ends.max(axis=0)) + 1, -1, last)
    ranges = [np.arange(low[each], high[each] + 1) for each in others]
    grid = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 2)
    columns = np.zeros((len(grid), 3))
    columns[:, others] = grid
    return columns
