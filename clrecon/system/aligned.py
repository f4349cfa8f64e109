"""Arrays that begin at the start of a memory page."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


def aligned_empty(shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
    """Return an uninitialised C-contiguous array that begins at the start of a memory page.

    CPU drivers use the memory of such an array directly (Intel's copies any other array), and kernels may read it as
    vectors.
    """
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    raw = np.empty(size + mmap.PAGESIZE, np.uint8)
    first = -raw.ctypes.data % mmap.PAGESIZE
    return raw[first : first + size].view(dtype).reshape(shape)
