"""What surrounds the patient: outside air below an iso value, and what a projection of the lowest values leaves out.

Voxels below an iso value are air around the patient, or lung, airway, sinus or bowel gas.  The body
(`clrecon.anatomy.body`) tells what is outside: its cavities belong to it.  An airway that is open to the outside, at
nostrils or mouth, is cut a little under the skin, and the area of the cut is reported.

A projection of the lowest values leaves out the air around the body, table and blankets, and masked voxels, at least as
low as what such a picture is made for (airways, emphysema, gas): a ray that counted them would show nothing else.  They
get a value above all others, which is never the lowest along a ray; a ray that meets nothing else is empty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from clrecon.anatomy.body import BODY_STEPS, MARGIN_MM, TISSUE_HU, find_body, find_unmeasured
from clrecon.anatomy.body_cells import count_cells, grow, spread_mask
from clrecon.errors import NoSurfaceError, RefusedInputError
from clrecon.geometry.certificate import amend
from clrecon.geometry.grid import AIR_HU
from clrecon.geometry.regions import FACES, Mask, Regions
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress, Steps
from clrecon.system.text import format_ml

SKIN_MM = 2.0
"""Air less deep than this below the outline of the body counts as outside: folds of the skin, steps of the outline."""
DEEP_MM = 5.0
"""Air that is connected to the outside is a cavity of the body if it reaches at least this far below `SKIN_MM`."""
OPEN_MM = 12.0
"""If an airway is open (parted lips) over at most this height, the outline there is that of the slices around it."""

_OWN_STEPS = 6
"""Steps after the search for the body, as progress counts them."""


def leave_outside_air(volume: Volume, levels: Sequence[float], *, progress: Progress | None = None) -> Volume:
    """Raise the air around the patient above the iso values (HU), so that no surface of air includes it.

    Air outside, never what is denser than -300 HU, gets a value as far above the highest level as air is below it, so
    that a surface between it and air of the body lies half way.  ``report["outside_air"]`` has ``left_out_ml``,
    ``kept_ml`` (below the highest level), ``opening_mm2`` (area where the two kinds of air meet, as far as it was
    measured) and ``filled_hu`` (the new value).
    """
    level = min(max(levels), TISSUE_HU)
    steps = Steps(progress, "mask", count_cells(volume)[0] + BODY_STEPS + _OWN_STEPS)
    try:
        body, step = find_body(volume, steps=steps)
    except RefusedInputError as error:
        way_out = f"{name_parameter('keep_outside', True)} takes all"
        raise RefusedInputError(f"{error}: what is outside of it is not known ({way_out})") from None
    # gaps along k close where voxels above and below, at most `reach` slices away, are inside
    reach = int(OPEN_MM / (2.0 * step[2] * volume.spacing[2]))
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    size, around = 2 * reach + 1, ((reach, reach), (0, 0), (0, 0))
    grown = maximum_filter1d(np.pad(body, around).view(np.uint8), size, axis=0, mode="constant")
    closed = minimum_filter1d(grown, size, axis=0, mode="constant", cval=1)
    body = np.asarray(closed[reach : len(closed) - reach].astype(bool))
    across = math.sqrt(step[0] * volume.spacing[0] * step[1] * volume.spacing[1])
    unmeasured = find_unmeasured(volume.voxels)
    steps.take()
    # A lung that is cut by the circle of the reconstruction reaches up to it: unmeasured voxels must not shrink the
    # body.
    inner = grow(body | unmeasured[:: step[2], :: step[1], :: step[0]], -(MARGIN_MM + SKIN_MM) / across)
    # Within a frame the border of the scan erodes too.
    framed = grow(np.pad(body, ((0, 0), (1, 1), (1, 1))), -(MARGIN_MM + SKIN_MM + DEEP_MM) / across)
    deep = _to_voxels(framed[:, 1:-1, 1:-1], step, volume)
    within = _to_voxels(inner, step, volume)
    steps.take()

    air = np.empty(volume.voxels.shape, dtype=bool)
    for k, layer in enumerate(volume.voxels):
        np.less(layer, level, out=air[k])
        volume.release_slices(k, k + 1)
    steps.take()
    cavities = _find_cavities(air, within & ~unmeasured, deep)
    steps.take()
    outside = air & ~cavities
    opening = _touching_mm2(cavities, outside & ~unmeasured, volume)
    steps.take()

    filled = _value_above(max(levels), volume.voxels.dtype)
    voxels = np.array(volume.voxels)
    voxels[outside] = filled
    left_out_ml, kept_ml = _millilitres(outside, volume), _millilitres(voxels < max(levels), volume)
    if kept_ml == 0.0:
        raise NoSurfaceError(
            f"nothing below {max(levels):g} HU lies within the body: {format_ml(left_out_ml)} are outside of it"
            f" ({name_parameter('keep_outside', True)} takes them)"
        )
    changed = volume.with_voxels(voxels)
    steps.take()
    facts = {
        "left_out_ml": round(left_out_ml, 3),
        "kept_ml": round(kept_ml, 3),
        "opening_mm2": round(opening, 1),
        "filled_hu": float(filled),
    }
    changed.report = amend(changed.report, outside_air=facts)
    return changed


def _find_cavities(air: Mask, within: Mask, deep: Mask) -> Mask:
    """Find air within the outline that is either not connected to the air outside, or reaches deep."""
    pieces = Regions(air & within, FACES)
    is_joined = pieces.sum_of(spread_mask(air & ~within)) > 0
    return pieces.cells_of(~is_joined | (pieces.sum_of(deep) > 0))


def _touching_mm2(inside: Mask, outside: Mask, volume: Volume) -> float:
    """Return the area of the faces between the voxels of two masks, mm2."""
    steps = volume.affine[:3, :3].T
    total = 0.0
    for axis in range(3):  # k, j, i
        area = float(np.linalg.norm(np.cross(steps[(3 - axis) % 3], steps[1 - axis])))
        here, there = np.moveaxis(inside, axis, 0), np.moveaxis(outside, axis, 0)
        total += area * int(np.count_nonzero(here[:-1] & there[1:]) + np.count_nonzero(there[:-1] & here[1:]))
    return total


def _millilitres(mask: Mask, volume: Volume) -> float:
    """Return the volume of the voxels of a mask, ml; a slice reaches half way to its neighbours."""
    steps = np.gradient(volume.slice_origins(border=1), axis=0)[1:-1]
    across = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    return float(np.count_nonzero(mask, axis=(1, 2)) @ np.abs(steps @ across)) / 1000.0


def _to_voxels(cells: Mask, step: tuple[int, int, int], volume: Volume) -> Mask:
    nk, nj, ni = volume.voxels.shape
    voxels = cells
    for axis, count in enumerate(reversed(step)):
        voxels = np.repeat(voxels, count, axis=axis)
    return np.asarray(voxels[:nk, :nj, :ni])


def _value_above(level: float, dtype: np.dtype[Any]) -> Any:
    """Return a value as far above a level as air lies below it, within the range of the type."""
    value = level + max(level - AIR_HU, 1.0)
    if dtype.kind == "f":
        return dtype.type(value)
    return dtype.type(min(math.ceil(value), np.iinfo(dtype).max))


LEFT_OUT = "left_out"
"""Entry of the report of a volume with voxels that are left out."""

LEFT_OUT_SKIN_MM = 3.0
"""The region left out around a body reaches at least this far below the skin: values there are blurred with air."""

LEAST_ROOM = 2.0
"""The value of what is left out lies so many times the range of the others above them: of a voxel beside it at most a
third can then be mistaken for something else."""


def leave_out_surroundings(volume: Volume, *, progress: Progress | None = None) -> Volume:
    """Give the voxels outside of the body, those that a mask has turned into air too, a value above all others.

    The type stays where it has room above the values, else it is float32.  ``report["left_out"]`` has ``highest_hu``,
    the highest value that counts: voxels above it are left out; ``value_hu``, which they get; and ``body``: whether a
    body was found.  Without one nothing is left out.
    """
    voxels, dtype = volume.voxels, volume.voxels.dtype
    low, high = float(np.nanmin(voxels)), float(np.nanmax(voxels))
    room = LEAST_ROOM * max(high - low, 1.0)
    value = high + 8.0 * room
    if dtype.kind in "iu" and np.iinfo(dtype).max - high >= room:
        value = float(min(np.iinfo(dtype).max, np.ceil(value)))
    else:
        dtype = np.dtype(np.float32)
    steps = Steps(progress, "mask", count_cells(volume)[0] + BODY_STEPS + len(voxels))
    cleared = np.array(voxels, dtype=dtype)
    try:
        body, (si, sj, sk) = find_body(volume, steps=steps)
    except RefusedInputError:
        body = None
    if body is not None:
        across = np.sqrt(si * volume.spacing[0] * sj * volume.spacing[1])
        body = grow(body, -(max(1, round(MARGIN_MM / across)) + np.ceil(LEFT_OUT_SKIN_MM / across)))
        for k, layer in enumerate(cleared):
            is_body = np.repeat(np.repeat(body[k // sk], sj, 0), si, 1)[: layer.shape[0], : layer.shape[1]]
            unmeasured = find_unmeasured(voxels[k : k + 1])[0]
            np.copyto(layer, value, where=~is_body | unmeasured, casting="unsafe")
            volume.release_slices(k, k + 1)
            steps.take()
    facts = {"highest_hu": high, "value_hu": value, "body": body is not None}
    return volume.with_voxels(cleared, amend(volume.report, **{LEFT_OUT: facts}))


def count_left_out(volume: Volume) -> dict[str, Any] | None:
    """Count the voxels that a volume leaves out, and say whether a body was found and a region applied; else None."""
    facts = volume.report.get(LEFT_OUT)
    if facts is None:
        return None
    voxels = sum(int(np.count_nonzero(layer > facts["highest_hu"])) for layer in volume.voxels)
    return {
        "voxels": voxels,
        "share": round(voxels / volume.voxels.size, 4),
        "body": facts["body"],
        "region": "region" in volume.report,
    }
