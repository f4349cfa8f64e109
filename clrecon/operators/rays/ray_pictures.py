"""Pictures by sampling rays: volume rendering and projections, from slab to slab."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.opencl import Stopwatch
from clrecon.operators.rays.buffers import PictureBuffers
from clrecon.operators.rays.composite import TransferTables, composite_slab
from clrecon.operators.rays.leaps import find_leaps
from clrecon.operators.rays.project import PROJECTIONS, project_slab
from clrecon.operators.rays.ray_view import RayView
from clrecon.operators.rays.slabs import RAYS, RaySlab, entry_slice, plan_ray_slabs, ray_slabs
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.frame import volume_box
from clrecon.rendering import Lighting, Rendering, TransferFunction
from clrecon.rendering.looks.label_style import LabelStyle
from clrecon.rendering.looks.window import choose_water_window, choose_window, grey_image
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

__all__ = ["RayPicture", "take_picture"]


@dataclass(frozen=True)
class RayPicture:
    """The description of a picture.

    Attributes
    ----------
    mode : {"dvr", "mip", "minip", "mean", "drr"}
    camera : Camera
    size : (width, height)
    ray_step : float
        mm.
    function : TransferFunction
        Of volume rendering.
    lighting : Lighting
    window : (low, high) or None
        Values of black and white in projections, in HU (in drr mm of water); None: chosen from the values.
    clip : Clip or None
    background : colour or None
        None: transparent.
    jitter : bool
    style : LabelStyle or None
        Of volume rendering.
    """

    mode: str
    camera: Camera
    size: tuple[int, int]
    ray_step: float
    function: TransferFunction
    lighting: Lighting
    window: tuple[float, float] | None = None
    clip: Clip | None = None
    background: str | Sequence[float] | None = None
    jitter: bool = False
    style: LabelStyle | None = None


def take_picture(resident: DeviceVolume, picture: RayPicture) -> Rendering:
    """Take one picture of a volume on a device.

    Raises
    ------
    DeviceError
        Not enough memory, or the device fails.
    RefusedInputError
        The labels do not lie on the volume.
    """
    return _Job(resident, picture).run()


class _Job:
    def __init__(self, resident: DeviceVolume, picture: RayPicture):
        self.resident, self.picture = resident, picture
        self.labels = None if picture.style is None else resident.bring(picture.style.labels)
        self.warnings = [] if self.labels is None else list(self.labels.warnings)
        self.stopwatch = Stopwatch()
        self.box = volume_box(resident.volume)
        self.planes = None if picture.clip is None else picture.clip.planes

    def run(self) -> Rendering:
        """Take the picture, with thinner slabs if the device has no room for the planned ones."""
        resident = self.resident
        slices = plan_ray_slabs(resident, *PictureBuffers.needs(self.picture.size), self.labels)
        return resident.halve(RAYS, slices, self._take, warnings=self.warnings)

    def _take(self, slices: int) -> Rendering:
        """Go through the slabs and collect the picture."""
        resident, picture, stopwatch = self.resident, self.picture, self.stopwatch
        device = resident.device
        several = slices < resident.volume.shape_ijk[2]
        output = PictureBuffers(device, picture.size, picture.background, several)
        slabs = 0
        for slab in ray_slabs(resident, slices, entry_slice(resident.volume, picture.camera), stopwatch):
            slabs += 1
            if picture.mode in PROJECTIONS:
                with stopwatch.running(device):  # wait: CPU devices read host arrays
                    project_slab(resident, slab, self._view(self.box), picture.mode, output, stopwatch)
            else:
                self._composite(slab, output)
        with stopwatch.timed("download"):
            image, depths, means = output.download()
        report = {
            "mode": picture.mode,
            "device": device.label,
            "driver": device.driver,
            "ray_step_mm": picture.ray_step,
            "slabs": slabs,
            "seconds": dict(stopwatch.seconds),
            "kernel_seconds": dict(stopwatch.by_kernel),
            "warnings": list(self.warnings),
        }
        if picture.mode in PROJECTIONS:
            return self._finish_projection(means, depths, report)
        report["unit_distance_mm"] = picture.function.unit_distance
        return Rendering(image, depths, means, picture.camera, None, picture.mode, report)

    def _composite(self, slab: RaySlab, output: PictureBuffers) -> None:
        resident, picture, stopwatch = self.resident, self.picture, self.stopwatch
        key = (picture.function, picture.ray_step)
        tables = resident.keep("transfer function", key, 0, lambda: TransferTables.of(resident.device, *key))
        with stopwatch.running(resident.device):
            leaps = find_leaps(resident, slab, key, tables.shown, tables.low, tables.scale, stopwatch)
        nothing = (self.box[1], self.box[1])
        view = self._view(nothing if leaps.box is None else leaps.box)
        composite_slab(
            resident, slab, view, tables, leaps, picture.lighting, picture.jitter, self.labels, picture.style,
            output, stopwatch,
        )  # fmt: skip

    def _finish_projection(
        self, values: NDArray[np.float32], depths: NDArray[np.float32], report: dict[str, Any]
    ) -> Rendering:
        picture = self.picture
        is_water = picture.mode == "drr"
        window = picture.window or (choose_water_window if is_water else choose_window)(values)
        report["window_mm_water" if is_water else "window_hu"] = list(window)
        image = grey_image(values, window)
        if is_water:
            image[values <= 0.0, 3] = 0  # nothing attenuates there, inside the volume or beside it
        made = Rendering(image, depths, depths.copy(), picture.camera, values, picture.mode, report)
        return made if picture.background is None else made.with_background(picture.background)

    def _view(self, focus: tuple[Float64Array, Float64Array]) -> RayView:
        picture = self.picture
        return RayView.of(
            self.resident.volume, picture.camera, picture.size, picture.ray_step,
            lighting=picture.lighting, planes=self.planes, box=self.box, focus=focus,
        )  # fmt: skip
