"""Pictures of a volume: one volume on a device, any number of pictures in any mode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.opencl import Device
from clrecon.operators.rays.project import PROJECTIONS
from clrecon.operators.rays.ray_pictures import RayPicture, take_picture
from clrecon.operators.resident.device_volume import DeviceVolume, take_volume
from clrecon.rendering import Lighting, Rendering, TransferFunction
from clrecon.rendering.looks.colors import is_transparent
from clrecon.rendering.looks.label_style import LabelStyle
from clrecon.rendering.looks.presets import DEFAULT_PRESET, find_preset
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import checked_size

__all__ = ["MODES", "VolumeRenderer", "render"]

MODES = ("dvr", "mip", "minip", "mean", "drr", "surface", "slices", "slice", "cpr")
"""Kinds of pictures."""

DEFAULT_SIZE = (1024, 1024)
DEFAULT_VIEW = "anterior"
DEFAULT_ISO_VALUE = 200.0
"""HU of surfaces: bone, thin cortex of vertebrae with it."""

SMALLEST_STEP = 0.01
"""Ray steps below this share of the smallest spacing add time and nothing else."""

MOST_STEPS = 1 << 15
"""Ray steps through the diagonal of a volume: float32 counts them, and Mesa's llvmpipe ends loops after 65535 turns."""

_LABELLED = ("dvr", "surface")
_CUT = ("slice", "cpr")
_RAYS = ("dvr", "mip", "minip", "mean", "drr", "surface", "slices")

KNOWN_IN: dict[str, tuple[str, ...]] = {
    "transfer_function": ("dvr", *PROJECTIONS, "slices"),  # part of the look that all pictures of a series share
    "lighting": _RAYS,
    "window": (*PROJECTIONS, "slices", *_CUT),
    "ray_step": ("dvr", *PROJECTIONS, "surface"),
    "zoom": (*_RAYS, "slice"),
    "view_angle": _RAYS,
    "clip": _RAYS,
    "jitter": ("dvr",),
    "iso_value": ("surface",),
    "color": ("surface",),
    "shadows": ("surface",),
    "depth_cue": ("surface",),
    "labels": _LABELLED,
    "label_colors": _LABELLED,
    "label_opacity": _LABELLED,
    "slices": ("slices",),
    "slice_opacity": ("slices",),
    "offset_mm": ("slice",),
    "thickness": _CUT,
    "combine": _CUT,
    "curve": ("cpr",),
    "cpr": ("cpr",),
}
"""Options that mean something in some modes only."""


