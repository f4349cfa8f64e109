"""Slices through a volume in any direction, curved reformations along a centre line, and contact sheets: parallel
slices side by side in one picture, all at one scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.anatomy.spine_line import find_spine_line
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.opencl import Device
from clrecon.operators.reformat.sheets import CutJob
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.annotations import edge_letters, sheet_letters
from clrecon.rendering.pictures.sheets import lay_out, write_on_tile
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.directions import DEFAULT_SIZE, checked_size, find_up, find_view
from clrecon.rendering.views.reformation import (
    CurvedSheet,
    find_plane,
    finest_step,
    plane_sheet,
    straightened_sheet,
    stretched_length,
    stretched_sheet,
)
from clrecon.system.arguments import Combination, CurvedKind, ViewName, WindowName, explains_arguments
from clrecon.system.progress import Progress, ignore_progress

DEFAULT_WIDTH_MM = 120.0
"""Default width of a curved reformation: a vertebra with its surroundings."""


BESIDE_MM = 60.0
"""A stretched picture is wider than the sideways extent of its line by at least this: half a vertebra on each side."""

LEAST_PIXELS = 768
"""Least pixels along the longer side of a curved reformation without a size, so that short curves are large enough to
look at."""


@explains_arguments
def cut_slice(
    volume: Volume | DeviceVolume,
    plane: Camera | ViewName | Sequence[float] = "axial",
    size: Sequence[int] = DEFAULT_SIZE,
    *,
    device: Device | str | int | None = None,
    zoom: float = 1.0,
    up: str | ArrayLike | None = None,
    pixel_mm: float | None = None,
    offset_mm: float = 0.0,
    thickness: float = 0.0,
    combine: Combination = "mean",
    window: Sequence[float] | WindowName | None = None,
    background: str | Sequence[float] = "black",
    memory: int | None = None,
    progress: Progress | None = None,
) -> Rendering:
    """Cut a slice through a volume, in any direction and as thick as wanted (oblique multiplanar reformation).

    Values are those of the trilinear field between voxel centres, through the full affine (shear included) or the
    positions of all slices where they are uneven; voxels that a pixel meets exactly come out unchanged.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` is used directly, with its own device and memory.
    plane : Camera, str or (float, float)
        A camera: the plane through its focal point across its view.  A name: axial, coronal, sagittal through the
        middle of the volume, as radiologists look at them, or a view as in `Camera.fit`.
    size : (int, int)
        Width and height of the picture, pixels.
    device : Device, str or int, optional
        See `clrecon.device`.
    zoom, up, pixel_mm
        Options for a plane by name, see ``clrecon.rendering.views.reformation.find_plane``.
    offset_mm : float
        Moves the plane along the view, away from the camera.
    thickness : float
        Thickness in mm of a thick slice, half of it on either side of the plane; its samples are combined.  0 is the
        plane alone.  Samples are at most half the smallest distance of voxels apart, see
        ``clrecon.rendering.views.reformation.SlabSamples``.
    combine : {"mean", "max", "min"}
        How the samples within the volume are combined.
    window : (low, high) or str, optional
        HU that are black and white, or a name of ``clrecon.rendering.looks.window.WINDOWS``; default "bone".
    background : str or colour
        Colour outside the volume; "transparent" gives opacity 0 there.
    memory : int, optional
        Bytes that may be taken on the device; a volume that needs more is processed in slabs.
    progress : callable, optional
        Called as ``progress("slabs", slices done, all slices)``.

    Returns
    -------
    Rendering
        ``values`` in HU, NaN outside of the volume; ``camera`` parallel with its focal point in the plane, ``depth``
        the plane's distance from it.

    Raises
    ------
    UsageError
        Unknown plane, impossible numbers, or a plane that misses the volume.
    DeviceError
        No device, two slices and the picture do not fit it, or it fails.
    """
    pixels = checked_size(size)
    style = PlaneCut(thickness=thickness, combine=combine, window=window, pixel_mm=pixel_mm, offset_mm=offset_mm)
    with open_volume(volume, device, memory, "a slice") as resident:
        if not isinstance(plane, Camera):
            plane = find_plane(resident.volume, plane, pixels, zoom=zoom, up=up, pixel_mm=style.pixel_mm)
        elif pixel_mm is not None or zoom != 1.0 or up is not None:
            raise UsageError("zoom, up and the size of pixels are those of the camera: leave them out, or the camera")
        return take_cut(resident, style, plane, pixels, background, progress or ignore_progress)


def take_cut(
    resident: DeviceVolume,
    style: PlaneCut,
    plane: Camera,
    size: tuple[int, int],
    background: str | Sequence[float] = "black",
    progress: Progress = ignore_progress,
) -> Rendering:
    """Cut the slice of a camera, as `cut_slice` does, with the labels of the style."""
    job = CutJob(resident, style, progress, background)
    sheet, camera = plane_sheet(plane, size, style.offset_mm)
    reformation = job.sample(sheet)
    if np.isnan(reformation.values).all():
        raise UsageError(_describe_miss(resident.volume, camera))
    image, numbers = job.draw(reformation.values, sheet)
    depth = np.where(np.isnan(reformation.values), np.float32(np.nan), np.float32(camera.distance))
    report = job.describe(reformation, camera.pixel_mm(size)) | _describe_plane(camera)
    return job.finish(image, reformation.values, depth, camera, numbers, report)


def _describe_plane(camera: Camera) -> dict[str, Any]:
    right, up, forward = camera.basis()
    return {
        "plane": {
            "point_lps_mm": list(camera.focal_point),
            "normal_lps": forward.tolist(),
            "right_lps": right.tolist(),
            "up_lps": up.tolist(),
        }
    }


def _describe_miss(volume: Volume, camera: Camera) -> str:
    along = (box_corners(volume) - camera.focal_point) @ camera.basis().forward
    if along.min() > 0.0 or along.max() < 0.0:
        return (
            f"the slice misses the volume, which lies {along.min():.1f} to {along.max():.1f} mm further along the view:"
            " choose an offset between"
        )
    return "the picture shows nothing of the volume: look at its place, or make it larger"


@explains_arguments
def reformat_curve(
    volume: Volume | DeviceVolume,
    curve: Curve | ArrayLike | str = "spine",
    kind: CurvedKind = "straightened",
    size: Sequence[int] | None = None,
    *,
    device: Device | str | int | None = None,
    view: ViewName | Sequence[float] = "left",
    up: str | ArrayLike | None = None,
    angle: float = 0.0,
    pixel_mm: float | None = None,
    width_mm: float | None = None,
    thickness: float = 0.0,
    combine: Combination = "mean",
    window: Sequence[float] | WindowName | None = None,
    background: str | Sequence[float] = "black",
    memory: int | None = None,
    progress: Progress | None = None,
) -> Rendering:
    """Curved planar reformation: a picture along a centre line, from its upper end to its lower.

    Parameters
    ----------
    volume : Volume or DeviceVolume
    curve : Curve, array_like of shape (n, 3), or "spine"
        Points of the centre line in LPS mm, all within the volume; the curve is smooth.  "spine" searches for the
        spinal canal, see ``clrecon.anatomy.spine_line``.
    kind : {"straightened", "stretched"}
        Straightened: the centre line is a straight line down the picture, and each row crosses it.  Stretched: all rows
        have one direction in the patient and form a surface, which the picture shows unrolled; all lengths within that
        surface are kept.  See ``clrecon.rendering.views.reformation``.
    size : (int, int), optional
        Width and height of the picture; default: the whole curve, and ``width_mm``.
    device : Device, str or int, optional
        See `clrecon.device`.
    view, up : str or direction
        Side from which the patient is seen, as in `Camera.fit`. It gives the direction that runs to the right, and the
        end of the curve at the top: left (a sagittal picture of the spine, the front at the left), anterior (a coronal
        one).
    angle : float
        Degrees by which the rows of a straightened picture are turned about the centre line.
    pixel_mm : float, optional
        Side of a pixel; default: the curve fills the height of ``size``, else the smallest distance of voxels,
        or a whole part of it so that the longer side has at least 768 pixels.
    width_mm : float, optional
        Width of the picture where no ``size`` is given; default 120 mm.
    thickness, combine, window, background, memory, progress
        As in `cut_slice`; a thick slice extends across the picture.

    Returns
    -------
    Rendering
        ``values`` in HU, NaN outside of the volume and beyond the ends of the curve; no camera and no depths.
        ``report["curve"]`` has the length, the arc length of each row and the column of the centre line in it.

    Raises
    ------
    UsageError
        The points, the kind, the view or a number cannot be; or the curve is parallel to the rows.
    RefusedInputError
        No part of the volume surely shows a spine.
    DeviceError
        No device, two slices and the picture do not fit it, or it fails.
    """
    style = CurveCut(curve, kind=kind, angle=angle, width_mm=width_mm, pixel_mm=pixel_mm,
                     thickness=thickness, combine=combine, window=window)  # fmt: skip
    with open_volume(volume, device, memory, "a slice") as resident:
        return take_curve(resident, style, view, up, size, background, progress or ignore_progress)


def take_curve(
    resident: DeviceVolume,
    style: CurveCut,
    view: str | Sequence[float],
    up: str | ArrayLike | None,
    size: Sequence[int] | None,
    background: str | Sequence[float] = "black",
    progress: Progress = ignore_progress,
) -> Rendering:
    """Make the picture along the curve of a style, as `reformat_curve` does, with its labels."""
    job = CutJob(resident, style, progress, background)
    line, spine = _find_line(resident.volume, style.curve, progress)
    across, top = _find_directions(view, up)
    turned = bool((line.points[-1] - line.points[0]) @ top > 0.0)
    line = line.reversed() if turned else line
    curved, pixel = _lay_sheet(resident.volume, style, line, across, size)
    reformation = job.sample(curved.sheet)
    reformation.values[np.isnan(curved.arc)] = np.nan
    image, numbers = job.draw(reformation.values, curved.sheet)
    curve_facts = _describe_curve(line, curved, style.kind, across, turned) | {"angle_deg": style.angle, "found": spine}
    edges = sheet_letters(curved.sheet, ~np.isnan(curved.arc))
    report = job.describe(reformation, pixel) | {"curve": curve_facts, "edges": edges}
    report["warnings"] += _warn_of_part(spine)
    return job.finish(image, reformation.values, None, None, numbers, report)


def _lay_sheet(
    volume: Volume, style: CurveCut, line: Curve, across: Float64Array, size: Sequence[int] | None
) -> tuple[CurvedSheet, float]:
    """Return the sheet along a curve, and the side of its pixels in mm."""
    straight = style.kind == "straightened"
    length = line.length if straight else stretched_length(line, across)
    sway = 0.0 if straight else float(np.ptp(line.at(np.linspace(0.0, line.length, 500)) @ across))
    fitted, pixel = _fit_picture(volume, length, sway, size, style)
    if straight:
        return straightened_sheet(line, across, fitted, pixel, style.angle), pixel
    return stretched_sheet(line, across, fitted, pixel), pixel


def _warn_of_part(spine: dict[str, Any] | None) -> list[str]:
    """Return the warning for a spine that was lost before the scan ends: where, and what was found instead."""
    if spine is None:
        return []
    ends = [(name, spine[f"{name}_end"]) for name in ("upper", "lower")]
    lost = [
        f"{'above' if name == 'upper' else 'below'} it was lost at z {end['lost_mm']:.1f} mm: {end['because']}"
        for name, end in ends
        if end["lost_mm"] is not None
    ]
    if not lost:
        return []
    (_, upper), (_, lower) = ends
    return [
        f"the spinal canal was followed from z {upper['z_mm']:.1f} to {lower['z_mm']:.1f} mm,"
        f" {spine['height_mm']:.0f} of the {spine['searched_mm']:.0f} mm of the scan; {'; '.join(lost)}"
    ]


def _find_line(
    volume: Volume, curve: Curve | ArrayLike | str, progress: Progress
) -> tuple[Curve, dict[str, Any] | None]:
    """Return the centre line, and the facts about it if it was searched for."""
    if isinstance(curve, Curve):
        curve.check_within(volume)
        return curve, None
    spine = find_spine_line(volume, progress=progress)
    known: dict[str, Any] = {"height_mm": spine.height_mm, "searched_mm": spine.searched_mm}
    known |= {"sure_share": spine.sure_share}
    known |= {f"{name}_end": None if end is None else asdict(end) for name, end in spine.ends.items()}
    return Curve(spine.points), known | {"points_lps_mm": spine.points.round(3).tolist()}


def _find_directions(view: str | Sequence[float], up: str | ArrayLike | None) -> tuple[Float64Array, Float64Array]:
    """Return the directions in LPS to the right and to the top of a view."""
    towards, default_up = find_view(view)
    camera = Camera(tuple(towards), (0.0, 0.0, 0.0), tuple(default_up if up is None else find_up(up)), 30.0)
    right, top, _ = camera.basis()
    return right, top


def _fit_picture(
    volume: Volume, length: float, sway: float, size: Sequence[int] | None, style: CurveCut
) -> tuple[tuple[int, int], float]:
    """Return the size of a picture and its pixels in mm: a curve of some length that sways to the sides fits."""
    width = max(DEFAULT_WIDTH_MM, sway + BESIDE_MM) if style.width_mm is None else style.width_mm
    if style.pixel_mm is not None:
        pixel = style.pixel_mm
    elif size is not None:
        wide, high = checked_size(size)
        pixel = max(length / high, (sway + BESIDE_MM) / wide if sway else 0.0)
    else:
        pixel = finest_step(volume)
        longest = max(length, width) / pixel
        pixel /= max(1.0, np.ceil(LEAST_PIXELS / longest))  # a whole number of pixels a voxel
    if size is not None:
        if style.width_mm is not None:
            raise UsageError("the width of a picture is given by its size or in mm, not by both")
        return checked_size(size), pixel
    return checked_size((max(round(width / pixel), 1), max(round(length / pixel), 1))), pixel


def _describe_curve(line: Curve, curved: CurvedSheet, kind: str, across: Float64Array, turned: bool) -> dict[str, Any]:
    radius = line.smallest_radius()
    return {
        "kind": kind,
        "across_lps": across.tolist(),
        "points": len(line.points),
        "length_mm": line.length,
        "smallest_radius_mm": radius if np.isfinite(radius) else None,
        "reversed": turned,
        "arc_mm": _rounded(curved.arc),
        "column": _rounded(curved.columns),
    }


def _rounded(values: NDArray[Any]) -> list[float | None]:
    """Return values for JSON, None for NaN."""
    return [None if np.isnan(value) else round(float(value), 4) for value in values]


PARALLEL = 1.0 - 1e-6
"""Cosine above which planes of voxels lie in those of the sheet."""

MOST_SLICES = 1000

_MOST_TURNED = 30.0
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
    progress: Progress = ignore_progress,
) -> Rendering:
    """Show parallel slices side by side, each with its place in mm and the sides of the patient.

    Axial slices come from the head downwards, coronal ones from the front, sagittal ones from the right.

    style: With a `sheet`; thickness, window and labels are those of each slice.
    plane: The plane in the middle, with zoom and centre, see `clrecon.rendering.views.reformation.find_plane`.
    shown: The volume, or the box of what is left of it: slices beside it are left out, and tiles fit it.

    Returns: Without a camera and depths; ``report["pixel_mm"]`` and ``report["edges"]`` are those of all slices,
        ``report["tiles"]`` has ``middle_lps_mm``, ``slice`` (number of its plane of voxels, or None), ``left`` and
        ``top`` (pixels) of each.
    """
    job = CutJob(resident, style, ignore_progress, background)
    _, plane = plane_sheet(plane, size)
    if style.slices is not None:
        plane = _turn_to_slices(resident.volume, plane, job.warnings)
    right, up, forward = plane.basis()
    seen = box_corners(shown) - plane.focal_point
    places = _choose_slices(resident.volume, style, plane, seen @ forward)
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
    reformation = None
    for n, (spot, (left, top)) in enumerate(zip(places, layout.corners, strict=True)):
        progress("render", n, len(places))
        middle = np.asarray(plane.focal_point) + spot.offset_mm * forward
        tile_plane = replace(
            plane, focal_point=tuple(middle), position=tuple(np.asarray(plane.position) + spot.offset_mm * forward),
            parallel_scale=0.5 * height * layout.pixel_mm,
        )  # fmt: skip
        sheet, _ = plane_sheet(tile_plane, layout.tile)
        reformation = job.sample(sheet)
        part = slice(top, top + height), slice(left, left + width)
        values[part] = reformation.values
        drawn, labels = job.draw(reformation.values, sheet)
        if numbers is not None and labels is not None:
            numbers[part] = labels
        axis = int(np.abs(forward).argmax())
        if abs(forward[axis]) > PARALLEL:
            texts = [f"{'xyz'[axis]} {middle[axis]:.1f} mm", f"{middle[axis]:.1f}"]
        else:
            texts = [f"{spot.offset_mm:+.1f} mm", f"{spot.offset_mm:+.1f}"]
        if spot.number is not None:
            texts.insert(0, f"{spot.number}: {texts[0]}")
        image[part] = write_on_tile(drawn, tuple(texts), edges)
        tiles.append({"slice": spot.number, "middle_lps_mm": middle.round(3).tolist(), "left": left, "top": top})
    progress("render", len(places), len(places))
    assert reformation is not None
    report = job.describe(reformation, layout.pixel_mm) | {"edges": edges, "tiles": tiles, "tile_size": [width, height]}
    return job.finish(image, values, None, None, numbers, report)


def _turn_to_slices(volume: Volume, plane: Camera, warnings: list[str]) -> Camera:
    """Return a camera across the nearest planes of voxels, or the same if none lie within `_MOST_TURNED` degrees."""
    forward = plane.basis()[2]
    columns = volume.affine[:3, :3]
    normals = [np.cross(columns[:, (axis + 1) % 3], columns[:, (axis + 2) % 3]) for axis in range(3)]
    normals = [normal / np.linalg.norm(normal) for normal in normals]
    cosines = [float(normal @ forward) for normal in normals]
    nearest = int(np.abs(cosines).argmax())
    turned = float(np.degrees(np.arccos(min(1.0, abs(cosines[nearest])))))
    if abs(cosines[nearest]) > PARALLEL or turned > _MOST_TURNED:
        return plane
    warnings.append(
        f"the slices are tilted by {turned:.1f} degrees from the plane asked for: they are as they were taken"
    )
    towards = np.sign(cosines[nearest]) * normals[nearest]
    position = np.asarray(plane.focal_point) - plane.distance * towards
    return replace(plane, position=tuple(position.tolist()))


def _choose_slices(volume: Volume, style: PlaneCut, plane: Camera, depths: Float64Array) -> list[_Place]:
    """Return the slices of a sheet in their order; `depths` are those of the corners of what is shown."""
    forward = plane.basis()[2]
    low, high = float(depths.min()), float(depths.max())
    planes = _voxel_planes(volume, plane)
    axis = int(np.abs(forward).argmax())
    if style.slices is not None:
        if planes is None:
            raise UsageError("planes of voxels do not lie in this view: choose slices by their number or distance")
        numbers = range(0, len(planes), style.slices) if isinstance(style.slices, int) else style.slices
        missing = [k for k in numbers if not 0 <= k < len(planes)]
        if missing:
            raise UsageError(
                f"slice {missing[0]} is not there: in this direction the volume has 0 to {len(planes) - 1}"
            )
        spots = [_Place(float(planes[k]), int(k)) for k in numbers]
    elif isinstance(style.sheet, str):
        step = float(style.sheet.removesuffix("mm"))
        first = np.ceil((low + float(plane.focal_point @ forward)) / step) * step - float(plane.focal_point @ forward)
        count = int(np.floor((high - first) / step + 1e-9)) + 1
        if not 1 <= count <= MOST_SLICES:
            raise UsageError(
                f"slices {style.sheet} apart are {max(count, 0):,} in the {high - low:.0f} mm of this view: 1 to"
                f" {MOST_SLICES:,} can be shown"
            )
        spots = [_Place(float(first + n * step), None) for n in range(count)]
    else:
        count = int(style.sheet or 1)
        spots = [_Place(low + (n + 0.5) * (high - low) / count, None) for n in range(count)]
        if planes is not None:  # slices as they were taken, where they are
            nearest = [int(np.abs(planes - place.offset_mm).round(6).argmin()) for place in spots]
            spots = [_Place(float(planes[k]), k) for k in dict.fromkeys(nearest)]
    head_first = axis == 2
    return sorted(spots, key=lambda place: place.offset_mm * (forward[axis] if not head_first else -forward[axis]))


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
