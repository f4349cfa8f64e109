"""Options of the command line, declared as fields of settings: flag, value, help and default stand once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, field, fields
from typing import Any, NamedTuple

_KEY = "option"
_OF_KIND: dict[Any, dict[str, Any]] = {
    **dict.fromkeys(("int", "int | None"), {"type": int}),
    **dict.fromkeys(("float", "float | None"), {"type": float}),
}
"""How values of a field are read, by its annotation; of others the text is the value."""


class Option(NamedTuple):
    """How a field of settings is given on the command line.

    name: Of the field.
    how: Keywords of `clrecon.cli.common.Parser.add_argument`.
    """

    name: str
    flag: str
    how: dict[str, Any]


def option(
    flag: str,
    metavar: str | tuple[str, ...],
    help: str,  # noqa: A002
    *,
    group: str = "",
    default: Any = None,
    parse: Callable[[str], Any] | None = None,
    **how: Any,
) -> Any:
    """Declare a field of settings that is an option of the command line.

    metavar: What stands for the value in the help.
    group: Names those that stand together.
    default: Of the field; where the option is not given, the parser has None.
    parse: Reads the value from text; its ValueError is the refusal.  None: as the annotation of the field says.
    **how: More keywords of `clrecon.cli.common.Parser.add_argument`.
    """
    if parse is not None:
        how["type"] = parse
    default = MISSING if how.get("required") else default
    return field(default=default, metadata={_KEY: (flag, group, {"metavar": metavar, "help": help, **how})})


def flag(name: str, help: str, *, group: str = "", default: bool = False, **how: Any) -> Any:  # noqa: A002
    """Declare a field of settings that is an option without a value, see `option`."""
    how = {"action": "store_false" if default else "store_true", "help": help, **how}
    return field(default=default, metadata={_KEY: (name, group, how)})


def options_of(settings: type, group: str = "") -> Iterator[Option]:
    """Yield the options of a group, in the order of the fields."""
    for own in fields(settings):
        flag, declared, how = own.metadata.get(_KEY, ("", None, {}))
        if declared == group:
            yield Option(own.name, flag, {**_OF_KIND.get(own.type, {}), **how})
