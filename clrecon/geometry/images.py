"""Volumes as images of other libraries, whose axes are even and at right angles: as they are, or resampled."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.base import BaseVolume
from clrecon.geometry.regular import (
    LARGEST_SHEAR_DEGREES,
    describe_unevenness,
    regular_grid,
    resample_grid,
    shear_degrees,
)
from clrecon.geometry.resample import air_of, check_count

Taken = tuple[NDArray[Any], Float64Array]
"""Voxels, shape (nk, nj, ni), and the affine, index (i, j, k) to LPS mm: what is taken of an image."""


class Image(NamedTuple):
    """Voxels that an image can hold.

    voxels: ndarray, shape (nk, nj, ni). Those of the volume, where it is not resampled.
    affine: ndarray, shape (4, 4), float64. Index (i, j, k) to LPS mm.
    resampled: Why they are resampled.
    """

    voxels: NDArray[Any]
    affine: Float64Array
    resampled: str | None


def image_of(volume: BaseVolume, resample: bool, method: str, *, holds_shear: bool = False) -> Image:
    """Return a volume as an image has it.

    resample: A volume that no image can hold is resampled (trilinear) to a regular grid around all its voxels: i and j
        in their own steps, k in the smallest step of the slices along their normal.
    method: The method of `Volume` that was called, for messages.
    holds_shear: The image's axes may lie at any angle.
    """
    fault = _fault_of(volume, holds_shear)
    if fault is None:
        return Image(volume.voxels, volume.affine, None)
    if not resample:
        needs = "even steps" if holds_shear else "even steps and axes at right angles"
        raise UsageError(
            f"this image has {needs}, but {fault}: use {method}(resample=True) for a copy on a regular grid in the"
            " smallest step of its slices, or volume.resample(MM) first"
        )
    regular = regular_grid(volume, volume.slice_origins())
    check_count(regular, "in the smallest step of its slices")
    return Image(resample_grid(volume, regular, air_of(volume.dtype)), regular.affine, fault)


def _fault_of(volume: BaseVolume, holds_shear: bool) -> str | None:
    """Return why an image cannot hold this volume as it is; None where it can."""
    if volume.uneven:
        return describe_unevenness(volume.slice_origins())
    shear = shear_degrees(volume.affine)
    if holds_shear or shear <= LARGEST_SHEAR_DEGREES:
        return None
    return f"the axes of this volume are sheared by {shear:.2f} degrees"
