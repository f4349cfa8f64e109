"""Slices in space: slices of a volume drawn at their own places; the host's side of cl/rays/slices.cl."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import Stopwatch, check_budget, kernel_constant, launch, load_program, upload
from clrecon.operators.rays.picture_buffers import (
    NEAR_ROW,
    Between,
    DrawnVolume,
    PictureBuffers,
    RayView,
    Shot,
    count_queues,
    describe_picture,
)
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import FieldFrame, volume_box, voxel_variants
from clrecon.rendering import Rendering
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.pictures.styles import SlicesInSpace
from clrecon.rendering.views.camera import Camera

_DEFAULT_COUNT = 12
"""Number of slices shown by default: enough to see the body, few enough to see each slice."""

_DEFAULT_WINDOW = (-300.0, 400.0)
"""HU of black and white without a window or a transfer function: soft tissue and bone."""

NODES = kernel_constant("rays/slices.cl", "BINS")
"""Entries of the table of colours."""

SLICES = "slices in space"
"""Purpose by which parts are planned."""

_EDGE_ON = 1e-3
"""Cosine between a parallel view and the slices' normal below which the slices are invisible."""


def choose_slices(volume: Volume, slices: int | Sequence[int] | None = None) -> list[int]:
    """Return the numbers k of the slices to show, as `SlicesInSpace.slices`, ascending."""
    nk = volume.shape_ijk[2]
    if slices is None:
        count = min(nk, _DEFAULT_COUNT)
        return np.unique(np.rint(np.linspace(0, nk - 1, count)).astype(int)).tolist()
    if isinstance(slices, int):
        return list(range(0, nk, slices))
    for k in slices:
        if not 0 <= k < nk:
            raise UsageError(f"slice {k} is not there: the volume has slices 0 to {nk - 1}")
    return sorted(slices)


def overlay_slices(resident: DeviceVolume, style: SlicesInSpace, shot: Shot) -> Rendering:
    """Show slices of a volume, sheared and uneven ones too, translucent at their own places, with the first visible
    depth.

    A volume that is already on the device is read there; else the shown slices are uploaded, in parts if need be.
    """
    for attempt in resident.with_fallback():
        with attempt as (_, warnings):
            overlay = _Overlay(resident, style, shot, warnings)
            planned = overlay.plan(*PictureBuffers.needs(shot.size))
            for slabs in resident.attempts(SLICES, planned, overlay.warnings):
                with slabs as slices:
                    picture = overlay.take(slices)
    return picture


def overlay_with_layers(
    resident: DeviceVolume,
    style: SlicesInSpace,
    shot: Shot,
    beside: Mapping[str, int],
    draw: Callable[[DrawnVolume], Rendering],
) -> Rendering:
    """Show slices of a volume with what lies between; `draw` is called again as in `take_with_layers`."""
    for attempt in resident.with_fallback():
        with attempt as (device, warnings):
            overlay = _Overlay(resident, style, shot, warnings)
            near_mm = float(overlay.view.table[NEAR_ROW, 0])
            for slabs in resident.attempts(SLICES, overlay.plan(beside, {}), overlay.warnings):
                with slabs as slices:
                    sample = partial(overlay.sample_between, slices)
                    picture = draw(DrawnVolume(device, sample, near_mm, overlay.stopwatch, overlay.warnings))
    return picture


class _Colors(NamedTuple):
    """Colours (NODES, 4) float32 by value; the nearest node to v is ``floor((v - low) * scale + 0.5)``."""

    table: NDArray[np.float32]
    low: float
    scale: float

    @classmethod
    def of(cls, style: SlicesInSpace) -> _Colors:
        if style.transfer_function is not None:
            low, high = style.transfer_function.range_hu
            colors = style.transfer_function.table(low, high, NODES)
        else:
            low, high = _DEFAULT_WINDOW if style.window is None else checked_window(style.window)
            colors = np.repeat(np.linspace(0.0, 1.0, NODES)[:, None], 4, axis=1).astype(np.float32)
        return cls(colors, low, (NODES - 1) / (high - low))


def _sort_slices(volume: Volume, camera: Camera, chosen: Sequence[int]) -> list[int]:
    """Sort slices as rays cross them, all alike: parallel ones up or down, others away from the camera."""
    heights = _heights(volume, volume.slice_origins()[list(chosen)])
    if camera.is_parallel:
        along = heights * np.sign(_heights(volume, camera.basis().forward[None])[0] or 1.0)
    else:
        along = np.abs(heights - _heights(volume, np.array([camera.position]))[0])
    return [chosen[n] for n in np.argsort(along, kind="stable")]


def _heights(volume: Volume, points: Float64Array) -> Float64Array:
    return np.asarray(points @ slice_normal(volume.affine), dtype=np.float64)


