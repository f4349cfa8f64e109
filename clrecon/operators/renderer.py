"""Pictures of a volume: one volume on a device, any number of pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.camera import Camera
from clrecon.geometry.clip import Clip
from clrecon.geometry.views import checked_size
from clrecon.kernels import Stopwatch
from clrecon.opencl import Device, choose_device
from clrecon.operators.composite import TransferTables, composite_slab
from clrecon.operators.pictures import PictureBuffers
from clrecon.operators.project import PROJECTIONS, project_slab
from clrecon.operators.ray_view import RayView, volume_box
from clrecon.operators.resident import ResidentVolume, entry_slice
from clrecon.rendering import Lighting, Rendering, TransferFunction
from clrecon.rendering.presets import DEFAULT_PRESET, find_preset
from clrecon.rendering.window import checked_window, choose_window, grey_image

__all__ = ["MODES", "VolumeRenderer", "render"]

MODES = ("dvr", "mip", "minip", "mean")
"""Kinds of pictures."""

DEFAULT_SIZE = (1024, 1024)
SMALLEST_STEP = 0.01
"""Ray steps below this share of the smallest spacing add time and nothing else."""


class VolumeRenderer:
    """A volume on a device, of which pictures are made one after the other.

    The volume is uploaded once where it fits the device as a whole; a larger one goes through in slabs for each
    picture, and gives the same.  Use it as a context manager, or `close` it.

    Parameters
    ----------
    volume : Volume
        Its voxels must not change as long as the renderer is open.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.

    Raises
    ------
    UsageError
        `volume` is no Volume or holds NaN, or `memory` is no number of bytes.
    DeviceError
        There is no such device.
    """

    def __init__(self, volume: Volume, device: Device | str | int | None = None, *, memory: int | None = None):
        if not isinstance(volume, Volume):
            raise UsageError(f"a picture needs a Volume, not {type(volume).__name__}: clrecon.Volume(voxels, affine)")
        if memory is not None and (isinstance(memory, bool) or not isinstance(memory, int) or memory < 1):
            raise UsageError(f"memory is a whole number of bytes, not {memory!r}")
        if volume.voxels.dtype.kind == "f" and not np.isfinite(volume.voxels).all():
            raise UsageError("the voxels hold NaN or infinite values: fill them first, for CT with -1024")
        self.volume = volume
        self.device = choose_device(device)
        self.memory = memory
        self._resident = ResidentVolume(volume, self.device, memory)
        self._tables: dict[tuple[TransferFunction, float], TransferTables] = {}

    def __enter__(self) -> VolumeRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the volume on the device."""
        self._resident.close()
        self._tables.clear()

    def render(
        self,
        mode: str | None = None,
        preset: str | None = None,
        transfer_function: TransferFunction | None = None,
        camera: Camera | None = None,
        view: str | Sequence[float] = "anterior",
        size: Sequence[int] = DEFAULT_SIZE,
        ray_step: float | None = None,
        *,
        up: str | Sequence[float] | None = None,
        zoom: float = 1.0,
        view_angle: float | None = None,
        lighting: Lighting | None = None,
        window: Sequence[float] | None = None,
        clip: Clip | None = None,
        background: str | Sequence[float] = "black",
        jitter: bool = False,
    ) -> Rendering:
        """Make one picture, see `render`."""
        size = checked_size(size)
        for what, value, kind in (("camera", camera, Camera), ("lighting", lighting, Lighting), ("clip", clip, Clip)):
            if not (value is None or isinstance(value, kind)):
                raise UsageError(f"the {what} of a picture is a {kind.__name__} or None, not {value!r:.60}")
        request = _Request.of(mode, preset, transfer_function, lighting, window)
        if camera is None:
            camera = Camera.fit(self.volume, view, zoom, up=up, view_angle=view_angle, size=size)
        step = self._checked_step(ray_step)
        job = _Job(self, request, camera, size, step, clip, None if background == "transparent" else background)
        return job.run(jitter)

    def _checked_step(self, ray_step: float | None) -> float:
        smallest = min(self.volume.spacing)
        if ray_step is None:
            return 0.5 * smallest
        try:
            step = float(ray_step)
        except (TypeError, ValueError):
            step = math.nan
        if not (math.isfinite(step) and step >= SMALLEST_STEP * smallest):
            raise UsageError(
                f"the ray step is a length in mm, at least {SMALLEST_STEP * smallest:.3g} in this volume"
                f" (a hundredth of its smallest spacing), not {ray_step!r}"
            )
        return step

    def _transfer_tables(self, function: TransferFunction, ray_step: float) -> TransferTables:
        key = (function, ray_step)
        if key not in self._tables:
            self._tables.clear()
            self._tables[key] = TransferTables.of(self.device, function, ray_step)
        return self._tables[key]


class _Request:
    """What is to be seen, after presets and defaults have had their say."""

    def __init__(self, mode: str, function: TransferFunction, lighting: Lighting, window: tuple[float, float] | None):
        self.mode = mode
        self.function = function
        self.lighting = lighting
        self.window = window

    @classmethod
    def of(
        cls,
        mode: str | None,
        preset: str | None,
        function: TransferFunction | None,
        lighting: Lighting | None,
        window: Sequence[float] | None,
    ) -> _Request:
        if function is not None and not isinstance(function, TransferFunction):
            raise UsageError(f"the transfer function is a TransferFunction, not {type(function).__name__}")
        if function is not None and preset is not None:
            raise UsageError(f"a picture has a preset ({preset}) or a transfer function, not both")
        chosen = find_preset(DEFAULT_PRESET if preset is None else preset)
        if mode is None:
            mode = chosen.mode if function is None else "dvr"
        if mode not in MODES:
            raise UsageError(f"there is no mode {mode!r}: it is one of {', '.join(MODES)}")
        if function is None:
            function = chosen.transfer_function
        if lighting is None:
            lighting = function.lighting or Lighting()
        if window is not None:
            window = checked_window(window)
        elif preset is not None:
            window = chosen.window
        return cls(mode, function, lighting, None if window is None else (window[0], window[1]))


