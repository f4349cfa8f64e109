"""Options of the command line, declared as fields of settings: flag, value, help and default stand once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import MISSING, field, fields
from typing import Any, NamedTuple

_KEY = "option"
_READERS = {"int": int, "int | None": int, "float": float, "float | None": float}
"""What reads the value of a field, by its annotation; of others the text is the value."""


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


def options_of(settings: type, group: str = "") -> Iterator[Option]:
    for item in fields(settings):
        flags, declared, how = item.metadata.get(_KEY, ([], None, {}))
        if declared == group:
            read = _READERS.get(str(item.type))
            yield Option(item.name, flags, how if read is None else {"type": read, **how})


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
