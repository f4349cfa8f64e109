"""A volume as ``pyvista.ImageData``: how VTK treats an image's axes is handled here alone.

``vtkImageData`` places its points by an origin, a spacing for each axis and a direction matrix: axes at right angles
and even steps.  Further behaviour of VTK, as tried with VTK 9.7:

- Contours of an image with left-handed axes come out with the inside outside, and volume mappers show nothing of it.
  Such volumes are passed with their slices in reverse order: the axes are then right-handed, and every voxel stays
  where it is.
- ``vtkFlyingEdges3D`` (pyvista's ``method="flying_edges"``) and the volume mapper for GPUs use the direction matrix;
  ``vtkContourFilter``, which is pyvista's default, and the fixed-point volume mapper do not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, is_left_handed
from clrecon.geometry.grid import Grid
from clrecon.geometry.regular import (
    LARGEST_SHEAR_DEGREES,
    describe_unevenness,
    regular_grid,
    resample_grid,
    shear_degrees,
)

__all__ = ["make_image_data"]


def make_image_data(grid: Grid, origins: Float64Array, uneven: bool, resample: bool, air: float) -> Any:
    """Make the image of `Volume.to_pyvista`.

    Parameters
    ----------
    grid : Grid
    origins : ndarray, shape (nk, 3)
        LPS mm of voxel (0, 0, k) of each slice.
    uneven : bool
        The slices lie elsewhere than the affine says.
    resample : bool
    air : float
        Value of the points beyond the voxels of a resampled volume.
    """
    import pyvista

    notes = {}
    fault = _fault_of(grid, origins, uneven)
    if fault is None:
        affine, values = grid.affine, grid.voxels
        if is_left_handed(affine):
            notes["SLICES"] = "in reverse order: the volume's axes are left-handed"
            affine, values = _reversed(grid)
    elif resample:
        notes["RESAMPLED"] = f"trilinear, to a regular grid: {fault}"
        regular = regular_grid(grid, origins)
        affine, values = regular.affine, resample_grid(grid, regular, air)
    else:
        raise UsageError(
            f"an image of pyvista has even steps and axes at right angles, but {fault}: use"
            " to_pyvista(resample=True) for a copy on a regular grid of the same spacing"
        )
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    image = pyvista.ImageData(dimensions=values.shape[::-1], spacing=tuple(steps), origin=tuple(affine[:3, 3]))
    image.SetDirectionMatrix(*(affine[:3, :3] / steps).ravel())  # pyvista has a property for it since 0.45
    image.point_data["HU"] = values.reshape(-1)
    image.set_active_scalars("HU")
    for name, text in {"SPACE": "LPS", "UNIT": "mm", **notes}.items():
        image.field_data[name] = [text]
    return image


def _fault_of(grid: Grid, origins: Float64Array, uneven: bool) -> str | None:
    """Return why an image cannot hold this volume as it is; None where it can."""
    if uneven:
        return describe_unevenness(origins)
    shear = shear_degrees(grid.affine)
    return f"the axes of this volume are sheared by {shear:.2f} degrees" if shear > LARGEST_SHEAR_DEGREES else None


def _reversed(grid: Grid) -> tuple[Float64Array, NDArray[Any]]:
    """Return the affine that counts slices from the last one, and the voxels in that order (a copy: VTK needs positive
    steps).
    """
    affine = grid.affine.copy()
    affine[:3, 3] += (grid.voxels.shape[0] - 1) * affine[:3, 2]
    affine[:3, 2] *= -1.0
    return affine, np.ascontiguousarray(grid.voxels[::-1])
