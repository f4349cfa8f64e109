"""`resample_volume`: a copy of a volume on a regular grid."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.base import AIR_HU, BaseVolume
from clrecon.geometry.blocks import describe_place
from clrecon.geometry.certificate import amend
from clrecon.geometry.regular import RegularGrid, regular_grid, resample_grid
from clrecon.system.progress import Progress, ignore_progress

Own = TypeVar("Own", bound=BaseVolume)

SMALLEST_STEP_MM = 0.01
MOST_VOXELS = 2**31
"""Most voxels of a resampled volume: 4 GiB of int16."""


def check_step(step_mm: float) -> None:
    """Refuse a step that no regular grid has."""
    number = isinstance(step_mm, int | float | np.integer | np.floating)
    if not (number and math.isfinite(step_mm) and step_mm >= SMALLEST_STEP_MM):
        shown = f"{step_mm:g}" if number else repr(step_mm)[:40]
        raise UsageError(f"the step of a resampled volume is a length of at least {SMALLEST_STEP_MM:g} mm, not {shown}")


def check_count(regular: RegularGrid, steps: str) -> None:
    """Refuse a grid that is too large.

    steps: What its steps are, for the message.
    """
    if math.prod(regular.shape_ijk) > MOST_VOXELS:
        shape = " x ".join(f"{n:,}" for n in regular.shape_ijk)
        raise RefusedInputError(
            f"{steps} the volume has {shape} voxels, at most {MOST_VOXELS:,} are made: take a longer step, or crop it"
        )


def air_of(dtype: np.dtype[Any]) -> float:
    """Return the value of voxels that hold no measurement, `AIR_HU` or the lowest value that the type has."""
    return AIR_HU if dtype.kind == "f" else max(AIR_HU, int(np.iinfo(dtype).min))


def resample_volume(volume: Own, step_mm: float, *, progress: Progress | None = None) -> Own:
    """Resample a volume (trilinear) to a regular grid with the same step along all axes, at right angles.

    i runs as in the volume, j within the plane of its slices, k along their normal.  The grid encloses all voxel
    centres; points beyond the voxels are air (`AIR_HU`).  Whole numbers are rounded.  Steps longer than those of the
    volume take single values and no means: smooth the volume first where that matters.

    progress: ``progress("resample", done, total)`` in slices.

    Returns: ``report["resampled"]`` says so, with ``step_mm`` and ``method``.
    """
    check_step(step_mm)
    regular = regular_grid(volume, volume.slice_origins(), step_mm)
    check_count(regular, f"in steps of {step_mm:g} mm")
    voxels = resample_grid(volume, regular, air_of(volume.dtype), progress or ignore_progress)
    made = type(volume)(voxels, regular.affine)
    before = " x ".join(f"{step:.4g}" for step in volume.spacing)
    said = f"resampled (trilinear) from {'uneven slices' if volume.uneven else f'{before} mm'} to {step_mm:g} mm"
    made.report = amend(
        volume.report,
        resampled={"step_mm": float(step_mm), "method": "trilinear"},
        warnings=[*volume.report.get("warnings", ()), said],
        **describe_place(volume.report, made),
    )
    return made
