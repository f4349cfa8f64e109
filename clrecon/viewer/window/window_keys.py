"""The keys of the window: what each does, in one table that the help is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Key:
    """A key.

    words: What it does, in the help.
    command: A command of `ViewSession.do`.
    own: Else what the window does itself.
    button: Words of its button in the list beside the picture; empty: it has none.
    """

    words: str
    command: Mapping[str, Any] | None = None
    own: str = ""
    button: str = ""


def _look(side: str) -> Key:
    return Key(f"look from {side}", {"do": "look", "view": side})


KEYS: dict[str, Key] = {
    "1": _look("anterior"),
    "2": _look("posterior"),
    "3": _look("left"),
    "4": _look("right"),
    "5": _look("superior"),
    "6": _look("inferior"),
    "f": Key("parallel or perspective", own="perspective"),
    "o": Key("next mode; O: the one before", own="next_mode"),
    "O": Key("", own="last_mode"),
    "b": Key("table and blankets away, or shown", own="table", button="table"),
    "Left": Key("5 HU lower; Right: higher", own="iso_down"),
    "Right": Key("", own="iso_up"),
    "m": Key("distance: two clicks", {"do": "start_tool", "name": "distance"}, button="distance"),
    "a": Key("angle: three clicks", {"do": "start_tool", "name": "angle"}, button="angle"),
    "k": Key("curve: clicks, then k: picture along it", own="curve", button="curve"),
    "e": Key("seed under the pointer", own="seed", button="seed"),
    "M": Key("drop all measures", {"do": "clear_measures"}),
    "x": Key("hide the part under the pointer", own="hide", button="hide"),
    "X": Key("only the part under the pointer", own="only", button="only"),
    "A": Key("show all parts", {"do": "show_all"}, button="all"),
    "l": Key("a colour for each part", own="color_parts", button="colours"),
    "c": Key("clip: a plane across the view", {"do": "add_clip", "direction": "view"}, button="clip"),
    "C": Key("clip: a box about the cross, or none", own="clip_box", button="box"),
    "u": Key("undo", {"do": "undo"}, button="undo"),
    "s": Key("save what is shown", own="save", button="save"),
    "p": Key("save the picture", own="picture", button="picture"),
    "h": Key("this help", own="help", button="help"),
    "Escape": Key("end the tool, the work, this help", own="escape"),
    "q": Key("quit", own="quit"),
}

_GESTURES = (
    ("drag", "turn; with Ctrl: roll"),
    ("middle drag", "pan; also Shift and drag"),
    ("right drag", "zoom; also the wheel"),
    ("Shift and click", "what is it? slices go there"),
    ("on a slice", ""),
    ("click, drag", "the other slices go there"),
    ("wheel", "scroll"),
    ("right drag", "window and level"),
)

_SECTIONS = (
    ("Views", ("1", "2", "3", "4", "5", "6", "f")),
    ("Scan", ("o", "b", "Left")),
    ("Measure", ("m", "a", "k", "e", "M")),
    ("Parts", ("x", "X", "A", "l")),
    ("Clip", ("c", "C")),
    ("Files", ("s", "p")),
    ("", ("u", "h", "Escape", "q")),
)


def find_key(name: str) -> Key | None:
    """Return the key of a name of X (``KP_1`` is that of the number pad)."""
    return KEYS.get(name.removeprefix("KP_"))


def help_sections() -> list[tuple[str, list[tuple[str, str]]]]:
    """Return titles, and gestures and keys with their words."""
    made: list[tuple[str, list[tuple[str, str]]]] = [("Mouse on the picture", list(_GESTURES[:4]))]
    made.append(("Mouse on a slice", list(_GESTURES[5:])))
    for title, names in _SECTIONS:
        made.append((title or "Else", [(name, KEYS[name].words) for name in names]))
    return made


def side_buttons(facts: Mapping[str, Any], *, help_shown: bool = False) -> list[tuple[str, str, bool]]:
    """Return the buttons beside the picture: key, words, whether it is on."""
    on = {
        "m": facts.get("tool") == "distance",
        "a": facts.get("tool") == "angle",
        "k": facts.get("tool") == "curve",
        "e": facts.get("tool") == "seed",
        "b": bool(facts.get("table")) and facts.get("iso") is not None,
        "C": facts.get("clip_box") is not None,
        "h": help_shown,
    }
    of_scans = {"b", "l"}
    return [
        (name, key.button, on.get(name, False))
        for name, key in KEYS.items()
        if key.button and (name not in of_scans or facts.get("iso") is not None)
    ]
