"""The sheet of a vertebra: for each side three slices through its corridor, with line and circles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.rendering.pictures.annotations import orientation_letters
from clrecon.rendering.pictures.picture_data import PictureData
from clrecon.rendering.pictures.sheets import Panel, Stroke, draw_sheet
from clrecon.spine.corridors import SIDES, Corridor, VertebraCorridors, screw_diameter
from clrecon.spine.measures import Screw
from clrecon.spine.solid_bone import sample_volume

Float64Array = NDArray[np.float64]

WIDTH_MM = 96.0
PIXELS = 400
CORRIDOR, LIMIT, GIVEN = (90, 230, 120), (255, 190, 60), (255, 90, 90)
"""Colours of corridor, largest screw and given screws."""

LEAST_RISE = 1e-6
"""Rise of an axis over a plane, as a share of its length, below which the axis lies in the plane."""


def _slice(volume: Volume, centre: Float64Array, right: Float64Array, down: Float64Array) -> NDArray[np.float32]:
    """Return HU (trilinear) of a plane of `WIDTH_MM`, shape (`PIXELS`, `PIXELS`); air beyond the scan."""
    way = (np.arange(PIXELS) - (PIXELS - 1) / 2.0) * (WIDTH_MM / PIXELS)
    points = centre + way[:, None, None] * down + way[None, :, None] * right
    return sample_volume(volume, points.reshape(-1, 3)).reshape(PIXELS, PIXELS)


def _flat(points: Float64Array, centre: Float64Array, right: Float64Array, down: Float64Array) -> Float64Array:
    return np.stack(((points - centre) @ right, (points - centre) @ down), axis=1)


def _along(
    centre: Float64Array, right: Float64Array, down: Float64Array, ends: Float64Array, radius: float, color: Any
) -> list[Stroke]:
    """Return the two sides of a cylinder that lies in the plane, and its axis."""
    flat = _flat(ends, centre, right, down)
    way = (flat[1] - flat[0]) / max(float(np.linalg.norm(flat[1] - flat[0])), 1e-9)
    across = radius * np.array((-way[1], way[0]))
    frame = np.stack((flat[0] + across, flat[1] + across, flat[1] - across, flat[0] - across, flat[0] + across))
    return [Stroke(frame, color), Stroke(flat, color)]


def _across(
    centre: Float64Array, right: Float64Array, down: Float64Array, ends: Float64Array, radius: float, color: Any
) -> list[Stroke]:
    """Return the circle where a cylinder's axis meets the plane; of one that lies in the plane, its section."""
    normal = np.cross(right, down)
    height, other = (ends - centre) @ normal
    if abs(other - height) > LEAST_RISE * float(np.linalg.norm(ends[1] - ends[0])):
        crossing = ends[0] + height / (height - other) * (ends[1] - ends[0])
        return [Stroke(_flat(crossing[None], centre, right, down), color, radius)]
    half_width = np.sqrt(max(radius**2 - height**2, 0.0))
    return _along(centre, right, down, ends, float(half_width), color) if half_width > 0.0 else []


def draw_corridors(
    volume: Volume, found: VertebraCorridors, screws: Sequence[Screw], margin: float, footer: Sequence[str]
) -> PictureData:
    """Draw the corridors of a vertebra.

    Each side has a row: the slice through line and left-right direction, the one through line and cranial direction,
    and the one square to the line at the narrowest section of the pedicle.  A side without corridor shows the slices
    through the vertebra's middle.

    screws: Given screws of this vertebra.
    margin: mm.
    footer: Lines of text below.
    """
    rows = [
        _row(volume, found, corridor, [screw for screw in screws if _side_of(found, screw) == corridor.side], margin)
        for corridor in found.corridors
    ]
    return draw_sheet(rows, footer)


def _side_of(found: VertebraCorridors, screw: Screw) -> str:
    first, last = found.frame.to_frame(np.stack((screw.entry, screw.tip)))
    share = np.clip((found.frame.body_y[1] - first[1]) / min(last[1] - first[1], -1e-9), 0.0, 1.0)
    return "left" if (first + share * (last - first))[0] > found.frame.canal[0] else "right"


def _row(
    volume: Volume, found: VertebraCorridors, corridor: Corridor, screws: Sequence[Screw], margin: float
) -> list[Panel]:
    axes, name = found.frame.axes, f"{found.name}, {corridor.side}"
    ends: Float64Array
    if corridor.tip is not None and corridor.entry is not None and corridor.pass_point is not None:
        ends, centre = np.stack((corridor.entry, corridor.tip)), corridor.pass_point
        told = [
            f"{name}: radius {corridor.radius:.1f} mm",
            f"screw to {screw_diameter(corridor.radius or 0.0, margin):.1f} mm, margin {margin:g} mm",
        ]
    else:
        side = SIDES[corridor.side]
        centre = found.frame.to_lps(np.array([[found.frame.canal[0] + 14.0 * side, found.frame.body_y[1], 0.0]]))[0]
        ends, told = np.stack((centre + 20.0 * axes[1], centre - 25.0 * axes[1])), [name, "no corridor"]
    back = ends[0] - ends[1]
    back /= np.linalg.norm(back)
    left = axes[0] - (axes[0] @ back) * back
    left /= np.linalg.norm(left)
    up = np.cross(back, left)
    up = up if up @ axes[2] > 0.0 else -up
    # seen from the patient's feet, from the patient's left, and from behind
    planes = ((left, back, "in the plane of line and left"), (back, -up, "of line and cranial"), (-left, -up, "across"))
    panels = []
    for number, (right, down, caption) in enumerate(planes):
        strokes: list[Stroke] = []
        for radius, pair, color in _cylinders(corridor, ends, screws, margin):
            if number < 2:
                strokes += _along(centre, right, down, pair, radius, color)
            else:
                strokes += _across(centre, right, down, pair, radius, color)
        edges = tuple(orientation_letters(way)[:1] for way in (-right, right, -down, down))
        panels.append(
            Panel(
                _slice(volume, centre, right, down),
                WIDTH_MM / PIXELS,
                [*told, caption] if number == 0 else [caption],
                strokes,
                edges,  # type: ignore[arg-type]
            )
        )
    return panels


def _cylinders(
    corridor: Corridor, ends: Float64Array, screws: Sequence[Screw], margin: float
) -> list[tuple[float, Float64Array, tuple[int, int, int]]]:
    """Return radius, ends and colour of what is drawn: corridor, largest screw, given screws."""
    drawn = []
    if corridor.radius is not None:
        drawn.append((corridor.radius, ends, CORRIDOR))
        if corridor.radius > margin:
            drawn.append((corridor.radius - margin, ends, LIMIT))
    drawn += [(screw.diameter / 2.0, np.stack((screw.entry, screw.tip)), GIVEN) for screw in screws]
    return drawn
