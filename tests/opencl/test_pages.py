"""The pool of result pages: lent as arrays, back when the last view is gone, never lent twice."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from refusals import refused

from clrecon.opencl.arrays import BLOCK_BYTES, SMALLEST_BYTES, PagePool

ROWS = SMALLEST_BYTES
"""Rows of arrays of three float32 that are large enough to lie in pages of the pool."""
PAGE_BYTES = 4096


def address(array) -> int:
    return int(array.ctypes.data)


def test_array_of_the_pool_is_a_writable_numpy_array_at_the_beginning_of_a_page():
    array = PagePool().empty((ROWS, 3), np.float32)
    assert type(array) is np.ndarray
    assert (array.shape, array.dtype) == ((ROWS, 3), np.float32)
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert address(array) % PAGE_BYTES == 0


def test_memory_of_an_array_is_not_lent_again_while_a_view_of_it_lives():
    pool = PagePool()
    view = pool.empty((ROWS, 3), np.float32).reshape(-1)[6:].view(np.uint32)
    gc.collect()
    assert pool.spare_bytes == 0
    view[:] = 7

    other = pool.empty((ROWS, 3), np.float32)
    other[:] = 1.0

    assert not np.shares_memory(view, other)
    assert (view == 7).all()


def test_memory_of_an_array_is_lent_again_after_its_last_view_is_gone():
    pool = PagePool()
    array = pool.empty((ROWS, 3), np.float32)
    first_address, array_bytes = address(array), array.nbytes
    view = array[6:]
    del array, view
    gc.collect()
    assert pool.spare_bytes >= array_bytes
    assert address(pool.empty((ROWS, 3), np.float32)) == first_address


def test_small_array_does_not_take_a_large_spare_block():
    pool = PagePool()
    large = pool.empty((64 * BLOCK_BYTES,), np.uint8)
    del large
    gc.collect()
    small = pool.empty((BLOCK_BYTES,), np.uint8)
    assert len(small) == BLOCK_BYTES
    assert pool.spare_bytes == 64 * BLOCK_BYTES


def pool_with_three_spare_blocks_of_five():
    pool = PagePool(spare_bytes=3 * BLOCK_BYTES)
    arrays = [pool.empty((BLOCK_BYTES,), np.uint8) for _ in range(5)]
    arrays.clear()
    gc.collect()
    return pool


def test_pool_keeps_no_more_spare_bytes_than_its_limit():
    assert pool_with_three_spare_blocks_of_five().spare_bytes == 3 * BLOCK_BYTES


def test_cleared_pool_has_no_spare_bytes():
    pool = pool_with_three_spare_blocks_of_five()
    pool.clear()
    assert pool.spare_bytes == 0


def test_empty_array_has_the_shape_that_was_asked_for():
    assert PagePool().empty((0, 3), np.float32).shape == (0, 3)


def test_small_array_has_its_own_memory_from_numpy():
    assert PagePool().empty((5, 3), np.uint32).base is None


def test_array_larger_than_the_memory_is_refused_with_its_bytes():
    with refused(MemoryError, 2**60 * 8):
        PagePool().empty((2**60,), np.float64)


def test_arrays_that_eight_threads_use_at_once_share_no_block():
    pool = PagePool()
    shared = []

    def write_and_read_back(number: int) -> None:
        for _ in range(30):
            array = pool.empty((BLOCK_BYTES,), np.uint8)
            array[::PAGE_BYTES] = number
            if (array[::PAGE_BYTES] != number).any():
                shared.append(number)

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(write_and_read_back, range(8)))  # raises what a thread raises
    assert shared == []
