"""`Studio`: a volume on its device, and one way to take each kind of picture of it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from clrecon.jobs.render.settings import SPINE, LabelLook, RenderSettings
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.geometry.affine import Float64Array
    from clrecon.labels import LabelMap
    from clrecon.opencl import Device
    from clrecon.rendering import Lighting, Rendering, TransferFunction
    from clrecon.rendering.views.camera import Camera

__all__ = ["Studio", "read_curve", "read_function", "read_look"]

SHARED_OPTIONS = (
    "ray_step", "clip", "jitter", "color", "shadows", "depth_cue", "slices", "slice_opacity", "offset_mm", "thickness",
    "combine", "cpr",
)  # fmt: skip
"""Options of `clrecon.operators.rays.render.render` that are settings of the same name."""


def read_function(named: str | None) -> TransferFunction | None:
    """Read the transfer function ``FILE`` or ``FILE:NAME``, None where there is none.

    Raises
    ------
    UsageError, RefusedInputError
        As `clrecon.rendering.looks.transfer_files.load_transfer_function`.
    """
    if named is None:
        return None
    from clrecon.rendering.looks.transfer_files import load_transfer_function

    path, colon, name = named.rpartition(":")
    if colon and not Path(named).exists() and Path(path).exists():
        return load_transfer_function(path, name)
    return load_transfer_function(named)


def read_curve(named: str | None) -> Float64Array | None:
    """Read the points (n, 3) in LPS mm of a centre line, None where there is none or the scan has to give it.

    Raises
    ------
    UsageError, RefusedInputError
        As `clrecon.rendering.views.centre_line_files.read_curve_points`.
    """
    if named is None or named == SPINE:
        return None
    from clrecon.rendering.views.centre_line_files import read_curve_points

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
            from clrecon.rendering.looks.presets import find_preset

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
        from clrecon.rendering.looks.lighting import UNSHADED

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
        if settings.mode_used != "cpr":
            return self.take(settings.camera(self._volume, view))
        if self._curve is None:
            self._progress("curve", 0, 0)
        return self._render(view=view, up=settings.up, size=settings.size)

    def take(self, camera: Camera) -> Rendering:
        """The picture of a camera."""
        return self._render(camera=camera, size=self._settings.size_used)

    def _render(self, **place: Any) -> Rendering:
        from clrecon.operators.rays.render import KNOWN_IN, VolumeRenderer

        settings = self._settings
        if self._renderer is None:
            self._renderer = self._stack.enter_context(
                VolumeRenderer(self._volume, self._device, memory=settings.memory)
            )
        mode = settings.mode_used
        known = {name: value for name, value in self._options().items() if mode in KNOWN_IN[name]}
        picture: Rendering = self._renderer.render(mode, background=settings.background, **place, **known)
        return picture.annotated(letters=settings.letters, scale_bar=settings.scale_bar, caption=settings.caption)

    def _options(self) -> dict[str, Any]:
        """Options that mean something in some modes only."""
        settings = self._settings
        options: dict[str, Any] = {name: getattr(settings, name) for name in SHARED_OPTIONS}
        window = None if settings.mode_used == "slices" and self.function is not None else self.window
        options.update(
            transfer_function=self.function,
            window=window,
            lighting=self.lighting,
            curve=self._curve,
            iso_value=settings.iso_value_used,
        )
        if self.labels is not None and settings.labels is not None:
            look = settings.labels
            plain = not (look.colors or look.opacities)  # then every label has a colour of its own
            options.update(labels=self.labels, label_colors=None if plain else dict(look.colors))
            options.update(label_opacity=dict(look.opacities))
        return options
