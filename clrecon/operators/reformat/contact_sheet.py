"""Contact sheets: parallel slices through a volume side by side in one picture, all at one scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.operators.reformat.cut_job import CutJob
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.annotations import edge_letters
from clrecon.rendering.pictures.contact_sheet import lay_out, write_on_tile
from clrecon.rendering.pictures.styles import PlaneCut
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.plane import plane_sheet
from clrecon.system.progress import Progress, ignore_progress

PARALLEL = 1.0 - 1e-6
"""Cosine above which planes of voxels lie in those of the sheet."""

MOST_SLICES = 1000

MOST_TURNED = 30.0
"""Degrees between a plane that is asked for and planes of voxels that are shown in its place: gantries tilt less."""


class _Place(NamedTuple):
    """A slice: its distance in mm from the plane of the camera, and the number of its plane of voxels."""

    offset_mm: float
    number: int | None


def take_contact_sheet(
    resident: DeviceVolume,
    style: PlaneCut,
    plane: Camera,
    shown: Grid,
    size: tuple[int, int],
    background: str | Sequence[float] = "black",
    progress: Progress | None = None,
) -> Rendering:
    """Show parallel slices side by side, each with its place in mm and the sides of the patient.

    Axial slices come from the head downwards, coronal ones from the front, sagittal ones from the right.

    style: With a `sheet`; thickness, window and labels are those of each slice.
    plane: The plane in the middle, with zoom and centre, see `clrecon.rendering.views.plane.find_plane`.
    shown: The volume, or the box of what is left of it: slices beside it are left out, and tiles fit it.
    size: Width and height of the picture.
    background, progress: As in `clrecon.operators.reformat.cut.cut_slice`.

    Returns: Without a camera and depths; ``report["pixel_mm"]`` and ``report["edges"]`` are those of all slices,
        ``report["tiles"]`` has ``middle_lps_mm``, ``slice`` (number of its plane of voxels, or None), ``left`` and
        ``top`` (pixels) of each.
    """
    tell = progress or ignore_progress
    job = CutJob(resident, style, None)
    _, plane = plane_sheet(plane, size)
    if style.slices is not None:
        plane = _turn_to_slices(resident.volume, plane, job.warnings)
    right, up, forward = plane.basis()
    seen = box_corners(shown) - plane.focal_point
    places = _choose(resident.volume, style, plane, seen @ forward)
    extent = np.ptp(seen @ right), np.ptp(seen @ up)
    whole = max(extent[0] / size[0], extent[1] / size[1])
    zoom = whole / plane.pixel_mm(size)  # the plane's own scale, beside that at which the box just fits
    layout = lay_out(len(places), (float(extent[0]), float(extent[1])), size, zoom)
    width, height = layout.tile
    values = np.full(size[::-1], np.nan, np.float32)
    image = np.zeros((*size[::-1], 4), np.uint8)
    numbers = None if job.look is None else np.zeros(size[::-1], job.look.labels.voxels.dtype)
    edges = edge_letters(plane)
    tiles: list[dict[str, Any]] = []
    made = None
    for n, (place, (left, top)) in enumerate(zip(places, layout.corners, strict=True)):
        tell("render", n, len(places))
        middle = np.asarray(plane.focal_point) + place.offset_mm * forward
        own = replace(
            plane, focal_point=tuple(middle), position=tuple(np.asarray(plane.position) + place.offset_mm * forward),
            parallel_scale=0.5 * height * layout.pixel_mm,
        )  # fmt: skip
        sheet, _ = plane_sheet(own, layout.tile)
        made = job.sample(sheet)
        part = slice(top, top + height), slice(left, left + width)
        values[part] = made.values
        drawn, labels = job.draw(made.values, sheet)
        if numbers is not None and labels is not None:
            numbers[part] = labels
        image[part] = write_on_tile(drawn, _name_place(place, middle, forward), edges)
        tiles.append({"slice": place.number, "middle_lps_mm": middle.round(3).tolist(), "left": left, "top": top})
    tell("render", len(places), len(places))
    assert made is not None
    report = job.describe(made, layout.pixel_mm) | {"edges": edges, "tiles": tiles, "tile_size": [width, height]}
    return job.finish(image, values, None, None, numbers, report, background)


def _turn_to_slices(volume: Volume, plane: Camera, warnings: list[str]) -> Camera:
    """Return a camera across the planes of voxels that lie nearest to its own: a tilted stack is shown as it was taken.

    The camera stays where no planes of voxels lie within `MOST_TURNED` degrees.
    """
    forward = plane.basis()[2]
    columns = volume.affine[:3, :3]
    normals = [np.cross(columns[:, (axis + 1) % 3], columns[:, (axis + 2) % 3]) for axis in range(3)]
    normals = [normal / np.linalg.norm(normal) for normal in normals]
    cosines = [float(normal @ forward) for normal in normals]
    nearest = int(np.abs(cosines).argmax())
    turned = float(np.degrees(np.arccos(min(1.0, abs(cosines[nearest])))))
    if abs(cosines[nearest]) > PARALLEL or turned > MOST_TURNED:
        return plane
    warnings.append(
        f"the slices are tilted by {turned:.1f} degrees from the plane asked for: they are as they were taken"
    )
    towards = np.sign(cosines[nearest]) * normals[nearest]
    position = np.asarray(plane.focal_point) - plane.distance * towards
    return replace(plane, position=tuple(position.tolist()))


def _choose(volume: Volume, style: PlaneCut, plane: Camera, depths: Float64Array) -> list[_Place]:
    """Return the slices of a sheet in their order; `depths` are those of the corners of what is shown."""
    forward = plane.basis()[2]
    low, high = float(depths.min()), float(depths.max())
    own = _voxel_planes(volume, plane)
    axis = int(np.abs(forward).argmax())
    if style.slices is not None:
        if own is None:
            raise UsageError("planes of voxels do not lie in this view: choose slices by their number or distance")
        numbers = range(0, len(own), style.slices) if isinstance(style.slices, int) else style.slices
        missing = [k for k in numbers if not 0 <= k < len(own)]
        if missing:
            raise UsageError(f"slice {missing[0]} is not there: in this direction the volume has 0 to {len(own) - 1}")
        found = [_Place(float(own[k]), int(k)) for k in numbers]
    elif isinstance(style.sheet, str):
        step = float(style.sheet.removesuffix("mm"))
        first = np.ceil((low + float(plane.focal_point @ forward)) / step) * step - float(plane.focal_point @ forward)
        count = int(np.floor((high - first) / step + 1e-9)) + 1
        if not 1 <= count <= MOST_SLICES:
            raise UsageError(
                f"slices {style.sheet} apart are {max(count, 0):,} in the {high - low:.0f} mm of this view: 1 to"
                f" {MOST_SLICES:,} can be shown"
            )
        found = [_Place(float(first + n * step), None) for n in range(count)]
    else:
        count = int(style.sheet or 1)
        found = [_Place(low + (n + 0.5) * (high - low) / count, None) for n in range(count)]
        if own is not None:  # slices as they were taken, where they are
            nearest = [int(np.abs(own - place.offset_mm).round(6).argmin()) for place in found]
            found = [_Place(float(own[k]), k) for k in dict.fromkeys(nearest)]
    head_first = axis == 2
    return sorted(found, key=lambda place: place.offset_mm * (forward[axis] if not head_first else -forward[axis]))


def _voxel_planes(volume: Volume, plane: Camera) -> Float64Array | None:
    """Return how far the planes of voxels lie behind the plane of a camera, mm; None where they are not parallel."""
    forward = plane.basis()[2]
    columns = volume.affine[:3, :3]
    for axis in range(3):
        normal = np.cross(columns[:, (axis + 1) % 3], columns[:, (axis + 2) % 3])
        if abs(float(normal @ forward)) > PARALLEL * np.linalg.norm(normal):
            if axis == 2:
                origins = volume.slice_origins()
            else:
                origins = volume.affine[:3, 3] + np.arange(volume.shape_ijk[axis])[:, None] * columns[:, axis]
            return np.asarray((origins - plane.focal_point) @ forward)
    return None


def _name_place(place: _Place, middle: Float64Array, forward: Float64Array) -> tuple[str, ...]:
    """Return texts for a slice, the longest first: its number and its place along the axis that it crosses."""
    axis = int(np.abs(forward).argmax())
    if abs(forward[axis]) > PARALLEL:
        texts = [f"{'xyz'[axis]} {middle[axis]:.1f} mm", f"{middle[axis]:.1f}"]
    else:
        texts = [f"{place.offset_mm:+.1f} mm", f"{place.offset_mm:+.1f}"]
    if place.number is not None:
        texts.insert(0, f"{place.number}: {texts[0]}")
    return tuple(texts)
