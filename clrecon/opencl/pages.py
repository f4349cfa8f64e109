"""Memory for results that is used again.

A page that a process has never touched is found and cleared by the system when a kernel first writes to it: for the
mesh of a CT series this takes as long as computing it.  Arrays made here give their pages back when the last view
of them is gone, and a later result of the same process writes to them at once.
"""

from __future__ import annotations

import mmap
import threading
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["PagePool", "result_pages"]

BLOCK_BYTES = 1 << 21
"""Blocks are whole multiples of this, the size of a huge page on most systems."""

SMALLEST_BYTES = 1 << 20
"""Smaller results come from numpy: the allocator of the C library keeps such pages itself."""

SPARE_BYTES = 1 << 28
"""Unused pages kept for the next result; what is beyond goes back to the system."""

LARGEST_WASTE = 2
"""A spare block serves a request only if it is at most so many times as large."""


_PRIVATE: dict[str, int] = (
    {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_ANONYMOUS") else {}  # Windows has neither
)


class _Loan(np.ndarray[Any, np.dtype[Any]]):
    """The array that a block is lent as: views of it keep it alive, and its end says that the block is free."""


class PagePool:
    """Blocks of memory that are lent as numpy arrays and come back by themselves.

    Parameters
    ----------
    spare_bytes : int
        How much unused memory is kept at most.
    """

    def __init__(self, spare_bytes: int = SPARE_BYTES):
        self._spare_bytes = spare_bytes
        self._spare: list[mmap.mmap] = []
        self._lock = threading.RLock()  # a loan can end, by garbage collection, while its thread holds the lock

    @property
    def spare_bytes(self) -> int:
        """Bytes that wait for the next result."""
        with self._lock:
            return sum(map(len, self._spare))

    def empty(self, shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
        """Return an uninitialised array, C-contiguous, at an address that suits every vector type.

        Raises
        ------
        MemoryError
            The system does not give that much.
        """
        dtype = np.dtype(dtype)
        count = int(np.prod(shape, dtype=object))
        size = count * dtype.itemsize
        if size < SMALLEST_BYTES:
            return np.empty(shape, dtype)
        block = self._take(size)
        # Made on the block itself: a view then refers to the loan, where numpy would pass over a loan that is a view.
        loan = _Loan(tuple(shape), dtype, buffer=block)
        weakref.finalize(loan, self._give_back, block).atexit = False
        return loan.view(np.ndarray)

    def _take(self, size: int) -> mmap.mmap:
        with self._lock:
            fitting = [block for block in self._spare if size <= len(block) <= LARGEST_WASTE * size]
            if fitting:
                block = min(fitting, key=len)
                self._spare.remove(block)
                return block
        try:
            block = mmap.mmap(-1, -(-size // BLOCK_BYTES) * BLOCK_BYTES, **_PRIVATE)
        except (OSError, OverflowError) as error:
            raise MemoryError(f"{size:,} bytes cannot be had: {error}") from error
        if hasattr(mmap, "MADV_HUGEPAGE"):
            try:
                block.madvise(mmap.MADV_HUGEPAGE)
            except OSError:  # a kernel without huge pages
                pass
        return block

    def _give_back(self, block: mmap.mmap) -> None:
        with self._lock:
            self._spare.append(block)
            while sum(map(len, self._spare)) > self._spare_bytes:
                self._spare.pop(0)  # unmapped once nothing refers to it

    def clear(self) -> None:
        """Give all spare memory back to the system."""
        with self._lock:
            self._spare.clear()


result_pages = PagePool()
"""The pool of this process."""
