"""Objects that are closed at the end of a ``with`` block."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from types import TracebackType

Opened = TypeVar("Opened", bound="Closing")


class Closing:
    """Base of classes with a `close` method: a ``with`` block gives the object itself and closes it."""

    def close(self) -> None:
        """Free what the object holds."""
        raise NotImplementedError

    def __enter__(self: Opened) -> Opened:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
