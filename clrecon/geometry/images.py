"""Volumes as images of other libraries, whose axes are even and at right angles: as they are, or resampled."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, column_spacing, lps_affine_from_ras
from clrecon.geometry.grid import BaseVolume
from clrecon.geometry.resample import (
    LARGEST_SHEAR_DEGREES,
    air_of,
    check_count,
    describe_unevenness,
    regular_grid,
    resample_grid,
    shear_degrees,
)
from clrecon.system.packages import import_package

Taken = tuple[NDArray[Any], Float64Array]
"""Voxels, shape (nk, nj, ni), and the affine, index (i, j, k) to LPS mm: what is taken of an image."""


class Image(NamedTuple):
    """Voxels (nk, nj, ni) that an image can hold, those of the volume unless `resampled` says why they are others."""

    voxels: NDArray[Any]
    affine: Float64Array
    resampled: str | None


def image_of(volume: BaseVolume, resample: bool, method: str, *, holds_shear: bool = False) -> Image:
    """Return a volume as an image has it; `method` of `Volume` was called.

    `resample` what no image can hold, uneven or maybe sheared, to a regular grid (trilinear) around all its voxels: i
    and j in their own steps, k in the smallest step of the slices along their normal.
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


def make_sitk(voxels: NDArray[Any], affine: Float64Array) -> Any:
    """Make a ``SimpleITK.Image``, a copy, of voxels (nk, nj, ni) and their affine."""
    image = import_package("SimpleITK", "an image of SimpleITK").GetImageFromArray(voxels)
    spacing = column_spacing(affine)
    image.SetSpacing(spacing)
    image.SetOrigin(affine[:3, 3].tolist())
    image.SetDirection((affine[:3, :3] / spacing).ravel().tolist())
    return image


def take_sitk(image: Any) -> Taken:
    """Take voxels, a copy, and affine of a ``SimpleITK.Image``."""
    sitk = import_package("SimpleITK", "an image of SimpleITK")
    if not isinstance(image, sitk.Image):
        raise UsageError(f"{type(image).__name__} is no SimpleITK.Image")
    if image.GetDimension() != 3:
        raise UsageError(f"the image has {image.GetDimension()} axes, a volume has three: of 4D take image[:, :, :, 0]")
    kind = image.GetPixelIDTypeAsString()
    if image.GetNumberOfComponentsPerPixel() != 1 or "complex" in kind or "label" in kind:
        raise UsageError(f"the pixels of the image are {kind}: a volume has one real number a voxel")
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return sitk.GetArrayFromImage(image), affine


MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
"""Millimetres of each code of the spatial unit: unknown (read as mm, as other programs do), metre, mm, micron."""

MM = 2
_SCANNER = 1
"""Codes of NIfTI: lengths in mm, positions as the scanner gave them."""


def place_in_header(header: Any, affine: Float64Array) -> None:
    """Write the place of the voxels, given their affine to LPS mm, into a header of nibabel."""
    ras = lps_affine_from_ras(affine)
    header.set_xyzt_units(MM)
    header.set_sform(ras, _SCANNER)
    axes = ras[:3, :3] / np.linalg.norm(ras[:3, :3], axis=0)
    if np.abs(axes.T @ axes - np.eye(3)).max() < 1e-6:
        header.set_qform(ras, _SCANNER)  # cannot hold a shear
    else:
        header["pixdim"][1:4] = column_spacing(affine)


def make_nibabel(voxels: NDArray[Any], affine: Float64Array) -> Any:
    """Make a ``nibabel.Nifti1Image`` of voxels (nk, nj, ni), whose memory it shares, and their affine."""
    nibabel = import_package("nibabel", "an image of nibabel")
    image = nibabel.Nifti1Image(voxels.T, lps_affine_from_ras(affine))
    place_in_header(image.header, affine)
    return image


def take_nibabel(image: Any) -> Taken:
    """Take voxels and affine of an image of nibabel; values as its header scales them."""
    nibabel = import_package("nibabel", "an image of nibabel")
    if not isinstance(image, nibabel.spatialimages.SpatialImage):
        raise UsageError(f"{type(image).__name__} is no image of nibabel: of a file take nibabel.load(path)")
    stored = image.get_data_dtype()
    if stored.kind not in "iufb":
        kind = "colours" if stored.names else str(stored)
        raise UsageError(f"the voxels of the image are {kind}: a volume has one real number a voxel")
    shape = tuple(int(n) for n in image.shape)
    if len(shape) < 3 or any(n != 1 for n in shape[3:]):
        raise UsageError(
            f"the image has shape {shape}, a volume has three axes: of 4D take image.slicer[..., 0]"
            if len(shape) > 3
            else f"the image has shape {shape}, a volume has three axes"
        )
    affine = _affine_of(image)
    return _as_whole_numbers(np.asanyarray(image.dataobj).reshape(shape[:3]), stored).T, affine


def _affine_of(image: Any) -> Float64Array:
    header, unit = image.header, 1.0
    coded = all(hasattr(header, name) for name in ("get_sform", "get_qform"))
    is_placed = not coded or any(int(header[f"{form}_code"]) for form in ("sform", "qform"))
    if image.affine is None or not is_placed:
        raise UsageError("the image does not say where it lies: it has no affine, or sform_code and qform_code are 0")
    if coded:
        code = int(header["xyzt_units"]) & 7
        if code not in MM_PER_UNIT:
            raise UsageError(f"the image has lengths in unknown units (code {code}): metres, mm and microns are known")
        unit = MM_PER_UNIT[code]
    return lps_affine_from_ras(np.diag((unit, unit, unit, 1.0)) @ checked_affine(image.affine))


def _as_whole_numbers(values: NDArray[Any], stored: np.dtype[Any]) -> NDArray[Any]:
    """Return values in the type of `read_volume`: whole if stored so, and slope and intercept left them."""
    if values.dtype.kind != "f" or stored.kind == "f":
        return values
    low, high = values.min(), values.max()
    whole = all(np.array_equal(plane, np.rint(plane)) for plane in np.moveaxis(values, 2, 0))
    for name in ("int16", "int32"):
        limits = np.iinfo(name)
        if whole and limits.min <= low and high <= limits.max:
            return values.astype(name)
    return values
