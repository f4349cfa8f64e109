"""Voxels in a memory-mapped file: which of their pages stay in memory."""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Mapping", "find_mapping"]


@dataclass(frozen=True)
class Mapping:
    """A file mapping, and the address in memory that it begins at."""

    file: mmap.mmap
    address: int

    def release(self, part: NDArray[Any]) -> None:
        """Let the whole pages of `part`, a C-contiguous view of the mapping, leave memory.

        They stay in the system's file cache as long as it has room, and are read again when they are used.
        """
        begin = part.ctypes.data - self.address
        first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
        end = (begin + part.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE
        if end > first and hasattr(mmap, "MADV_DONTNEED"):
            self.file.madvise(mmap.MADV_DONTNEED, first, end - first)


def find_mapping(array: NDArray[Any]) -> Mapping | None:
    """Return the file mapping that `array` is a view of, None where its values are ordinary memory.

    Only a `numpy.memmap` that is shared with its file is taken: what was written to any other mapping would be lost.
    """
    owner: Any = array
    while isinstance(owner, np.ndarray):
        base: Any = owner.base
        if isinstance(owner, np.memmap) and isinstance(base, mmap.mmap):
            shared = owner.mode != "c"
            return Mapping(base, np.frombuffer(base, np.uint8, 1).ctypes.data) if shared else None
        owner = base
    return None
