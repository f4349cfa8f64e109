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


def check_sorted(device, keys, *, bits=32, **chunks):
    """Sorted keys and their former places equal the twin's, and the keys themselves stay."""
    keys_d = upload(device, keys)
    made = radix_sort(device, keys_d, len(keys), bits=bits, **chunks)
    sorted_keys, values = twin.radix_sort(keys)
    assert np.array_equal(download(device, np.empty(len(keys), np.uint32), made.keys_d), sorted_keys)
    assert np.array_equal(download(device, np.empty(len(keys), np.uint32), made.values_d), values)
    assert np.array_equal(download(device, np.empty(len(keys), np.uint32), keys_d), keys)


@pytest.fixture(params=["own form", "other form"])
def kernel_form(request, device, monkeypatch):
    """Both forms of the kernels on every device: for CPUs, and for GPUs."""
    if request.param == "other form":
        lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
        monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})


@pytest.mark.parametrize("n", SIZES)
def test_random_keys_of_all_bits_are_sorted(device, kernel_form, n):
    check_sorted(device, np.random.default_rng(n).integers(0, 2**32, n, dtype=np.uint32))


@pytest.mark.parametrize("bits", [0, 1, 2, RADIX_BITS - 1, RADIX_BITS, RADIX_BITS + 1, 21, 22, 23, 31, 32])
def test_keys_of_few_bits_are_sorted_stably(device, kernel_form, bits):
    keys = np.random.default_rng(bits).integers(0, 2**bits, 9001, dtype=np.uint32)
    keys[::3] = keys[0]
    check_sorted(device, keys, bits=bits)


@pytest.mark.parametrize("order", ["ascending", "descending", "equal", "greatest"])
def test_keys_in_order_or_equal_are_sorted(device, kernel_form, order):
    keys = {
        "ascending": np.arange(12_345, dtype=np.uint32),
        "descending": np.arange(12_345, dtype=np.uint32)[::-1].copy(),
        "equal": np.full(12_345, 77, np.uint32),
        "greatest": np.full(12_345, 2**32 - 1, np.uint32),
    }[order]
    check_sorted(device, keys)


@pytest.mark.oclgrind
@pytest.mark.parametrize(("keys", "bits"), [(1234, 6), (633, 13)])
def test_keys_in_several_chunks_of_100_are_sorted(device, kernel_form, keys, bits):
    check_sorted(device, np.random.default_rng(bits).integers(0, 2**bits, keys, dtype=np.uint32), bits=bits, fewest=100)


@pytest.mark.parametrize("group", daily(1, [1, 16]))
def test_keys_are_sorted_on_devices_with_small_work_groups(device, kernel_form, group, monkeypatch):
    monkeypatch.setattr(device, "max_work_group_size", group)
    check_sorted(device, np.random.default_rng(group).integers(0, 2**9, 5000, dtype=np.uint32), bits=9)


@pytest.mark.parametrize(
    ("bits", "digits"),
    [(11, [(0, 11)]), (12, [(0, 6), (6, 6)]), (32, [(0, 10), (10, 11), (21, 11)])],
    ids=["one pass", "two passes", "three passes"],
)
def test_bits_of_keys_are_shared_by_as_few_digits_of_up_to_11_bits_as_hold_them(bits, digits):
    """Each digit begins at a bit and has so many."""
    assert RADIX_BITS == 11
    assert _plan_digits(bits) == digits


@pytest.mark.parametrize("bits", range(1, 33))
def test_digits_have_all_bits_of_their_keys(bits):
    assert sum(width for _, width in _plan_digits(bits)) == bits


@pytest.mark.parametrize(("bits", "pairs"), [(RADIX_BITS, 1), (RADIX_BITS + 1, 2)], ids=["one pass", "two passes"])
def test_forecast_of_a_sort_counts_pairs_of_keys_and_values_and_a_table(device, bits, pairs):
    """Of several passes each reads one pair of buffers and writes another."""
    table = 4 * 2**RADIX_BITS
    assert sort_bytes(device, CHUNK, bits) == pairs * (4 + 4) * CHUNK + table


def test_sort_of_no_keys_is_refused_with_the_numbers_allowed(device):
    with refused(UsageError, 0, 1, 2**31):
        radix_sort(device, None, 0)


def test_sort_of_more_bits_than_keys_have_is_refused(device):
    with refused(UsageError, 33, 0, 32):
        radix_sort(device, None, 1, bits=33)


@pytest.mark.every_device
def test_many_keys_are_sorted_where_work_items_end_early(device):
    """Shares of a core would be longer than llvmpipe's loops: they were sorted wrongly, without a word."""
    if device.most_steps is None:
        pytest.skip("work-items of this device do not end early")
    check_sorted(device, np.random.default_rng(7).integers(0, 2**32, 70 * device.most_steps, dtype=np.uint32))


@pytest.mark.parametrize("bits", [RADIX_BITS, RADIX_BITS + 1, 2 * RADIX_BITS + 1])
def test_buffers_of_a_sort_are_as_long_as_its_keys(device, bits):
    """Of one, two and three passes, which take turns in two pairs of buffers."""
    keys = np.random.default_rng(bits).integers(0, 2**bits, 1000, dtype=np.uint32)
    made = radix_sort(device, upload(device, keys), 1000, bits=bits)
    offsets_d = exclusive_scan(device, made.keys_d, 1000).offsets_d
    assert [made.keys_d.size, made.values_d.size, offsets_d.size] == [4 * 1000] * 3
