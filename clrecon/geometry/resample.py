"""`resample_volume`: a copy of a volume on a regular grid."""

from __future__ import annotations

import math

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.blocks import describe_place
from clrecon.geometry.certificate import amend
from clrecon.geometry.regular import regular_grid, resample_grid
from clrecon.geometry.volume import AIR_HU, Volume
from clrecon.system.progress import Progress, ignore_progress

__all__ = ["MOST_VOXELS", "SMALLEST_STEP_MM", "check_step", "resample_volume"]

SMALLEST_STEP_MM = 0.01
MOST_VOXELS = 2**31
"""Most voxels of a resampled volume: 4 GiB of int16."""


def check_step(step_mm: float) -> None:
    """Refuse a step that no regular grid has.

    Raises
    ------
    UsageError
        It is no number, or below 0.01 mm.
    """
    if not (math.isfinite(step_mm) and step_mm >= SMALLEST_STEP_MM):
        raise UsageError(
            f"the step of a resampled volume is a length of at least {SMALLEST_STEP_MM:g} mm, not {step_mm:g}"
        )


def resample_volume(volume: Volume, step_mm: float, *, progress: Progress | None = None) -> Volume:
    """Resample a volume (trilinear) to a regular grid with the same step along all axes, at right angles.

    i runs as in the volume, j within the plane of its slices, k along their normal.  The grid encloses all voxel
    centres; points beyond the voxels are air (`AIR_HU`).  Whole numbers are rounded.  Steps longer than those of the
    volume take single values and no means: smooth the volume first where that matters.

    Parameters
    ----------
    volume : Volume
    step_mm : float
    progress : callable, optional
        ``progress("resample", done, total)`` in slices.

    Returns
    -------
    Volume
        ``report["resampled"]`` says so, with ``step_mm`` and ``method``.

    Raises
    ------
    UsageError
        `step_mm` is no length, or below 0.01 mm.
    RefusedInputError
        The result would have more than 2^31 voxels.
    """
    check_step(step_mm)
    regular = regular_grid(volume, volume.slice_origins(), step_mm)
    count = math.prod(regular.shape_ijk)
    if count > MOST_VOXELS:
        shape = " x ".join(f"{n:,}" for n in regular.shape_ijk)
        raise RefusedInputError(
            f"in steps of {step_mm:g} mm the volume has {shape} voxels, at most {MOST_VOXELS:,} are made: take a longer"
            " step, or crop it"
        )
    dtype = volume.voxels.dtype
    air = AIR_HU if dtype.kind == "f" else max(AIR_HU, np.iinfo(dtype).min)
    made = Volume(resample_grid(volume, regular, air, progress or ignore_progress), regular.affine)
    before = " x ".join(f"{step:.4g}" for step in volume.spacing)
    said = f"resampled (trilinear) from {'uneven slices' if volume.uneven else f'{before} mm'} to {step_mm:g} mm"
    made.report = amend(
        volume.report,
        resampled={"step_mm": float(step_mm), "method": "trilinear"},
        warnings=[*volume.report.get("warnings", ()), said],
        **describe_place(volume.report, made),
    )
    return made
