"""The commands of a view with their checked arguments, and the keys with their words; a page gets the keys as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from clrecon.errors import UsageError
from clrecon.rendering.looks.window import WINDOWS
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import unknown_name

MOST_TEXT = 200
"""Characters of a name in a command."""


def _check_number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("a number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or int(value) != value:
        raise TypeError("a whole number")
    return int(value)


def _text(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MOST_TEXT:
        raise TypeError("a name")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError("true or false")
    return value


def _check_numbers(count: int) -> Callable[[Any], tuple[float, ...]]:
    def check(value: Any) -> tuple[float, ...]:
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
            raise TypeError(f"{count} numbers")
        return tuple(_check_number(each) for each in value)

    return check


def _size(value: Any) -> tuple[int, int]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise TypeError("width and height")
    width, height = (_whole(each) for each in value)
    return width, height


def _name_or_numbers(count: int) -> Callable[[Any], str | tuple[float, ...]]:
    return lambda value: _text(value) if isinstance(value, str) else _check_numbers(count)(value)


def _or_none(check: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else check(value)


@dataclass(frozen=True)
class Command:
    """A command: the checks of its arguments, and the method of a session that gets these ("undo", "model.turn")."""

    words: str
    needs: Mapping[str, Callable[[Any], Any]]
    takes: Mapping[str, Callable[[Any], Any]]
    method: str


COMMANDS: dict[str, Command] = {}


def _command(owner: str, name: str, words: str, /, *, takes: Mapping[str, Any] | None = None, **needs: Any) -> None:
    COMMANDS[name] = Command(words, needs, takes or {}, owner + name)


_model = partial(_command, "model.")
"""Adds a command that is a method of the model, with arguments of the same names."""
_session = partial(_command, "")


_model("turn", "turn about the middle, in shares of the height", dx=_check_number, dy=_check_number)
_model("pan", "shift what is seen, in shares of the height", dx=_check_number, dy=_check_number)
_model("zoom", "show larger; at: from the middle, in shares of the height",
       factor=_check_number, takes={"at": _check_numbers(2)})  # fmt: skip
_model("roll", "turn the picture clockwise, degrees", degrees=_check_number)
_model("look", "look from a side of the patient, or azimuth and elevation", view=_name_or_numbers(2))
_model("set_perspective", "a perspective or a parallel camera", on=_flag)
_model("toggle_perspective", "a perspective camera for a parallel one, or back")
_model("set_iso", "iso value of the surfaces, HU", hu=_check_number)
_model("step_iso", "move the iso value by HU, as far as the slider goes", by=_check_number)
_model("set_mode", "what scans are shown as", name=_text)
_model("step_mode", "go so many modes further down the list", steps=_whole)
_model("set_window", "HU of black and white; of: slices or picture",
       low=_check_number, high=_check_number, takes={"of": _text})  # fmt: skip
_model("set_occlusion", "darken hollows of scans, or not", on=_flag)
_model("toggle_occlusion", "darken hollows of scans, or not any more")
_session("set_table", "show or take away table and blankets", shown=_flag)
_session("toggle_table", "take table and blankets away, or show them")
_session("set_smooth", "smooth scans against their noise, or show them as read", on=_flag)
_session("toggle_smooth", "smooth scans against their noise, or show them as read")
_session("set_fitted", "show surfaces fitted to the bone, or at the iso value", shown=_flag)
_session("toggle_fitted", "fit surfaces to the bone, or stop that, or show them at the iso value")
_model("set_color_by", "colour fitted surfaces by thickness or error; null: not", name=_or_none(_text))
_model("step_color_by", "colour fitted surfaces by the next number, or not")
_model("scroll", "move a slice by steps of its voxels", plane=_text, steps=_check_number)
_session("zoom_slice", "show a slice of a size larger; about: from the middle, in shares of the height",
         plane=_text, factor=_check_number, size=_size, takes={"about": _check_numbers(2)})  # fmt: skip
_session("pan_slice", "shift a slice of a size, in shares of the height",
         plane=_text, dx=_check_number, dy=_check_number, size=_size)  # fmt: skip
_model("turn_cross", "turn the cross on a slice clockwise, degrees", plane=_text, degrees=_check_number)
_model("straighten", "slices along the axes of the patient again")
_model("set_slab", "slices of so many mm: mean, max or min of them", thickness=_check_number, takes={"combine": _text})
_model("step_slab", "thick slices: mean, max, or planes again")
_model("set_layout", "lay the views out: 1, 1+3 or 4", name=_text)
_model("step_layout", "lay the views out in the next way")
_model("set_compare", "first input left of a line at a share of the width, others right; null: together",
       share=_or_none(_check_number))  # fmt: skip
_model("toggle_compare", "compare the first input with the others, or show all together")
_session("find_spine", "find the canal of the spine, and make it a curve")
_model("fit_slices", "show the slices as they fit")
_session("probe", "HU at a place, LPS mm", point=_check_numbers(3))
_model("set_cross", "move the slices to a place, LPS mm", point=_check_numbers(3))
_session("find_parts", "find the parts of the scans at the iso value")
_model("show", "show or hide a part", key=_text, visible=_flag)
_model("only", "show one part alone", key=_text)
_model("show_all", "show all parts")
_model("set_color", "colour of a part, 0 to 1; null: its own", key=_text, rgb=_or_none(_check_numbers(3)))
_model("color_parts", "a colour for each part of scans", takes={"distinct": _flag})
_model("toggle_colors", "a colour for each part of scans, or none")
_model("toggle_small_parts", "hide the small components of scans, or show them")
_model("set_opacity", "opacity of a part, 0 to 1", key=_text, value=_check_number)
_AT = {"x": _check_number, "y": _check_number, "size": _size}
_session("pick", "what is seen at a pixel; plane: of a slice", takes={"plane": _or_none(_text)}, **_AT)
_session("hide_at", "hide the part at a pixel", takes={"plane": _or_none(_text)}, **_AT)
_session("only_at", "show the part at a pixel alone", takes={"plane": _or_none(_text)}, **_AT)
_session("cross_at", "move the slices to what is seen at a pixel", takes={"plane": _or_none(_text)}, **_AT)
_session("add_point", "add what is seen at a pixel to the tool", takes={"plane": _or_none(_text)}, **_AT)
_session("mark_at", "keep the place at a pixel as a seed", takes={"plane": _or_none(_text)}, **_AT)
_model("start_tool", "take points for: distance, angle, curve, seed, circle, box", name=_text)
_model("end_tool", "put the tool away; a curve is made")
_model("rename_measure", "name a measure by its number, from 0", n=_whole, name=_text)
_model("remove_measure", "drop one measure", n=_whole)
_model("clear_measures", "drop all measures")
_model("add_clip", "cut with a plane towards a side", direction=_name_or_numbers(3))
_model("move_clip", "move a plane, 0 to 1", n=_whole, share=_check_number)
_model("flip_clip", "take the other side of a plane away", n=_whole)
_model("remove_clip", "drop a plane", n=_whole)
_model("set_clip_box", "show a box, LPS mm; null: all",
       low=_or_none(_check_numbers(3)), high=_or_none(_check_numbers(3)))  # fmt: skip
_model("toggle_clip_box", "show a box about the cross, or all")
_session("undo", "take the last change back")
_model("hold", "the pointer is pressed: until it is released one step of undo", on=_flag)
_session("save", "write what is shown; the extension says as what", path=_text, takes={"size": _size})
_session("cancel", "stop the work in the background")
_session("dismiss", "drop the words of the last error")


def check_command(command: Any) -> tuple[Command, dict[str, Any]]:
    """Return the command that a mapping names, and its checked arguments."""
    if not isinstance(command, Mapping):
        raise UsageError(f'a command is a mapping such as {{"do": "undo"}}, not {type(command).__name__}')
    name = command.get("do")
    if not isinstance(name, str) or name not in COMMANDS:
        raise UsageError(unknown_name("command", name, COMMANDS))
    known_command = COMMANDS[name]
    given = {key: value for key, value in command.items() if key != "do"}
    known = {**known_command.needs, **known_command.takes}
    for key in given:
        if key not in known:
            raise UsageError(
                f"the command {name} has no argument {str(key)!r:.60}: {', '.join(known) or 'it takes none'}"
            )
    missing = [key for key in known_command.needs if key not in given]
    if missing:
        raise UsageError(f"the command {name} needs {', '.join(missing)}")
    checked = {}
    for key, value in given.items():
        try:
            checked[key] = known[key](value)
        except (TypeError, ValueError, OverflowError) as error:
            wanted = str(error) if isinstance(error, TypeError) else "a number"
            raise UsageError(f"{key} of the command {name} is {wanted}, not {value!r:.60}") from None
    return known_command, checked


_ISO_STEP = 5.0
"""HU by which a key moves the iso value."""


@dataclass(frozen=True)
class Key:
    """A key; its name stands in the list of keys, where it is not what a browser calls the key.

    does: A command of `ViewSession.do`, or the name of something that the page does itself.
    at_pointer: The command gets the pixel under the pointer.
    """

    words: str
    does: Mapping[str, Any] | str
    at_pointer: bool = False
    name: str = ""


def _look_from(side: str) -> Key:
    return Key(f"look from {side}", {"do": "look", "view": side})


_SECTIONS: dict[str, dict[str, Key]] = {
    "Views": {
        "1": _look_from("anterior"),
        "2": _look_from("posterior"),
        "3": _look_from("left"),
        "4": _look_from("right"),
        "5": _look_from("superior"),
        "6": _look_from("inferior"),
        "f": Key("parallel or perspective", {"do": "toggle_perspective"}),
        "g": Key("layout: picture alone, slices beside it, four views", {"do": "step_layout"}),
        "v": Key("compare: first input left of a line, others right", {"do": "toggle_compare"}),
    },
    "Scan": {
        "o": Key("next mode; O: the one before", {"do": "step_mode", "steps": 1}),
        "O": Key("", {"do": "step_mode", "steps": -1}),
        "b": Key("table and blankets away, or shown", {"do": "toggle_table"}),
        "y": Key("smoothed against noise, or as read", {"do": "toggle_smooth"}),
        "w": Key("hollows darker, or as light as all", {"do": "toggle_occlusion"}),
        "t": Key("surface fitted to the bone, or at the iso value", {"do": "toggle_fitted"}),
        "T": Key("fitted surface: thickness of the walls, error, plain", {"do": "step_color_by"}),
        "ArrowLeft": Key(f"{_ISO_STEP:g} HU lower; Right: higher", {"do": "step_iso", "by": -_ISO_STEP}, name="Left"),
        "ArrowRight": Key("", {"do": "step_iso", "by": _ISO_STEP}),
    },
    "Slices": {
        "z": Key("one view at full size, or all views", "full"),
        "PageUp": Key("slice before; Page Down: slice behind", "before", name="Page Up"),
        "PageDown": Key("", "behind"),
        "+": Key("larger; -: smaller", "larger"),
        "-": Key("", "smaller"),
        "0": Key("slices as they fit", {"do": "fit_slices"}),
        "[": Key("turn the cross on the slice by 5°; ]: clockwise", "turn_left"),
        "]": Key("", "turn_right"),
        "r": Key("slices along the axes of the patient again", {"do": "straighten"}),
        "j": Key("slices of 10 mm: mean, max; or planes again", {"do": "step_slab"}),
    },
    "Measure": {
        "m": Key("distance: two clicks", "distance"),
        "a": Key("angle: three clicks", "angle"),
        "d": Key("circle on a slice: middle and edge; B: box, two corners", "circle"),
        "B": Key("", "box"),
        "k": Key("curve: clicks, then k: picture along it; again: without", "curve"),
        "K": Key("curve along the spine, found in the scan", {"do": "find_spine"}),
        "e": Key("place under the pointer, as a seed point", {"do": "mark_at"}, at_pointer=True),
        "M": Key("remove all measures", {"do": "clear_measures"}),
    },
    "Parts": {
        "x": Key("hide the part under the pointer, else the chosen one", {"do": "hide_at"}, at_pointer=True),
        "X": Key("show only the part under the pointer, else the chosen one", {"do": "only_at"}, at_pointer=True),
        "A": Key("show all parts", {"do": "show_all"}),
        "l": Key("a colour for each part", {"do": "toggle_colors"}),
        "n": Key("small parts hidden, or shown", {"do": "toggle_small_parts"}),
    },
    "Clip": {
        "c": Key("a plane across the view", {"do": "add_clip", "direction": "view"}),
        "C": Key("a box about the cross, or none", {"do": "toggle_clip_box"}),
    },
    "Else": {
        "s": Key("save what is shown", "save"),
        "p": Key("save the picture", "photo"),
        "u": Key("undo", {"do": "undo"}),
        "L": Key("copy a link to this view", "link"),
        "?": Key("this list; also h", "help"),
        "h": Key("", "help"),
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
        ("drag an end of the cross", "turn it: the other slices become oblique"),
        ("wheel", "scroll; touch: one finger"),
        ("Ctrl and wheel", "zoom; touch: two fingers, which move it too"),
        ("Shift and drag", "move; also with the middle button"),
        ("right drag", "window (right: wider) and level (down: higher)"),
        ("double click", "full size, or all views again; also on the picture"),
    ),
}

_HINTS = {
    "distance": "Click two points.",
    "angle": "Click three points; the angle is at the second.",
    "curve": "Click points along a curve, then end: the scan is shown along it.",
    "seed": "Click a place.",
    "circle": "Click the middle of a circle on a slice, then a point of its edge.",
    "box": "Click two opposite corners on a slice.",
    "only": "Click the part to keep.",
    "hide": "Click the parts to hide, then end.",
}

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
        "iso_step": _ISO_STEP,
    }
