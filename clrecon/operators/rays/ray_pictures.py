"""Pictures by sampling rays: volume rendering and projections, from slab to slab."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.surroundings import LEFT_OUT, count_left_out
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import Stopwatch
from clrecon.operators.rays.buffers import Between, DrawnVolume, PictureBuffers
from clrecon.operators.rays.composite import TransferTables, composite_slab
from clrecon.operators.rays.leaps import find_leaps
from clrecon.operators.rays.project import project_slab
from clrecon.operators.rays.ray_view import NEAR_ROW, RayView
from clrecon.operators.rays.slabs import RAYS, RaySlab, entry_slice, plan_ray_slabs, ray_slabs
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.frame import volume_box
from clrecon.rendering import Lighting, Rendering
from clrecon.rendering.looks.window import (
    checked_window,
    choose_mip_window,
    choose_water_window,
    choose_window,
    grey_image,
)
from clrecon.rendering.pictures.styles import Projection, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.system.progress import Progress, ignore_progress

_NO_BODY = "no body was found in the scan: the lowest values are those of all of it, the air around included"


def take_picture(
    resident: DeviceVolume,
    style: VolumeLook | Projection,
    camera: Camera,
    size: tuple[int, int],
    ray_step: float,
    background: str | Sequence[float] | None = None,
    progress: Progress | None = None,
) -> Rendering:
    """Take one picture of a volume on a device.

    size: (width, height)
    ray_step: mm.
    background: str or (float, float, float). None: transparent.
    progress: Called as ``progress("slabs", slices done, all slices)``.
    """

    def take(told: list[str]) -> Rendering:
        job = _Job(resident, style, camera, size, ray_step, background, progress or ignore_progress)
        job.warnings[:0] = told
        return job.run()

    return resident.attempt(take)


def take_with_layers(
    resident: DeviceVolume,
    style: VolumeLook,
    camera: Camera,
    size: tuple[int, int],
    ray_step: float,
    beside: Mapping[str, int],
    draw: Callable[[DrawnVolume], Rendering],
) -> Rendering:
    """Take a picture of a volume with what lies in it.

    beside: Bytes of other buffers on the device.
    draw: Draws the picture; it is called again where the device has no room, or another one takes over.
    """

    def take(told: list[str]) -> Rendering:
        job = _Job(resident, style, camera, size, ray_step, None, ignore_progress)
        job.warnings[:0] = told
        slices = plan_ray_slabs(resident, beside, {}, job.labels)

        def attempt(slices: int) -> Rendering:
            sampled = DrawnVolume(
                resident.device, partial(job.sample_between, slices), job.near_mm, job.stopwatch, job.warnings
            )
            return draw(sampled)

        return resident.halve(RAYS, slices, attempt, warnings=job.warnings)

    return resident.attempt(take)


class _Job:
    def __init__(
        self,
        resident: DeviceVolume,
        style: VolumeLook | Projection,
        camera: Camera,
        size: tuple[int, int],
        ray_step: float,
        background: str | Sequence[float] | None,
        progress: Progress,
    ):
        self.resident, self.style, self.camera, self.size = resident, style, camera, size
        self.ray_step, self.background, self.progress = ray_step, background, progress
        label_style = style.label_style if isinstance(style, VolumeLook) else None
        self.labels = None if label_style is None else resident.bring(label_style.labels)
        self.warnings = [] if self.labels is None else list(self.labels.warnings)
        self.lighting = style.light if isinstance(style, VolumeLook) else Lighting()
        self.stopwatch = Stopwatch()
        self.box = volume_box(resident.volume)
        self.planes = None if style.clip is None else style.clip.planes

    def run(self) -> Rendering:
        """Take the picture, with thinner slabs if the device has no room for the planned ones."""
        resident = self.resident
        slices = plan_ray_slabs(resident, *PictureBuffers.needs(self.size), self.labels)
        return resident.halve(RAYS, slices, self._take, warnings=self.warnings)

    def _take(self, slices: int) -> Rendering:
        """Go through the slabs and collect the picture."""
        resident, style, stopwatch = self.resident, self.style, self.stopwatch
        device, nk = resident.device, resident.volume.shape_ijk[2]
        output = PictureBuffers(device, self.size, self.background, slices < nk)
        slabs = 0
        self.progress("slabs", 0, nk)
        for slab in ray_slabs(resident, slices, entry_slice(resident.volume, self.camera), stopwatch):
            slabs += 1
            if isinstance(style, Projection):
                with stopwatch.running(device):  # wait: CPU devices read host arrays
                    project_slab(resident, slab, self._view(self.box), style.kind, output, stopwatch)
            else:
                self._composite(slab, style, output)
            self.progress("slabs", min(slabs * slices, nk), nk)
        with stopwatch.timed("download"):
            image, depths, means = output.download()
        report = {
            "mode": style.mode,
            "device": device.label,
            "driver": device.driver,
            "ray_step_mm": self.ray_step,
            "slabs": slabs,
            "seconds": dict(stopwatch.seconds),
            "kernel_seconds": dict(stopwatch.by_kernel),
            "warnings": [*device.warnings, *self.warnings],
        }
        if isinstance(style, Projection):
            return self._finish_projection(style, means, depths, report)
        report["unit_distance_mm"] = style.function.unit_distance
        return Rendering(image, depths, means, self.camera, None, style.mode, report)

    @property
    def near_mm(self) -> float:
        """Where the rays begin, see `VIEW_NEAR` in cl/rays/view.h."""
        return float(self._view(self.box).table[NEAR_ROW, 0])

    def sample_between(self, slices: int, between: Between) -> None:
        """Add what the volume shows between two layers to the states of the rays."""
        resident, style = self.resident, self.style
        assert isinstance(style, VolumeLook)
        output = PictureBuffers.of_states(resident.device, self.size, between.states_d)
        for slab in ray_slabs(resident, slices, entry_slice(resident.volume, self.camera), self.stopwatch):
            self._composite(slab, style, output, between)

    def _composite(
        self, slab: RaySlab, style: VolumeLook, output: PictureBuffers, between: Between | None = None
    ) -> None:
        resident, stopwatch = self.resident, self.stopwatch
        key = (style.function, self.ray_step)
        tables = resident.keep("transfer function", key, 0, lambda: TransferTables.of(resident.device, *key))
        with stopwatch.running(resident.device):
            leaps = find_leaps(resident, slab, key, tables.shown, tables.low, tables.scale, stopwatch)
        nothing = (self.box[1], self.box[1])
        view = self._view(nothing if leaps.box is None else leaps.box)
        composite_slab(
            resident, slab, view, tables, leaps, self.lighting, style.jitter, self.labels, style.label_style,
            output, stopwatch, between,
        )  # fmt: skip

    def _finish_projection(
        self, style: Projection, values: NDArray[np.float32], depths: NDArray[np.float32], report: dict[str, Any]
    ) -> Rendering:
        is_water = style.kind == "drr"
        volume = self.resident.volume
        if style.leaves_out and LEFT_OUT in volume.report:
            left_out = self.resident.keep("left out", None, 0, lambda: count_left_out(volume))
            assert left_out is not None
            empty = ~(values <= volume.report[LEFT_OUT]["highest_hu"])
            values[empty] = depths[empty] = np.nan
            report["left_out"] = left_out
            if not left_out["body"]:
                report["warnings"].append(_NO_BODY)
        choose = {"drr": choose_water_window, "mip": choose_mip_window}.get(style.kind, choose_window)
        window = choose(values) if style.window is None else checked_window(style.window)
        report["window_mm_water" if is_water else "window_hu"] = list(window)
        image = grey_image(values, window)
        if is_water:
            image[values <= 0.0, 3] = 0  # nothing attenuates there, inside the volume or beside it
        made = Rendering(image, depths, depths.copy(), self.camera, values, style.kind, report)
        return made if self.background is None else made.with_background(self.background)

    def _view(self, focus: tuple[Float64Array, Float64Array]) -> RayView:
        return RayView.of(
            self.resident.volume, self.camera, self.size, self.ray_step,
            lighting=self.lighting, planes=self.planes, box=self.box, focus=focus,
        )  # fmt: skip
