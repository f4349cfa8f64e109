"""What a camera fits: the whole volume, or where parts of it are masked, cut or hidden, the box of what is shown."""

from __future__ import annotations

import math

import numpy as np

from clrecon.anatomy.surroundings import LEFT_OUT
from clrecon.geometry import Volume
from clrecon.geometry.base import AIR_HU
from clrecon.geometry.grid import Grid
from clrecon.labels import resample_labels
from clrecon.operators.rays.slices import choose_slices
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.rendering.looks.label_style import LabelStyle
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.pictures.styles import Projection, SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.seen import ShownLabels, find_seen_box

MASKED_BY = ("field_of_view", "remove_table", "region", LEFT_OUT)
"""Entries of the report of a volume of which a part was turned into air, or left out."""

AIR_ROOM_HU = 100.0
"""Projections and slices show nothing of interest less than this above the air that a mask leaves."""


def framing_key(volume: Volume, style: Style) -> tuple[object, ...]:
    """Return what of a style decides about `shown_box`; styles with equal keys have the same box."""
    look = _hiding_look(style)
    hidden = None if look is None else (look.labels, look.table[:, 3].tobytes())  # a label map equals only itself
    slices = style.slices if isinstance(style, SlicesInSpace) else None
    return type(style), getattr(style, "clip", None), _band(style, volume), slices, hidden


def shown_box(shown: Volume | DeviceVolume, style: Style) -> Grid:
    """Return the grid that cameras fit.

    shown: The latter brings labels to the grid of the volume once for all pictures.

    Returns: The volume itself where all of it is shown, or nothing.  Else the box of what can be seen, see
        `find_seen_box`.
    """
    volume = shown.volume if isinstance(shown, DeviceVolume) else shown
    clip = getattr(style, "clip", None)
    labels = _shown_labels(shown, style)
    if clip is None and labels is None and not any(name in volume.report for name in MASKED_BY):
        return volume
    slices = choose_slices(volume, style.slices) if isinstance(style, SlicesInSpace) else None
    box = find_seen_box(volume, _band(style, volume), clip=clip, labels=labels, slices=slices)
    return volume if box is None else box


def _hiding_look(style: Style) -> LabelStyle | None:
    """Return the look of the labels if some of them are hidden."""
    look = style.label_style if isinstance(style, VolumeLook | SurfaceLook) else None
    return None if look is None or (look.table[:, 3] > 0.0).all() else look


def _shown_labels(volume: Volume | DeviceVolume, style: Style) -> ShownLabels | None:
    """Return the labels on the grid of the volume if some of them are hidden."""
    look = _hiding_look(style)
    if look is None:
        return None
    taken = volume.bring(look.labels) if isinstance(volume, DeviceVolume) else resample_labels(look.labels, volume)
    return ShownLabels(taken.voxels, look.table[:, 3] > 0.0)


def _band(style: Style, volume: Volume) -> tuple[float, float]:
    """Return the HU that a style shows of a volume, infinite where they have no end."""
    if isinstance(style, Projection) and style.leaves_out and LEFT_OUT in volume.report:
        return -math.inf, volume.report[LEFT_OUT]["highest_hu"]
    if isinstance(style, SurfaceLook):
        return style.iso_value, math.inf
    if isinstance(style, SlicesInSpace):
        return style.lowest_hu, math.inf
    if isinstance(style, VolumeLook):
        return _band_of(style.function)
    return AIR_HU + AIR_ROOM_HU, math.inf


def _band_of(function: TransferFunction) -> tuple[float, float]:
    """Return the HU between which the opacity of a transfer function is not 0."""
    hu, opacity = function.points[:, 0], function.points[:, -1]
    shown = np.flatnonzero(opacity > 0.0)
    if not len(shown):
        return -math.inf, math.inf
    low = -math.inf if shown[0] == 0 else float(hu[shown[0] - 1])
    high = math.inf if shown[-1] == len(hu) - 1 else float(hu[shown[-1] + 1])
    return low, high
