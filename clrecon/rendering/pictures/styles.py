"""Styles: what a picture shows.  Each kind of picture has a class, whose fields are all that this kind takes.

>>> clrecon.render(volume, SurfaceLook(300, color="orange"), view="left")

Where a picture is taken from, how large it is and what is behind it is no part of a style.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import cached_property, partial
from typing import Any, ClassVar, TypeVar, cast

from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import checked_iso_value
from clrecon.labels import LabelMap
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.looks.label_style import LabelStyle
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.presets import DEFAULT_PRESET, find_preset
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.pictures import style_checks as checks
from clrecon.rendering.pictures.style_checks import SPINE
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.plane import checked_offset, checked_thickness, positive_mm
from clrecon.system.wording import name_parameter

__all__ = [
    "COMBINATIONS",
    "CURVED_KINDS",
    "PROJECTIONS",
    "SPINE",
    "CurveCut",
    "PlaneCut",
    "Projection",
    "SlicesInSpace",
    "Style",
    "SurfaceLook",
    "VolumeLook",
]

_T = TypeVar("_T")
_ByLabel = Mapping[int, _T] | Mapping[str, _T] | Mapping[int | str, _T]
_Color = str | Sequence[float]

PROJECTIONS = ("mip", "minip", "mean", "drr")
COMBINATIONS = ("mean", "max", "min")
CURVED_KINDS = ("straightened", "stretched")

DEFAULT_ISO_VALUE = 200.0
"""HU of surfaces: bone, thin cortex of vertebrae with it."""

DEFAULT_COLOR = "bone"
"""Of surfaces without labels."""

DEFAULT_OPACITY = 0.5
"""Of a slice in space: the front ones are bright, and the third still shows an eighth of its light."""

LOWEST_SHOWN_HU = -300.0
"""Below is air, lung and most of what lies around a patient: transparent, so that the slices behind are seen."""


def _field(default: Any, check: Callable[[Any], Any], keyword: str | None = None) -> Any:
    """A field whose values go through `check`; `keyword` is what `render` calls it, where that is another name."""
    return field(default=default, metadata={"check": check} | ({"keyword": keyword} if keyword else {}))


@dataclass(frozen=True, kw_only=True)
class Style:
    """What all styles have in common: every field is checked when the style is made.

    Raises
    ------
    UsageError
        A value is impossible, or two exclude each other; the message says what is possible.
    """

    _mode: ClassVar[str]

    def __post_init__(self) -> None:
        for own in fields(self):
            value = getattr(self, own.name)
            if value is not None or own.default is not None:
                object.__setattr__(self, own.name, own.metadata["check"](value))

    @property
    def mode(self) -> str:
        """The name of this kind of picture, one of `clrecon.rendering.pictures.modes.MODES`."""
        return self._mode

    def parameters(self) -> dict[str, Any]:
        """The fields by name, for a function that takes them."""
        return {own.name: getattr(self, own.name) for own in fields(self)}


@dataclass(frozen=True, kw_only=True)
class _Labelled(Style):
    """Styles in which labels can look different."""

    lighting: Lighting | None = _field(None, checks.instance_of("lighting", Lighting))
    ray_step: float | None = _field(None, checks.ray_step)
    clip: Clip | None = _field(None, checks.instance_of("clip", Clip))
    labels: LabelMap | None = _field(None, checks.instance_of("labels", LabelMap))
    label_colors: _ByLabel[_Color] | None = _field(None, checks.mapping("colours"))
    label_opacity: _ByLabel[float] | None = _field(None, checks.mapping("opacities"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.labels is None:
            for name in ("label_colors", "label_opacity"):
                if getattr(self, name) is not None:
                    raise UsageError(f"{name} says how labels look: give the labels too")
        _ = self.label_style

    @property
    def light(self) -> Lighting:
        """The lighting that is used."""
        return self.lighting or Lighting()

    @cached_property
    def label_style(self) -> LabelStyle | None:
        """Colour and opacity of each label, None where there are no labels."""
        if self.labels is None:
            return None
        colors = cast("Mapping[int | str, _Color] | None", self.label_colors)
        return LabelStyle.of(self.labels, colors, cast("Mapping[int | str, float] | None", self.label_opacity))


@dataclass(frozen=True)
class VolumeLook(_Labelled):
    """Volume rendering: every HU with the colour and opacity of a transfer function, composited along the ray.

    Parameters
    ----------
    transfer_function : TransferFunction or str
        Colours and opacities by HU, or the name of a preset, see `clrecon.rendering.looks.presets`.
    lighting : Lighting, optional
        Default: that of the transfer function, and where it has none ``Lighting()``.
    ray_step : float, optional
        mm between samples; default: half the smallest spacing of the volume.
    jitter : bool
        Samples at random places of their steps: grain in place of rings.
    clip : Clip, optional
        The part of space that is shown.
    labels : LabelMap, optional
        Labels that look different.
    label_colors : mapping of label to colour, optional
        Labels by number or name, see `clrecon.rendering.looks.label_style.LabelStyle.of`; default: a colour for each.
    label_opacity : mapping of label to float, optional
        Factors on the opacity, 0 to 1.
    """

    _mode: ClassVar[str] = "dvr"

    transfer_function: TransferFunction | str = _field(DEFAULT_PRESET, checks.preset_or_function)
    _: KW_ONLY
    jitter: bool = _field(False, partial(checks.flag, "jitter"))

    @property
    def function(self) -> TransferFunction:
        """The transfer function, that of the preset where one is named."""
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
        The highest, lowest or mean HU; or a radiograph: the water in mm that attenuates as much.
    window : (float, float), optional
        HU, in "drr" mm of water, that are black and white; default: the 1st to the 99th percentile of the picture, in
        "drr" of the rays that meet the body.
    ray_step : float, optional
        mm between samples; default: half the smallest spacing of the volume.
    clip : Clip, optional
        The part of space that is shown.
    """

    kind: str = _field("mip", checks.one_of(PROJECTIONS, f"a projection is one of {', '.join(PROJECTIONS)}"), "mode")
    _: KW_ONLY
    window: Sequence[float] | None = _field(None, checked_window)
    ray_step: float | None = _field(None, checks.ray_step)
    clip: Clip | None = _field(None, checks.instance_of("clip", Clip))

    @property
    def mode(self) -> str:
        return self.kind


