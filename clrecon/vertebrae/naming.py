"""Names of vertebrae: counted from the head, or by the level that the user gives one of them."""

from __future__ import annotations

import re

from clrecon.errors import UsageError

__all__ = ["LEVELS", "check_level", "name_levels"]

LEVELS = (
    *(f"C{n}" for n in range(1, 8)), *(f"T{n}" for n in range(1, 13)), *(f"L{n}" for n in range(1, 7))
)  # fmt: skip
"""Levels from the head downwards; place n has the number n + 1 in the VerSe data set, L6 included."""


def check_level(name: str) -> str:
    """Return the name of a level as `LEVELS` has it.

    Raises
    ------
    UsageError
        There is no level of this name.
    """
    level = str(name).strip().upper()
    if not re.fullmatch(r"[CTL][0-9]{1,2}", level) or level not in LEVELS:
        raise UsageError(f"there is no vertebra {str(name)[:20]!r}: they are C1 to C7, T1 to T12 and L1 to L6")
    return level


def name_levels(count: int, given: tuple[int, str] | None) -> dict[int, str]:
    """Return the number in the label map and the name of each of `count` vertebrae, from the head downwards.

    Parameters
    ----------
    count : int
    given : (int, str), optional
        Place of a vertebra, from 0, and its level.  Without it they are ``vertebra_1`` and so on.

    Raises
    ------
    UsageError
        The row would reach beyond C1 or L6.
    """
    if given is None:
        return {n: f"vertebra_{n}" for n in range(1, count + 1)}
    place, level = given
    first = LEVELS.index(level) - place
    if first < 0 or first + count > len(LEVELS):
        raise UsageError(
            f"with {level} at that point, {place} vertebrae above it and {count - 1 - place} below it need names,"
            " and C1 to L6 are not enough: look at the picture of the discs and name another"
        )
    return {first + n + 1: LEVELS[first + n] for n in range(count)}
