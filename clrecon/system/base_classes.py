"""Bases of classes: objects that are closed at the end of a ``with`` block, and messages.

Messages can be sent to other processes, as those of a batch are, without losing anything.  pickle makes read-only
arrays writeable; the read-only arrays of a `Message` stay read-only in every copy.  pickle also reads a memory-mapped
file into memory; a `MappedArray` is sent as its place in the file, which the receiver maps again, read-only.  The file
belongs to whoever mapped it and must exist until then; clrecon itself maps no files.  The values themselves are sent
where the file has been removed or replaced before the message is sent, and for mappings whose changes stay private
(numpy's mode "c")."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.system.memory import FilePlace, Mapping

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


class Message:
    """Base of classes with a ``__dict__`` whose objects pickle and copy as this module says."""

    _UNSENT: ClassVar[tuple[str, ...]] = ()
    """Names of attributes that are not sent; they are computed again when they are asked for."""

    def __getstate__(self) -> dict[str, object]:
        return {name: _pack(value) for name, value in vars(self).items() if name not in self._UNSENT}

    def __setstate__(self, state: dict[str, object]) -> None:
        unpacked = {name: value.array if isinstance(value, _Packed) else value for name, value in state.items()}
        vars(self).update(unpacked)


class _Packed:
    """A read-only array while it is being sent; unpickled it is a plain array."""

    def __init__(self, array: NDArray[Any]):
        self.array = array

    def __reduce__(self) -> tuple[Callable[..., NDArray[Any]], tuple[object, ...]]:
        return _receive, (self.array, self.array.flags.writeable)

    def __deepcopy__(self, memo: dict[int, Any]) -> _Packed:
        return _Packed(_receive(self.array.copy(), self.array.flags.writeable))


class MappedArray(_Packed):
    """An array in a memory-mapped file while it is sent; a deep copy shares a read-only mapping and copies others."""

    def __init__(self, array: NDArray[Any], mapping: Mapping):
        super().__init__(array)
        self.mapping = mapping

    def __reduce__(self) -> tuple[Callable[..., NDArray[Any]], tuple[object, ...]]:
        file_place = self.mapping.place(self.array)
        return super().__reduce__() if file_place is None else (FilePlace.open, (file_place,))

    def __deepcopy__(self, memo: dict[int, Any]) -> _Packed:
        return super().__deepcopy__(memo) if self.mapping.writeable else self


def _pack(value: object) -> object:
    return _Packed(value) if isinstance(value, np.ndarray) and not value.flags.writeable else value


def _receive(array: NDArray[Any], writeable: bool) -> NDArray[Any]:
    if not writeable:  # a received array is writeable, and numpy may refuse to set that anew
        array.flags.writeable = False
    return array
