"""Modes: the names of the kinds of pictures, and the styles that names and keywords stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from itertools import chain
from typing import Literal, NamedTuple, TypedDict

from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.labels import LabelMap
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.presets import ALL_PRESETS, find_preset
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.pictures.object_looks import MESH_COLORS, MeshLook, PointLook
from clrecon.rendering.pictures.styles import (
    ByLabel,
    Color,
    CurveCut,
    PlaneCut,
    PresetSheet,
    Projection,
    SlicesInSpace,
    Style,
    SurfaceLook,
    VolumeLook,
)
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import hint_at_sheet
from clrecon.system.arguments import Combination, CurvedKind, ModeName, PresetName, WindowName, name_parameter
from clrecon.system.text import list_names, unknown_name


class Mode(NamedTuple):
    """A kind of picture: the class of its styles, and a description for people."""

    style: type[Style]
    description: str


MODES = {
    "dvr": Mode(VolumeLook, "volume rendering: every HU with the colour and opacity of a transfer function"),
    "mip": Mode(Projection, "the highest HU along each ray"),
    "minip": Mode(Projection, "the lowest HU along each ray"),
    "mean": Mode(Projection, "the mean HU along each ray"),
    "drr": Mode(Projection, "a radiograph: water-equivalent thickness along the ray, mm"),
    "surface": Mode(SurfaceLook, "the shaded surface at an iso value"),
    "slices": Mode(SlicesInSpace, "slices of the scan in space, translucent, at their positions"),
    "slice": Mode(PlaneCut, "a plane through the volume in any direction, of any thickness"),
    "cpr": Mode(CurveCut, "curved planar reformation along a centre line"),
    "presets": Mode(PresetSheet, "a contact sheet: the same view with each preset"),
    "points": Mode(PointLook, "the points of a cloud, coloured by HU, label or reason of removal"),
    "mesh": Mode(MeshLook, "the triangles of a mesh, shaded"),
}


class Look(TypedDict, total=False):
    """The keywords of `render` in place of a style, of all modes; None means the default."""

    mode: ModeName | None
    preset: PresetName | None
    transfer_function: TransferFunction | PresetName | None
    lighting: Lighting | None
    ray_step: float | None
    clip: Clip | None
    labels: LabelMap | None
    label_colors: ByLabel[Color] | None
    label_opacity: ByLabel[float] | None
    jitter: bool
    smooth_light: float | None
    window: Sequence[float] | WindowName | None
    keep_air: bool
    iso_value: float
    color: Color | None
    shadows: bool
    ambient_occlusion: float
    depth_cue: float | None
    slices: int | Sequence[int] | None
    slice_opacity: float
    lowest_hu: float
    thickness: float
    combine: Combination
    pixel_mm: float | None
    offset_mm: float
    sheet: int | str | None
    curve: Curve | ArrayLike | str
    cpr: CurvedKind
    angle: float
    width_mm: float | None
    opacity: float
    flat: bool
    vertex_colors: ArrayLike | None
    color_by: Literal["thickness", "error", "distance", "hu", "label", "removed"] | None
    radius_mm: float | None


_RAYS = ("dvr", "mip", "minip", "mean", "drr", "surface", "slices")
_CAMERAS = (*_RAYS, "points", "mesh")

_BESIDE = {
    "preset": tuple(mode for mode in MODES if mode not in ("surface", "points", "mesh")),
    "transfer_function": ("mip", "minip", "mean", "drr"),
    "lighting": ("mip", "minip", "mean", "drr", "slices"),
    "zoom": (*_CAMERAS, "presets", "slice"),
    "view_angle": (*_CAMERAS, "presets"),
    "center": (*_CAMERAS, "presets", "slice"),
    "letters": (*_CAMERAS, "presets", "slice", "cpr"),
    "depth": ("dvr", "mip", "minip", "surface", "slices", "slice", "points", "mesh"),
    "values": ("mip", "minip", "mean", "drr", "slice", "cpr"),
    "turntable": _CAMERAS,
    "meshes": ("dvr", "surface", "slices", "points", "mesh"),
}
"""Keywords that are not fields of a style, and the modes that allow each; some accept a look without using it."""


_ALONE = {"keep_air": ("minip",)}
"""Fields of a style of several modes that mean something in some of them only."""


def keywords_of(mode: str) -> dict[str, str]:
    """Return the keywords of `render` for a mode, each with the field of the style that it sets."""
    return {own.metadata.get("keyword", own.name): own.name for own in fields(MODES[mode].style)}


def check_known(mode: str, keyword: str, called: str | None = None) -> None:
    """Refuse a keyword, which the message can call otherwise, that has no meaning in a mode."""
    modes = [name for name in MODES if keyword in keywords_of(name) or name in _BESIDE.get(keyword, ())]
    modes = [name for name in modes if name in _ALONE.get(keyword, modes)]
    if mode not in modes:
        named = name_parameter(called or keyword)
        raise UsageError(f"{named} does not apply to mode {mode}, only to {', '.join(modes)}")


def choose_mode(mode: str | None = None, preset: str | None = None, **look: object) -> str:
    """Choose the mode that names and keywords ask for: a name of `MODES`, by default volume rendering.

    Without `mode` an iso value means a surface, a curve means a curved reformation, a sheet means slices, what vertices
    are coloured by means a mesh, a radius of points or what they are coloured by means points, a preset means its own
    mode, and all presets mean a sheet of them.
    """
    if mode is not None:
        if not isinstance(mode, str) or mode not in MODES:
            raise UsageError(unknown_name("mode", mode, MODES) + hint_at_sheet(mode))
        return mode
    if look.get("iso_value") is not None:
        return "surface"
    if look.get("curve") is not None:
        return "cpr"
    if look.get("sheet") is not None:
        return "slice"
    if look.get("color_by") in MESH_COLORS:
        return "mesh"
    if look.get("color_by") is not None or look.get("radius_mm") is not None:
        return "points"
    if preset == ALL_PRESETS:
        return "presets"
    return "dvr" if preset is None else find_preset(preset).mode


def make_style(mode: str | None = None, preset: str | None = None, **look: object) -> Style:
    """Make the style that names and keywords ask for: ``make_style("surface", iso_value=300)``.

    preset: Volume rendering and slices in space use its transfer function, the other modes that show HU use its window.
    **look: Fields of the mode's style, see `keywords_of`.  None and False mean the default.
    """
    given = {keyword: value for keyword, value in look.items() if value is not None and value is not False}
    mode = choose_mode(mode, preset, **given)
    known = dict.fromkeys(chain(*map(keywords_of, MODES)))
    for keyword in given:
        if keyword not in known:
            raise UsageError(f"a picture has no option {keyword!r}: it is one of {', '.join(known)}")
        check_known(mode, keyword)
    style = MODES[mode].style
    if preset is not None:
        if "transfer_function" in given:
            raise UsageError(f"a picture has a preset ({preset}) or a transfer function, not both")
        check_known(mode, "preset")
        if (preset == ALL_PRESETS) != (mode == "presets"):
            raise UsageError(f"mode presets shows all presets side by side, not preset {preset} in mode {mode}")
    if preset is not None and preset != ALL_PRESETS:
        chosen = find_preset(preset)
        if style is VolumeLook:
            given["transfer_function"] = chosen.name
        elif style is SlicesInSpace and "window" not in given:
            given["transfer_function"] = chosen.transfer_function
        elif mode != "drr":  # its window is in mm of water
            given.setdefault("window", chosen.window)
    names = keywords_of(mode)
    arguments = {names[keyword]: value for keyword, value in {**given, "mode": mode}.items() if keyword in names}
    return style(**arguments)


def find_style(style: Style | str | None, look: Mapping[str, object]) -> Style:
    """Return a given style unchanged, or make the one that a mode and keywords ask for."""
    if isinstance(style, Style):
        if look:
            raise UsageError(f"a style says by itself what a picture shows: leave out {list_names(look)}, or the style")
        return style
    if style is not None and "mode" in look:
        raise UsageError(f"the mode is given twice, as {style!r:.60} and as {look['mode']!r:.60}")
    return make_style(**({} if style is None else {"mode": style}), **look)  # type: ignore[arg-type]
