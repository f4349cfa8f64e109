"""Arrays on a page of their own."""

from __future__ import annotations

import mmap

import numpy as np
import pytest
from refusals import refused

from clrecon.system.memory import aligned_empty


@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
@pytest.mark.parametrize("shape", [(1,), (3, 5, 7), (20, 64, 64)])
def test_arrays_begin_with_a_page(shape, dtype):
    arrays = [aligned_empty(shape, dtype) for _ in range(5)]
    for number, array in enumerate(arrays):
        assert array.shape == shape and array.dtype == dtype
        assert array.flags.c_contiguous and array.flags.writeable
        assert array.ctypes.data % mmap.PAGESIZE == 0
        array[...] = number
    assert all((array == number).all() for number, array in enumerate(arrays))


def test_more_than_there_is_is_a_memory_error():
    with refused(MemoryError, "allocate"):
        aligned_empty((2**50,), np.float64)
