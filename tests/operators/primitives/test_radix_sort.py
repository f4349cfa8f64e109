"""The sort equals its twin and keeps equal keys in their order, in both forms of its kernels."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.opencl import download, upload
from clrecon.operators.primitives.scan import (
    FEWEST_PER_CHUNK,
    RADIX_BITS,
    _plan_digits,
    exclusive_scan,
    radix_sort,
    sort_bytes,
)
from clrecon.proof.volumes import volume_twins as twin

CHUNK = FEWEST_PER_CHUNK
SIZES = sorted({1, 2, *(border + step for border in (64, 1024, CHUNK, 2 * CHUNK) for step in (-1, 0, 1)), 90_001})


def check_sorted(device, keys, bits=32, **chunks):
    keys_d = upload(device, keys)
    made = radix_sort(device, keys_d, len(keys), bits=bits, **chunks)
    sorted_keys, values = twin.radix_sort(keys)
    assert np.array_equal(download(device, np.empty(len(keys), np.uint32), made.keys_d), sorted_keys)
    assert np.array_equal(download(device, np.empty(len(keys), np.uint32), made.values_d), values)
    assert np.array_equal(download(device, np.empty(len(keys), np.uint32), keys_d), keys)


@pytest.fixture(params=["own form", "other form"])
def form(request, device, monkeypatch):
    """Both forms of the kernels on every device."""
    if request.param == "other form":
        lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
        monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})


@pytest.mark.parametrize("n", SIZES)
def test_random_keys_of_all_bits_are_sorted(device, form, n):
    check_sorted(device, np.random.default_rng(n).integers(0, 2**32, n, dtype=np.uint32))


@pytest.mark.parametrize("bits", [0, 1, 2, RADIX_BITS - 1, RADIX_BITS, RADIX_BITS + 1, 21, 22, 23, 31, 32])
def test_keys_of_few_bits_are_sorted_stably(device, form, bits):
    keys = np.random.default_rng(bits).integers(0, 2**bits, 9001, dtype=np.uint32)
    keys[::3] = keys[0]
    check_sorted(device, keys, bits)


@pytest.mark.parametrize("order", ["ascending", "descending", "equal", "greatest"])
def test_keys_in_order_or_equal_are_sorted(device, form, order):
    keys = {
        "ascending": np.arange(12_345, dtype=np.uint32),
        "descending": np.arange(12_345, dtype=np.uint32)[::-1].copy(),
        "equal": np.full(12_345, 77, np.uint32),
        "greatest": np.full(12_345, 2**32 - 1, np.uint32),
    }[order]
    check_sorted(device, keys)


@pytest.mark.oclgrind
def test_keys_in_several_small_chunks_are_sorted(device, form):
    """Chunks of 100 elements: a simulator can check many of them."""
    check_sorted(device, np.random.default_rng(5).integers(0, 40, 1234, dtype=np.uint32), 6, fewest=100)
    check_sorted(device, np.random.default_rng(6).integers(0, 2**13, 633, dtype=np.uint32), 13, fewest=100)


@pytest.mark.parametrize("group", daily(1, [1, 16]))
def test_keys_are_sorted_on_devices_with_small_work_groups(device, form, group, monkeypatch):
    monkeypatch.setattr(device, "max_work_group_size", group)
    check_sorted(device, np.random.default_rng(group).integers(0, 500, 5000, dtype=np.uint32), 9)


def test_fewer_bits_take_fewer_passes():
    assert _plan_digits(11) == [(0, 11)]
    assert _plan_digits(12) == [(0, 6), (6, 6)]
    assert _plan_digits(32) == [(0, 10), (10, 11), (21, 11)]
    assert [sum(width for _, width in _plan_digits(bits)) for bits in range(1, 33)] == list(range(1, 33))


def test_the_forecast_counts_keys_values_and_tables(device):
    table = 4 << RADIX_BITS
    assert sort_bytes(device, CHUNK, 11) == 8 * CHUNK + table
    assert sort_bytes(device, CHUNK, 12) == 16 * CHUNK + table


def test_what_cannot_be_sorted_is_refused(device):
    with refused(UsageError, 0, 1, 2147483648):
        radix_sort(device, None, 0)
    with refused(UsageError, 33, 0, 32):
        radix_sort(device, None, 1, bits=33)


@pytest.mark.every_device
def test_many_keys_are_sorted_where_work_items_end_early(device):
    """Shares of a core would be longer than llvmpipe's loops: they were sorted wrongly, without a word."""
    if device.most_steps is None:
        pytest.skip("work-items of this device do not end early")
    check_sorted(device, np.random.default_rng(7).integers(0, 2**32, 70 * device.most_steps, dtype=np.uint32))


@pytest.mark.parametrize("bits", [RADIX_BITS, RADIX_BITS + 1, 2 * RADIX_BITS + 1])
def test_buffers_are_as_long_as_the_keys(device, bits):
    """Of one, two and three passes, which take turns in two pairs of buffers."""
    keys = np.random.default_rng(bits).integers(0, 2**bits, 1000, dtype=np.uint32)
    made = radix_sort(device, upload(device, keys), 1000, bits=bits)
    offsets_d = exclusive_scan(device, made.keys_d, 1000).offsets_d
    assert [made.keys_d.size, made.values_d.size, offsets_d.size] == [4000] * 3