@dataclass(frozen=True)
class SurfaceLook(_Labelled):
    """The surface of the closed mesh at an iso value, shaded, without a mesh.

    Parameters
    ----------
    iso_value : float
        HU; inside is ``>= iso_value``.
    color : str or (float, float, float), optional
        See `clrecon.rendering.looks.colors.find_color`; default: "bone".
    shadows : bool
        What something else hides from the light has ambient light alone.  Needs a light that stands still.
    depth_cue : float, optional
        Share of the brightness, 0 to 1, that is lost from the nearest corner of the volume to the farthest.
    lighting : Lighting, optional
        Default: ``Lighting()``.
    ray_step : float, optional
        mm between samples; default: half the smallest spacing of the volume.
    clip : Clip, optional
        The part of space that is shown; what is cut is capped.
    labels, label_colors, label_opacity
        As of `VolumeLook`.
    """

    _mode: ClassVar[str] = "surface"

    iso_value: float = _field(DEFAULT_ISO_VALUE, checked_iso_value)
    _: KW_ONLY
    color: _Color | None = _field(None, checks.color)
    shadows: bool = _field(False, partial(checks.flag, "shadows"))
    depth_cue: float | None = _field(
        None,
        checks.number("the depth cue is a share of the brightness from 0 to 1, not", lambda share: 0.0 <= share <= 1.0),
    )

    @property
    def rgb(self) -> Float64Array:
        """The colour, red, green and blue from 0 to 1."""
        return find_color(DEFAULT_COLOR if self.color is None else self.color)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shadows and (self.lighting is None or self.lighting.direction is None):
            direction = name_parameter("direction", (0.5, -1, 1))
            raise UsageError(
                "shadows need a light that stands still: with a light at the camera none is seen; give lighting a"
                f" direction, such as {direction}"
            )


