"""Volumes as ``pyvista.ImageData`` and back: how VTK treats an image's axes is handled here alone.

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
from clrecon.geometry.affine import Float64Array, choose_space, frame_from_lps, is_left_handed
from clrecon.geometry.images import Image, Taken

_TURNED = "in reverse order: the volume's axes are left-handed"
"""Field array ``SLICES`` of an image whose slices run from the last one of the volume to its first."""


def make_image_data(volume: Image, name: str = "HU") -> Any:
    """Make the image of `Volume.to_pyvista`, its numbers as the point data `name`."""
    import pyvista

    notes = {} if volume.resampled is None else {"RESAMPLED": f"trilinear, to a regular grid: {volume.resampled}"}
    affine, values = volume.affine, volume.voxels
    if is_left_handed(affine):
        notes["SLICES"] = _TURNED
        values, affine = _reversed(values, affine)
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    image = pyvista.ImageData(dimensions=values.shape[::-1], spacing=tuple(steps), origin=tuple(affine[:3, 3]))
    image.SetDirectionMatrix(*(affine[:3, :3] / steps).ravel())  # pyvista has a property for it since 0.45
    image.point_data[name] = values.reshape(-1)
    image.set_active_scalars(name)
    for note, text in {"SPACE": "LPS", "UNIT": "mm", **notes}.items():
        image.field_data[note] = [text]
    return image


def take_image_data(image: Any, name: str | None, space: str | None) -> Taken:
    """Take voxels, a copy, and affine of a ``pyvista.ImageData``; see `Volume.from_pyvista`."""
    import pyvista

    wrapped = pyvista.wrap(image) if hasattr(image, "GetPointData") else image
    if not isinstance(wrapped, pyvista.ImageData):
        raise UsageError(f"{type(image).__name__} is no pyvista.ImageData: a volume has even steps along three axes")
    values = np.array(_numbers_of(wrapped, name)).reshape(wrapped.dimensions[::-1])
    affine = np.eye(4)
    matrix = wrapped.GetDirectionMatrix()
    direction = [[matrix.GetElement(row, column) for column in range(3)] for row in range(3)]
    affine[:3, :3] = np.array(direction) * wrapped.GetSpacing()
    affine[:3, 3] = wrapped.GetPoint(0)  # an image that was cut out of another does not begin at its origin
    turn = np.eye(4)
    turn[:3, :3] = frame_from_lps(choose_space(space, _read_note(wrapped, "SPACE"), "the ImageData"))
    affine = turn @ affine  # its own inverse: to LPS as from LPS
    if _read_note(wrapped, "SLICES") == _TURNED:
        values, affine = _reversed(values, affine)
    return values, affine


def _numbers_of(image: Any, name: str | None) -> Any:
    """Return the point data `name`, or the active scalars, shape (n,)."""
    names = list(image.point_data.keys())
    chosen = image.point_data.active_scalars_name if name is None else name
    if chosen is None and len(names) == 1:
        chosen = names[0]
    if chosen not in names:
        if not names and image.cell_data.keys():
            raise UsageError(
                "the numbers of the ImageData belong to its cells, those of a volume to its points: take"
                " image.cells_to_points() first"
            )
        asked = "no active scalars" if chosen is None else f"no point data {str(chosen)[:40]!r}"
        raise UsageError(f"the ImageData has {asked}; it has {', '.join(map(str, names))[:100] or 'none'}")
    values = image.point_data[chosen]
    if values.ndim != 1:
        raise UsageError(
            f"the point data {str(chosen)[:40]!r} have {values.shape[1]} numbers a point: a volume has one real number"
            " a voxel"
        )
    return values


def _read_note(image: Any, name: str) -> str | None:
    return str(image.field_data[name][0]) if name in image.field_data else None


def _reversed(voxels: NDArray[Any], affine: Float64Array) -> Taken:
    """Return voxels with their slices in reverse order, a copy as VTK needs positive steps, and the affine of these."""
    turned = affine.copy()
    turned[:3, 3] += (len(voxels) - 1) * affine[:3, 2]
    turned[:3, 2] *= -1.0
    return np.ascontiguousarray(voxels[::-1]), turned
