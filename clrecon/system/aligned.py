"""Arrays that begin with a page of memory."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["aligned_empty"]


def aligned_empty(shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
    """Return an uninitialised C-contiguous array whose first value is the first of a page.

    CPU drivers use such an array in place (Intel's copies any other), and kernels may read it as vectors.

    Raises
    ------
    MemoryError
        The system does not give that much.
    """
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    raw = np.empty(size + mmap.PAGESIZE, np.uint8)
    first = -raw.ctypes.data % mmap.PAGESIZE
    return raw[first : first + size].view(dtype).reshape(shape)
