"""Parts of a volume: blocks of whole voxels, which keep their places, what a certificate says of them, and boxes in mm
as a crop is asked for: a box, two heights, or a point and a length.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, facts_of_orientation, frame_from_lps, signed_tilt, slice_normal
from clrecon.geometry.certificate import amend
from clrecon.geometry.grid import BaseVolume, Grid, fit_even
from clrecon.system.arguments import name_parameter

_ON_EDGE_MM = 1e-6
"""A voxel centre this near to the side of a box lies in the box."""


class Block(NamedTuple):
    """Voxels first to end - 1 along each axis, (i, j, k)."""

    first: tuple[int, int, int]
    end: tuple[int, int, int]

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        """(ni, nj, nk) of the block."""
        ni, nj, nk = (end - first for first, end in zip(self.first, self.end, strict=True))
        return ni, nj, nk


def find_block(grid: Grid, origins: Float64Array, low: ArrayLike, high: ArrayLike, margin: int = 0) -> Block | None:
    """Return the smallest block of all voxel centres in a box, LPS mm, with a margin; None without such a centre.

    origins: LPS mm of voxel (0, 0, k) of each slice, (nk, 3).
    """
    ni, nj, nk = grid.shape_ijk
    low, high = np.asarray(low, np.float64) - _ON_EDGE_MM, np.asarray(high, np.float64) + _ON_EDGE_MM
    # In each row (k, j) the voxels in the box are an interval of i: that which lies within all three pairs of sides.
    first, last = np.zeros((nk, nj)), np.full((nk, nj), ni - 1.0)
    for a in range(3):
        start = origins[:, a, None] + np.arange(nj) * grid.affine[a, 1]
        step = grid.affine[a, 0]
        if step == 0.0:
            last[(start < low[a]) | (start > high[a])] = -1.0
            continue
        ends = (low[a] - start) / step, (high[a] - start) / step
        first = np.maximum(first, np.ceil(np.minimum(*ends)))
        last = np.minimum(last, np.floor(np.maximum(*ends)))
    is_inside = first <= last
    if not is_inside.any():
        return None
    slices, rows = np.flatnonzero(is_inside.any(axis=1)), np.flatnonzero(is_inside.any(axis=0))
    begins = first[is_inside].min(), rows[0], slices[0]
    ends_at = last[is_inside].max(), rows[-1], slices[-1]
    i0, j0, k0 = (max(0, int(one) - margin) for one in begins)
    i1, j1, k1 = (min(n, int(one) + 1 + margin) for one, n in zip(ends_at, (ni, nj, nk), strict=True))
    return Block((i0, j0, k0), (i1, j1, k1))


def place_block(affine: Float64Array, origins: Float64Array, uneven: bool, block: Block) -> tuple[Any, Any]:
    """Return the affine of a block, and positions (n, 3) of its slices, None where these are even among themselves."""
    placed = np.array(affine)
    aside = affine[:3, 0] * block.first[0] + affine[:3, 1] * block.first[1]
    positions = origins[block.first[2] : block.end[2]] + aside
    placed[:3, 3] = positions[0]
    if not uneven or len(positions) < 2:
        return placed, None
    step, origin, is_even = fit_even(positions, slice_normal(affine))
    if is_even:
        placed[:3, 2], placed[:3, 3] = step, origin
        return placed, None
    placed[:3, 2] = (positions[-1] - positions[0]) / (len(positions) - 1)
    return placed, positions


def facts_of_place(report: Mapping[str, Any], volume: Any) -> dict[str, Any]:
    """Return the entries of a report that change with the shape and the place of a volume, as far as it has them."""
    ni, nj, nk = volume.shape_ijk
    di, dj, dk = volume.spacing
    origins, normal = volume.slice_origins(), slice_normal(volume.affine)
    gaps = np.abs(np.diff(origins, axis=0) @ normal) if nk > 1 else np.array([abs(volume.affine[:3, 2] @ normal)])
    usual = float(np.median(gaps))
    even = volume.affine[:3, 3] + np.arange(nk)[:, None] * volume.affine[:3, 2]
    off = np.linalg.norm(origins - even, axis=1)
    hu = volume.hu_range
    entries = {
        "slices": nk,
        "shape_ijk": [ni, nj, nk],
        "spacing_mm": [di, dj, dk],
        "extent_mm": [ni * di, nj * dj, float(gaps.sum()) + usual if nk > 1 else usual],
        "affine_ijk_to_lps_mm": volume.affine.tolist(),
        "orientation": facts_of_orientation(volume.affine),
        "tilt_deg": signed_tilt(volume.affine),
        "gap_mm": {"min": float(gaps.min()), "max": float(gaps.max()), "median": usual},
        "uneven": volume.uneven,
        "gap_runs": None,
        "slice_positions_mm": origins.tolist() if volume.uneven else None,
        "hu_range": None if hu is None else [float(hu[0]), float(hu[1])],
    }
    if report.get("uneven"):  # of even slices the residual is that of reading
        entries["grid_residual_max_mm"] = float(off.max()) if volume.uneven else None
        entries["grid_residual_rms_mm"] = float(np.sqrt(np.mean(off**2))) if volume.uneven else None
    return {name: value for name, value in entries.items() if name in report}


def take_report(changed: BaseVolume, volume: BaseVolume, warning: str, **facts: Any) -> None:
    """Give a volume the report of the one that it was made of, with its own place, more facts, and a warning."""
    warnings = [*volume.report.get("warnings", ()), warning]
    changed.report = amend(volume.report, warnings=warnings, **facts, **facts_of_place(volume.report, changed))


Own = TypeVar("Own", bound=BaseVolume)


def crop_volume(volume: Own, low: ArrayLike, high: ArrayLike, *, margin: int = 0, space: str = "lps") -> Own:
    """Crop a volume to the smallest block of whole voxels that holds every voxel centre in a box, and a margin.

    Voxels keep their places, uneven slices too; they are a view where they can be.  Where the volume lies oblique to
    the patient, the block also holds voxels beyond the box.  ``report["crop"]`` has the figures.

    low, high: Corners of the box, mm of the frame `space`; infinite numbers leave a side open.
    """
    try:
        box = np.array([low, high], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.empty(0)
    if box.shape != (2, 3) or np.isnan(box).any():
        raise UsageError(f"a box has two corners of three numbers in mm, not {low!r} and {high!r}")
    for axis, (below, above) in zip("xyz", box.T, strict=True):
        if not below <= above:
            raise UsageError(
                f"the box runs from {below:g} to {above:g} mm along {axis}: it holds nothing; give the lower end first"
            )
    if not isinstance(margin, int | np.integer) or margin < 0:
        raise UsageError(f"the margin of a crop is a number of voxels from 0, not {margin!r}")
    turned = np.sort(box * np.diag(frame_from_lps(space)), axis=0)
    block = find_block(volume, volume.slice_origins(), turned[0], turned[1], margin)
    if block is None:
        raise UsageError(
            f"nothing is left: no voxel lies in the box {_describe_box(box)} mm ({space.upper()});"
            f" {describe_extent(volume, space)}"
        )
    return _certify(volume, cut_block(volume, block), block, box, space)


def cut_block(volume: Own, block: Block) -> Own:
    """Return a block of a volume with the report of the whole."""
    (i0, j0, k0), (i1, j1, k1) = block
    affine, positions = place_block(volume.affine, volume.slice_origins(), volume.uneven, block)
    return volume.alike(volume.voxels[k0:k1, j0:j1, i0:i1], affine, volume.report, positions)


def _certify(volume: Own, cropped: Own, block: Block, box: np.ndarray, space: str) -> Own:
    every, stay = math.prod(volume.shape_ijk), math.prod(cropped.shape_ijk)
    size = [n * step for n, step in zip(cropped.shape_ijk, cropped.spacing, strict=True)]
    whole = [n * step for n, step in zip(volume.shape_ijk, volume.spacing, strict=True)]
    facts = {
        "space": space.lower(),
        "box_mm": [[float(end) if math.isfinite(end) else None for end in corner] for corner in box],
        "first_ijk": list(block.first),
        "shape_ijk_before": list(volume.shape_ijk),
        "voxels": stay,
        "voxels_all": every,
    }
    warning = (
        f"cropped to {_describe_box(box)} mm ({space.upper()}): {stay:,} of {every:,} voxels stay"
        f" ({100.0 * stay / every:.3g} %), {_describe_size(size)} of {_describe_size(whole)} mm"
    )
    take_report(cropped, volume, warning, crop=facts)
    return cropped


def find_extent(volume: BaseVolume) -> tuple[Float64Array, Float64Array]:
    """Return the lowest and highest (x, y, z) of the box of the voxels' centres, LPS mm."""
    ni, nj, _ = volume.shape_ijk
    in_plane = np.array(list(product((0, ni - 1), (0, nj - 1)))) @ volume.affine[:3, :2].T
    corners = (volume.slice_origins()[:, None] + in_plane).reshape(-1, 3)
    return corners.min(axis=0), corners.max(axis=0)


