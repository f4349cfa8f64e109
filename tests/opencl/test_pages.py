"""The pool of result pages: lent as arrays, back when the last view is gone, never lent twice."""

from __future__ import annotations

import gc
import threading

import numpy as np
from refusals import refused

from clrecon.opencl.arrays import BLOCK_BYTES, SMALLEST_BYTES, PagePool

ROWS = SMALLEST_BYTES


def address(array) -> int:
    return int(array.ctypes.data)


def test_arrays_are_plain_and_aligned():
    array = PagePool().empty((ROWS, 3), np.float32)
    assert type(array) is np.ndarray
    assert array.shape == (ROWS, 3) and array.dtype == np.float32
    assert array.flags.c_contiguous and array.flags.writeable
    assert address(array) % 4096 == 0


def test_memory_comes_back_with_the_last_view():
    pool = PagePool()
    array = pool.empty((ROWS, 3), np.float32)
    at = address(array)
    view = array.reshape(-1)[6:].view(np.uint32)
    del array
    gc.collect()
    assert pool.spare_bytes == 0
    other = pool.empty((ROWS, 3), np.float32)
    assert address(other) != at
    view[:] = 7
    other[:] = 1.0
    assert (view == 7).all()
    del view
    gc.collect()
    assert pool.spare_bytes >= ROWS * 12
    assert address(pool.empty((ROWS, 3), np.float32)) == at


def test_a_small_result_does_not_take_a_large_block():
    pool = PagePool()
    array = pool.empty((64 * BLOCK_BYTES,), np.uint8)
    del array
    gc.collect()
    small = pool.empty((BLOCK_BYTES,), np.uint8)
    assert pool.spare_bytes == 64 * BLOCK_BYTES
    assert len(small) == BLOCK_BYTES


def test_no_more_than_the_limit_is_kept():
    pool = PagePool(spare_bytes=3 * BLOCK_BYTES)
    arrays = [pool.empty((BLOCK_BYTES,), np.uint8) for _ in range(5)]
    arrays.clear()
    gc.collect()
    assert pool.spare_bytes == 3 * BLOCK_BYTES
    pool.clear()
    assert pool.spare_bytes == 0


def test_small_and_empty_arrays_are_numpys_own():
    pool = PagePool()
    assert pool.empty((0, 3), np.float32).shape == (0, 3)
    assert pool.empty((5, 3), np.uint32).base is None


def test_more_than_there_is_is_a_memory_error():
    with refused(MemoryError, 9223372036854775808):
        PagePool().empty((2**60,), np.float64)


def test_threads_never_share_a_block():
    pool = PagePool()
    wrong = []

    def work(number: int) -> None:
        for _ in range(30):
            array = pool.empty((BLOCK_BYTES,), np.uint8)
            array[::4096] = number
            if (array[::4096] != number).any():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
