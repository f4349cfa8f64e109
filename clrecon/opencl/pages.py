"""Memory for results, used again for later results.

When a kernel first writes to a new page, the system has to find and clear it.  For the mesh of a CT series this takes
as long as computing the mesh.  Arrays made here return their pages when their last view is gone, and a later result of
the same process uses them without that delay.
"""

from __future__ import annotations

import mmap
import threading
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

BLOCK_BYTES = 1 << 21
"""Block sizes are multiples of this, the size of a huge page on most systems."""

SMALLEST_BYTES = 1 << 20
"""Smaller results come from numpy: the allocator of the C library keeps those pages itself."""

SPARE_BYTES = 1 << 28
"""Most bytes of unused pages that are kept for the next result; more go back to the system."""

LARGEST_WASTE = 2
"""A spare block serves a request only if it is at most this many times as large."""


_PRIVATE: dict[str, int] = (
    {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_ANONYMOUS") else {}  # Windows has neither
)


class _Loan(np.ndarray[Any, np.dtype[Any]]):
    """The array as which a block is lent: its views keep it alive, and when it is gone the block is free."""


class PagePool:
    """Blocks of memory that are lent as numpy arrays and return automatically.

    spare_bytes: Most bytes of unused memory that are kept.
    """

    def __init__(self, spare_bytes: int = SPARE_BYTES):
        self._spare_bytes = spare_bytes
        self._spare: list[mmap.mmap] = []
        self._lock = threading.RLock()  # a loan can end, by garbage collection, while its own thread holds the lock

    @property
    def spare_bytes(self) -> int:
        """Bytes that are free for the next result."""
        with self._lock:
            return sum(map(len, self._spare))

    def empty(self, shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
        """Return an uninitialised array, C-contiguous, aligned for every vector type."""
        dtype = np.dtype(dtype)
        count = int(np.prod(shape, dtype=object))
        size = count * dtype.itemsize
        if size < SMALLEST_BYTES:
            return np.empty(shape, dtype)
        block = self._take(size)
        # Made directly on the block: views then refer to the loan.  If the loan were a view itself, numpy would skip
        # it.
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
                self._spare.pop(0)  # unmapped when nothing refers to it

    def clear(self) -> None:
        """Give all spare memory back to the system."""
        with self._lock:
            self._spare.clear()


result_pages = PagePool()
"""The pool of this process."""
