"""Volumes as images of nibabel: its arrays run (i, j, k), and its affines lead to RAS."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, column_spacing
from clrecon.geometry.frames import lps_affine_from_ras
from clrecon.geometry.images import Taken
from clrecon.system.packages import import_package

MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
"""Millimetres of each code of the spatial unit: unknown (read as mm, as other programs do), metre, mm, micron."""

MM = 2
SCANNER = 1
"""Codes of NIfTI: lengths in mm, positions as the scanner gave them."""


def place_in_header(header: Any, affine: Float64Array) -> None:
    """Write the place of the voxels into a header of nibabel.

    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.
    """
    ras = lps_affine_from_ras(affine)
    header.set_xyzt_units(MM)
    header.set_sform(ras, SCANNER)
    if _is_rigid(ras):
        header.set_qform(ras, SCANNER)  # cannot hold a shear
    else:
        header["pixdim"][1:4] = column_spacing(affine)


def _is_rigid(affine: Float64Array) -> bool:
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    return bool(np.abs(axes.T @ axes - np.eye(3)).max() < 1e-6)


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
    values = _whole(np.asanyarray(image.dataobj).reshape(shape[:3]), stored)
    return values.T, affine


def _affine_of(image: Any) -> Float64Array:
    header, unit = image.header, 1.0
    coded = all(hasattr(header, name) for name in ("get_sform", "get_qform"))
    told = not coded or any(int(header[f"{form}_code"]) for form in ("sform", "qform"))
    if image.affine is None or not told:
        raise UsageError("the image does not say where it lies: it has no affine, or sform_code and qform_code are 0")
    if coded:
        code = int(header["xyzt_units"]) & 7
        if code not in MM_PER_UNIT:
            raise UsageError(f"the image has lengths in unknown units (code {code}): metres, mm and microns are known")
        unit = MM_PER_UNIT[code]
    return lps_affine_from_ras(np.diag((unit, unit, unit, 1.0)) @ checked_affine(image.affine))


def _whole(values: NDArray[Any], stored: np.dtype[Any]) -> NDArray[Any]:
    """Return values in the type that `read_volume` gives them: stored whole numbers that slope and intercept left whole
    are whole numbers.
    """
    if values.dtype.kind != "f" or stored.kind == "f":
        return values
    low, high = values.min(), values.max()
    whole = all(np.array_equal(plane, np.rint(plane)) for plane in np.moveaxis(values, 2, 0))
    for name in ("int16", "int32"):
        limits = np.iinfo(name)
        if whole and limits.min <= low and high <= limits.max:
            return values.astype(name)
    return values
