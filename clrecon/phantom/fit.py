"""How many slices chosen levels need, and whether those that are given hold them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.phantom.chain import SpineChoice
from clrecon.phantom.extent import body_extent, bone_extent
from clrecon.phantom.frames import slice_directions
from clrecon.phantom.levels import format_levels
from clrecon.phantom.parts import Vertebra
from clrecon.phantom.plan import plan_anatomy

Float64Array = NDArray[np.float64]

MOST_SLICES = 9999


def spine_choice(
    levels: tuple[str, ...],
    bend: tuple[float, float],
    facet_gap_mm: float | None,
    *,
    centred: bool,
    directions: tuple[float, tuple[float, float, float], bool],
    length_mm: float | None,
) -> SpineChoice:
    """Return a choice for slices that lie as `slice_directions` says.

    bend: (kyphosis, scoliosis). Degrees.
    directions: (tilt, oblique, prone)
    length_mm: Length of the volume along the normal of its slices.
    """
    row, column, _ = slice_directions(*directions)
    x, y, z = (float(value) for value in np.cross(row, column))
    return SpineChoice(levels, *bend, facet_gap_mm, centred, (x, y, z), length_mm)


def _reach(extent: tuple[float, float]) -> float:
    return 2.0 * max(abs(extent[0]), abs(extent[1]))


def fit_slices(
    choice: SpineChoice,
    size: tuple[int, int],
    spacing: tuple[float, float, float],
    seed: int,
    directions: tuple[float, tuple[float, float, float], bool],
    slices: int | None,
) -> int:
    """Return the number of slices: the given one, if it holds the vertebral bodies, else as many as the bones need.

    size: (columns, rows)
    spacing: (dj, di, dk). mm.
    directions: (tilt, oblique, prone)
    """
    dj, di, dk = spacing
    open_joints = dataclasses.replace(choice, facet_gap_mm=None)
    extent = size[0] * di, size[1] * dj
    anatomy = plan_anatomy((*extent, 0.0), np.diag((di, dj, dk)), seed, open_joints)
    shown: list[Vertebra] = anatomy.vertebrae
    named = f"levels {format_levels(choice.levels)}"
    whole = math.ceil(_reach(bone_extent(shown, choice.normal)) / dk)
    bodies = math.ceil(_reach(body_extent(shown, choice.normal)) / dk)
    row, column, _ = slice_directions(*directions)
    for what, direction, available in (("columns", row, extent[0]), ("rows", column, extent[1])):
        needed = _reach(body_extent(shown, direction))
        if needed > available:
            raise UsageError(
                f"{named} do not fit: their bodies need {needed:.0f} mm of {what}, there are {available:.0f} mm;"
                " take more pixels, larger ones or fewer levels"
            )
    if slices is not None:
        if bodies > slices:
            raise UsageError(
                f"{named} do not fit into {slices} slices of {dk:g} mm: their bodies need {bodies} slices, whole"
                f" vertebrae {whole}; name fewer levels, or leave the number of slices out"
            )
        return slices
    if whole > MOST_SLICES:
        raise UsageError(f"{named} need {whole} slices of {dk:g} mm: at most {MOST_SLICES} are possible")
    return whole
