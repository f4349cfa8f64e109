"""Strict reading of JSON from unknown sources: every refusal names the field and its place."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from typing import Any, NoReturn

from clrecon.errors import RefusedInputError


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the field {key[:64]!r} is there twice")
        found[key] = value
    return found


def parse_json(text: str) -> Any:
    """Parse JSON strictly: no NaN, no Infinity, no field twice."""
    try:
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        raise RefusedInputError(f"line {error.lineno}, column {error.colno}: no JSON: {error.msg}") from None
    except ValueError as error:  # raised by the hooks above, or by a whole number of thousands of digits
        raise RefusedInputError(f"no JSON: {str(error)[:200]}") from None
    except RecursionError:
        raise RefusedInputError("no JSON that can be read: nested too deep") from None


def _show(value: Any) -> str:
    kinds = {dict: "an object", list: "a list", bool: "true or false", type(None): "null"}
    for kind, words in kinds.items():
        if isinstance(value, kind):
            return words
    return f"{value!r}"[:64]


def take_object(
    value: Any, where: str, known: Collection[str] | None = None, needed: Collection[str] = ()
) -> dict[str, Any]:
    """Return an object; if `known` is given, refuse other fields."""
    if not isinstance(value, dict):
        raise RefusedInputError(f"{where} is {_show(value)}, not an object")
    unknown = [key for key in value if known is not None and key not in known]
    if unknown:
        raise RefusedInputError(
            f"{where} has a field {unknown[0][:64]!r} that is not known: {', '.join(known or ())} are"
        )
    missing = [key for key in needed if key not in value]
    if missing:
        raise RefusedInputError(f"{where} has no field {missing[0]!r}")
    return value


def take_list(value: Any, where: str) -> list[Any]:
    """Return a list that is not empty."""
    if not isinstance(value, list) or not value:
        raise RefusedInputError(
            f"{where} is {'empty' if value == [] else _show(value)}, not a list with something in it"
        )
    return value


def take_number(value: Any, where: str) -> float:
    """Return a finite number."""
    try:
        number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.nan
    if not math.isfinite(number):
        raise RefusedInputError(f"{where} is {_show(value)}, not a finite number")
    return number


def take_text(value: Any, where: str) -> str:
    """Return a text."""
    if not isinstance(value, str):
        raise RefusedInputError(f"{where} is {_show(value)}, not a text")
    return value


def take_color(value: Any, where: str) -> tuple[float, float, float]:
    """Return red, green, blue from three numbers or from a text ``#rrggbb``."""
    if isinstance(value, str) and len(value) == 7 and value[0] == "#":
        try:
            digits = bytes.fromhex(value[1:])
            return digits[0] / 255, digits[1] / 255, digits[2] / 255
        except (ValueError, IndexError):
            pass
    if not isinstance(value, list) or len(value) != 3:
        raise RefusedInputError(f"{where} is {_show(value)}, not [red, green, blue] or '#rrggbb'")
    red, green, blue = (take_number(part, f"{where}[{n}]") for n, part in enumerate(value))
    return red, green, blue
