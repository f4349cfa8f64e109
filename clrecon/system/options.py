"""Options of the command line, declared as fields of settings: flag, value, help and default stand once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, field, fields
from typing import Any, NamedTuple, TypeVar

from clrecon.errors import UsageError

_KEY = "option"
_READERS = {"int": int, "int | None": int, "float": float, "float | None": float}
"""What reads the value of a field, by its annotation; of others the text is the value."""


Settings = TypeVar("Settings")

_FLAGS = {"yes": True, "no": False, "true": True, "false": False, "1": True, "0": False}


class Option(NamedTuple):
    """How a field of settings is given in a command, by `Parser.add_argument`; its first flag names it in messages."""

    name: str
    flags: list[str]
    how: dict[str, Any]


def option(
    usage: str,
    help: str,  # noqa: A002
    *,
    group: str = "",
    default: Any = None,
    parse: Callable[[str], Any] | None = None,
    **how: Any,
) -> Any:
    """Declare a field of settings that is an option of the command line, with its flags and a text for its value.

    group: Names those that stand together.
    default: Of the field; where the option is not given, the parser has None.
    parse: Reads the value from text; its ValueError is the refusal.  None: as the annotation of the field says.
    """
    flags = [word for word in usage.split() if word.startswith("-")]
    values = usage.split()[len(flags) :]
    if not values:
        how = {"action": "store_false" if default else "store_true", **how}
        default = bool(default)
    elif len(values) == 1:
        how["metavar"] = values[0]
    else:
        how |= {"metavar": tuple(values), "nargs": len(values)}
    if parse is not None:
        how["type"] = parse
    default = MISSING if how.get("required") else default
    return field(default=default, metadata={_KEY: (flags, group, {"help": help, **how})})


def option_beside(name: str, declared: Any) -> Option:
    """Return an option of a command that no settings hold, of what `option` declares."""
    flags, _, how = declared.metadata[_KEY]
    return Option(name, flags, how)


def options_of(settings: type, group: str | None = "") -> Iterator[Option]:
    """Yield the options of a group, for None those of all groups."""
    for item in fields(settings):
        flags, declared, how = item.metadata.get(_KEY, ([], None, {}))
        if flags and group in (None, declared):
            read = _READERS.get(str(item.type))
            yield Option(item.name, flags, how if read is None else {"type": read, **how})


def pick_fields(settings: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Pick the values that are fields of settings and not None; those that may be given again make a tuple."""
    picked = {own.name: given.get(own.name) for own in fields(settings)}
    return {
        name: tuple(value) if isinstance(value, list) else value for name, value in picked.items() if value is not None
    }


def make_part(part: type[Settings], given: Mapping[str, Any], owner: str | None, needs: str) -> Settings | None:
    """Make settings that mean nothing without the option of `owner`, None where it has no value; `needs` says which."""
    if owner is not None:
        return part(**pick_fields(part, given))
    for declared in options_of(part):
        if given.get(declared.name) is not None:
            raise UsageError(f"{declared.flags[0]} {needs}")
    return None


def read_value(read: Callable[[str], Any] | None, text: str, unit: object = None) -> Any:
    """Read a value from text; a ValueError is the refusal.  What is no number is said with the unit it does without."""
    try:
        return text if read is None else read(text)
    except UsageError:  # it says all by itself
        raise
    except ValueError as error:
        reason = str(error)
        if read in (int, float):
            number = "whole number" if read is int else "number"
            advice = ": write the length in mm, without a unit" if unit == "MM" else ""
            reason = f"{text!r:.80} is no {number}{advice}"
        raise ValueError(reason) from None


def read_cell(declared: Option, text: str) -> Any:
    """Read the value of an option from a cell of a table: yes or no for a flag, and | between values of a list."""
    how = declared.how
    action, word = how.get("action", ""), text.lower()
    if action in ("store_true", "store_false", "yes-no"):
        if word not in _FLAGS:
            raise ValueError(f"{text!r:.40} is neither yes nor no")
        return _FLAGS[word] is not (action == "store_false")
    if word == "yes" and how.get("nargs") == "?":
        return how["const"]
    parts = [part.strip() for part in text.split("|")] if action == "append" else [text]
    values = [read_value(how.get("type"), part, how.get("metavar")) for part in parts]
    return tuple(values) if action == "append" else values[0]


def parse_numbers(text: str, *, ends: bool = False) -> tuple[float, ...] | None:
    """Read numbers with commas between, None where one is none; with `ends` an empty one is infinite, -, + in turns."""
    words = [word.strip() for word in text.split(",")]
    try:
        return tuple(
            math.copysign(math.inf, place % 2 - 0.5) if ends and not word else float(word)
            for place, word in enumerate(words)
        )
    except ValueError:
        return None


def numbers_reader(count: int | None, fault: str, *, ends: bool = False) -> Callable[[str], tuple[float, ...]]:
    """Return what reads so many numbers, or any count, see `parse_numbers`; refusals say `fault` behind the text."""

    def read_numbers(text: str) -> tuple[float, ...]:
        numbers = parse_numbers(text, ends=ends)
        if numbers is None or count not in (None, len(numbers)):
            raise ValueError(f"{text!r} {fault}")
        return numbers

    return read_numbers
