"""Volumes as ``SimpleITK.Image``: ITK places voxel centres in LPS mm, as clrecon does."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, column_spacing
from clrecon.geometry.images import Taken
from clrecon.system.packages import import_package


def make_sitk(voxels: NDArray[Any], affine: Float64Array) -> Any:
    """Make a ``SimpleITK.Image``, a copy, of voxels (nk, nj, ni) and their affine."""
    sitk = import_package("SimpleITK", "an image of SimpleITK")
    image = sitk.GetImageFromArray(voxels)
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
