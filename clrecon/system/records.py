"""Records: results as frozen dataclasses with typed fields, which are also the entries of JSON reports.

A record is also a read-only dict: code that used results as dicts (``quality["closed"]``, ``json.dumps(report)``) works
until version 1.0. `Record.as_dict` returns a dict that can be changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, ClassVar, NoReturn, TypeVar

Own = TypeVar("Own", bound="Record")


class Record(dict[str, Any]):
    """Base of frozen dataclasses; they are made with ``eq=False``, because records compare as dicts do."""

    _LEFT_OUT: ClassVar[tuple[str, ...]] = ()
    """Names of fields that are left out of the entries where they are None."""

    def __post_init__(self) -> None:
        dict.update(self, self._entries())

    def _entries(self) -> dict[str, Any]:
        """The entries in their order: the fields."""
        own = _fields_of(self)
        return {name: value for name, value in own.items() if value is not None or name not in self._LEFT_OUT}

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


def _fields_of(record: Record) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}  # type: ignore[arg-type]


def _restore(kind: Callable[..., Record], values: Mapping[str, Any]) -> Record:
    return kind(**values)


def _as_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _as_plain(entry) for name, entry in value.items()}
    return [_as_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
