"""`Sheet`: where each pixel of a reformation lies in the patient, for planes and for curved ones alike.

Every row of such a picture is a straight line: it has an origin, a step from one pixel to the next, and a normal along
which a thick slice is sampled.  A plane has the same step and normal in every row; a curved reformation turns them
along its centre line, stretched or straightened after Kanitsar et al. 2002.

A *stretched* picture unrolls a cylinder: the surface that a straight line of one direction sweeps when it moves along
the centre line.  It distorts nothing: every length within that surface is kept, along the centre line, across it and in
between.  The centre line itself appears as a curve on the unrolled surface.

A *straightened* picture shows the centre line as a straight vertical line: each row is a line across it, in a frame
that does not twist along the line.  Lengths are kept along the centre line and in every row.  At a distance d from a
line that bends with radius r, lengths along the line towards the centre of the bend are stretched by 1 / (1 - d / r).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.geometry.volume import Volume
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.centre_line import Curve, rotation_minimising_normals
from clrecon.rendering.views.directions import DIRECTIONS, as_point, checked_size
from clrecon.system.arguments import number_or_nan
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.text import unknown_name

MOST_SAMPLES = 65536
"""Most samples through a thick slice; more mean that its thickness is a mistake."""

_THIN_LAYER = 0.25
"""Layers of an uneven stack thinner than this share of a slice's pixel do not make the samples denser."""


@dataclass(frozen=True)
class Sheet:
    """Pixel (x, y) of a picture lies at ``origins[y] + x * steps[y]``, LPS mm.

    origins: ndarray, shape (h, 3). Centre of the first pixel of each row.
    steps: ndarray, shape (h, 3). Step from one pixel of a row to the next, mm.
    normals: ndarray, shape (h, 3). Unit vectors into the picture, along which a thick slice is sampled.
    """

    origins: Float64Array
    steps: Float64Array
    normals: Float64Array
    width: int

    @property
    def height(self) -> int:
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
    """Return the smallest distance in mm between neighbouring planes of voxel centres, over their three families."""
    columns = volume.affine[:3, :3]
    if not volume.uneven:
        return float(1.0 / np.linalg.norm(np.linalg.inv(columns), axis=1).max())
    normal = np.cross(columns[:, 0], columns[:, 1])
    area = np.linalg.norm(normal)
    in_plane = area / np.linalg.norm(columns[:, :2], axis=0).max()
    gaps = np.abs(np.diff(volume.slice_origins() @ (normal / area)))
    return float(min(in_plane, max(gaps.min(), _THIN_LAYER * in_plane)))


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
"""Planes, and the views that show them as radiologists do: the patient's left or front at the right or left."""


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
    """Return a parallel camera for a slice through the middle of a volume, or through a `center` in LPS mm.

    view: axial, coronal, sagittal, or a view as in `Camera.fit`.
    zoom: At 1 the volume's box, seen in this direction, just fits into the picture: a slice is shown larger than a
        picture of the whole volume, for which `Camera.fit` leaves room in every direction.
    pixel_mm: Side of a pixel; default: so that the box fits.
    """
    seen_from: Any = view
    if isinstance(view, str):
        name = view.strip().lower()
        seen_from = PLANES.get(name, name)
        if seen_from not in DIRECTIONS:
            words = unknown_name("plane", name, [*PLANES, *DIRECTIONS])
            raise UsageError(f"{words}, or (azimuth, elevation) in degrees")
    width, height = checked_size(size)
    camera = Camera.fit(volume, seen_from, up=up, size=size)
    right, top, _ = camera.basis()
    seen = box_corners(volume) - camera.focal_point
    half = max(float(np.abs(seen @ top).max()), float(np.abs(seen @ right).max()) * height / width)
    if pixel_mm is not None:
        half = 0.5 * height * positive_mm("the size of a pixel", pixel_mm)
    if center is not None:
        camera = Camera.fit(volume, seen_from, up=up, size=size, center=center)
    return replace(camera, parallel_scale=half).zoomed(zoom)


def checked_thickness(thickness: float) -> float:
    size = number_or_nan(thickness)
    if not 0.0 <= size < np.inf:
        raise UsageError(f"the thickness of a slice is a length in mm, 0 for a plane without one, not {thickness!r}")
    return size


def checked_offset(offset_mm: float) -> float:
    offset = number_or_nan(offset_mm)
    if not np.isfinite(offset):
        raise UsageError(f"the offset of a slice is a length in mm, not {offset_mm!r}")
    return offset


def positive_mm(subject: str, value: float) -> float:
    number = number_or_nan(value)
    if not 0.0 < number < np.inf:
        raise UsageError(f"{subject} is a length in mm, not {value!r}")
    return number


def plane_sheet(camera: Camera, size: Sequence[int], offset_mm: float = 0.0) -> tuple[Sheet, Camera]:
    """Make the plane through a focal point, `offset_mm` away from the camera, and the parallel camera of its pixels."""
    width, height = checked_size(size)
    right, up, forward = camera.basis()
    pixel = camera.pixel_mm(size)
    shift = checked_offset(offset_mm) * forward
    centre = np.add(camera.focal_point, shift)
    position = np.add(camera.position, shift)
    plane_camera = Camera(as_point(position), as_point(centre), camera.up, parallel_scale=0.5 * height * pixel)
    above = 0.5 * height - 0.5 - np.arange(height)
    origins = centre + (0.5 - 0.5 * width) * pixel * right + (pixel * above)[:, None] * up
    return Sheet(origins, np.tile(pixel * right, (height, 1)), np.tile(forward, (height, 1)), width), plane_camera


