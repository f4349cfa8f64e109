"""Settings of the render job, validated on construction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.jobs.shared.settings import InputSettings
from clrecon.labels import LabelMap
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.presets import DEFAULT_PRESET, PRESETS, find_preset
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.movies.movie import turntable_cameras
from clrecon.rendering.pictures.annotations import SMALLEST_SIDE
from clrecon.rendering.pictures.modes import MODES, check_known, choose_mode, keywords_of, make_style
from clrecon.rendering.pictures.styles import SPINE, CurveCut, PlaneCut, SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import DIRECTIONS, checked_size
from clrecon.rendering.views.plane import find_plane

__all__ = [
    "DEFAULT_SIZE",
    "LabelLook",
    "RenderSettings",
    "Turntable",
    "VIEWS",
    "describe_modes",
    "describe_presets",
]

DEFAULT_SIZE = (1024, 1024)
DEFAULT_VIEWS = {"slice": "axial", "cpr": "left"}
"""Of the modes that do not look at the patient from the front."""
SPINES = (SPINE, "auto")
"""As a curve: the spinal canal, found in the scan."""
VIEWS = tuple(DIRECTIONS)
LIGHTS = ("head", "none")

_CALLED = {"light": "lighting", "labels": "labels", "clip_box": "clip", "clip_planes": "clip"}
"""Settings that make a field of the style: what they are called, and the field."""


@dataclass(frozen=True)
class Turntable:
    """How a moving picture turns.

    Parameters
    ----------
    frames : int
    fps : float
        Frames a second.
    degrees : float
        From the first frame to the last, towards the patient's left.
    """

    frames: int = 100
    fps: float = 25.0
    degrees: float = 360.0


@dataclass(frozen=True)
class LabelLook:
    """Which labels look different.

    Parameters
    ----------
    path : path
        NIfTI, NRRD, MetaImage or DICOM SEG.
    colors : mapping of str to str
        Number or name of a label to a colour, see `clrecon.rendering.looks.colors.find_color`.
    opacities : mapping of str to float
        The same to a factor on its opacity.
    """

    path: str
    colors: Mapping[str, str] = field(default_factory=dict)
    opacities: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for color in self.colors.values():
            find_color(color)
        for label, opacity in self.opacities.items():
            if not 0.0 <= opacity <= 1.0:
                raise UsageError(f"the opacity of a label lies between 0 and 1, that of {label} is {opacity:g}")


@dataclass(frozen=True)
class RenderSettings(InputSettings):
    """How pictures are made from a CT series.

    Parameters
    ----------
    style : Style
        What the pictures show, all but what the files below say: see `style_with`.
    preset : str, optional
        The preset that the style was made from.
    transfer_function : str, optional
        ``FILE`` or ``FILE:NAME``, see `clrecon.rendering.looks.transfer_files.load_transfer_function`.
    curve : str, optional
        File with the centre line; "spine" (or "auto"), as None, leaves it to the style.
    labels : LabelLook, optional
    light : "head", "none", side of the patient or (x, y, z), optional
        Where the light comes from: the camera, nowhere (colours as they are), or a direction in LPS from the patient.
        Default: as the style and its transfer function have it.
    views : sequence of str
        One picture each, see `clrecon.rendering.views.camera.Camera.fit`; slices know axial, coronal and sagittal too.
    up, zoom, size, view_angle
        As in `Camera.fit`; without a size 1024 x 1024, and what the curve needs for a curved reformation.
    background : str
        Colour, or "transparent".
    letters, scale_bar : bool
    caption : str, optional
        Drawn into the pictures.
    turntable : Turntable, optional
    **shared
        See `clrecon.jobs.shared.settings.InputSettings`.

    Raises
    ------
    UsageError
        A value is impossible, means nothing in the mode, or two exclude each other.
    """

    style: Style = VolumeLook()
    preset: str | None = None
    transfer_function: str | None = None
    curve: str | None = None
    labels: LabelLook | None = None
    light: str | Sequence[float] | None = None
    views: Sequence[str] = ()
    up: str | Sequence[float] | None = None
    zoom: float = 1.0
    size: tuple[int, int] | None = None
    view_angle: float | None = None
    background: str = "black"
    letters: bool = False
    scale_bar: bool = False
    caption: str | None = None
    turntable: Turntable | None = None

    @classmethod
    def of(
        cls,
        mode: str | None = None,
        preset: str | None = None,
        *,
        clip_box: Sequence[float] | None = None,
        clip_planes: Sequence[Sequence[float]] = (),
        **given: Any,
    ) -> RenderSettings:
        """Settings by the words of `clrecon.rendering.pictures.modes.make_style`.

        Parameters
        ----------
        mode, preset : str, optional
        clip_box : (x0, x1, y0, y1, z0, z1), optional
            What is kept, LPS mm; infinite numbers leave a side open.
        clip_planes : sequence of (px, py, pz, nx, ny, nz)
            Point and normal each; the side of the normal is kept.
        **given
            Fields of these settings, and of the mode's style.

        Raises
        ------
        UsageError
            As `RenderSettings` and `make_style`.
        """
        own = {name: given.pop(name) for name in [*given] if name in {each.name for each in fields(cls)}}
        curve = None if own.get("curve") is None else SPINE  # files are read later: something stands in for them
        function = None if own.get("transfer_function") is None else find_preset(DEFAULT_PRESET).transfer_function
        mode = choose_mode(mode, preset, curve=curve, **given)
        said = own | {"clip_box": clip_box, "clip_planes": tuple(clip_planes) or None}
        for called, keyword in _CALLED.items():
            if said.get(called) is not None:
                check_known(mode, keyword, called)
        light = own.get("light")
        look = {
            "lighting": None if light is None else _turn_light(light, Lighting()),
            "clip": _find_clip(clip_box, clip_planes),
            "transfer_function": function,
            "curve": curve,
        }
        return cls(make_style(mode, preset, **given, **look), preset, **own)

    @classmethod
    def keywords(cls) -> set[str]:
        """The names that `of` takes; what labels look like is part of `labels`."""
        look = {keyword for mode in MODES for keyword in keywords_of(mode)} - {"label_colors", "label_opacity"}
        return {own.name for own in fields(cls)} | look | {"preset", "clip_box", "clip_planes"}

    def __post_init__(self) -> None:
        if self.background != "transparent":
            find_color(self.background)
        if self.light is not None:
            _turn_light(self.light, Lighting())
        for name in ("letters", "zoom", "view_angle", "turntable"):
            if getattr(self, name) != _DEFAULTS[name]:
                check_known(self.mode, name)
        self._check_place()
        super().__post_init__()

    def _check_place(self) -> None:
        """Views, sizes and angles: by placing cameras before a volume of one voxel."""
        checked_size(self.size_used)
        if (self.letters or self.scale_bar or self.caption) and min(self.size_used) < SMALLEST_SIDE:
            raise UsageError(
                f"a picture of {self.size_used[0]} x {self.size_used[1]} pixels is too small for letters, a scale"
                f" bar or a caption: at least {SMALLEST_SIDE} x {SMALLEST_SIDE}"
            )
        if len(set(self.views)) < len(self.views):
            raise UsageError("a view is given twice")
        if self.mode == "cpr" and len(self.views_used) > 1:
            raise UsageError("a curved reformation is seen from one side: give one view")
        voxel = Grid(np.zeros((1, 1, 1), np.int8), np.eye(4))
        for view in self.views_used:
            self.camera(voxel, view)
        if self.turntable is not None:
            if len(self.views_used) > 1:
                raise UsageError("a turntable starts from one view: give one")
            turntable_cameras(self.camera(voxel, self.views_used[0]), self.turntable.frames, self.turntable.degrees)

    @property
    def mode(self) -> str:
        """The mode of the style."""
        return self.style.mode

    @property
    def preset_used(self) -> str | None:
        """Name of the preset, None where the mode or a transfer function does without."""
        if self.preset is not None or self.transfer_function is not None or not isinstance(self.style, VolumeLook):
            return self.preset
        named = self.style.transfer_function
        return named if isinstance(named, str) else None

    def style_with(
        self,
        function: TransferFunction | None = None,
        curve: Float64Array | None = None,
        labels: LabelMap | None = None,
    ) -> Style:
        """The style with what the files say, None where there is none, and with the light.

        Raises
        ------
        UsageError
            As the style.
        """
        style = self.style
        if function is not None and isinstance(style, VolumeLook | SlicesInSpace):
            style = replace(style, transfer_function=function)
        if self.light is not None and isinstance(style, VolumeLook | SurfaceLook):
            made_for = style.function.lighting if isinstance(style, VolumeLook) else None
            style = replace(style, lighting=_turn_light(self.light, made_for or Lighting()))
        if curve is not None and isinstance(style, CurveCut):
            style = replace(style, curve=curve)
        if labels is not None and self.labels is not None and isinstance(style, VolumeLook | SurfaceLook):
            plain = not (self.labels.colors or self.labels.opacities)  # then every label has a colour of its own
            colors = None if plain else dict(self.labels.colors)
            style = replace(style, labels=labels, label_colors=colors, label_opacity=dict(self.labels.opacities))
        return style

    @property
    def views_used(self) -> tuple[str, ...]:
        """The views that pictures are taken from."""
        return tuple(self.views) or (DEFAULT_VIEWS.get(self.mode, "anterior"),)

    @property
    def size_used(self) -> tuple[int, int]:
        """Width and height in pixels; of a curved reformation without `size` they depend on the curve."""
        return DEFAULT_SIZE if self.size is None else self.size

    @property
    def files_read(self) -> tuple[str, ...]:
        """Files that say how, beside the scan."""
        function = self.transfer_function or ""
        curve = "" if self.curve in (None, *SPINES) else self.curve
        look = "" if self.labels is None else self.labels.path
        return tuple(path for path in (function, function.rpartition(":")[0], curve, look) if path)

    def camera(self, volume: Grid, view: str, turning: bool = False) -> Camera:
        """The camera of one of the views; with `turning` the volume stays whole when the camera orbits.

        Raises
        ------
        UsageError
            As `Camera.fit`.
        """
        if isinstance(self.style, PlaneCut):
            return find_plane(volume, view, self.size_used, zoom=self.zoom, up=self.up)  # type: ignore[arg-type]
        return Camera.fit(
            volume, view, self.zoom, up=self.up, view_angle=self.view_angle, size=self.size_used, turning=turning
        )


_DEFAULTS = {own.name: own.default for own in fields(RenderSettings)}


def _turn_light(light: str | Sequence[float], lighting: Lighting) -> Lighting:
    """A lighting that comes from where a light is said to be.

    Raises
    ------
    UsageError
        Neither one of `LIGHTS`, a side of the patient nor three numbers.
    """
    if light == "none":
        return UNSHADED
    direction: Any = light
    if isinstance(light, str):
        if light not in (*LIGHTS, *DIRECTIONS):
            known = ", ".join((*LIGHTS, *DIRECTIONS))
            raise UsageError(f"unknown light {light!r}: use one of {known}, or a direction X,Y,Z in LPS")
        direction = DIRECTIONS.get(light)
    return replace(lighting if lighting.shades else Lighting(), direction=direction)


def _find_clip(box: Sequence[float] | None, planes: Sequence[Sequence[float]]) -> Clip | None:
    """The part of space that a box and planes leave, None for all of it."""
    clip = Clip()
    if box is not None:
        if len(box) != 6:
            raise UsageError(f"a clip box has six numbers, x0,x1,y0,y1,z0,z1, not {len(box)}")
        clip = Clip.box(box[0::2], box[1::2])
    for plane in planes:
        if len(plane) != 6:
            raise UsageError(f"a clip plane is a point and a normal, six numbers, not {len(plane)}")
        clip = clip & Clip.plane(plane[:3], plane[3:])
    return clip if len(clip.planes) else None


def describe_modes() -> dict[str, str]:
    """Names of the modes of pictures, and what each shows."""
    return {name: mode.description for name, mode in MODES.items()}


def describe_presets() -> dict[str, str]:
    """Names of the presets of pictures, and what each shows."""
    return {preset.name: preset.description for preset in PRESETS.values()}
