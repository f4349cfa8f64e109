"""The solid bone of one vertebra: its label, or a level within it, closed and filled, with the canal left open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.geometry import Volume, column_spacing
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels import LabelMap
from clrecon.labels.label_levels import Growth, find_boxes
from clrecon.labels.resample import check_together, warn_of_place
from clrecon.mesh.scanlines import fill_surface
from clrecon.opencl import Device, download
from clrecon.operators.masks.mask import Mask
from clrecon.operators.masks.regions import checked_mm
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cortex_mesh import CortexReport, fit_labels
from clrecon.operators.surface.labels import LabelExtraction
from clrecon.system.arguments import SurfaceKind, explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import format_hu

_SPARE_VOXELS = 3
"""Voxels beyond the distances that are asked for, so that nothing round the label touches the end of the crop."""

_AXIAL_COSINE = 0.7
"""Slices whose normal has at least this cosine with the patient's long axis are axial: up to 45 degrees off."""


@dataclass(frozen=True)
class LabelCrop:
    """A label with its surroundings: the volume around it, and the same part of the label map, on its own grid.

    Axes are in the order that makes the slices as axial as they can be, `axial` within 45 degrees; only those of uneven
    stacks stay.  `inside_share` of the label's voxels, above 0, lie in the whole volume.
    """

    volume: Volume
    labels: LabelMap
    number: int
    name: str
    inside_share: float
    axial: bool
    warnings: tuple[str, ...]


