"""The crop of a job: the scan becomes smaller before anything is made of it, and its voxels keep their places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.system.wording import name_parameter

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap

__all__ = ["CROPS", "Box", "crop_box", "crop_labels", "crop_scan"]

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
    clip_box: Sequence[float] | None, between: Sequence[float] | None, around: Sequence[float] | None
) -> Box | None:
    """Return the box that is in all of those that are given; None without any.

    Parameters
    ----------
    clip_box : (x0, x1, y0, y1, z0, z1), optional
        A box in mm; infinite numbers leave a side open.
    between : (z0, z1), optional
        Heights in mm.
    around : (x, y, z, r), optional
        A point and half the side of the cube around it, mm.

    Raises
    ------
    UsageError
        A value has another count of numbers, is no number, or the box holds nothing.
    """
    boxes = []
    for name, values in (("clip_box", clip_box), ("between", between), ("around", around)):
        if values is not None:
            boxes.append(_box_of(name, values))
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


def _box_of(name: str, values: Sequence[float]) -> Box:
    """Return the corners of one box.

    Raises
    ------
    UsageError
    """
    count, form = _COUNTS[name]
    named = name_parameter(name)
    if len(values) != count:
        raise UsageError(f"{named} takes {form}, not {len(values)}")
    if any(math.isnan(value) for value in values):
        raise UsageError(f"{named} takes numbers, and one of them is NaN")
    everywhere = math.inf
    if name == "around":
        x, y, z, radius = values
        if not all(map(math.isfinite, values)) or radius <= 0.0:
            raise UsageError(f"{named} takes a point and a length above 0 in mm, not {_numbers(values)}")
        return (x - radius, y - radius, z - radius), (x + radius, y + radius, z + radius)
    given = tuple(values) if name == "clip_box" else (-everywhere, everywhere, -everywhere, everywhere, *values)
    for axis, low, high in zip("xyz", given[0::2], given[1::2], strict=True):
        if not low < high:
            raise UsageError(
                f"{named} runs from {low:g} to {high:g} mm along {axis}: it holds nothing; give the lower end first"
            )
    return given[0::2], given[1::2]


def _numbers(values: Sequence[float]) -> str:
    return ",".join(f"{value:g}" for value in values)


def crop_scan(volume: Volume, box: Box | None, space: str, *, margin: int = 0) -> Volume:
    """Return the part of a scan in a box, in mm of the frame `space`; all of it without a box.

    Raises
    ------
    UsageError
        No voxel lies in the box.
    """
    if box is None:
        return volume
    from clrecon.geometry.crop import crop_volume

    return crop_volume(volume, *box, margin=margin, space=space)


def crop_labels(labels: LabelMap, box: Box | None, space: str) -> LabelMap:
    """Return the part of a label map in a box, as `crop_scan` does a scan.

    Raises
    ------
    UsageError
        No labelled voxel lies in the box.
    """
    if box is None:
        return labels
    import numpy as np

    from clrecon.geometry import frame_from_lps
    from clrecon.geometry.blocks import find_block, place_block
    from clrecon.labels import LabelMap

    turned = np.sort(np.array(box) * np.diag(frame_from_lps(space)), axis=0)
    origins = labels.affine[:3, 3] + np.arange(labels.shape_ijk[2])[:, None] * labels.affine[:3, 2]
    block = find_block(labels, origins, turned[0], turned[1])
    cut = None
    if block is not None:
        (i0, j0, k0), (i1, j1, k1) = block
        cut = labels.voxels[k0:k1, j0:j1, i0:i1]
    if block is None or cut is None or not cut.any():
        raise UsageError("nothing is left: no labelled voxel lies in the box of the crop")
    affine, _ = place_block(labels.affine, origins, False, block)
    names = {number: labels.name(number) for number in labels.numbers}
    return LabelMap(
        cut, affine, names, frame_of_reference_hash=labels.frame_of_reference_hash, warnings=labels.warnings
    )