def _warn_of_edge(volume: Volume, camera: Camera) -> list[str]:
    if not camera.is_parallel or abs(_heights(volume, camera.basis().forward[None])[0]) > _EDGE_ON:
        return []
    return ["the slices are seen edge-on and do not show: look from another side, such as 30,30, or in perspective"]


class _Overlay:
    """One picture: part after part of the slices, in the order in which rays cross them."""

    def __init__(self, resident: DeviceVolume, style: SlicesInSpace, shot: Shot, warnings: list[str]):
        self.resident, self.style = resident, style
        self.shot = shot
        camera = shot.camera
        self.chosen = choose_slices(resident.volume, style.slices)
        self.colors = _Colors.of(style)
        self.order = _sort_slices(resident.volume, camera, self.chosen)
        box = volume_box(resident.volume)
        planes = None if style.clip is None else style.clip.planes
        self.view = RayView.of(resident.volume, camera, shot.size, 1.0, planes=planes, box=box, focus=box)
        self.stopwatch = Stopwatch()
        self.warnings = [*warnings, *_warn_of_edge(resident.volume, camera)]

    def plan(self, picture: Mapping[str, int], states: Mapping[str, int]) -> int:
        """Return how many slices fit beside a picture at once."""
        resident, count = self.resident, len(self.chosen)

        def needs(slices: int) -> dict[str, int]:
            buffers = {"slices": slices * resident.slice_bytes, **picture}
            return buffers if slices == count else {**buffers, **states}

        if resident.is_held and resident.shortage({"volume": resident.volume.voxels.nbytes, **picture}):
            resident.make_way()
        slices = count if resident.is_held else resident.plan(SLICES, count, needs)
        if slices == 0:
            check_budget(resident.device, needs(1), resident.memory)
        if slices < count:
            resident.make_way()
        return max(slices, 1)

    def sample_between(self, slices: int, between: Between) -> None:
        """Add what slices show between two layers to the states of the rays."""
        output = PictureBuffers.of_states(self.resident.device, self.view.size, between.states_d)
        for first in range(0, len(self.order), slices):
            self._draw(self.order[first : first + slices], 0, output, between)

    def take(self, slices: int) -> Rendering:
        stopwatch, device = self.stopwatch, self.resident.device
        parts = [self.order[first : first + slices] for first in range(0, len(self.order), slices)]
        output = PictureBuffers(device, self.shot.size, self.shot.background, len(parts) > 1)
        self.shot.progress("slabs", 0, len(self.order))
        for number, part in enumerate(parts):
            self._draw(part, (number == 0) + 2 * (number == len(parts) - 1), output)
            self.shot.progress("slabs", min((number + 1) * slices, len(self.order)), len(self.order))
        with stopwatch.timed("download"):
            image, late = output.download_image()
        report = describe_picture(
            "slices", device, stopwatch, self.warnings,
            slices=self.chosen, slice_opacity=self.style.opacity, lowest_shown_hu=self.style.lowest_hu,
        )  # fmt: skip
        return Rendering.with_late_depths(late, image, self.view.camera, None, "slices", report)

    def _draw(self, part: Sequence[int], stage: int, output: PictureBuffers, between: Between | None = None) -> None:
        """Draw slices in the given order, and wait."""
        resident, style = self.resident, self.style
        colors, view = self.colors, self.view
        stopwatch = self.stopwatch
        device, volume = resident.device, resident.volume
        places = np.zeros((len(part), 4), np.float32)
        places[:, :3] = FieldFrame.of(volume).places(volume.slice_origins()[list(part)])
        if resident.is_held:
            slices_d, places[:, 3] = resident.whole(stopwatch), part
        else:
            slices_d, places[:, 3] = resident.upload(volume.voxels[list(part)], stopwatch), range(len(part))
        ni, nj, _ = volume.shape_ijk
        queues = count_queues(device)
        variants, shortened = voxel_variants(volume.voxels.dtype), {}
        if between is not None:
            variants = {**variants, "BETWEEN": "1"}
            shortened = {"nearest": between.nearest_d, "farthest": between.farthest_d}
        program = load_program(device, "rays/slices.cl", variants)
        with stopwatch.running(device):  # wait: CPU devices read the host's array
            launch(
                device, program["overlay_slices"], output.items(queues, 1), slices=slices_d,
                places=upload(device, places), colors=upload(device, colors.table), view=upload(device, view.table),
                ni=ni, nj=nj, count=len(part), bins_low=colors.low, bins_scale=colors.scale, opacity=style.opacity,
                lowest=style.lowest_hu, stage=stage, queues=queues, **output.arguments, **view.arguments, **shortened,
            )  # fmt: skip