def crop_label(volume: Volume, labels: LabelMap, label: int | str, margin_mm: float) -> LabelCrop:
    """Cut out one label with `margin_mm`, and some voxels more, around it."""
    shares = check_together(labels, volume)
    number = labels.find(label)
    share, called = shares[number], f"label {number} {labels.name(number)}"
    box = find_boxes(labels.voxels, (number,), (0, 0, 0))[number]
    low, high = (np.array([getattr(part, end) for part in box[::-1]]) for end in ("start", "stop"))
    corners = np.stack(np.meshgrid(*zip(low - 0.5, high - 0.5, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    first, end = _window(volume, labels.ijk_to_lps(corners), margin_mm)
    if share == 0.0 or (first >= end).any():
        raise RefusedInputError(f"{called} has no voxel in the CT: it lies outside")
    around = volume.ijk_to_lps(
        np.stack(np.meshgrid(*zip(first, end - 1, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    )
    cut_map = _cut_map(labels, *_window(labels, around, 0.0))
    cut, axial = _cut_volume(volume, first, end)
    warnings = [*labels.warnings, *warn_of_place(labels, volume)]
    if share < 1.0:
        warnings.append(
            f"{100 * (1 - share):.3g} % of {called} lie outside the CT: the vertebra ends where the CT does"
        )
    return LabelCrop(cut, cut_map, number, labels.name(number), share, axial, tuple(warnings))


def _window(
    grid: Volume | LabelMap, places: Float64Array, margin_mm: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first voxel (i, j, k), and the one behind the last, of the box of a grid around places."""
    indices = grid.lps_to_ijk(places)
    # along an axis that is oblique to another the margin takes more steps: rows of the inverse have their lengths
    steps = np.linalg.norm(np.linalg.inv(grid.affine[:3, :3]), axis=1)
    if isinstance(grid, Volume) and grid.uneven:
        gaps = np.linalg.norm(np.diff(grid.slice_origins(), axis=0), axis=1)
        steps[2] *= grid.spacing[2] / max(float(gaps.min(initial=grid.spacing[2])), 1e-6)
    more = margin_mm * steps + _SPARE_VOXELS
    first = np.clip(np.floor(indices.min(axis=0) - more), 0, grid.shape_ijk).astype(np.int64)
    return first, np.clip(np.ceil(indices.max(axis=0) + more) + 1, 0, grid.shape_ijk).astype(np.int64)


def _cut_map(labels: LabelMap, first: NDArray[np.int64], end: NDArray[np.int64]) -> LabelMap:
    parts = tuple(slice(a, b) for a, b in zip(first[::-1], end[::-1], strict=True))
    affine = labels.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ first
    return LabelMap(labels.voxels[parts], affine, labels.names)


def _cut_volume(volume: Volume, first: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[Volume, bool]:
    """Cut a box out of a volume and turn its axes; tell whether its slices are axial."""
    parts = tuple(slice(a, b) for a, b in zip(first[::-1], end[::-1], strict=True))
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ first
    voxels, origins = volume.voxels[parts], None
    if volume.uneven and end[2] - first[2] > 1:
        origins = volume.slice_origins()[first[2] : end[2]] + affine[:3, :2] @ first[:2]
    elif volume.uneven:
        affine[:3, 3] = volume.ijk_to_lps([first])[0]
    else:
        upright = int(np.argmax(np.abs(affine[2, :3]) / column_spacing(affine)))
        order = [axis for axis in range(3) if axis != upright] + [upright]
        affine[:3, :3] = affine[:3, order]
        voxels = voxels.transpose([2 - axis for axis in order[::-1]])
    normal = np.cross(affine[:3, 0], affine[:3, 1])
    axial = bool(abs(normal[2]) >= _AXIAL_COSINE * np.linalg.norm(normal))
    return Volume(np.ascontiguousarray(voxels), affine, volume.report, origins), axial


CLOSE_MM = 1.5
"""Radius of the balls that close pores and vessels of the cortex."""


@explains_arguments
def vertebra_solid(
    volume: Volume,
    labels: LabelMap,
    label: int | str,
    iso_value: float | None = None,
    *,
    surface: SurfaceKind = "hu",
    close_mm: float = CLOSE_MM,
    grow_mm: float | None = None,
    device: Device | str | int | None = None,
    memory: int | None = None,
) -> Mask:
    """Choose the solid bone of one vertebra: cortex and marrow, without the spinal canal.

    The voxels of the label, or those that `extract_labels` with ``solid=True`` takes at an iso value, are closed by a
    ball; what they enclose is filled, and no voxel of another label is taken.  The canal is open at both ends and stays
    open.

    Parameters
    ----------
    volume : Volume
    labels : LabelMap
        On any grid.
    label : int or str
        Number or name, as `LabelMap.find` takes it.
    iso_value : float, optional
        HU; None: the label's own voxels, whatever their HU.
    surface : {"hu", "cortex"}
        "cortex": the surface at the iso value, a low one such as 200, is moved onto the bone as `fit_cortex` does; its
        voxels are those whose centres lie within.
    close_mm : float
        Radius of the ball, mm.  Below every step of the voxels it closes nothing.
    grow_mm : float, optional
        With an iso value: distance of growth, see `extract_labels`.
    device : Device, str or int, optional
        See `clrecon.device`.
    memory : int, optional
        Most bytes on the device.

    Returns
    -------
    Mask
        ``mask.scan`` is the part of the volume around the vertebra, at its place in the patient; the order of its
        axes makes the slices as axial as they can be.

    Raises
    ------
    UsageError
        These are not a Volume and a LabelMap, the map has no such label, a length is no number above 0, or a growth is
        given without an iso value.
    RefusedInputError
        The map names another frame of reference, lies outside of the volume, or this label does.
    NoSurfaceError
        No voxel of the label has the iso value, or every voxel around it has.
    DeviceError
        The device has no room, or it fails.
    """
    crop = crop_label(volume, labels, label, label_margin(volume, close_mm, grow_mm))
    with DeviceVolume(crop.volume, device=device, memory=memory) as resident:
        return make_solid(resident, crop, iso_value, surface, close_mm, grow_mm)[0]


def label_margin(volume: Volume, close_mm: float, grow_mm: float | None) -> float:
    """Return how far beyond the label voxels are looked at, mm."""
    close = checked_mm(close_mm, "the radius that closes a vertebra")
    growth = Growth.of(volume, grow_mm).grow_mm
    return close + (float(np.linalg.norm(volume.spacing)) if growth is None else growth)


def make_solid(
    resident: DeviceVolume,
    crop: LabelCrop,
    iso_value: float | None,
    surface: SurfaceKind,
    close_mm: float,
    grow_mm: float | None,
) -> tuple[Mask, Mask, CortexReport | None]:
    """Return the solid bone of a cropped label, the voxels of all other labels, and what was found of the cortex."""
    if surface not in ("hu", "cortex"):
        raise UsageError(f"there is no surface {surface!r}: it is hu or cortex")
    if surface == "cortex" and iso_value is None:
        raise UsageError(
            f"the cortex is looked for from a low level on, which shows its walls: give it"
            f" ({name_parameter('iso_value', 200)})"
        )
    if iso_value is None and grow_mm is not None:
        raise UsageError("the label's own voxels do not grow: leave the growth out, or give an iso value")
    numbers = resident.bring(crop.labels).voxels
    others = Mask.from_array(resident, (numbers != 0) & (numbers != crop.number))
    cortex, is_label = None, numbers == crop.number
    if iso_value is not None:
        is_label = _inside(resident, crop, iso_value, grow_mm)
    if iso_value is not None and surface == "cortex" and is_label.any():
        mesh = fit_labels(resident, crop.labels, iso_value, crop.number, grow_mm=grow_mm)[crop.number]
        places = crop.volume.lps_to_ijk(mesh.vertices)[:, ::-1]
        cortex, is_label = mesh.report["cortex"], fill_surface(places, mesh.triangles, is_label.shape)
    if not is_label.any():
        raise _refuse_empty(crop, numbers == crop.number, iso_value)
    bone = Mask.from_array(resident, is_label)
    # not close(): near the end of the scan it takes what lies between bone and the end, as bone may go on beyond it
    closed = bone.dilate(close_mm).erode(close_mm) | bone
    solid = (closed - others).fill_holes() - others
    phrase = "label" if iso_value is None else f"{iso_value:g} HU in label"
    phrase = f"the cortex from {phrase}" if cortex else phrase
    solid.name = f"solid bone of {phrase} {crop.name}, closed by {close_mm:g} mm"
    return solid, others, cortex


def _refuse_empty(crop: LabelCrop, is_label: NDArray[np.bool_], iso_value: float | None) -> NoSurfaceError:
    """Return the error for a label without voxels at an iso value, or without any on the grid of the volume."""
    called, hu = f"label {crop.number} {crop.name}", crop.volume.voxels[is_label]
    if iso_value is None or not hu.size:
        return NoSurfaceError(f"{called} holds the centre of no voxel of the CT: it is smaller than they are")
    low, high = float(hu.min()), float(hu.max())
    return NoSurfaceError(
        f"no voxel of {called} has {iso_value:g} HU: they run from {format_hu(low)} to {format_hu(high)} HU"
    )


def _inside(resident: DeviceVolume, crop: LabelCrop, iso_value: float, grow_mm: float | None) -> NDArray[np.bool_]:
    """Mark the voxels that are inside of the label at an iso value, as surfaces of solid labels have them."""
    volume = crop.volume
    placed = resident.bring(crop.labels)
    rule = choose_iso_rule(volume, iso_value, closed=True, values=resident.values)
    growth = Growth.of(volume, grow_mm)
    boxes = find_boxes(placed.voxels, (crop.number,), growth.reach)
    inside = np.zeros(placed.voxels.shape, placed.voxels.dtype)
    if rule.mark_inside(volume.voxels).all():
        raise NoSurfaceError(
            f"every voxel around label {crop.number} {crop.name} has {iso_value:g} HU and more, from"
            f" {float(volume.voxels.min()):g} HU on: a level lies between bone and what is beside it"
        )
    if not boxes or not ((placed.voxels == crop.number) & rule.mark_inside(volume.voxels)).any():
        return inside != 0
    for attempt in resident.with_fallback():
        with attempt:
            slab = LabelExtraction(resident, placed, rule, growth, True, []).hold(boxes)
            download(resident.device, inside[slab.first : slab.end], slab.inside_d)
    return inside == crop.number