class _Job:
    """One picture: from slab to slab."""

    def __init__(
        self,
        renderer: VolumeRenderer,
        request: _Request,
        camera: Camera,
        size: tuple[int, int],
        ray_step: float,
        clip: Clip | None,
        background: str | Sequence[float] | None,
    ):
        self.renderer = renderer
        self.request = request
        self.stopwatch = Stopwatch()
        self.background = background
        self.camera, self.size, self.ray_step = camera, size, ray_step
        self.planes = clip.planes if clip is not None else None

    def run(self, jitter: bool) -> Rendering:
        """Go through the slabs and collect the picture."""
        renderer, request, stopwatch = self.renderer, self.request, self.stopwatch
        resident, device = renderer._resident, renderer.device
        slices = resident.plan(*PictureBuffers.needs(self.size))
        output = PictureBuffers(device, self.size, self.background, slices < renderer.volume.shape_ijk[2])
        box = volume_box(renderer.volume)
        slabs = 0
        with stopwatch.running(device):
            for slab in resident.slabs(slices, entry_slice(renderer.volume, self.camera), stopwatch):
                slabs += 1
                if request.mode in PROJECTIONS:
                    project_slab(resident, slab, self._view(box, box), request.mode, output, stopwatch)
                else:
                    tables = renderer._transfer_tables(request.function, self.ray_step)
                    key = (request.function, self.ray_step)
                    leaps = resident.find_leaps(slab, key, tables.shown, tables.low, tables.scale, stopwatch)
                    view = self._view(box, box if leaps.box is None else leaps.box, nothing=leaps.box is None)
                    composite_slab(resident, slab, view, tables, leaps, request.lighting, jitter, output, stopwatch)
        with stopwatch.timed("download"):
            image, depths, means = output.download()
        report = {
            "mode": request.mode,
            "device": device.label,
            "driver": device.driver,
            "ray_step_mm": self.ray_step,
            "slabs": slabs,
            "seconds": dict(stopwatch.seconds),
            "kernel_seconds": dict(stopwatch.by_kernel),
            "warnings": [],
        }
        if request.mode in PROJECTIONS:
            return self._finish_projection(means, depths, report)
        report["unit_distance_mm"] = request.function.unit_distance
        return Rendering(image, depths, means, self.camera, None, request.mode, report)

    def _finish_projection(
        self, values: NDArray[np.float32], depths: NDArray[np.float32], report: dict[str, Any]
    ) -> Rendering:
        window = self.request.window or choose_window(values)
        report["window_hu"] = list(window)
        made = Rendering(
            grey_image(values, window), depths, depths.copy(), self.camera, values, self.request.mode, report
        )
        return made if self.background is None else made.with_background(self.background)

    def _view(
        self, box: tuple[Float64Array, Float64Array], focus: tuple[Float64Array, Float64Array], nothing: bool = False
    ) -> RayView:
        if nothing:
            focus = (focus[1], focus[1])
        return RayView.of(
            self.renderer.volume, self.camera, self.size, self.ray_step,
            lighting=self.request.lighting, planes=self.planes, box=box, focus=focus,
        )  # fmt: skip


def render(
    volume: Volume,
    mode: str | None = None,
    preset: str | None = None,
    transfer_function: TransferFunction | None = None,
    camera: Camera | None = None,
    view: str | Sequence[float] = "anterior",
    size: Sequence[int] = DEFAULT_SIZE,
    ray_step: float | None = None,
    device: Device | str | int | None = None,
    *,
    memory: int | None = None,
    **options: Any,
) -> Rendering:
    """Make a picture of a volume.

    Parameters
    ----------
    volume : Volume
    mode : {"dvr", "mip", "minip", "mean"}, optional
        Default is the preset's, or "dvr".
    preset : str, optional
        See `clrecon.rendering.presets`; default "bone".
    transfer_function : TransferFunction, optional
        In place of a preset.
    camera : Camera, optional
        In place of `view`, `up`, `zoom` and `view_angle`.
    view : str or (azimuth, elevation)
        See `Camera.fit`, which also takes `up`, `zoom` and `view_angle`.
    size : (width, height)
        Pixels.
    ray_step : float, optional
        mm between samples; default half the smallest spacing.
    device : Device, str or int, optional
        See `clrecon.device`.
    memory : int, optional
        Bytes that may be taken on the device; default all that it has.
    **options
        ``lighting``; ``window``, HU that are black and white in projections, by default the 1st to the 99th
        percentile; ``clip``, a `Clip`; ``background``, a colour or "transparent"; ``jitter``, samples at random places
        of their segments.

    Returns
    -------
    Rendering

    Raises
    ------
    UsageError
        A value that cannot be; the message lists what can.
    DeviceError
        No device, not enough memory, or the device fails.
    """
    with VolumeRenderer(volume, device, memory=memory) as renderer:
        return renderer.render(mode, preset, transfer_function, camera, view, size, ray_step, **options)
