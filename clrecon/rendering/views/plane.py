"""`Sheet`: where each pixel of a reformation lies in the patient, for planes and for curved ones alike.

Every row of such a picture is a straight line: it has an origin, a step from one pixel to the next, and a normal along
which a thick slice is sampled.  A plane has the same step and normal in every row; a curved reformation turns them
along its centre line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.geometry.volume import Volume
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.directions import DIRECTIONS, checked_size, number_or_nan
from clrecon.system.text import unknown_name

MOST_SAMPLES = 65536
"""Most samples through a thick slice; more mean that its thickness is a mistake."""

THIN_LAYER = 0.25
"""Layers of an uneven stack thinner than this share of a slice's pixel do not make the samples denser."""


@dataclass(frozen=True)
class Sheet:
    """Pixel (x, y) of a picture lies at ``origins[y] + x * steps[y]``, LPS mm.

    origins: ndarray, shape (h, 3), float64. Centre of the first pixel of each row.
    steps: ndarray, shape (h, 3), float64. Step from one pixel of a row to the next, mm.
    normals: ndarray, shape (h, 3), float64. Unit vectors into the picture, along which a thick slice is sampled.
    width: Number of pixels in a row.
    """

    origins: Float64Array
    steps: Float64Array
    normals: Float64Array
    width: int

    @property
    def height(self) -> int:
        """Number of rows."""
        return len(self.origins)

    def points(self, rows: slice = slice(None), depth: float = 0.0) -> Float64Array:
        """Return the centres of the pixels of `rows`, `depth` mm into the picture, (rows, w, 3) in LPS mm."""
        first = self.origins[rows] + depth * self.normals[rows]
        return np.asarray(first[:, None] + np.arange(self.width)[:, None] * self.steps[rows][:, None])