_FRAME_STEP_MM = 0.25
"""Largest distance between places at which frames and projected lengths are computed; less for small pixels."""


@dataclass(frozen=True)
class CurvedSheet:
    """The sheet along a curve: `arc`, (h,) mm, NaN beyond its ends; `columns`, (h,), in which rows show it."""

    sheet: Sheet
    arc: Float64Array
    columns: Float64Array


def _row_places(length: float, height: int, pixel: float) -> Float64Array:
    """Return the positions of the row centres along a curve that is in the middle of the picture."""
    return np.asarray(0.5 * length + (np.arange(height) + 0.5 - 0.5 * height) * pixel, dtype=np.float64)


def _fine_arcs(length: float, pixel: float) -> Float64Array:
    count = max(int(np.ceil(length / min(pixel, _FRAME_STEP_MM))), 8)
    return np.linspace(0.0, length, count + 1, dtype=np.float64)


def _unit_vectors(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def straightened_sheet(
    curve: Curve, across: Float64Array, size: tuple[int, int], pixel: float, angle: float = 0.0
) -> CurvedSheet:
    """Make a sheet (w, h) whose rows cross a curve, which becomes a straight line down the middle of the picture.

    across: ndarray, shape (3,). Direction in LPS that the rows follow as well as a frame without twist allows: the mean
        of their rotation from it, along the curve, is zero.
    pixel: mm.
    angle: Degrees by which all rows are turned about the curve: into the picture at the right.
    """
    width, height = size
    arcs = _fine_arcs(curve.length, pixel)
    places, tangents = curve.at(arcs), curve.tangents(arcs)
    normals = rotation_minimising_normals(places, tangents, np.eye(3)[np.abs(tangents[0]).argmin()])
    binormals = np.cross(tangents, normals)
    along_normal, along_binormal = float((normals @ across).sum()), float((binormals @ across).sum())
    if np.hypot(along_normal, along_binormal) < 1e-3 * len(arcs):
        raise UsageError("the centre line runs along the direction that should run across it: take another view")
    turn = np.arctan2(along_binormal, along_normal)
    rights = np.cos(turn) * normals + np.sin(turn) * binormals
    depths = np.cross(rights, tangents)  # into the picture
    turned = np.radians(angle)
    c, s = np.cos(turned), np.sin(turned)
    rights, depths = c * rights + s * depths, c * depths - s * rights
    arc = _row_places(curve.length, height, pixel)
    within = (arc >= 0.0) & (arc <= curve.length)
    tangent = curve.tangents(arc)
    right = np.stack([np.interp(arc, arcs, column) for column in rights.T], axis=1)
    right = _unit_vectors(right - (right * tangent).sum(axis=1, keepdims=True) * tangent)
    middle = 0.5 * (width - 1)
    sheet = Sheet(curve.at(arc) - middle * pixel * right, pixel * right, np.cross(right, tangent), width)
    return CurvedSheet(sheet, np.where(within, arc, np.nan), np.where(within, middle, np.nan))


def stretched_sheet(curve: Curve, across: Float64Array, size: tuple[int, int], pixel: float) -> CurvedSheet:
    """Make a sheet (w, h) of parallel rows in a direction (3,) through a curve, even on the surface they form."""
    width, height = size
    direction = _unit_vectors(np.asarray(across, dtype=np.float64))
    arcs = _fine_arcs(curve.length, pixel)
    flow = curve.tangents(arcs)
    flat = flow - (flow @ direction)[:, None] * direction
    speed = np.linalg.norm(flat, axis=1)
    if speed.min() < 0.05:
        arc_mm = float(arcs[int(speed.argmin())])
        raise UsageError(
            f"the centre line runs along the rows of the stretched picture {arc_mm:.1f} mm after its begin: take"
            " another view, or straighten it"
        )
    # Simpson's rule on each step, with the speed in the middle of the step too.
    between = curve.tangents(0.5 * (arcs[1:] + arcs[:-1]))
    middle_speed = np.linalg.norm(between - (between @ direction)[:, None] * direction, axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.diff(arcs) * (speed[:-1] + 4.0 * middle_speed + speed[1:]) / 6.0)])
    rows = _row_places(float(length[-1]), height, pixel)
    within = (rows >= 0.0) & (rows <= length[-1])
    arc = np.interp(rows, length, arcs)
    places, tangent = curve.at(arc), curve.tangents(arc)
    aside = places @ direction
    extent = curve.at(arcs) @ direction
    centre = 0.5 * (extent.min() + extent.max())
    origins = places + (centre - aside - 0.5 * (width - 1) * pixel)[:, None] * direction
    down = _unit_vectors(tangent - (tangent @ direction)[:, None] * direction)
    sheet = Sheet(origins, np.tile(pixel * direction, (height, 1)), np.cross(direction, down), width)
    columns = (aside - centre) / pixel + 0.5 * (width - 1)
    return CurvedSheet(sheet, np.where(within, arc, np.nan), np.where(within, columns, np.nan))


def stretched_length(curve: Curve, across: Float64Array) -> float:
    """Return the height in mm of a stretched picture of the whole curve."""
    arcs = _fine_arcs(curve.length, _FRAME_STEP_MM)
    flow = curve.tangents(0.5 * (arcs[1:] + arcs[:-1]))
    direction = _unit_vectors(np.asarray(across, dtype=np.float64))
    return float((np.linalg.norm(flow - (flow @ direction)[:, None] * direction, axis=1) * np.diff(arcs)).sum())
