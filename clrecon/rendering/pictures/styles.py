"""Styles: what a picture shows.  Each kind of picture has its own class with its own fields.

>>> clrecon.render(volume, SurfaceLook(300, color="orange"), view="left")

Camera, size and background are not part of a style.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, field, fields
from functools import cached_property, partial
from typing import Any, ClassVar, TypeVar, cast, get_args

from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import checked_iso_value
from clrecon.labels import LabelMap
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.presets import DEFAULT_PRESET, find_preset
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.pictures import style_checks as checks
from clrecon.rendering.pictures.label_style import LabelStyle
from clrecon.rendering.pictures.style_checks import SPINE
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.reformation import checked_offset, checked_thickness, positive_mm
from clrecon.system.arguments import Combination, CurvedKind, PresetName, ProjectionKind, WindowName, name_parameter
from clrecon.system.light_dataclass import dataclass

_T = TypeVar("_T")
ByLabel = Mapping[int, _T] | Mapping[str, _T] | Mapping[int | str, _T]
Color = str | Sequence[float]

PROJECTIONS, COMBINATIONS, CURVED_KINDS = (get_args(words) for words in (ProjectionKind, Combination, CurvedKind))

DEFAULT_ISO_VALUE = 200.0
"""Iso value of surfaces in HU: bone, including the thin cortex of vertebrae."""

_DEFAULT_COLOR = "bone"

_DEFAULT_OPACITY = 0.5
"""Opacity of a slice in space: the front slices are bright, and the third still gives an eighth of its light."""

_LOWEST_SHOWN_HU = -300.0
"""HU below this are transparent: air, lung and most things around a patient, so that slices behind are visible."""


def style_field(default: Any, check: Callable[[Any], Any], keyword: str | None = None) -> Any:
    """Declare a field with a check; `keyword` is its name in `render` if that differs."""
    return field(default=default, metadata={"check": check} | ({"keyword": keyword} if keyword else {}))


class Lit:
    """Lighting and colour of a style where none are given."""

    lighting: Lighting | None
    color: Color | None

    @property
    def light(self) -> Lighting:
        """The lighting that is used."""
        return self.lighting or Lighting()

    @property
    def rgb(self) -> Float64Array:
        """The colour: red, green and blue, each from 0 to 1."""
        return find_color(_DEFAULT_COLOR if self.color is None else self.color)


@dataclass(frozen=True, kw_only=True)
class Style:
    """Base of all styles: every field is checked on construction.

    Raises
    ------
    UsageError
        A value is impossible, or two values exclude each other; the message says what is possible.
    """

    _mode: ClassVar[str]

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is not None or item.default is not None:
                object.__setattr__(self, item.name, item.metadata["check"](value))

    @property
    def mode(self) -> str:
        """The name of this kind of picture, one of ``clrecon.rendering.pictures.modes.MODES``."""
        return self._mode

    @property
    def is_sheet(self) -> bool:
        """True where pictures stand side by side, each with letters of its own."""
        return False


@dataclass(frozen=True, kw_only=True)
class _Labelled(Style):
    """Base of styles in which labels can look different."""

    labels: LabelMap | None = style_field(None, checks.instance_of("labels", LabelMap))
    label_colors: ByLabel[Color] | None = style_field(None, checks.mapping("colours"))
    label_opacity: ByLabel[float] | None = style_field(None, checks.mapping("opacities"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.labels is None:
            for name in ("label_colors", "label_opacity"):
                if getattr(self, name) is not None:
                    raise UsageError(f"{name} says how labels look: give the labels too")
        _ = self.label_style

    @cached_property
    def label_style(self) -> LabelStyle | None:
        """Colour and opacity of each label, None without labels."""
        if self.labels is None:
            return None
        colors = cast("Mapping[int | str, Color] | None", self.label_colors)
        return LabelStyle.of(self.labels, colors, cast("Mapping[int | str, float] | None", self.label_opacity))


@dataclass(frozen=True, kw_only=True)
class _Lit(_Labelled, Lit):
    lighting: Lighting | None = style_field(None, checks.instance_of("lighting", Lighting))
    ray_step: float | None = style_field(None, checks.ray_step)
    ambient_occlusion: float = style_field(
        0.0,
        checks.number("ambient occlusion is a share of the light from 0 to 1, not", lambda share: 0.0 <= share <= 1.0),
    )
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))


@dataclass(frozen=True)
class VolumeLook(_Lit):
    """Volume rendering: every HU with the colour and opacity of a transfer function, composited along the ray.

    Parameters
    ----------
    transfer_function : TransferFunction or str
        Colours and opacities by HU, or the name of a preset, see ``clrecon.rendering.looks.presets``.
    lighting : Lighting, optional
        Default: that of the transfer function, else ``Lighting()``.
    ray_step : float, optional
        mm between samples; default: half the smallest spacing of the volume.
    jitter : bool
        Place each sample at random within its step: fine noise instead of rings.
    ambient_occlusion : float
        Share of the light that is lost in hollows, where what is around lets none through: 0 to 1; 0: none is lost.
    smooth_light : float, optional
        Light comes from gradients of the volume smoothed by a Gaussian of this standard deviation in mm; colours and
        opacities are those of the volume itself.  0: no smoothing; default: about a voxel, more for a noisy scan.
    clip : Clip, optional
        The part of space that is shown.
    labels : LabelMap, optional
        Labels that get a look of their own.
    label_colors : mapping of label to colour, optional
        Labels by number or name, see ``clrecon.rendering.pictures.label_style.LabelStyle.of``; default: a colour for
        each.
    label_opacity : mapping of label to float, optional
        Factors on the opacity, 0 to 1; label 0 is all that has no label.
    """

    _mode: ClassVar[str] = "dvr"

    transfer_function: TransferFunction | PresetName = style_field(DEFAULT_PRESET, checks.preset_or_function)
    _: KW_ONLY
    jitter: bool = style_field(False, partial(checks.flag, "jitter"))
    smooth_light: float | None = style_field(None, checks.smooth_light)

    @property
    def function(self) -> TransferFunction:
        """The transfer function; for the name of a preset, that of the preset."""
        named = self.transfer_function
        return find_preset(named).transfer_function if isinstance(named, str) else named

    @property
    def light(self) -> Lighting:
        return self.lighting or self.function.lighting or Lighting()


@dataclass(frozen=True)
class Projection(Style):
    """One value along each ray, in grey.

    Parameters
    ----------
    kind : {"mip", "minip", "mean", "drr"}
        The highest, lowest or mean HU; "drr" is a radiograph: the thickness of water in mm with the same attenuation.
    window : (float, float) or str, optional
        Values shown as black and white, in HU or (drr) mm of water, or a name of
        ``clrecon.rendering.looks.window.WINDOWS`` such as "lung"; default: the 1st and the 99th percentile of the
        picture, in "drr" and "mip" of the rays that meet the body.
    ray_step : float, optional
        mm between samples; default: half the smallest spacing of the volume.
    keep_air : bool
        Of "minip": count what lies outside of the body, and what a mask took, too; else it is left out, see
        ``clrecon.anatomy.surroundings``.
    clip : Clip, optional
        The part of space that is shown.
    """

    kind: ProjectionKind = style_field(
        "mip", checks.one_of(PROJECTIONS, f"a projection is one of {', '.join(PROJECTIONS)}"), "mode"
    )
    _: KW_ONLY
    window: Sequence[float] | WindowName | None = style_field(None, checked_window)
    ray_step: float | None = style_field(None, checks.ray_step)
    keep_air: bool = style_field(False, partial(checks.flag, "keep_air"))
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))

    def __post_init__(self) -> None:
        named = self.window
        super().__post_init__()
        if self.keep_air and self.kind != "minip":
            raise UsageError(
                f"{name_parameter('keep_air')} does not apply to mode {self.kind}: only minip leaves air out"
            )
        if self.kind == "drr" and isinstance(named, str):
            raise UsageError(
                f"the window {named!r:.60} is in HU, and mode drr shows mm of water: give the mm that are black"
                " and white"
            )

    @property
    def mode(self) -> str:
        return self.kind

    @property
    def leaves_out(self) -> bool:
        """True where a picture leaves out what lies outside of the body."""
        return self.kind == "minip" and not self.keep_air


@dataclass(frozen=True)
class PresetSheet(Style):
    """A contact sheet of presets: the same view with each of them, under its name.

    Parameters
    ----------
    ray_step, clip
        As of `Projection`.
    """

    _mode: ClassVar[str] = "presets"

    _: KW_ONLY
    ray_step: float | None = style_field(None, checks.ray_step)
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))

    @property
    def is_sheet(self) -> bool:
        return True


@dataclass(frozen=True)
class SurfaceLook(_Lit):
    """The shaded surface at an iso value: that of the closed mesh, but no mesh is made.

    Parameters
    ----------
    iso_value : float
        HU; inside is ``>= iso_value``.
    color : str or (float, float, float), optional
        See ``clrecon.rendering.looks.colors.find_color``; default: "bone".
    shadows : bool
        Parts that other parts hide from the light get ambient light only.  The light must have a fixed direction.
    depth_cue : float, optional
        Loss of brightness from the nearest corner of the volume to the farthest, a share from 0 to 1.
    lighting : Lighting, optional
        Default: ``Lighting()``.
    ray_step : float, optional
        mm between samples; default: half the smallest spacing of the volume.
    ambient_occlusion : float
        As of `VolumeLook`.
    clip : Clip, optional
        The part of space that is shown; cuts are capped.
    labels, label_colors, label_opacity
        As of `VolumeLook`.
    """

    _mode: ClassVar[str] = "surface"

    iso_value: float = style_field(DEFAULT_ISO_VALUE, checked_iso_value)
    _: KW_ONLY
    color: Color | None = style_field(None, checks.color)
    shadows: bool = style_field(False, partial(checks.flag, "shadows"))
    depth_cue: float | None = style_field(
        None,
        checks.number("the depth cue is a share of the brightness from 0 to 1, not", lambda share: 0.0 <= share <= 1.0),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shadows and (self.lighting is None or self.lighting.direction is None):
            direction = name_parameter("direction", (0.5, -1, 1))
            raise UsageError(
                "shadows need a light that stands still: with a headlight none is seen; give lighting a"
                f" direction, such as {direction}"
            )


@dataclass(frozen=True)
class SlicesInSpace(Style):
    """Translucent slices of the scan, each at its place in space.

    Parameters
    ----------
    slices : int or sequence of int, optional
        An int n: every n-th slice from the first.  A list: those slices.  Default: about twelve, evenly spaced.
    opacity : float
        Opacity of each slice, above 0 and at most 1.
    window : (float, float) or str, optional
        HU shown as black and white; default: -300 to 400.
    transfer_function : TransferFunction, optional
        Colours to use in place of grey; its opacity is ignored.
    lowest_hu : float
        HU below this are transparent.
    clip : Clip, optional
        The part of space that is shown.
    """

    _mode: ClassVar[str] = "slices"

    slices: int | Sequence[int] | None = style_field(None, checks.slices)
    _: KW_ONLY
    opacity: float = style_field(
        _DEFAULT_OPACITY,
        checks.number("the opacity of a slice lies above 0 and up to 1, not at", lambda share: 0.0 < share <= 1.0),
        "slice_opacity",
    )
    window: Sequence[float] | WindowName | None = style_field(None, checked_window)
    transfer_function: TransferFunction | None = style_field(
        None, checks.instance_of("transfer function", TransferFunction)
    )
    lowest_hu: float = style_field(
        _LOWEST_SHOWN_HU, checks.number("the lowest HU that slices show is a number, not", lambda hu: True)
    )
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transfer_function is not None and self.window is not None:
            raise UsageError("slices are coloured by a window or by a transfer function, not by both")


@dataclass(frozen=True, kw_only=True)
class _Cut(_Labelled):
    """Base of cuts through the volume; a thick one combines samples across it, and labels are those of its middle."""

    thickness: float = style_field(0.0, checked_thickness)
    combine: Combination = style_field(
        "mean", checks.one_of(COMBINATIONS, f"samples of a thick slice are combined by {', '.join(COMBINATIONS)}")
    )
    window: Sequence[float] | WindowName | None = style_field(None, checked_window)
    pixel_mm: float | None = style_field(None, partial(positive_mm, "the size of a pixel"))


@dataclass(frozen=True)
class PlaneCut(_Cut):
    """A plane through the volume in any direction, or a thick slice around it.

    Parameters
    ----------
    offset_mm : float
        Distance by which the plane is moved along the view, away from the camera.
    thickness : float
        Thickness in mm of the thick slice around the plane; its samples are combined.  0: the plane alone.
    combine : {"mean", "max", "min"}
        Which value of the samples is shown.
    window : (float, float) or str, optional
        HU shown as black and white; default: -450 to 1050, a window for bone.
    pixel_mm : float, optional
        Side of a pixel; by default the volume fits the picture.
    sheet : int or str, optional
        A contact sheet: so many slices side by side, or as text their distance, such as "5 mm".
    slices : int or sequence of int, optional
        Of a contact sheet: every n-th plane of voxels, or a list of them.
    labels : LabelMap, optional
        Labels that are drawn over the slice, see ``clrecon.rendering.pictures.label_style``.
    label_colors : mapping of label to colour, optional
        Labels that are drawn, with their colours; default: all, each with one of its own.
    label_opacity : mapping of label to float, optional
        Share of its colour within a label, 0 to 1, default 0.3; 0 hides the label with its outline.
    """

    _mode: ClassVar[str] = "slice"

    _: KW_ONLY
    offset_mm: float = style_field(0.0, checked_offset)
    sheet: int | str | None = style_field(None, checks.sheet)
    slices: int | Sequence[int] | None = style_field(None, checks.slices)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slices is not None and self.sheet is None:
            object.__setattr__(self, "sheet", checks.SHEET_SLICES)
        if self.sheet is not None and (self.offset_mm or self.pixel_mm is not None):
            option = name_parameter("offset_mm" if self.offset_mm else "pixel_mm")
            raise UsageError(f"a contact sheet shows slices through all of the scan, at one scale: leave {option} out")

    @property
    def is_sheet(self) -> bool:
        return self.sheet is not None


@dataclass(frozen=True)
class CurveCut(_Cut):
    """Curved planar reformation: a picture along a centre line.

    Parameters
    ----------
    curve : Curve, array_like of shape (n, 3), or "spine"
        Points of the centre line in LPS mm; "spine": the spinal canal, found in the volume.
    kind : {"straightened", "stretched"}
        See ``clrecon.rendering.views.reformation``.
    angle : float
        Rotation of the rows of a straightened picture about the centre line, in degrees.
    width_mm : float, optional
        Width of the picture if no size is given; default: 120 mm.
    thickness, combine, window, labels, label_colors, label_opacity
        As of `PlaneCut`; the thick slice lies across the picture.
    pixel_mm : float, optional
        Side of a pixel; by default the curve fills the height of the size; without a size it is the smallest spacing,
        or a whole part of it so that the longer side has at least 768 pixels.
    """

    _mode: ClassVar[str] = "cpr"

    curve: Curve | ArrayLike | str = style_field(SPINE, checks.curve)
    _: KW_ONLY
    kind: CurvedKind = style_field(
        "straightened", checks.one_of(CURVED_KINDS, f"a curved reformation is {' or '.join(CURVED_KINDS)}"), "cpr"
    )
    angle: float = style_field(
        0.0, checks.number("the angle of a straightened picture is in degrees, not", math.isfinite)
    )
    width_mm: float | None = style_field(None, partial(positive_mm, "the width of the picture"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.angle != 0.0 and self.kind == "stretched":
            raise UsageError(
                f"the angle turns straightened pictures, in degrees: not {self.angle!r} in a stretched one"
            )