@dataclass(frozen=True)
class SlicesInSpace(Style):
    """Slices of the scan, translucent, each where it lies.

    Parameters
    ----------
    slices : int or sequence of int, optional
        An int n: every n-th slice from the first.  A list: those slices.  Default: about twelve, evenly spaced.
    opacity : float
        Of each slice, above 0 to 1.
    window : (float, float), optional
        HU that are black and white; default: -300 to 400.
    transfer_function : TransferFunction, optional
        Its colours in place of grey; its opacity plays no part.
    lowest_hu : float
        What is below is transparent.
    clip : Clip, optional
        The part of space that is shown.
    """

    _mode: ClassVar[str] = "slices"

    slices: int | Sequence[int] | None = _field(None, checks.slices)
    _: KW_ONLY
    opacity: float = _field(
        DEFAULT_OPACITY,
        checks.number("the opacity of a slice lies above 0 and up to 1, not at", lambda share: 0.0 < share <= 1.0),
        "slice_opacity",
    )
    window: Sequence[float] | None = _field(None, checked_window)
    transfer_function: TransferFunction | None = _field(None, checks.instance_of("transfer function", TransferFunction))
    lowest_hu: float = _field(
        LOWEST_SHOWN_HU, checks.number("the lowest HU that slices show is a number, not", lambda hu: True)
    )
    clip: Clip | None = _field(None, checks.instance_of("clip", Clip))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transfer_function is not None and self.window is not None:
            raise UsageError("slices are coloured by a window or by a transfer function, not by both")


@dataclass(frozen=True, kw_only=True)
class _Cut(Style):
    """Sheets through the volume, with samples across them."""

    thickness: float = _field(0.0, checked_thickness)
    combine: str = _field(
        "mean", checks.one_of(COMBINATIONS, f"samples of a thick slice are combined by {', '.join(COMBINATIONS)}")
    )
    window: Sequence[float] | None = _field(None, checked_window)
    pixel_mm: float | None = _field(None, partial(positive_mm, "the size of a pixel"))


@dataclass(frozen=True)
class PlaneCut(_Cut):
    """A plane through the volume in any direction, as thick as wanted.

    Parameters
    ----------
    offset_mm : float
        Moves the plane along the view, away from the camera.
    thickness : float
        mm of the thick slice around the plane whose samples are combined; 0 is the plane alone.
    combine : {"mean", "max", "min"}
        Of these samples.
    window : (float, float), optional
        HU that are black and white; default: -450 to 1050, a window for bone.
    pixel_mm : float, optional
        Side of a pixel; default: the volume fits the picture.
    """

    _mode: ClassVar[str] = "slice"

    _: KW_ONLY
    offset_mm: float = _field(0.0, checked_offset)


@dataclass(frozen=True)
class CurveCut(_Cut):
    """Curved planar reformation: a picture along a centre line.

    Parameters
    ----------
    curve : Curve, array_like of shape (n, 3), or "spine"
        Points of the centre line in LPS mm; "spine": the spinal canal, found in the volume.
    kind : {"straightened", "stretched"}
        See `clrecon.rendering.views.curved`.
    angle : float
        Degrees by which the rows of a straightened picture are turned about the centre line.
    width_mm : float, optional
        Width of the picture where no size is given; default: 120 mm.
    thickness, combine, window
        As of `PlaneCut`; the thick slice lies across the picture.
    pixel_mm : float, optional
        Side of a pixel; default: the curve fills the height of the size, else the smallest distance of voxels.
    """

    _mode: ClassVar[str] = "cpr"

    curve: Curve | ArrayLike | str = _field(SPINE, checks.curve)
    _: KW_ONLY
    kind: str = _field(
        "straightened", checks.one_of(CURVED_KINDS, f"a curved reformation is {' or '.join(CURVED_KINDS)}"), "cpr"
    )
    angle: float = _field(0.0, checks.number("the angle of a straightened picture is in degrees, not", math.isfinite))
    width_mm: float | None = _field(None, partial(positive_mm, "the width of the picture"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.angle != 0.0 and self.kind == "stretched":
            raise UsageError(
                f"the angle turns straightened pictures, in degrees: not {self.angle!r} in a stretched one"
            )
