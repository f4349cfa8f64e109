"""Boxes in mm, as a crop is asked for: a box, two heights, or a point and a length."""

from __future__ import annotations

import math
from collections.abc import Sequence

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter

Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Lowest and highest corner (x, y, z) in mm; infinite where a side is open."""

CROPS = ("clip_box", "between", "around")
"""Names of the settings that make the box."""

_COUNTS = {
    "clip_box": (6, "six numbers, x0,x1,y0,y1,z0,z1"),
    "between": (2, "two numbers, z0,z1"),
    "around": (4, "a point and a radius, four numbers, x,y,z,r"),
}


def crop_box(
    clip_box: Sequence[float | None] | None, between: Sequence[float | None] | None, around: Sequence[float] | None
) -> Box | None:
    """Return the box, mm, that is in all of those that are given; None without any.  None or infinity leaves a side
    open.

    They are (x0, x1, y0, y1, z0, z1), heights (z0, z1), and a point with half the side of the cube around (x, y, z, r).
    """
    given = (("clip_box", clip_box), ("between", between), ("around", around))
    boxes = [_box_of(name, values) for name, values in given if values is not None]
    if not boxes:
        return None
    low = tuple(max(corner[axis] for corner, _ in boxes) for axis in range(3))
    high = tuple(min(corner[axis] for _, corner in boxes) for axis in range(3))
    for axis, below, above in zip("xyz", low, high, strict=True):
        if not below < above:
            raise UsageError(
                f"the boxes have nothing in common: along {axis} one begins at {below:g} mm and another ends at"
                f" {above:g} mm"
            )
    return low, high


def _box_of(name: str, given: Sequence[float | None]) -> Box:
    count, form = _COUNTS[name]
    named = name_parameter(name)
    everywhere = math.inf
    open_side = (-everywhere, everywhere) if name != "around" else (math.nan, math.nan)
    try:
        values = [open_side[place % 2] if value is None else float(value) for place, value in enumerate(given)]
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{named} takes {form}, not {str(given)[:60]}") from error
    if len(values) != count:
        raise UsageError(f"{named} takes {form}, not {len(values)}")
    if any(math.isnan(value) for value in values):
        missing = "None" if any(value is None for value in given) else "NaN"
        raise UsageError(f"{named} takes numbers, and one of them is {missing}")
    if name == "around":
        x, y, z, radius = values
        if not all(map(math.isfinite, values)) or radius <= 0.0:
            shown = ",".join(f"{value:g}" for value in values)
            raise UsageError(f"{named} takes a point and a length above 0 in mm, not {shown}")
        return (x - radius, y - radius, z - radius), (x + radius, y + radius, z + radius)
    sides = values if name == "clip_box" else [-everywhere, everywhere, -everywhere, everywhere, *values]
    low_corner, high_corner = tuple(sides[0::2]), tuple(sides[1::2])
    for axis, low, high in zip("xyz", low_corner, high_corner, strict=True):
        if not low < high:
            raise UsageError(
                f"{named} runs from {low:g} to {high:g} mm along {axis}: it holds nothing; give the lower end first"
            )
    return low_corner, high_corner
