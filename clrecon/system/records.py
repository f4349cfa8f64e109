"""Records: results as frozen dataclasses with typed fields, which are also the entries of JSON reports; and gates.

A record is also a read-only dict: code that used results as dicts (``quality["closed"]``, ``json.dumps(report)``) works
until version 1.0. A gate is a record of a measured figure, its bound, and whether the figure keeps the bound; of meshes
and of volumes they have the same form.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NoReturn, TypeVar

from clrecon.system.light_dataclass import dataclass, fields, replace
from clrecon.system.text import count_of

Own = TypeVar("Own", bound="Record")


class Record(dict[str, Any]):
    """Base of frozen dataclasses; they are made with ``eq=False``, because records compare as dicts do."""

    _LEFT_OUT: ClassVar[tuple[str, ...]] = ()
    """Names of fields that are left out of the entries where they are None."""

    def __post_init__(self) -> None:
        dict.update(self, self._entries())

    def _entries(self) -> dict[str, Any]:
        own_entries = _fields_of(self)
        return {name: value for name, value in own_entries.items() if value is not None or name not in self._LEFT_OUT}

    def as_dict(self) -> dict[str, Any]:
        """Return the entries as a new dict, with records inside as dicts too: the form of reports."""
        return {name: _as_plain(value) for name, value in self.items()}

    def changed(self: Own, **changes: Any) -> Own:
        """Return a copy with other values in some fields."""
        return replace(self, **changes)  # type: ignore[type-var]

    def __reduce__(self) -> tuple[Callable[..., Record], tuple[object, ...]]:
        return _restore, (type(self), _fields_of(self))

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError(f"a {type(self).__name__} cannot be changed: as_dict() gives a dict that can")

    __setitem__ = __delitem__ = __ior__ = _refuse  # type: ignore[assignment]
    clear = pop = popitem = setdefault = update = _refuse  # type: ignore[assignment]


def name_schema(schema: str, entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a JSON object with its schema, docs/schemas/`schema`.json, as the first."""
    return {"schema": f"clrecon-{schema}-1", **entries}


def _fields_of(record: Record) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}  # type: ignore[arg-type]


def _restore(kind: Callable[..., Record], values: Mapping[str, Any]) -> Record:
    return kind(**values)


def _as_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _as_plain(entry) for name, entry in value.items()}
    return [_as_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True, eq=False)
class Gate(Record):
    """A figure and its bound, in `unit` or None, in a line of `text`; `measured` and `ok` are None if not measured."""

    name: str
    measured: float | bool | None
    bound: float | bool
    unit: str | None
    ok: bool | None
    text: str


def none_of(name: str, count: int, subject: str, ok: bool | None = None) -> Gate:
    """Gate: a count must be 0.  Where `ok` is given, it decides instead of the count."""
    ok = count == 0 if ok is None else ok
    return Gate(name, count, 0, None, bool(ok), f"{subject}: {count}, none allowed")


def is_true(name: str, flag: bool, subject: str) -> Gate:
    says = subject if flag else f"this does not hold: {subject}"
    return Gate(name, bool(flag), True, None, bool(flag), says)


def at_most(name: str, measured: float, bound: float, unit: str | None, subject: str) -> Gate:
    text = f"{subject}: {_say_figure(measured, bound, 3)}{' ' * bool(unit)}{unit or ''}, at most {bound:.3g}"
    return Gate(name, measured, bound, unit, measured <= bound, text)


def at_least(name: str, measured: float, bound: float, unit: str | None, subject: str) -> Gate:
    text = f"{subject}: {_say_figure(measured, bound, 4)}{' ' * bool(unit)}{unit or ''}, at least {bound:g}"
    return Gate(name, measured, bound, unit, measured >= bound, text)


def _say_figure(measured: float, bound: float, digits: int) -> str:
    """Return a figure with as many digits as tell it from its bound, `digits` at least."""
    while measured != bound and digits < 17 and f"{measured:.{digits}g}" == f"{bound:.{digits}g}":
        digits += 1
    return f"{measured:.{digits}g}"


def unmeasured(name: str, bound: float | bool, unit: str | None, why: str) -> Gate:
    """Gate whose figure was not measured, or for which there is nothing to measure."""
    return Gate(name, None, bound, unit, None, why)


def failed_gates(gates: Iterable[Mapping[str, Any]]) -> list[str]:
    return [f"gate {gate['name']} failed: {gate['text']}" for gate in gates if gate["ok"] is False]


def describe_volume(volume: Mapping[str, Any]) -> str:
    """Describe a volume in one line, from its report."""
    parts = []
    if volume.get("shape_ijk"):
        ni, nj, nk = volume["shape_ijk"]
        parts.append(f"{count_of(nk, 'slice')} of {ni} x {nj}")
    if volume.get("spacing_mm"):
        di, dj, dk = volume["spacing_mm"]
        gaps = volume["gap_mm"]
        along = f", uneven gaps of {gaps['min']:.4g} to {gaps['max']:.4g}" if volume["uneven"] else f" x {dk:.4g}"
        parts.append(f"spacing {di:.4g} x {dj:.4g}{along} mm")
    if volume.get("tilt_deg") and abs(volume["tilt_deg"]) >= 0.05:
        parts.append(f"tilt {volume['tilt_deg']:+.2f} degrees")
    return ", ".join(parts)
