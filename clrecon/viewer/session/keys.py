"""The keys of a view with their words, and what the mouse does; a page gets them as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from clrecon.rendering.looks.window import WINDOWS

ISO_STEP = 5.0
"""HU by which a key moves the iso value."""


@dataclass(frozen=True)
class Key:
    """A key.

    does: A command of `ViewSession.do`, or the name of something that the page does itself.
    at_pointer: The command gets the pixel under the pointer.
    name: In the list of keys, where it is not what a browser calls the key.
    """

    words: str
    does: Mapping[str, Any] | str
    at_pointer: bool = False
    name: str = ""


def _look(side: str) -> Key:
    return Key(f"look from {side}", {"do": "look", "view": side})


_SECTIONS: dict[str, dict[str, Key]] = {
    "Views": {
        "1": _look("anterior"),
        "2": _look("posterior"),
        "3": _look("left"),
        "4": _look("right"),
        "5": _look("superior"),
        "6": _look("inferior"),
        "f": Key("parallel or perspective", {"do": "toggle_perspective"}),
    },
    "Scan": {
        "o": Key("next mode; O: the one before", {"do": "step_mode", "steps": 1}),
        "O": Key("", {"do": "step_mode", "steps": -1}),
        "b": Key("table and blankets away, or shown", {"do": "toggle_table"}),
        "ArrowLeft": Key(f"{ISO_STEP:g} HU lower; Right: higher", {"do": "step_iso", "by": -ISO_STEP}, name="Left"),
        "ArrowRight": Key("", {"do": "step_iso", "by": ISO_STEP}),
    },
    "Measure": {
        "m": Key("distance: two clicks", "distance"),
        "a": Key("angle: three clicks", "angle"),
        "k": Key("curve: clicks, then k: picture along it; again: without", "curve"),
        "e": Key("place under the pointer, as a seed point", {"do": "mark_at"}, at_pointer=True),
        "M": Key("remove all measures", {"do": "clear_measures"}),
    },
    "Parts": {
        "x": Key("hide the part under the pointer, else the chosen one", {"do": "hide_at"}, at_pointer=True),
        "X": Key("show only the part under the pointer, else the chosen one", {"do": "only_at"}, at_pointer=True),
        "A": Key("show all parts", {"do": "show_all"}),
        "l": Key("a colour for each part", {"do": "toggle_colors"}),
    },
    "Clip": {
        "c": Key("a plane across the view", {"do": "add_clip", "direction": "view"}),
        "C": Key("a box about the cross, or none", {"do": "toggle_clip_box"}),
    },
    "Else": {
        "s": Key("save what is shown", "save"),
        "p": Key("save the picture", "photo"),
        "u": Key("undo", {"do": "undo"}),
        "h": Key("this list", "help"),
        "Escape": Key("put the tool away, else stop the work", "escape"),
        "q": Key("quit: clrecon ends", "quit"),
    },
}

KEYS = {name: key for keys in _SECTIONS.values() for name, key in keys.items()}

_MOUSE = {
    "Mouse on the picture": (
        ("drag", "turn; with Ctrl: roll"),
        ("Shift and drag", "pan; also with another button"),
        ("wheel", "zoom; also Ctrl, Shift and drag"),
        ("Shift and click", "what is it? The slices go there"),
        ("touch", "one finger turns, two pan and zoom"),
    ),
    "Mouse on a slice": (
        ("click, drag", "the other slices go there"),
        ("wheel", "scroll; touch: one finger"),
        ("right drag", "window (right: wider) and level (down: higher); touch: two fingers"),
    ),
}

_HINTS = {
    "distance": "Click two points.",
    "angle": "Click three points; the angle is at the second.",
    "curve": "Click points along a curve, then end: the scan is shown along it.",
    "seed": "Click a place.",
    "only": "Click the part to keep.",
    "hide": "Click the parts to hide, then end.",
}
"""What is to be done next, for each tool."""

_SLICE_WINDOWS = ("bone", "soft", "lung", "brain")


def page_words() -> dict[str, Any]:
    """Return keys, hints and windows for a page: they do not change while it is open."""
    rows = {
        title: [(key.name or name, key.words) for name, key in keys.items() if key.words]
        for title, keys in _SECTIONS.items()
    }
    return {
        "keys": {name: key.does for name, key in KEYS.items()},
        "at_pointer": [name for name, key in KEYS.items() if key.at_pointer],
        "help": {**_MOUSE, **rows},
        "hints": _HINTS,
        "windows": {name: WINDOWS[name] for name in _SLICE_WINDOWS},
        "iso_step": ISO_STEP,
    }