MM3_PER_ML = 1000.0


def slice_voxel_ml(volume: BaseVolume) -> Float64Array:
    """Return the volume of a voxel of each slice, (nk,) ml: half way to both neighbours along the normal."""
    area = float(np.linalg.norm(np.cross(volume.affine[:3, 0], volume.affine[:3, 1])))
    heights = volume.slice_origins(border=1) @ slice_normal(volume.affine)
    return area * np.abs(heights[2:] - heights[:-2]) / 2.0 / MM3_PER_ML


def describe_extent(volume: BaseVolume, space: str) -> str:
    """Describe the box of the voxels' centres, mm of the frame `space`, and their HU."""
    low, high = np.sort(np.array(find_extent(volume)) * np.diag(frame_from_lps(space)), axis=0)
    box = ", ".join(f"{name} {a:.1f} to {b:.1f}" for name, a, b in zip("xyz", low, high, strict=True))
    hu = volume.hu_range
    values = "" if hu is None else f" and from {hu[0]:g} to {hu[1]:g} HU"
    return f"the scan runs from {box} mm ({space.upper()}){values}"


def _describe_box(box: np.ndarray) -> str:
    """Describe the sides of a box that are not open: ``x -20 to 30, z from 900``."""
    words = []
    for axis, (low, high) in zip("xyz", box.T, strict=True):
        if math.isfinite(low) and math.isfinite(high):
            words.append(f"{axis} {low:g} to {high:g}")
        elif math.isfinite(low) or math.isfinite(high):
            words.append(f"{axis} from {low:g}" if math.isfinite(low) else f"{axis} to {high:g}")
    return ", ".join(words) or "all"


