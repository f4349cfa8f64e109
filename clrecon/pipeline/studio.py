"""`Studio`: a volume on its device, and one way to take each kind of picture of it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from clrecon.pipeline.progress import Progress
from clrecon.pipeline.render_settings import SPINE, LabelLook, RenderSettings

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.geometry.affine import Float64Array
    from clrecon.geometry.camera import Camera
    from clrecon.labels import LabelMap
    from clrecon.opencl import Device
    from clrecon.rendering import Lighting, Rendering, TransferFunction

__all__ = ["Studio", "read_curve", "read_function", "read_look"]


def read_function(named: str | None) -> TransferFunction | None:
    """Read the transfer function ``FILE`` or ``FILE:NAME``, None where there is none.

    Raises
    ------
    UsageError, RefusedInputError
        As `clrecon.rendering.transfer_files.load_transfer_function`.
    """
    if named is None:
        return None
    from clrecon.rendering.transfer_files import load_transfer_function

    path, colon, name = named.rpartition(":")
    if colon and not Path(named).exists() and Path(path).exists():
        return load_transfer_function(path, name)
    return load_transfer_function(named)


def read_curve(named: str | None) -> Float64Array | None:
    """Read the points (n, 3) in LPS mm of a centre line, None where there is none or the scan has to give it.

    Raises
    ------
    UsageError, RefusedInputError
        As `clrecon.formats.curve_points.read_curve_points`.
    """
    if named is None or named == SPINE:
        return None
    from clrecon.formats.curve_points import read_curve_points

    return read_curve_points(named)


def read_look(look: LabelLook | None) -> LabelMap | None:
    """Read the label map, None where there is none.

    Raises
    ------
    UsageError, RefusedInputError
        As `clrecon.labels.read_labels`; a label that it does not have is refused too.
    """
    if look is None:
        return None
    from clrecon.labels import read_labels

    labels = read_labels(look.path)
    for label in (*look.colors, *look.opacities):
        labels.find(label)
    return labels


class Studio:
    """Takes the pictures that settings ask for; a context manager that frees the device.

    Parameters
    ----------
    volume : Volume
    device : Device
    settings : RenderSettings
    function : TransferFunction, optional
        From a file; None leaves it to the preset.
    curve : ndarray, shape (n, 3), optional
        LPS mm; of curved reformations, None is the spinal canal.
    labels : LabelMap, optional
    progress : callable
    """

    def __init__(
        self,
        volume: Volume,
        device: Device,
        settings: RenderSettings,
        *,
        function: TransferFunction | None = None,
        curve: Float64Array | None = None,
        labels: LabelMap | None = None,
        progress: Progress,
    ):
        self._volume, self._device, self._settings = volume, device, settings
        self._curve, self.labels, self._progress = curve, labels, progress
        self.warnings: list[str] = []
        self._stack = ExitStack()
        self._renderer: Any = None
        preset = None
        if settings.preset_used is not None:
            from clrecon.rendering.presets import find_preset

            preset = find_preset(settings.preset_used)
        self.function = preset.transfer_function if function is None and preset is not None else function
        self.window: Sequence[float] | None = settings.window
        if self.window is None and preset is not None:
            self.window = preset.window

    def __enter__(self) -> Studio:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def lighting(self) -> Lighting | None:
        """The light that shaded pictures have, None in modes without."""
        from clrecon.rendering import Lighting
        from clrecon.rendering.lighting import UNSHADED

        settings = self._settings
        if settings.mode_used not in ("dvr", "surface"):
            return None
        made_for = None if settings.mode_used == "surface" or self.function is None else self.function.lighting
        light = made_for or Lighting()
        if settings.light is None:
            return light
        if settings.light == "none":
            return UNSHADED
        return replace(light if light.shades else Lighting(), direction=settings.light_direction())

    def take_view(self, view: str) -> Rendering:
        """The picture of one of the views, with what is drawn into it."""
        settings = self._settings
        if settings.mode_used == "cpr":
            return self._finish(self._reformat(view))
        return self.take(settings.camera(self._volume, view))

    def take(self, camera: Camera) -> Rendering:
        """The picture of a camera."""
        return self._finish(self._cut(camera) if self._settings.mode_used == "slice" else self._cast(camera))

    def _finish(self, picture: Rendering) -> Rendering:
        settings = self._settings
        return picture.annotated(letters=settings.letters, scale_bar=settings.scale_bar, caption=settings.caption)

    def _cast(self, camera: Camera) -> Rendering:
        from clrecon.operators.renderer import VolumeRenderer

        settings = self._settings
        if self._renderer is None:
            self._renderer = self._stack.enter_context(
                VolumeRenderer(self._volume, self._device, memory=settings.memory)
            )
        options: dict[str, Any] = {
            "camera": camera,
            "size": settings.size_used,
            "ray_step": settings.ray_step,
            "lighting": self.lighting,
            "window": self.window,
            "clip": settings.clip,
            "background": settings.background,
            "jitter": settings.jitter,
        }
        picture: Rendering = self._renderer.render(settings.mode_used, **options, **self._more())
        return picture

    def _more(self) -> dict[str, Any]:
        """Options that only some pictures have."""
        settings = self._settings
        more: dict[str, Any] = {}
        if settings.mode_used == "dvr":
            more["transfer_function"] = self.function
        elif settings.mode_used == "surface":
            more.update(iso_value=settings.iso_value, shadows=settings.shadows)
            if settings.color is not None:
                more["color"] = settings.color
        elif settings.mode_used == "slices":
            more["slices"] = settings.slices
            if settings.slice_opacity is not None:
                more["slice_opacity"] = settings.slice_opacity
            if settings.window is None:
                more["transfer_function"] = self.function
        if self.labels is not None and settings.labels is not None:
            look = settings.labels
            plain = not (look.colors or look.opacities)  # then every label has a colour of its own
            more.update(labels=self.labels, label_colors=None if plain else dict(look.colors))
            more.update(label_opacity=dict(look.opacities))
        return more

    def _cut(self, camera: Camera) -> Rendering:
        from clrecon.operators.reformat import cut_slice

        settings = self._settings
        return cut_slice(
            self._volume, camera, settings.size_used, self._device, offset_mm=settings.offset_mm, **self._slab()
        )

    def _reformat(self, view: str) -> Rendering:
        from clrecon.operators.reformat import reformat_curve

        settings = self._settings
        kind = settings.cpr or "straightened"
        curve = "spine" if self._curve is None else self._curve
        if self._curve is None:
            self._progress("curve", 0, 0)
        return reformat_curve(
            self._volume, curve, kind, settings.size, self._device, view=view, up=settings.up, **self._slab()
        )

    def _slab(self) -> dict[str, Any]:
        settings = self._settings
        return {
            "thickness": settings.thickness,
            "combine": settings.combine or "mean",
            "window": self.window,
            "background": settings.background,
            "memory": settings.memory,
            "progress": self._progress,
        }
