"""Modes of pictures, and which settings mean something in which."""

from __future__ import annotations

from clrecon.system.wording import name_parameter

__all__ = ["MODES", "VIEWS", "find_misplaced"]

MODES = {
    "dvr": "volume rendering: every HU with the colour and opacity of a transfer function",
    "mip": "the highest HU along each ray",
    "minip": "the lowest HU along each ray",
    "mean": "the mean HU along each ray",
    "drr": "a radiograph: the water that attenuates as much as all along the ray, mm",
    "surface": "the shaded surface at an iso value",
    "slices": "slices of the scan in space, translucent, each where it lies",
    "slice": "a plane through the volume in any direction, as thick as wanted",
    "cpr": "curved planar reformation along a centre line",
}
"""Names, and what the pictures show."""

VIEWS = ("anterior", "posterior", "left", "right", "superior", "inferior")

_RAYS = ("dvr", "mip", "minip", "mean", "drr", "surface", "slices")

_MODES_OF = {
    "preset": ("dvr", "mip", "minip", "mean", "drr", "slices", "slice", "cpr"),
    "letters": (*_RAYS, "slice"),
    "depth": ("dvr", "mip", "minip", "surface", "slices", "slice"),
    "values": ("mip", "minip", "mean", "drr", "slice", "cpr"),
    "turntable": _RAYS,
}
"""Settings that the renderer does not know; of all others it says itself in which modes they mean something."""

_CHECKED = (
    "preset", "transfer_function", "iso_value", "color", "depth_cue", "window", "ray_step", "light", "shadows",
    "jitter", "zoom", "view_angle", "clip_box", "clip_planes", "letters", "depth", "values", "slices", "slice_opacity",
    "thickness", "combine", "offset_mm", "curve", "cpr", "labels", "turntable",
)  # fmt: skip
"""Settings that mean nothing in some modes, in the order in which they are looked at."""

_RENDERER_NAMES = {"light": "lighting", "clip_box": "clip", "clip_planes": "clip"}


def find_misplaced(mode: str, given: set[str]) -> str | None:
    """Say which of the settings `given` means nothing in a mode; None where all do.

    Parameters
    ----------
    mode : str
        One of `MODES`.
    given : set of str
        Names of settings that differ from what they are without being asked for, and of files of `PictureFiles`.
    """
    from clrecon.operators.rays.render import KNOWN_IN  # numpy: not wanted before a job starts

    for setting in _CHECKED:
        modes = _MODES_OF.get(setting) or KNOWN_IN[_RENDERER_NAMES.get(setting, setting)]
        if setting in given and mode not in modes:
            return f"{name_parameter(setting)} means nothing in mode {mode}: it belongs to {', '.join(modes)}"
    return None
