"""Modes of a view: what a scan is shown as, by the names of `clrecon.render`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from clrecon.rendering.looks.presets import PRESETS

SLICE_WINDOW = (-450.0, 1050.0)
"""HU shown as black and white in slices at the start: a window for bone."""


@dataclass(frozen=True)
class ViewMode:
    """A mode.

    name, words: The words say what is seen.
    kind: "surface", "volume" (volume rendering), "projection", "slices" or "labels".
    style: Name of the preset or of the projection.
    joins: Other objects are shown with it in one picture.
    window: HU of black and white of a projection; None: chosen from the picture.
    """

    name: str
    words: str
    kind: str
    style: str = ""
    joins: bool = True
    window: tuple[float, float] | None = None


@cache
def find_modes() -> dict[str, ViewMode]:
    """Return all modes by name, in the order in which they are listed."""
    modes = [ViewMode("surface", "the surface at the iso value", "surface")]
    modes += [
        ViewMode(preset.name, preset.description, "volume", preset.name)
        for preset in PRESETS.values()
        if preset.mode == "dvr"
    ]
    modes += [
        ViewMode(
            preset.mode, preset.description.partition(" (mode")[0], "projection", preset.mode, False, preset.window
        )
        for preset in PRESETS.values()
        if preset.mode != "dvr"
    ]
    modes.append(ViewMode("slices", "translucent slices in space", "slices"))
    modes.append(ViewMode("labels", "the labels alone, as solid shapes", "labels"))
    return {mode.name: mode for mode in modes}
