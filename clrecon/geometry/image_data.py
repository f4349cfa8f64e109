"""A volume as ``pyvista.ImageData``: the one place that knows what VTK makes of an image's axes.

``vtkImageData`` places its points by an origin, a spacing for each axis and a direction matrix: axes at right angles
and even steps.  What else VTK does with such an image, as tried with VTK 9.7:

- It turns what it contours in an image of left-handed axes inside out, and its volume mappers show nothing of it.  The
  slices of such volumes are given in reverse order: the axes are right-handed then and every voxel stays where it is.
- ``vtkFlyingEdges3D`` (pyvista's ``method="flying_edges"``) and the volume mapper for GPUs look at the direction;
  ``vtkContourFilter``, which is pyvista's default, and the fixed-point volume mapper do not.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, apply_affine, is_left_handed

if TYPE_CHECKING:
    from clrecon.geometry.volume import Volume

__all__ = ["RegularGrid", "make_image_data", "regular_grid", "shear_degrees"]

LARGEST_SHEAR_DEGREES = 0.01
"""Axes this near to right angles count as such: directions of headers are rounded.  The image keeps them as they are,
so that its points are those of the volume."""

ON_GRID = 1e-6
"""Steps; a volume that ends this near to a point of the regular grid needs no further one."""


class RegularGrid(NamedTuple):
    """Points in even steps along axes at right angles.

    Attributes
    ----------
    affine : ndarray, shape (4, 4), float64
        Index to LPS mm, right-handed.
    shape_ijk : (int, int, int)
    """

    affine: Float64Array
    shape_ijk: tuple[int, int, int]


def make_image_data(volume: Volume, resample: bool) -> Any:
    """See `Volume.to_pyvista`."""
    import pyvista

    notes = {}
    fault = _fault_of(volume)
    if fault is None:
        affine, values = volume.affine, volume.voxels
        if is_left_handed(affine):
            notes["SLICES"] = "in reverse order: the volume's axes are left-handed"
            affine, values = _reversed(volume)
    elif resample:
        notes["RESAMPLED"] = f"trilinear, to a regular grid: {fault}"
        grid = regular_grid(volume)
        affine, values = grid.affine, _resample(volume, grid)
    else:
        raise UsageError(
            f"an image of pyvista has even steps and axes at right angles, but {fault}: use"
            " to_pyvista(resample=True) for a copy on a regular grid of the same spacing"
        )
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    image = pyvista.ImageData(dimensions=values.shape[::-1], spacing=tuple(steps), origin=tuple(affine[:3, 3]))
    image.SetDirectionMatrix(*(affine[:3, :3] / steps).ravel())  # pyvista has a property for it from 0.45 on
    image.point_data["HU"] = values.reshape(-1)
    image.set_active_scalars("HU")
    for name, text in {"SPACE": "LPS", "UNIT": "mm", **notes}.items():
        image.field_data[name] = [text]
    return image


def shear_degrees(affine: Float64Array) -> float:
    """Largest deviation of the angles between the three axes from right angles, degrees."""
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    cosines = axes.T @ axes
    return float(np.degrees(np.arcsin(np.clip(np.abs(cosines - np.diag(np.diag(cosines))).max(), 0.0, 1.0))))


def _fault_of(volume: Volume) -> str | None:
    """Why an image cannot hold this volume as it is; None where it can."""
    if volume.uneven:
        gaps = np.linalg.norm(np.diff(volume.slice_origins(), axis=0), axis=1)
        return f"the slices of this volume are uneven ({gaps.min():.4g} to {gaps.max():.4g} mm apart)"
    shear = shear_degrees(volume.affine)
    return f"the axes of this volume are sheared by {shear:.2f} degrees" if shear > LARGEST_SHEAR_DEGREES else None


def _reversed(volume: Volume) -> tuple[Float64Array, NDArray[Any]]:
    """The affine that counts slices from the last one, and the voxels so (a copy: VTK knows no backward steps)."""
    affine = volume.affine.copy()
    affine[:3, 3] += (volume.voxels.shape[0] - 1) * affine[:3, 2]
    affine[:3, 2] *= -1.0
    return affine, np.ascontiguousarray(volume.voxels[::-1])


def regular_grid(volume: Volume) -> RegularGrid:
    """The smallest regular grid around all voxel centres of a volume.

    i runs as in the volume, j within the plane of the slices, k along their normal; the step of k is the mean distance
    of the slices along it.  Where a volume is sheared but even, the planes of the grid are those of its slices.
    """
    di, dj, _ = volume.spacing
    first = volume.affine[:3, 0] / di
    second = volume.affine[:3, 1] - (volume.affine[:3, 1] @ first) * first
    second /= np.linalg.norm(second)
    axes = np.column_stack([first, second, np.cross(first, second)])
    origins = volume.slice_origins()
    ni, nj, nk = volume.shape_ijk
    in_plane = np.array([(i, j) for i, j in product((0, ni - 1), (0, nj - 1))]) @ volume.affine[:3, :2].T
    places = (origins[:, None, :] + in_plane).reshape(-1, 3) @ axes
    heights = origins @ axes[:, 2]
    dk = abs(heights[-1] - heights[0]) / (nk - 1) if nk > 1 else abs(volume.affine[:3, 2] @ axes[:, 2])
    spacing = np.array([di, dj, dk])
    low, high = places.min(axis=0), places.max(axis=0)
    counts = np.ceil((high - low) / spacing - ON_GRID).astype(int) + 1
    affine = np.eye(4)
    affine[:3, :3] = axes * spacing
    affine[:3, 3] = axes @ low
    return RegularGrid(affine, (int(counts[0]), int(counts[1]), int(counts[2])))


def _resample(volume: Volume, grid: RegularGrid) -> NDArray[Any]:
    """Values of a volume (trilinear) at the points of a grid, plane by plane; air beyond its voxels.

    Returns
    -------
    ndarray, shape (nk, nj, ni)
        In the type of the voxels; integers are rounded.
    """
    from clrecon.geometry.volume import AIR_HU

    ni, nj, nk = grid.shape_ijk
    dtype = volume.voxels.dtype
    air = AIR_HU if dtype.kind == "f" else max(AIR_HU, np.iinfo(dtype).min)
    values = np.full((nk, nj, ni), air, dtype)
    for k, plane in enumerate(values):
        # The plane is parallel to the slices: one k for all of it, and i and j run linearly along its rows and columns.
        corners = volume.lps_to_ijk(apply_affine(grid.affine, [[0.0, 0.0, k], [1.0, 0.0, k], [0.0, 1.0, k]]))
        first, columns, rows = corners[0], corners[1] - corners[0], corners[2] - corners[0]
        if not -0.5 <= first[2] <= volume.voxels.shape[0] - 0.5:
            continue
        found, inside = _sample_plane(_slice_at(volume, first[2]), first, columns, rows, (nj, ni))
        if dtype.kind != "f":
            np.rint(found, out=found)
        np.copyto(plane, found, where=inside, casting="unsafe")
    return values


def _slice_at(volume: Volume, k: float) -> NDArray[np.float32]:
    """The slice at a fraction of an index, shape (nj, ni); the outer ones beyond the ends."""
    k = min(max(k, 0.0), volume.voxels.shape[0] - 1.0)
    below = int(k)
    values = volume.voxels[below].astype(np.float32)
    if k > below:
        values += np.float32(k - below) * (volume.voxels[below + 1].astype(np.float32) - values)
    return values


def _sample_plane(
    values: NDArray[np.float32], first: Float64Array, columns: Float64Array, rows: Float64Array, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A slice (bilinear, its outer values beyond it) at ``first + column * columns + row * rows``.

    Returns
    -------
    found : ndarray of `shape`, float32
    inside : ndarray of `shape`, bool
        At most half a voxel beyond the outer centres.
    """
    from scipy import ndimage

    matrix = np.array([[rows[1], columns[1]], [rows[0], columns[0]]])
    found = ndimage.affine_transform(values, matrix, first[1::-1], shape, np.float32, order=1, mode="nearest")
    row, column = np.ogrid[: shape[0], : shape[1]]
    inside = np.ones(shape, dtype=bool)
    for axis, count in enumerate(values.shape[::-1]):
        place = first[axis] + row * rows[axis] + column * columns[axis]
        inside &= (place >= -0.5) & (place <= count - 0.5)
    return found, inside
