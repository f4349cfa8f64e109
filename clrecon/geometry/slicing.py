"""Parts of a volume by indices, ``volume[k0:k1, j0:j1, i0:i1]``: voxels keep their places in the patient."""

from __future__ import annotations

import math
import operator
from typing import Any, TypeVar

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.base import BaseVolume
from clrecon.geometry.blocks import Block, describe_place, place_block
from clrecon.geometry.certificate import amend

Own = TypeVar("Own", bound=BaseVolume)

_AXES = "kji"


def slice_volume(volume: Own, key: Any) -> Own:
    """Return a part of a volume with the affine, and the slice positions where they are uneven, of that part.

    The rules are those of nibabel's ``image.slicer``, in the order of the array: ``volume[key].voxels`` is
    ``volume.voxels[key]``.

    key: Along k, j, i; ``...`` stands for whole axes.  A step of 2 takes every other voxel and doubles the spacing,
        without smoothing.  A step below zero turns an axis round: index space may become left-handed.

    Returns: Its voxels are a view of those of `volume` where they can be.  ``report["sliced"]`` has the figures.
    """
    slices = _checked_slices(key)
    ranges = [range(*one.indices(size)) for one, size in zip(slices, volume.shape, strict=True)]
    for axis, kept, one, size in zip(_AXES, ranges, slices, volume.shape, strict=True):
        if not kept:
            raise UsageError(f"nothing is left: {_describe(one)} holds none of the {size} indices along {axis}")
    along_ijk = ranges[::-1]
    affine = np.array(volume.affine)
    for column, kept in enumerate(along_ijk):
        # A single voxel has no neighbour to be further away from: it keeps the step of the volume.
        step = kept.step if len(kept) > 1 else math.copysign(1, kept.step)
        affine[:3, column] = affine[:3, column] * step + 0.0  # which turns -0 into 0
    aside = volume.affine[:3, :2] @ [kept.start for kept in along_ijk[:2]]
    origins = volume.slice_origins()[np.array(along_ijk[2])] + aside
    shape = tuple(len(kept) for kept in along_ijk)
    placed, positions = place_block(affine, origins, volume.uneven, Block((0, 0, 0), shape))  # type: ignore[arg-type]
    made = type(volume)(volume.voxels[slices], placed, None, positions)
    said = f"sliced to {', '.join(map(_describe, slices))} of k, j, i: {made.voxels.size:,} of {volume.voxels.size:,}"
    made.report = amend(
        volume.report,
        sliced={
            "first_ijk": [kept.start for kept in along_ijk],
            "step_ijk": [kept.step for kept in along_ijk],
            "shape_ijk_before": list(volume.shape_ijk),
        },
        warnings=[*volume.report.get("warnings", ()), f"{said} voxels stay"],
        **describe_place(volume.report, made),
    )
    return made


def _checked_slices(key: Any) -> tuple[slice, slice, slice]:
    """Return one slice for each of k, j, i."""
    given = key if isinstance(key, tuple) else (key,)
    places = [place for place, one in enumerate(given) if one is Ellipsis]
    if len(places) == 1:
        given = (*given[: places[0]], *[slice(None)] * max(0, 4 - len(given)), *given[places[0] + 1 :])
    if len(given) > 3:
        raise UsageError(f"a volume has three axes, k, j, i, and is cut by as many slices, not by {len(given)}")
    for axis, one in zip(_AXES, given, strict=False):
        _check_slice(axis, one)
    k, j, i = [*given, slice(None), slice(None), slice(None)][:3]
    return k, j, i


def _check_slice(axis: str, one: Any) -> None:
    if isinstance(one, slice):
        try:
            one.indices(1)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{_describe(one)} along {axis} is no range of indices: {error}") from error
        return
    try:
        number = operator.index(one)
    except TypeError:
        raise UsageError(
            f"a volume is cut by slices such as 10:20 along k, j, i, not by {type(one).__name__} along {axis}: for an"
            " array take volume.voxels[...], for a mask clrecon.Mask"
        ) from None
    end = "" if number == -1 else number + 1
    raise UsageError(
        f"the index {number} along {axis} leaves no volume: take {number}:{end} for a slab of one, or"
        " volume.voxels[...] for the array"
    )


def _describe(one: slice) -> str:
    ends = ["" if end is None else str(end)[:20] for end in (one.start, one.stop)]
    return ":".join([*ends, *([] if one.step is None else [str(one.step)[:20]])])