def _describe_size(size: list[float]) -> str:
    return " x ".join(f"{length:.4g}" for length in size)


_AXES = "kji"


def slice_volume(volume: Own, key: Any) -> Own:
    """Return a part of a volume with the affine, and the slice positions where they are uneven, of that part.

    The rules are those of nibabel's ``image.slicer``, in the order of the array: ``volume[key].voxels`` is
    ``volume.voxels[key]``, a view where it can be.  ``report["sliced"]`` has the figures.

    key: Along k, j, i; ``...`` stands for whole axes.  A step of 2 takes every other voxel and doubles the spacing,
        without smoothing.  A step below zero turns an axis round: index space may become left-handed.
    """
    slices = _checked_slices(key)
    ranges = [range(*one.indices(size)) for one, size in zip(slices, volume.shape, strict=True)]
    for axis, indices, cut, size in zip(_AXES, ranges, slices, volume.shape, strict=True):
        if not indices:
            raise UsageError(f"nothing is left: {_slice_text(cut)} holds none of the {size} indices along {axis}")
    along_ijk = ranges[::-1]
    affine = np.array(volume.affine)
    for column, indices in enumerate(along_ijk):
        # A single voxel has no neighbour to be further away from: it keeps the step of the volume.
        step = indices.step if len(indices) > 1 else math.copysign(1, indices.step)
        affine[:3, column] = affine[:3, column] * step + 0.0  # which turns -0 into 0
    aside = volume.affine[:3, :2] @ [kept.start for kept in along_ijk[:2]]
    origins = volume.slice_origins()[np.array(along_ijk[2])] + aside
    shape = tuple(len(kept) for kept in along_ijk)
    placed, positions = place_block(affine, origins, volume.uneven, Block((0, 0, 0), shape))  # type: ignore[arg-type]
    part = volume.alike(volume.voxels[slices], placed, None, positions)
    words = (
        f"sliced to {', '.join(map(_slice_text, slices))} of k, j, i: {part.voxels.size:,} of {volume.voxels.size:,}"
    )
    facts = {
        "first_ijk": [kept.start for kept in along_ijk],
        "step_ijk": [kept.step for kept in along_ijk],
        "shape_ijk_before": list(volume.shape_ijk),
    }
    take_report(part, volume, f"{words} voxels stay", sliced=facts)
    return part


def _checked_slices(key: Any) -> tuple[slice, slice, slice]:
    given = key if isinstance(key, tuple) else (key,)
    places = [place for place, one in enumerate(given) if one is Ellipsis]
    if len(places) == 1:
        given = (*given[: places[0]], *[slice(None)] * max(0, 4 - len(given)), *given[places[0] + 1 :])
    if len(given) > 3:
        raise UsageError(f"a volume has three axes, k, j, i, and is cut by as many slices, not by {len(given)}")
    for axis, cut in zip(_AXES, given, strict=False):
        _check_slice(axis, cut)
    k, j, i = [*given, slice(None), slice(None), slice(None)][:3]
    return k, j, i


def _check_slice(axis: str, cut: Any) -> None:
    if isinstance(cut, slice):
        try:
            cut.indices(1)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{_slice_text(cut)} along {axis} is no range of indices: {error}") from error
        return
    try:
        number = operator.index(cut)
    except TypeError:
        raise UsageError(
            f"a volume is cut by slices such as 10:20 along k, j, i, not by {type(cut).__name__} along {axis}: for an"
            " array take volume.voxels[...], for a mask clrecon.Mask"
        ) from None
    end = "" if number == -1 else number + 1
    raise UsageError(
        f"the index {number} along {axis} leaves no volume: take {number}:{end} for a slab of one, or"
        " volume.voxels[...] for the array"
    )


def _slice_text(cut: slice) -> str:
    ends = ["" if end is None else str(end)[:20] for end in (cut.start, cut.stop)]
    return ":".join([*ends, *([] if cut.step is None else [str(cut.step)[:20]])])


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
