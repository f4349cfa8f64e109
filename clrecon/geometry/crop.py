"""`crop_volume`: the part of a volume that lies in a box, as a smaller volume."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.base import BaseVolume
from clrecon.geometry.blocks import Block, describe_place, find_block, place_block
from clrecon.geometry.certificate import amend
from clrecon.geometry.frames import frame_from_lps

Own = TypeVar("Own", bound=BaseVolume)


def crop_volume(volume: Own, low: ArrayLike, high: ArrayLike, *, margin: int = 0, space: str = "lps") -> Own:
    """Crop a volume to the smallest block of whole voxels that holds every voxel centre in a box.

    Voxels keep their places; slices of an uneven volume keep their own positions.  Where the volume lies oblique to the
    patient, the block also holds voxels beyond the box.

    low, high: array_like, shape (3,). Corners of the box along the axes of the patient, mm of the frame `space`;
        infinite numbers leave a side open.
    margin: Voxels more on each side, as far as the volume goes.
    space: {"lps", "ras"}

    Returns: Its voxels are a view of those of `volume` where they can be.  ``report["crop"]`` has the figures.
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
    return type(volume)(volume.voxels[k0:k1, j0:j1, i0:i1], affine, volume.report, positions)


def _certify(volume: Own, cropped: Own, block: Block, box: np.ndarray, space: str) -> Own:
    every, kept = math.prod(volume.shape_ijk), math.prod(cropped.shape_ijk)
    place = describe_place(volume.report, cropped)
    size = [n * step for n, step in zip(cropped.shape_ijk, cropped.spacing, strict=True)]
    whole = [n * step for n, step in zip(volume.shape_ijk, volume.spacing, strict=True)]
    facts = {
        "space": space.lower(),
        "box_mm": [[float(end) if math.isfinite(end) else None for end in corner] for corner in box],
        "first_ijk": list(block.first),
        "shape_ijk_before": list(volume.shape_ijk),
        "voxels": kept,
        "voxels_all": every,
    }
    said = (
        f"cropped to {_describe_box(box)} mm ({space.upper()}): {kept:,} of {every:,} voxels stay"
        f" ({100.0 * kept / every:.3g} %), {_describe_size(size)} of {_describe_size(whole)} mm"
    )
    warnings = [*volume.report.get("warnings", ()), said]
    cropped.report = amend(volume.report, crop=facts, warnings=warnings, **place)
    return cropped


def find_extent(volume: BaseVolume) -> tuple[Float64Array, Float64Array]:
    """Return the lowest and highest (x, y, z) of the box of the voxels' centres, LPS mm."""
    ni, nj, _ = volume.shape_ijk
    in_plane = np.array([(i, j) for i in (0, ni - 1) for j in (0, nj - 1)]) @ volume.affine[:3, :2].T
    corners = (volume.slice_origins()[:, None] + in_plane).reshape(-1, 3)
    return corners.min(axis=0), corners.max(axis=0)


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
