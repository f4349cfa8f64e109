"""Arrays on a page of their own."""

from __future__ import annotations

import mmap
from itertools import combinations

import numpy as np
import pytest
from refusals import refused

from clrecon.system.memory import aligned_empty


@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
@pytest.mark.parametrize("shape", [(1,), (3, 5, 7), (20, 64, 64)])
def test_aligned_array_is_writable_with_shape_and_type_and_begins_with_a_page(shape, dtype):
    array = aligned_empty(shape, dtype)
    assert (array.shape, array.dtype) == (shape, dtype)
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert array.ctypes.data % mmap.PAGESIZE == 0


@pytest.mark.parametrize("shape", [(1,), (3, 5, 7), (20, 64, 64)])
def test_aligned_arrays_share_no_memory(shape):
    arrays = [aligned_empty(shape, "int16") for _ in range(5)]
    assert not any(np.shares_memory(first, second) for first, second in combinations(arrays, 2))


def test_aligned_array_larger_than_the_memory_is_refused():
    with refused(MemoryError, "allocate"):
        aligned_empty((2**50,), np.float64)
