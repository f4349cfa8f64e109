"""The solid bone of one vertebra: its label, or an iso level within it, closed and filled, with the canal left open."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels import LabelMap
from clrecon.labels.growth import Growth
from clrecon.labels.solid import find_boxes
from clrecon.opencl import Device, download
from clrecon.operators.masks.mask import Mask
from clrecon.operators.masks.regions import checked_mm
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.label_extraction import LabelExtraction
from clrecon.operators.vertebrae.crop import LabelCrop, crop_label
from clrecon.system.arguments import explains_arguments
from clrecon.system.text import format_hu

CLOSE_MM = 1.5
"""Radius of the balls that close pores and vessels of the cortex."""


@explains_arguments
def vertebra_solid(
    volume: Volume,
    labels: LabelMap,
    label: int | str,
    iso_value: float | None = None,
    *,
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
        ``mask.volume`` is the part of the volume around the vertebra, at its place in the patient; the order of its
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
        return make_solid(resident, crop, iso_value, close_mm, grow_mm)[0]


def label_margin(volume: Volume, close_mm: float, grow_mm: float | None) -> float:
    """Return how far beyond the label voxels are looked at, mm."""
    close = checked_mm(close_mm, "the radius that closes a vertebra")
    growth = Growth.of(volume, grow_mm).grow_mm
    return close + (float(np.linalg.norm(volume.spacing)) if growth is None else growth)


def make_solid(
    resident: DeviceVolume, crop: LabelCrop, iso_value: float | None, close_mm: float, grow_mm: float | None
) -> tuple[Mask, Mask]:
    """Return the solid bone of a cropped label, and the voxels of all other labels."""
    if iso_value is None and grow_mm is not None:
        raise UsageError("the label's own voxels do not grow: leave the growth out, or give an iso value")
    numbers = resident.bring(crop.labels).voxels
    others = Mask.from_array(resident, (numbers != 0) & (numbers != crop.number))
    own = numbers == crop.number if iso_value is None else _inside(resident, crop, iso_value, grow_mm)
    if not own.any():
        raise _refuse_empty(crop, numbers == crop.number, iso_value)
    bone = Mask.from_array(resident, own)
    # not close(): near the end of the scan it takes what lies between bone and the end, as bone may go on beyond it
    closed = bone.dilate(close_mm).erode(close_mm) | bone
    solid = (closed - others).fill_holes() - others
    what = "label" if iso_value is None else f"{iso_value:g} HU in label"
    solid.name = f"solid bone of {what} {crop.name}, closed by {close_mm:g} mm"
    return solid, others


def _refuse_empty(crop: LabelCrop, own: NDArray[np.bool_], iso_value: float | None) -> NoSurfaceError:
    """Return the error for a label without voxels at an iso value, or without any on the grid of the volume."""
    called, hu = f"label {crop.number} {crop.name}", crop.volume.voxels[own]
    if iso_value is None or not hu.size:
        return NoSurfaceError(f"{called} holds the centre of no voxel of the CT: it is smaller than they are")
    low, high = float(hu.min()), float(hu.max())
    return NoSurfaceError(
        f"no voxel of {called} has {iso_value:g} HU: they run from {format_hu(low)} to {format_hu(high)} HU"
    )


def _inside(resident: DeviceVolume, crop: LabelCrop, iso_value: float, grow_mm: float | None) -> NDArray[np.bool_]:
    """Mark the voxels that are inside of the label at an iso value, as surfaces of solid labels have them."""
    volume = crop.volume
    taken = resident.bring(crop.labels)
    rule = choose_iso_rule(volume, iso_value, True, values=resident.values)
    growth = Growth.of(volume, grow_mm)
    boxes = find_boxes(taken.voxels, (crop.number,), growth.reach)
    inside = np.zeros(taken.voxels.shape, taken.voxels.dtype)
    if rule.mark_inside(volume.voxels).all():
        raise NoSurfaceError(
            f"every voxel around label {crop.number} {crop.name} has {iso_value:g} HU and more, from"
            f" {float(volume.voxels.min()):g} HU on: a level lies between bone and what is beside it"
        )
    if not boxes or not ((taken.voxels == crop.number) & rule.mark_inside(volume.voxels)).any():
        return inside != 0

    def find(told: list[str]) -> Any:
        run = LabelExtraction(resident, taken, rule, growth, solid=True)
        held = run.find_inside(boxes)
        return download(resident.device, inside[held.first : held.end], held.inside_d)

    resident.attempt(find)
    return inside == crop.number
