"""Names of vertebrae: counted from the head, or by the level that the user gives one of them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from clrecon.errors import UsageError
from clrecon.system.wording import name_parameter

LEVELS = (
    *(f"C{n}" for n in range(1, 8)), *(f"T{n}" for n in range(1, 13)), *(f"L{n}" for n in range(1, 7))
)  # fmt: skip
"""Levels from the head downwards; place n has the number n + 1 in the VerSe data set, L6 included."""


def check_level(name: str) -> str:
    """Return the name of a level as `LEVELS` has it."""
    level = str(name).strip().upper()
    if not re.fullmatch(r"[CTL][0-9]{1,2}", level) or level not in LEVELS:
        raise UsageError(f"there is no vertebra {str(name)[:20]!r}: they are C1 to C7, T1 to T12 and L1 to L6")
    return level


def check_landmark(name_at: tuple[Sequence[float], str] | None, first: str | None) -> str | None:
    """Return the level of the landmark as `LEVELS` has it, None without one."""
    if name_at is not None and first is not None:
        raise UsageError(
            f"{name_parameter('first')} and {name_parameter('name_at')} both name levels: give one of them"
        )
    level = first if name_at is None else name_at[1]
    return None if level is None else check_level(level)


def name_levels(count: int, given: tuple[int, str] | None) -> dict[int, str]:
    """Return the number in the label map and the name of each of `count` vertebrae, from the head downwards.

    given: Place of a vertebra, from 0, and its level.  Without it they are ``vertebra_1`` and so on.
    """
    if given is None:
        return {n: f"vertebra_{n}" for n in range(1, count + 1)}
    place, level = given
    first = LEVELS.index(level) - place
    if first < 0:
        raise UsageError(
            f"{place} vertebrae were found above {level}, and there are only {place + first} levels above {level}:"
            " look at the picture and name another level"
        )
    if first + count > len(LEVELS):
        raise UsageError(
            f"{count - place} vertebrae were found from {level} downwards, and there are only"
            f" {len(LEVELS) - first - place} levels from {level} to {LEVELS[-1]}: look at the picture and name another"
            " level"
        )
    return {first + n + 1: LEVELS[first + n] for n in range(count)}
