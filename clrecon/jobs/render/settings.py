"""Settings of the render job, validated on construction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import frame_from_lps
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.blocks import CROPS, Box, crop_box
from clrecon.geometry.grid import Grid
from clrecon.jobs import options
from clrecon.labels import LabelMap
from clrecon.rendering.looks.colors import COLORS as COLORS
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.presets import ALL_PRESETS as ALL_PRESETS
from clrecon.rendering.looks.presets import DEFAULT_PRESET, PRESETS, find_preset
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.looks.window import WINDOWS as WINDOWS
from clrecon.rendering.movies import turntable_cameras
from clrecon.rendering.pictures.annotations import SMALLEST_SIDE
from clrecon.rendering.pictures.label_style import NO_LABEL, distinct_colors
from clrecon.rendering.pictures.modes import MODES, check_known, choose_mode, keywords_of, make_style
from clrecon.rendering.pictures.object_looks import MESH_COLORS as MESH_COLORS
from clrecon.rendering.pictures.object_looks import POINT_COLORS as POINT_COLORS
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.picture import checked_dpi
from clrecon.rendering.pictures.sheets import SHEET_SIZE
from clrecon.rendering.pictures.style_checks import SHEET_SLICES as SHEET_SLICES
from clrecon.rendering.pictures.styles import CURVED_KINDS as CURVED_KINDS
from clrecon.rendering.pictures.styles import SPINE, CurveCut, PlaneCut, SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views import directions
from clrecon.rendering.views.camera import DEFAULT_VIEW_ANGLE, Camera
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.reformation import PLANES, find_plane
from clrecon.system.arguments import Space, name_parameter
from clrecon.system.light_dataclass import MISSING, dataclass, fields, replace
from clrecon.system.options import numbers_reader, option
from clrecon.system.text import unknown_name

_DEFAULT_VIEWS = {"slice": "axial", "cpr": "left", "slices": directions.say_view(directions.SLICES_VIEWS[0])}
"""Default view of the modes whose default is not the view from the front; that of slices suits the scan."""
SPINES = (SPINE, "auto")
"""Values of a curve that stand for the spinal canal, which is found in the scan."""
VIEWS = tuple(directions.DIRECTIONS)
_LIGHTS = ("head", "none")

_CALLED = {"light": "lighting", "labels": "labels", "clip_planes": "clip"}
"""Settings that make a field of the style under another name: the name of the setting, and that of the field."""


def _parse_views(text: str) -> tuple[str, ...]:
    """Read ``left``, ``anterior,left,posterior`` or ``AZ,EL``: names or one pair of angles."""
    parts = tuple(part.strip().lower() for part in text.split(","))
    if all(part[:1].isalpha() for part in parts):
        return parts
    try:
        _azimuth, _elevation = (float(part) for part in parts)
    except ValueError:
        raise ValueError(
            f"{text!r} is neither names of views with commas between them ({', '.join(VIEWS)}; of slices axial,"
            " coronal, sagittal), nor one AZ,EL in degrees, such as 30,15: give"
            f" {name_parameter('views')} again for further ones"
        ) from None
    return (",".join(parts),)


_parse_vector = numbers_reader(3, "is not a side of the patient, nor a direction X,Y,Z in LPS")


def parse_direction(text: str) -> str | tuple[float, ...]:
    return _parse_vector(text) if "," in text else text.lower()


def _parse_label_opacity(text: str) -> tuple[str, float]:
    label, _, number = text.rpartition("=")
    try:
        opacity = float(number)
    except ValueError:
        opacity = math.nan
    if not label or math.isnan(opacity):
        raise ValueError(f"{text!r} is not LABEL=OPACITY, such as L2=0.2")
    return label, opacity


_camera_option = partial(option, group="camera")


@dataclass(frozen=True)
class Turntable:
    frames: int = option("--frames N", "frames of the turn (default: 100)", default=100)
    fps: float = option("--fps N", "frames per second (default: 25)", default=25.0)
    degrees: float = option("--degrees D", "angle of the turn, to the patient's left (default: 360)", default=360.0)


@dataclass(frozen=True)
class LabelLook:
    """A label map and the look of its labels, by number or name; of opacities "0" is for all that has no label."""

    path: str = options.label_map_option(default=MISSING)
    colors: Mapping[str, str] = options.label_color_option(", by name or number")
    opacities: Mapping[str, float] = option(
        "--label-opacity LABEL=SHARE",
        "multiply the opacity of a label by 0 to 1 (label 0: all without a label); over slices: share of its colour"
        " (default: 0.3); may be given again",
        default=(),
        parse=_parse_label_opacity,
        action="append",
    )

    def __post_init__(self) -> None:
        for name in ("colors", "opacities"):
            object.__setattr__(self, name, dict(getattr(self, name)))
        for label, color in self.colors.items():
            find_color(color)
            if label.strip() == str(NO_LABEL):
                raise UsageError("what has no label (0) keeps the colours of the picture: give it an opacity alone")
        for label, opacity in self.opacities.items():
            if not 0.0 <= opacity <= 1.0:
                raise UsageError(f"the opacity of a label lies between 0 and 1, that of {label} is {opacity:g}")


@dataclass(frozen=True)
class MeshFile:
    """A mesh that is shown with the input; by default it is "bone", and several have a colour each."""

    path: str
    color: str | Sequence[float] | None = None
    opacity: float = 1.0

    def __post_init__(self) -> None:
        _ = self.look

    @property
    def look(self) -> MeshLook:
        return MeshLook(self.color, opacity=self.opacity)


def color_apart(meshes: Sequence[MeshFile]) -> list[MeshFile]:
    """Return meshes of which each of several without a colour has one of its own."""
    if len(meshes) < 2:
        return list(meshes)
    colors = distinct_colors(len(meshes)).tolist()
    return [replace(mesh, color=mesh.color or color) for mesh, color in zip(meshes, colors, strict=True)]


@dataclass(frozen=True)
class RenderSettings(options.SharedSettings):
    """Settings of the render job, which makes pictures from a CT series; options say in their help what they do.

    style: What the pictures show.  The files below add to it, see `style_with`.
    preset: The preset that the style was made from.
    transfer_function: ``FILE`` or ``FILE:NAME``.
    curve: File with the centre line; "spine" (or "auto") and None mean the curve of the style.
    light: "head", "none", side of the patient or (x, y, z). Origin of the light: the camera, nowhere (no shading), or a
        direction in LPS as seen from the patient.  Default: that of the style and its transfer function.
    size: Default of a contact sheet: 1600 x 1200; for a curved reformation it depends on the curve.
    """

    style: Style = VolumeLook()
    preset: str | None = None
    transfer_function: str | None = None
    curve: str | None = None
    labels: LabelLook | None = None
    meshes: Sequence[MeshFile] = ()
    mesh_space: Space | None = options.mesh_space_option("meshes whose files do not name theirs", "meshes")
    light: str | Sequence[float] | None = None
    views: Sequence[str] = options.view_option(
        "V[,V...]|AZ,EL",
        f"place the camera: {', '.join(VIEWS)}; or degrees from anterior to the patient's left and to the head; for"
        " slices also axial, coronal, sagittal (default: anterior; in mode slice axial, in slices 30,30, in cpr left);"
        " several make a picture each: out_left.png; may be given again",
        group="camera",
        default=(),
        parse=_parse_views,
        action="append",
        first=True,
        words=(*directions.DIRECTIONS, *PLANES),
    )
    up: str | Sequence[float] | None = _camera_option(
        "--up SIDE|X,Y,Z", "direction at the top (default: superior, otherwise anterior)", parse=parse_direction
    )
    zoom: float = _camera_option("--zoom F", "magnify: 2 shows everything twice as large", default=1.0)
    center: Sequence[float] | None = _camera_option(
        "--center X,Y,Z",
        "LPS mm at the centre of the picture, also of a slice (default: the centre of what is shown)",
        parse=numbers_reader(3, "is not a place X,Y,Z in LPS mm, such as -12,40,310"),
    )
    size: tuple[int, int] | None = options.size_option(group="camera", first=True)
    view_angle: float | None = _camera_option(
        "--perspective DEGREES",
        f"perspective of this many degrees from bottom to top ({DEFAULT_VIEW_ANGLE:g} without a number; default:"
        " parallel)",
        nargs="?",
        const=DEFAULT_VIEW_ANGLE,
    )
    background: str = _camera_option(
        "--background C", "colour, such as white or #102030, or transparent", default="black", words=COLORS
    )
    letters: bool = _camera_option("--letters", "draw the sides of the patient: L, R, A, P, S, I")
    scale_bar: bool = _camera_option("--scale-bar", "draw a bar of a round length in mm")
    legend: bool = _camera_option("--legend", "draw the colours and names of the labels beside the picture")
    caption: str | None = _camera_option("--caption TEXT", "draw a line of text at the top left")
    dpi: float | None = _camera_option(
        "--dpi N",
        "pixels per inch of the printed figure: text of 8 points, and the resolution in the file (default: text of a"
        " share of the picture, and the size of a pixel in the patient)",
    )
    turntable: Turntable | None = None

    @classmethod
    def of(
        cls,
        mode: str | None = None,
        preset: str | None = None,
        *,
        clip_planes: Sequence[Sequence[float]] = (),
        **given: Any,
    ) -> RenderSettings:
        """Make settings from the keywords of `clrecon.rendering.pictures.modes.make_style`.

        clip_planes: Planes by point and normal, six numbers each; the side to which the normal points is kept.
        **given: Fields of `RenderSettings`, and of the mode's style.  The box of ``clip_box``, ``between`` and
            ``around`` crops a scan, and where the style can be clipped it ends exactly at the box; clouds and meshes
            are clipped alone.
        """
        picks = {name: given.pop(name) for name in [*given] if name in {each.name for each in fields(cls)}}
        curve = None if picks.get("curve") is None else SPINE  # files are read later: placeholders until then
        function = None if picks.get("transfer_function") is None else find_preset(DEFAULT_PRESET).transfer_function
        mode = choose_mode(mode, preset, curve=curve, **given)
        box = crop_box(*(picks.get(name) for name in CROPS))
        if mode in ("points", "mesh"):
            picks = {name: value for name, value in picks.items() if name not in CROPS}
        values = picks | {"clip_planes": tuple(clip_planes) or None}
        for called, keyword in _CALLED.items():
            if values.get(called) is not None:
                check_known(mode, keyword, called)
        light = picks.get("light")
        look = {
            "lighting": None if light is None else _turn_light(light, Lighting()),
            "clip": _find_clip(box if "clip" in keywords_of(mode) else None, clip_planes),
            "transfer_function": function,
            "curve": curve,
        }
        return cls(make_style(mode, preset, **given, **look), preset, **picks)

    @classmethod
    def keywords(cls) -> set[str]:
        """The keywords that `of` accepts; the looks of labels are part of `labels`."""
        look = set(chain(*map(keywords_of, MODES))) - {"label_colors", "label_opacity"}
        return {own.name for own in fields(cls)} | look | {"preset", "clip_planes"}

    def __post_init__(self) -> None:
        if self.background != "transparent":
            find_color(self.background)
        if self.light is not None:
            _turn_light(self.light, Lighting())
        if self.dpi is not None:
            object.__setattr__(self, "dpi", checked_dpi(self.dpi))
        if self.mesh_space is not None:
            frame_from_lps(self.mesh_space)
            if not self.meshes and self.mode != "mesh":
                space = name_parameter("mesh_space")
                raise UsageError(
                    f"{space} says how meshes lie in the patient: name one with {name_parameter('meshes')}"
                )
        for name in ("letters", "zoom", "view_angle", "center", "turntable", "meshes"):
            if getattr(self, name) != _DEFAULTS[name]:
                check_known(self.mode, name)
        if self.legend and self.labels is None:
            raise UsageError(
                f"{name_parameter('legend')} names labels: give the label map with {name_parameter('labels')}"
            )
        self._check_place()
        super().__post_init__()

    def _check_place(self) -> None:
        """Check views, sizes and angles by placing cameras before a volume of one voxel."""
        directions.checked_size(self.size_used)
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
        return self.style.mode

    @property
    def crop_margin(self) -> int:
        """Voxels that stay beyond the box: where rays end exactly at it, they sample up to the next voxel."""
        return 0 if getattr(self.style, "clip", None) is None else 1

    @property
    def preset_used(self) -> str | None:
        """Name of the preset; None if the mode or a transfer function needs none."""
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
        """Return the style with the light and the contents of the files; None stands for a file that was not given."""
        style = self.style
        if function is not None and isinstance(style, VolumeLook | SlicesInSpace):
            style = replace(style, transfer_function=function)
        if self.light is not None and isinstance(style, VolumeLook | SurfaceLook | PointLook | MeshLook):
            made_for = style.function.lighting if isinstance(style, VolumeLook) else None
            style = replace(style, lighting=_turn_light(self.light, made_for or Lighting()))
        if curve is not None and isinstance(style, CurveCut):
            style = replace(style, curve=curve)
        if (
            labels is not None
            and self.labels is not None
            and isinstance(style, VolumeLook | SurfaceLook | PlaneCut | CurveCut)
        ):
            colors = dict(self.labels.colors) or None  # without any, every label has its own colour
            style = replace(style, labels=labels, label_colors=colors, label_opacity=dict(self.labels.opacities))
        return style

    @property
    def views_used(self) -> tuple[str, ...]:
        return tuple(self.views) or (_DEFAULT_VIEWS.get(self.mode, directions.ANTERIOR),)

    @property
    def size_used(self) -> tuple[int, int]:
        """Width and height in pixels; for a curved reformation without `size` they depend on the curve."""
        if self.size is not None:
            return self.size
        return SHEET_SIZE if self.style.is_sheet else directions.DEFAULT_SIZE

    @property
    def files_read(self) -> tuple[str, ...]:
        function = self.transfer_function or ""
        curve = "" if self.curve in (None, *SPINES) else self.curve
        look = "" if self.labels is None else self.labels.path
        meshes = (mesh.path for mesh in self.meshes)
        return tuple(path for path in (function, function.rpartition(":")[0], curve, look, *meshes) if path)

    def mesh_looks(self) -> list[MeshLook]:
        """Return the styles of the meshes: with the light, and a colour for each of several that have none."""
        looks = [mesh.look for mesh in color_apart(self.meshes)]
        if self.light is not None:
            lighting = _turn_light(self.light, Lighting())
            looks = [replace(look, lighting=lighting) for look in looks]
        return looks

    def camera(self, volume: Grid, view: str, *, turning: bool = False) -> Camera:
        """Place the camera of one view; with `turning` the whole volume stays in it while the camera orbits."""
        if isinstance(self.style, PlaneCut):
            return find_plane(
                volume, directions.read_view(view), self.size_used, zoom=self.zoom, up=self.up, center=self.center
            )
        return Camera.fit(
            volume, directions.read_view(view), self.zoom,
            up=self.up, view_angle=self.view_angle, size=self.size_used, turning=turning, center=self.center,
        )  # fmt: skip


_DEFAULTS = {own.name: own.default for own in fields(RenderSettings)}


def _turn_light(light: str | Sequence[float], lighting: Lighting) -> Lighting:
    if light == "none":
        return UNSHADED
    direction: Any = light
    if isinstance(light, str):
        if light not in (*_LIGHTS, *directions.DIRECTIONS):
            known = (*_LIGHTS, *directions.DIRECTIONS)
            raise UsageError(f"{unknown_name('light', light, known)}, or a direction X,Y,Z in LPS")
        direction = directions.DIRECTIONS.get(light)
    return replace(lighting if lighting.shades else Lighting(), direction=direction)


def _find_clip(box: Box | None, planes: Sequence[Sequence[float]]) -> Clip | None:
    """Return the part of space that a box and planes leave, None for all of it."""
    clip = Clip()
    if box is not None:
        clip = Clip.box(*box)
    for plane in planes:
        if len(plane) != 6:
            raise UsageError(f"a clip plane is a point and a normal, six numbers, not {len(plane)}")
        clip = clip & Clip.plane(plane[:3], plane[3:])
    return clip if len(clip.planes) else None


def describe_modes() -> dict[str, str]:
    return {name: mode.description for name, mode in MODES.items()}


def describe_presets() -> dict[str, str]:
    return {preset.name: preset.description for preset in PRESETS.values()}
