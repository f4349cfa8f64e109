"""Options of the command line, declared as fields of settings: flag, value, help and default stand once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any

_KEY = "option"


@dataclass(frozen=True)
class Option:
    """How a field of settings is given on the command line.

    metavar: What stands for the value in the help; None for a flag.
    parse: Reads the value from text; its ValueError is the refusal.
    how: More keywords of `argparse.ArgumentParser.add_argument`.
    first: One of the options that most people need.
    """

    flag: str
    metavar: str | None
    help: str
    group: str
    parse: Callable[[str], Any] | None
    first: bool
    how: dict[str, Any]


def option(
    flag: str,
    metavar: str | None,
    help: str,  # noqa: A002
    *,
    group: str,
    default: Any = None,
    parse: Callable[[str], Any] | None = None,
    first: bool = False,
    **how: Any,
) -> Any:
    """Declare a field of settings that is an option of the command line; `group` names those that stand together."""
    return field(default=default, metadata={_KEY: Option(flag, metavar, help, group, parse, first, how)})


def options_of(settings: type, group: str) -> Iterator[tuple[str, Any, Option]]:
    """Yield the name, the default and the option of each field of a group, in the order of the fields."""
    for own in fields(settings):
        declared = own.metadata.get(_KEY)
        if declared is not None and declared.group == group:
            yield own.name, own.default, declared