class VolumeRenderer:
    """A volume on a device, of which pictures are made one after the other.

    The volume is uploaded once where it fits the device as a whole; a larger one goes through in slabs for each
    picture, and gives the same.  Use it as a context manager, or `close` it.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        The voxels must not change as long as the renderer is open.  A `DeviceVolume` is used as it is, and has its
        device and memory.
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

    def __init__(
        self, volume: Volume | DeviceVolume, device: Device | str | int | None = None, *, memory: int | None = None
    ):
        self._resident, self._is_own = take_volume(volume, device, memory, "a picture")
        self.volume, self.device = self._resident.volume, self._resident.device
        voxels = self.volume.voxels
        if voxels.dtype.kind == "f" and not np.isfinite(voxels).all():
            raise UsageError("the voxels hold NaN or infinite values: fill them first, for CT with -1024")

    def __enter__(self) -> VolumeRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the volume on the device; a `DeviceVolume` that was given stays as it is."""
        if self._is_own:
            self._resident.close()

    def render(
        self,
        mode: str | None = None,
        preset: str | None = None,
        transfer_function: TransferFunction | None = None,
        camera: Camera | None = None,
        view: str | Sequence[float] | None = None,
        size: Sequence[int] | None = None,
        ray_step: float | None = None,
        *,
        up: str | Sequence[float] | None = None,
        zoom: float | None = None,
        view_angle: float | None = None,
        background: str | Sequence[float] = "black",
        **options: Any,
    ) -> Rendering:
        """Make one picture, see `render`."""
        if not (mode is None or isinstance(mode, str)):
            raise UsageError(f"there is no mode {mode!r:.60}: it is one of {', '.join(MODES)}")
        if size is not None or mode != "cpr":
            size = checked_size(DEFAULT_SIZE if size is None else size)
        for what, value, kind in (
            ("camera", camera, Camera), ("lighting", options.get("lighting"), Lighting),
            ("clip", options.get("clip"), Clip), ("transfer function", transfer_function, TransferFunction),
            ("labels", options.get("labels"), LabelMap),
        ):  # fmt: skip
            if not (value is None or isinstance(value, kind)):
                raise UsageError(f"the {what} of a picture is a {kind.__name__} or None, not {type(value).__name__}")
        mode = _choose_mode(mode, preset, transfer_function)
        given = {"transfer_function": transfer_function, "ray_step": ray_step, "zoom": zoom, "view_angle": view_angle}
        _check_options(mode, given | options)
        if camera is not None:
            if mode == "cpr":
                raise UsageError("a curved reformation has no camera: view and up say which way one looks at it")
            _check_alone(view=view, up=up, zoom=zoom, view_angle=view_angle)
        view, zoom = DEFAULT_VIEW if view is None else view, 1.0 if zoom is None else zoom
        if mode == "cpr":
            return self._reformat(view, size, up, background, preset, options)
        assert size is not None
        if mode == "slice":
            return self._cut(camera, view, size, zoom, up, background, preset, options)
        if camera is None:
            camera = Camera.fit(self.volume, view, zoom, up=up, view_angle=view_angle, size=size)
        ground = None if is_transparent(background) else background
        step = self._checked_step(ray_step)
        if mode == "surface":
            return self._surface(camera, size, step, ground, options)
        if mode == "slices":
            return self._overlay(camera, size, transfer_function, ground, options)
        chosen = find_preset(DEFAULT_PRESET if preset is None else preset)
        function = chosen.transfer_function if transfer_function is None else transfer_function
        picture = RayPicture(
            mode, camera, size, step, function, options.get("lighting") or function.lighting or Lighting(),
            _choose_window(None if mode == "drr" else preset, options), options.get("clip"), ground,
            _is_set(options, "jitter"), _label_style(options),
        )  # fmt: skip
        return take_picture(self._resident, picture)

    def _surface(
        self,
        camera: Camera,
        size: tuple[int, int],
        step: float,
        background: str | Sequence[float] | None,
        options: Mapping[str, Any],
    ) -> Rendering:
        from clrecon.operators.rays.surface import SURFACE_COLOR, cast_surface

        return cast_surface(
            self._resident, _given(options, "iso_value", DEFAULT_ISO_VALUE), camera, size, step,
            lighting=options.get("lighting"), clip=options.get("clip"), color=_given(options, "color", SURFACE_COLOR),
            background=background, shadows=_is_set(options, "shadows"), depth_cue=_given(options, "depth_cue", 0.0),
            style=_label_style(options),
        )  # fmt: skip

    def _overlay(
        self,
        camera: Camera,
        size: tuple[int, int],
        function: TransferFunction | None,
        background: str | Sequence[float] | None,
        options: Mapping[str, Any],
    ) -> Rendering:
        from clrecon.operators.rays.slices import DEFAULT_OPACITY, overlay_slices

        return overlay_slices(
            self._resident, camera, size, slices=options.get("slices"),
            opacity=_given(options, "slice_opacity", DEFAULT_OPACITY), window=options.get("window"),
            transfer_function=function, clip=options.get("clip"), background=background,
        )  # fmt: skip

    def _cut(
        self,
        camera: Camera | None,
        view: str | Sequence[float],
        size: tuple[int, int],
        zoom: float,
        up: str | Sequence[float] | None,
        background: str | Sequence[float],
        preset: str | None,
        options: Mapping[str, Any],
    ) -> Rendering:
        from clrecon.operators.reformat.cut import cut_slice

        own: dict[str, Any] = {} if camera is not None else {"zoom": zoom, "up": up}
        return cut_slice(
            self._resident, view if camera is None else camera, size,
            offset_mm=_given(options, "offset_mm", 0.0), **own, **self._slab_options(background, preset, options),
        )  # fmt: skip

    def _reformat(
        self,
        view: str | Sequence[float],
        size: Sequence[int] | None,
        up: str | Sequence[float] | None,
        background: str | Sequence[float],
        preset: str | None,
        options: Mapping[str, Any],
    ) -> Rendering:
        from clrecon.operators.reformat.cut import reformat_curve

        curve: ArrayLike | str = _given(options, "curve", "spine")
        return reformat_curve(
            self._resident, curve, _given(options, "cpr", "straightened"), size,
            view=view, up=up, **self._slab_options(background, preset, options),
        )  # fmt: skip

    def _slab_options(
        self, background: str | Sequence[float], preset: str | None, options: Mapping[str, Any]
    ) -> dict[str, Any]:
        return {
            "thickness": _given(options, "thickness", 0.0),
            "combine": _given(options, "combine", "mean"),
            "window": _choose_window(preset, options),
            "background": background,
        }

    def _checked_step(self, ray_step: float | None) -> float:
        smallest = min(self.volume.spacing)
        diagonal = float(np.linalg.norm(np.ptp(box_corners(self.volume), axis=0)))
        finest = max(SMALLEST_STEP * smallest, diagonal / MOST_STEPS)
        if ray_step is None:
            return max(0.5 * smallest, finest)
        try:
            step = float(ray_step)
        except (TypeError, ValueError, OverflowError):
            step = math.nan
        if finest <= step < math.inf:
            return min(step, 2.0 * diagonal)  # one sample, in the middle of what a ray crosses
        raise UsageError(
            f"the ray step is a length in mm, at least {finest:.3g} in this volume (a hundredth of its smallest"
            f" spacing, and {MOST_STEPS:,} through its diagonal), not {ray_step!r}"
        )


