"""Gates as data: a measured figure, its bound, and whether the figure keeps the bound.

Gates of meshes and of volumes have the same form, so one reader of reports understands both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from clrecon.system.records import Record


@dataclass(frozen=True, eq=False)
class Gate(Record):
    """A figure and its bound.

    measured: None: not measured.
    unit: None for counts, shares and flags.
    ok: None: not measured.
    text: One line without patient data.
    """

    name: str
    measured: float | bool | None
    bound: float | bool
    unit: str | None
    ok: bool | None
    text: str


def none_of(name: str, count: int, what: str, ok: bool | None = None) -> Gate:
    """Gate: a count must be 0.  Where `ok` is given, it decides instead of the count."""
    ok = count == 0 if ok is None else ok
    return Gate(name, count, 0, None, bool(ok), f"{what}: {count}, none allowed")


def is_true(name: str, flag: bool, what: str) -> Gate:
    """Gate: a statement must be true."""
    says = what if flag else f"this does not hold: {what}"
    return Gate(name, bool(flag), True, None, bool(flag), says)


def at_most(name: str, measured: float, bound: float, unit: str | None, what: str) -> Gate:
    """Gate: a figure must not be larger than its bound."""
    text = f"{what}: {_say(measured, bound, 3)}{' ' * bool(unit)}{unit or ''}, at most {bound:.3g}"
    return Gate(name, measured, bound, unit, measured <= bound, text)


def at_least(name: str, measured: float, bound: float, unit: str | None, what: str) -> Gate:
    """Gate: a figure must not be smaller than its bound."""
    text = f"{what}: {_say(measured, bound, 4)}{' ' * bool(unit)}{unit or ''}, at least {bound:g}"
    return Gate(name, measured, bound, unit, measured >= bound, text)


def _say(measured: float, bound: float, digits: int) -> str:
    """Return a figure with as many digits as tell it from its bound, `digits` at least."""
    while measured != bound and digits < 17 and f"{measured:.{digits}g}" == f"{bound:.{digits}g}":
        digits += 1
    return f"{measured:.{digits}g}"


def unmeasured(name: str, bound: float | bool, unit: str | None, why: str) -> Gate:
    """Gate whose figure was not measured, or for which there is nothing to measure."""
    return Gate(name, None, bound, unit, None, why)


def failed_gates(gates: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return one line for each gate that was measured and not kept."""
    return [f"gate {gate['name']} failed: {gate['text']}" for gate in gates if gate["ok"] is False]