@dataclass(frozen=True)
class SlabSamples:
    """Samples of a thick slice along its normal: at ``(m - intervals / 2) * step`` mm for m from 0 to `intervals`.

    `intervals` is even, so that one sample lies on the sheet itself; 0 for a thin slice.  A mean gives the two ends
    half weight (trapezoidal rule). Along straight rows of voxels this is the exact integral of their interpolation if
    the samples lie on the voxels and half way between.
    """

    intervals: int
    step: float

    @property
    def offsets(self) -> Float64Array:
        """Positions in mm along the normal, (intervals + 1,)."""
        return np.asarray((np.arange(self.intervals + 1) - self.intervals // 2) * self.step, dtype=np.float64)

    @property
    def weights(self) -> Float64Array:
        """Weights of the samples in a mean, (intervals + 1,)."""
        weights: Float64Array = np.ones(self.intervals + 1, np.float64)
        if self.intervals:
            weights[[0, -1]] = 0.5
        return weights


def finest_step(volume: Volume) -> float:
    """Return the smallest distance in mm between neighbouring planes of voxel centres, over the three families of
    planes.
    """
    columns = volume.affine[:3, :3]
    if not volume.uneven:
        return float(1.0 / np.linalg.norm(np.linalg.inv(columns), axis=1).max())
    normal = np.cross(columns[:, 0], columns[:, 1])
    area = np.linalg.norm(normal)
    in_plane = area / np.linalg.norm(columns[:, :2], axis=0).max()
    gaps = np.abs(np.diff(volume.slice_origins() @ (normal / area)))
    return float(min(in_plane, max(gaps.min(), THIN_LAYER * in_plane)))


def slab_samples(volume: Volume, thickness: float) -> SlabSamples:
    """Place samples through a thick slice of `thickness` mm, at most half the smallest voxel distance apart."""
    size = checked_thickness(thickness)
    if size == 0.0:
        return SlabSamples(0, 0.0)
    finest = finest_step(volume)
    pairs = float(np.ceil(size / finest - 1e-9))
    if 2 * pairs > MOST_SAMPLES:
        most = MOST_SAMPLES // 2 * finest
        raise UsageError(f"a slice {size:g} mm thick goes beyond every scan: at most {most:.0f} mm in this volume")
    return SlabSamples(2 * max(int(pairs), 1), size / (2 * max(int(pairs), 1)))


PLANES = {"axial": "inferior", "coronal": "anterior", "sagittal": "left"}
"""The anatomical planes, and the views that show them as radiologists do: the patient's left is at the right of axial
and coronal slices, the front at the left of sagittal ones."""


def find_plane(
    volume: Grid,
    view: str | Sequence[float],
    size: Sequence[int],
    *,
    zoom: float = 1.0,
    up: str | ArrayLike | None = None,
    pixel_mm: float | None = None,
    center: ArrayLike | None = None,
) -> Camera:
    """Return a parallel camera for a slice through the middle of a volume.

    view: str or (float, float). axial, coronal, sagittal, or a view as in `Camera.fit`.
    size: Width and height of the picture.
    zoom: At 1 the volume's box, seen in this direction, just fits into the picture: a slice is shown larger than a
        picture of the whole volume, for which `Camera.fit` leaves room in every direction.
    up: str or array_like, shape (3,). As in `Camera.fit`.
    pixel_mm: Side of a pixel; default: so that the box fits.
    center: array_like, shape (3,). A point of the plane, LPS mm, in the middle of the picture; default: the middle of
        the volume.
    """
    if isinstance(view, str):
        name = view.strip().lower()
        view = PLANES.get(name, name)
        if "," not in view and view not in DIRECTIONS:
            raise UsageError(f"{unknown_name('plane', name, [*PLANES, *DIRECTIONS])}, or AZIMUTH,ELEVATION in degrees")
    width, height = checked_size(size)
    camera = Camera.fit(volume, view, up=up, size=size)
    right, top, _ = camera.basis()
    seen = box_corners(volume) - camera.focal_point
    half = max(float(np.abs(seen @ top).max()), float(np.abs(seen @ right).max()) * height / width)
    if pixel_mm is not None:
        half = 0.5 * height * positive_mm("the size of a pixel", pixel_mm)
    if center is not None:
        camera = Camera.fit(volume, view, up=up, size=size, center=center)
    return replace(camera, parallel_scale=half).zoomed(zoom)


def _triple(vector: Float64Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def checked_thickness(thickness: float) -> float:
    """Check the thickness of a slice in mm and return it as a float."""
    size = number_or_nan(thickness)
    if not 0.0 <= size < np.inf:
        raise UsageError(f"the thickness of a slice is a length in mm, 0 for a plane without one, not {thickness!r}")
    return size


def checked_offset(offset_mm: float) -> float:
    """Check the offset of a slice along the view, mm, and return it as a float."""
    offset = number_or_nan(offset_mm)
    if not np.isfinite(offset):
        raise UsageError(f"the offset of a slice is a length in mm, not {offset_mm!r}")
    return offset


def positive_mm(what: str, value: float) -> float:
    """Check a length in mm and return it as a float."""
    number = number_or_nan(value)
    if not 0.0 < number < np.inf:
        raise UsageError(f"{what} is a length in mm, not {value!r}")
    return number


def plane_sheet(camera: Camera, size: Sequence[int], offset_mm: float = 0.0) -> tuple[Sheet, Camera]:
    """Make the plane through a camera's focal point across its view.

    camera: For a perspective camera its scale at the focal point is used.
    size: (w, h). Pixels.
    offset_mm: Moves the plane along the view, away from the camera.

    Returns:
    camera: A parallel camera with its focal point in the plane: each of its rays meets the sheet in its own pixel.
    """
    width, height = checked_size(size)
    right, up, forward = camera.basis()
    pixel = camera.pixel_mm(size)
    shift = checked_offset(offset_mm) * forward
    centre = np.add(camera.focal_point, shift)
    position = np.add(camera.position, shift)
    own = Camera(_triple(position), _triple(centre), camera.up, parallel_scale=0.5 * height * pixel)
    above = 0.5 * height - 0.5 - np.arange(height)
    first = centre + (0.5 - 0.5 * width) * pixel * right
    origins = first + (pixel * above)[:, None] * up
    return Sheet(origins, np.tile(pixel * right, (height, 1)), np.tile(forward, (height, 1)), width), own
