"""Gates as data: a figure, the bound that it is held against, and whether it keeps it.

Meshes and volumes are judged in the same form, so that one reader of reports understands both.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

__all__ = ["Gate", "at_least", "at_most", "failed_gates", "is_true", "none_of", "unmeasured"]

Gate = dict[str, Any]
"""``name``, ``measured`` (None: not measured), ``bound``, ``unit`` (None for counts, shares and flags), ``ok`` (None:
not measured) and ``text``, one line without patient data."""


def none_of(name: str, count: int, what: str, ok: bool | None = None) -> Gate:
    """There is none of something; `ok` where something else than the count decides."""
    ok = count == 0 if ok is None else ok
    return {
        "name": name,
        "measured": count,
        "bound": 0,
        "unit": None,
        "ok": bool(ok),
        "text": f"{what}: {count}, none allowed",
    }


def is_true(name: str, flag: bool, what: str) -> Gate:
    """A statement holds."""
    says = what if flag else f"does not hold: {what}"
    return {"name": name, "measured": bool(flag), "bound": True, "unit": None, "ok": bool(flag), "text": says}


def at_most(name: str, measured: float, bound: float, unit: str | None, what: str) -> Gate:
    """A figure is no larger than its bound."""
    text = f"{what}: {measured:.3g}{' ' * bool(unit)}{unit or ''}, at most {bound:g}"
    return {"name": name, "measured": measured, "bound": bound, "unit": unit, "ok": measured <= bound, "text": text}


def at_least(name: str, measured: float, bound: float, unit: str | None, what: str) -> Gate:
    """A figure is no smaller than its bound."""
    text = f"{what}: {measured:.4g}{' ' * bool(unit)}{unit or ''}, at least {bound:g}"
    return {"name": name, "measured": measured, "bound": bound, "unit": unit, "ok": measured >= bound, "text": text}


def unmeasured(name: str, bound: float | bool, unit: str | None, why: str) -> Gate:
    """What this gate asks for was not looked at, or there is nothing to look at."""
    return {"name": name, "measured": None, "bound": bound, "unit": unit, "ok": None, "text": why}


def failed_gates(gates: Iterable[Gate]) -> list[str]:
    """One line for each gate that was measured and not kept."""
    return [f"gate {gate['name']} failed: {gate['text']}" for gate in gates if gate["ok"] is False]
