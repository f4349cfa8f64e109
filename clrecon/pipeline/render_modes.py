"""Modes of pictures, and which settings mean something in which."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["MODES", "VIEWS", "find_misplaced"]

MODES = {
    "dvr": "volume rendering: every HU with the colour and opacity of a transfer function",
    "mip": "the highest HU along each ray",
    "minip": "the lowest HU along each ray",
    "mean": "the mean HU along each ray, as a radiograph",
    "surface": "the shaded surface at an iso value",
    "slices": "slices of the scan in space, translucent, each where it lies",
    "slice": "a plane through the volume in any direction, as thick as wanted",
    "cpr": "curved planar reformation along a centre line",
}
"""Names, and what the pictures show."""

VIEWS = ("anterior", "posterior", "left", "right", "superior", "inferior")

_SAMPLED = ("dvr", "mip", "minip", "mean", "surface")
_RAYS = (*_SAMPLED, "slices")
_VALUES = ("mip", "minip", "mean", "slice", "cpr")
_CUT = ("slice", "cpr")


class _Place(NamedTuple):
    """A setting, the option of the command that gives it, and the modes that know it."""

    setting: str
    option: str
    modes: tuple[str, ...]


_PLACES = (
    _Place("preset", "--preset", ("dvr", "mip", "minip", "mean", "slices")),
    _Place("transfer_function", "--transfer-function", ("dvr", "slices")),
    _Place("iso_value", "--iso", ("surface",)),
    _Place("color", "--color", ("surface",)),
    _Place("shadows", "--shadows", ("surface",)),
    _Place("light", "--light", ("dvr", "surface")),
    _Place("jitter", "--jitter", ("dvr",)),
    _Place("ray_step", "--ray-step", _SAMPLED),
    _Place("window", "--window", (*_VALUES, "slices")),
    _Place("slices", "--slices", ("slices",)),
    _Place("slice_opacity", "--slice-opacity", ("slices",)),
    _Place("view_angle", "--perspective", _RAYS),
    _Place("zoom", "--zoom", (*_RAYS, "slice")),
    _Place("clip", "--clip and --clip-box", _RAYS),
    _Place("letters", "--letters", (*_RAYS, "slice")),
    _Place("depth", "--depth", ("dvr", "mip", "minip", "surface", "slices", "slice")),
    _Place("values", "--values", _VALUES),
    _Place("turntable", "--turntable", _RAYS),
    _Place("thickness", "--thickness", _CUT),
    _Place("combine", "--combine", _CUT),
    _Place("offset_mm", "--offset", ("slice",)),
    _Place("curve", "--curve", ("cpr",)),
    _Place("cpr", "--cpr", ("cpr",)),
    _Place("labels", "--labels", ("surface",)),
)


def find_misplaced(mode: str, given: set[str]) -> str | None:
    """Say which of the settings `given` means nothing in a mode; None where all do.

    Parameters
    ----------
    mode : str
        One of `MODES`.
    given : set of str
        Names of settings that differ from what they are without being asked for, and of files of `PictureFiles`.
    """
    for setting, option, modes in _PLACES:
        if setting in given and mode not in modes:
            return f"{option} means nothing in mode {mode}: it belongs to {', '.join(modes)}"
    return None