def _choose_mode(mode: str | None, preset: str | None, function: TransferFunction | None) -> str:
    """The mode that is asked for, or the preset's own."""
    if function is not None and preset is not None:
        raise UsageError(f"a picture has a preset ({preset}) or a transfer function, not both")
    chosen = find_preset(DEFAULT_PRESET if preset is None else preset)
    if mode is None:
        return chosen.mode if function is None else "dvr"
    if mode not in MODES:
        raise UsageError(f"there is no mode {mode!r}: it is one of {', '.join(MODES)}")
    return mode


def _check_options(mode: str, given: Mapping[str, Any]) -> None:
    """Refuse options that do not exist, or mean nothing in a mode."""
    for name, value in given.items():
        if name not in KNOWN_IN:
            raise UsageError(f"a picture has no option {name!r}: it is one of {', '.join(KNOWN_IN)}")
        if value is not None and value is not False and mode not in KNOWN_IN[name]:
            raise UsageError(f"{name} means nothing in mode {mode}: it belongs to {', '.join(KNOWN_IN[name])}")


def _check_alone(**placing: Any) -> None:
    """Refuse what places a camera beside a camera that is given."""
    given = [name for name, value in placing.items() if value is not None]
    if given:
        them = " and ".join(filter(None, (", ".join(given[:-1]), given[-1])))
        raise UsageError(f"a camera says by itself where a picture is taken from: leave out {them}, or the camera")


def _given(options: Mapping[str, Any], name: str, default: Any) -> Any:
    value = options.get(name)
    return default if value is None else value


def _is_set(options: Mapping[str, Any], name: str) -> bool:
    value = _given(options, name, False)
    if not isinstance(value, (bool, np.bool_)):
        raise UsageError(f"{name} is True or False, not {value!r:.60}")
    return bool(value)


def _choose_window(preset: str | None, options: Mapping[str, Any]) -> tuple[float, float] | None:
    window = options.get("window")
    if window is not None:
        return checked_window(window)
    return None if preset is None else find_preset(preset).window


def _label_style(options: Mapping[str, Any]) -> LabelStyle | None:
    if options.get("labels") is None:
        for name in ("label_colors", "label_opacity"):
            if options.get(name) is not None:
                raise UsageError(f"{name} says how labels look: give the labels too")
        return None
    return LabelStyle.of(options["labels"], options.get("label_colors"), options.get("label_opacity"))


def render(
    volume: Volume | DeviceVolume,
    mode: str | None = None,
    preset: str | None = None,
    transfer_function: TransferFunction | None = None,
    camera: Camera | None = None,
    view: str | Sequence[float] | None = None,
    size: Sequence[int] | None = None,
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
    mode : {"dvr", "mip", "minip", "mean", "drr", "surface", "slices", "slice", "cpr"}, optional
        Volume rendering, highest, lowest or mean value along each ray, radiograph (the water that attenuates as much),
        shaded surface at an iso value, slices in space, a plane through the volume, curved planar reformation.  Default
        is the preset's, or "dvr".
    preset : str, optional
        See `clrecon.rendering.looks.presets`; default "bone".
    transfer_function : TransferFunction, optional
        In place of a preset.
    camera : Camera, optional
        In place of `view`, `up`, `zoom` and `view_angle`, which are refused beside it.
    view : str or (azimuth, elevation), optional
        Default "anterior".  See `Camera.fit`, which also takes `up`, `zoom` and `view_angle`.
    size : (width, height), optional
        Pixels; default 1024 x 1024, and what the curve needs in "cpr".
    ray_step : float, optional
        mm between samples; default half the smallest spacing.
    device : Device, str or int, optional
        See `clrecon.device`.
    memory : int, optional
        Bytes that may be taken on the device; default all that it has.
    **options
        ``background``, a colour or "transparent"; and by mode (others refuse them):

        dvr, surface: ``lighting``; ``labels``, a `LabelMap`, with ``label_colors`` and ``label_opacity``, mappings of
        label to colour and to a factor on the opacity.  dvr: ``jitter``, samples at random places of their segments.

        surface: ``iso_value`` in HU (default 200), ``color``, ``shadows`` (they need a fixed light), ``depth_cue``.

        mip, minip, mean, slices, slice, cpr: ``window``, HU that are black and white; default the 1st to the 99th
        percentile in projections, -450 to 1050 HU else.  drr: ``window`` in mm of water; default the 1st to the 99th
        percentile of the rays that meet the body.

        slices: ``slices``, how many or which, ``slice_opacity``.  slice, cpr: ``thickness`` in mm with ``combine``
        ("mean", "max", "min").  slice: ``offset_mm`` along the view.  cpr: ``curve``, points (n, 3) in LPS mm (default:
        the spinal canal, found), ``cpr`` ("straightened", "stretched").

        All but slice and cpr: ``clip``, a `Clip`.

    Returns
    -------
    Rendering

    Raises
    ------
    UsageError
        A value that cannot be; the message lists what can.
    RefusedInputError
        The spinal canal is to be found, and there is none that one could be sure of.
    DeviceError
        No device, not enough memory, or the device fails.
    """
    with VolumeRenderer(volume, device, memory=memory) as renderer:
        return renderer.render(mode, preset, transfer_function, camera, view, size, ray_step, **options)
