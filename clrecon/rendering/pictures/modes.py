"""Modes: the names of the kinds of pictures, and the one place that turns names and keywords into a style."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import NamedTuple

from clrecon.errors import UsageError
from clrecon.rendering.looks.presets import find_preset
from clrecon.rendering.pictures.styles import (
    CurveCut,
    PlaneCut,
    Projection,
    SlicesInSpace,
    Style,
    SurfaceLook,
    VolumeLook,
)
from clrecon.system.wording import name_parameter

__all__ = ["MODES", "Mode", "check_known", "choose_mode", "find_style", "keywords_of", "make_style"]


class Mode(NamedTuple):
    """A kind of picture: the class of its styles, and what it shows."""

    style: type[Style]
    description: str


MODES = {
    "dvr": Mode(VolumeLook, "volume rendering: every HU with the colour and opacity of a transfer function"),
    "mip": Mode(Projection, "the highest HU along each ray"),
    "minip": Mode(Projection, "the lowest HU along each ray"),
    "mean": Mode(Projection, "the mean HU along each ray"),
    "drr": Mode(Projection, "a radiograph: the water that attenuates as much as all along the ray, mm"),
    "surface": Mode(SurfaceLook, "the shaded surface at an iso value"),
    "slices": Mode(SlicesInSpace, "slices of the scan in space, translucent, each where it lies"),
    "slice": Mode(PlaneCut, "a plane through the volume in any direction, as thick as wanted"),
    "cpr": Mode(CurveCut, "curved planar reformation along a centre line"),
}

_RAYS = ("dvr", "mip", "minip", "mean", "drr", "surface", "slices")

_BESIDE = {
    "preset": tuple(mode for mode in MODES if mode != "surface"),
    "transfer_function": ("mip", "minip", "mean", "drr"),
    "lighting": ("mip", "minip", "mean", "drr", "slices"),
    "zoom": (*_RAYS, "slice"),
    "view_angle": _RAYS,
    "letters": (*_RAYS, "slice"),
    "depth": ("dvr", "mip", "minip", "surface", "slices", "slice"),
    "values": ("mip", "minip", "mean", "drr", "slice", "cpr"),
    "turntable": _RAYS,
}
"""What may be said beside the fields of a style, by mode: where the camera is, what a picture gives, and the look that
the pictures of a series share, of which some show nothing."""


def keywords_of(mode: str) -> dict[str, str]:
    """What `render` calls the fields of a mode's style: keyword to field.

    A field has the keyword of its name, but for `CurveCut.kind` (cpr), `SlicesInSpace.opacity` (slice_opacity) and
    `Projection.kind` (mode).
    """
    return {own.metadata.get("keyword", own.name): own.name for own in fields(MODES[mode].style)}


def check_known(mode: str, keyword: str, called: str | None = None) -> None:
    """Refuse a keyword that means nothing in a mode.

    Parameters
    ----------
    mode : str
    keyword : str
    called : str, optional
        The caller's own name for it, for the message.

    Raises
    ------
    UsageError
        The message says where the keyword belongs.
    """
    modes = [name for name in MODES if keyword in keywords_of(name) or name in _BESIDE.get(keyword, ())]
    if mode not in modes:
        named = name_parameter(called or keyword)
        raise UsageError(f"{named} means nothing in mode {mode}: it belongs to {', '.join(modes)}")


def choose_mode(mode: str | None = None, preset: str | None = None, **look: object) -> str:
    """The mode that names and keywords ask for: a name of `MODES`.

    Without `mode` an iso value asks for a surface, a curve for a curved reformation, a preset for its own mode, and all
    else for volume rendering.

    Raises
    ------
    UsageError
        There is no such mode or preset.
    """
    if mode is not None:
        if not isinstance(mode, str) or mode not in MODES:
            raise UsageError(f"unknown mode {mode!r:.60}: use one of {', '.join(MODES)}")
        return mode
    if look.get("iso_value") is not None:
        return "surface"
    if look.get("curve") is not None:
        return "cpr"
    return "dvr" if preset is None else find_preset(preset).mode


def make_style(mode: str | None = None, preset: str | None = None, **look: object) -> Style:
    """The style that names and keywords ask for.

    >>> make_style("surface", iso_value=300)
    SurfaceLook(iso_value=300.0, ...)

    Parameters
    ----------
    mode : str, optional
        A name of `MODES`; default: see `choose_mode`.
    preset : str, optional
        See `clrecon.rendering.looks.presets`: its transfer function in volume rendering and in slices in space, its
        window in the other modes that show HU.
    **look
        Fields of the mode's style, see `keywords_of`.  None and False stand for the default.

    Raises
    ------
    UsageError
        An unknown mode, preset or keyword, one that means nothing in the mode, or as the style.
    """
    given = {keyword: value for keyword, value in look.items() if value is not None and value is not False}
    mode = choose_mode(mode, preset, **given)
    known = dict.fromkeys(keyword for name in MODES for keyword in keywords_of(name))
    for keyword in given:
        if keyword not in known:
            raise UsageError(f"a picture has no option {keyword!r}: it is one of {', '.join(known)}")
        check_known(mode, keyword)
    style = MODES[mode].style
    if preset is not None:
        if "transfer_function" in given:
            raise UsageError(f"a picture has a preset ({preset}) or a transfer function, not both")
        check_known(mode, "preset")
        chosen = find_preset(preset)
        if style is VolumeLook:
            given["transfer_function"] = preset
        elif style is SlicesInSpace and "window" not in given:
            given["transfer_function"] = chosen.transfer_function
        elif mode != "drr":  # whose window is in mm of water
            given.setdefault("window", chosen.window)
    names = keywords_of(mode)
    own = {names[keyword]: value for keyword, value in {**given, "mode": mode}.items() if keyword in names}
    return style(**own)


def find_style(style: Style | str | None, look: Mapping[str, object]) -> Style:
    """A style as it is, or the one that a mode and keywords ask for.

    Raises
    ------
    UsageError
        Keywords beside a style, or as `make_style`.
    """
    if isinstance(style, Style):
        if look:
            raise UsageError(f"a style says by itself what a picture shows: leave out {_join(look)}, or the style")
        return style
    if style is not None and "mode" in look:
        raise UsageError(f"the mode is given twice, as {style!r:.60} and as {look['mode']!r:.60}")
    return make_style(**({} if style is None else {"mode": style}), **look)  # type: ignore[arg-type]


def _join(names: Iterable[str]) -> str:
    *first, last = names
    return " and ".join(filter(None, (", ".join(first), last)))
