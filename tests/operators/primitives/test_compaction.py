"""Scan and compaction equal their twins at every awkward size."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.opencl import download, upload
from clrecon.opencl.device import GROUP_SIZE
from clrecon.operators.primitives.scan import SCAN_PER_ITEM, compact, exclusive_scan
from clrecon.proof.volumes import volume_twins as twin

BLOCK = GROUP_SIZE * SCAN_PER_ITEM
BORDERS = (SCAN_PER_ITEM, GROUP_SIZE, BLOCK, BLOCK * GROUP_SIZE)
SIZES = sorted({1, *(border + step for border in BORDERS for step in (-1, 0, 1)), 200_003})


@pytest.mark.every_device
@pytest.mark.parametrize("n", SIZES)
def test_scan_equals_its_twin(device, n):
    counts = np.random.default_rng(n).integers(0, 50, n).astype(np.uint32)
    scanned = exclusive_scan(device, upload(device, counts), n)
    offsets, total = twin.exclusive_scan(counts)
    assert scanned.total == total == int(counts.sum())
    assert np.array_equal(download(device, np.empty(n, np.uint32), scanned.offsets_d), offsets)


@pytest.mark.parametrize("n", [1, BLOCK - 1, BLOCK + 1, 20_003])
def test_a_scan_may_take_the_place_of_its_counts(device, n):
    counts = np.random.default_rng(n).integers(0, 5, n).astype(np.uint32)
    scanned = exclusive_scan(device, upload(device, counts), n)  # writable, and counts as good as any
    again = exclusive_scan(device, scanned.offsets_d, n, in_place=True)
    assert again.offsets_d is scanned.offsets_d
    once, _ = twin.exclusive_scan(counts)
    expected, _ = twin.exclusive_scan(once)
    assert np.array_equal(download(device, np.empty(n, np.uint32), again.offsets_d), expected)


@pytest.mark.every_device
@pytest.mark.parametrize("group", [1, 16])
def test_scan_on_devices_with_small_work_groups_equals_the_twin(device, group, monkeypatch):
    monkeypatch.setattr(device, "max_work_group_size", group)
    counts = np.random.default_rng(group).integers(0, 50, 5000).astype(np.uint32)
    scanned = exclusive_scan(device, upload(device, counts), counts.size)
    offsets, total = twin.exclusive_scan(counts)
    assert scanned.total == total
    assert np.array_equal(download(device, np.empty(counts.size, np.uint32), scanned.offsets_d), offsets)


@pytest.mark.every_device
def test_a_total_beyond_32_bits_is_exact(device):
    n = 70 * BLOCK + 3  # more blocks than a work-group has items
    largest = 2**21 - 1  # the sum of a block still fits 32 bits
    counts = np.full(n, largest, np.uint32)
    scanned = exclusive_scan(device, upload(device, counts), n)
    assert scanned.total == n * largest > 2**32
    expected, _ = twin.exclusive_scan(counts)
    assert np.array_equal(download(device, np.empty(n, np.uint32), scanned.offsets_d), expected)


@pytest.mark.oclgrind
def test_scan_of_more_blocks_than_group_items_equals_the_twin(device, monkeypatch):
    """With groups of one wavefront this is a large scan; small groups make it one that a simulator can check."""
    monkeypatch.setattr(device, "max_work_group_size", 4)
    counts = np.random.default_rng(4).integers(0, 50, 4 * SCAN_PER_ITEM * 5 + 3).astype(np.uint32)
    scanned = exclusive_scan(device, upload(device, counts), counts.size)
    expected, _ = twin.exclusive_scan(counts)
    assert np.array_equal(download(device, np.empty(counts.size, np.uint32), scanned.offsets_d), expected)


@pytest.mark.parametrize(("size", "facts"), [(0, (0, "elements")), (2**32, ("scan",))])
def test_scan_of_none_or_of_more_than_32_bits_count_is_refused(device, size, facts):
    with refused(UsageError, *facts):
        exclusive_scan(device, None, size)


def test_compaction_whose_positions_need_more_than_32_bits_is_refused(device):
    with refused(UsageError, 32, "positions"):
        compact(device, None, words=2**32 // 32 + 1)


def test_twin_of_scan_sums_what_stands_before_each_count():
    offsets, total = twin.exclusive_scan(np.array([3, 0, 2, 7], np.uint32))
    assert offsets.tolist() == [0, 3, 3 + 0, 3 + 0 + 2]
    assert total == 3 + 0 + 2 + 7


def test_twin_of_compact_lists_the_places_of_bits():
    words = np.array([0b101, 0, 1 << 31], np.uint32)
    assert twin.compact(words).tolist() == [0, 2, 2 * 32 + 31]


@pytest.mark.every_device
@pytest.mark.parametrize("words", [1, 7, 8, 9, 63, 64, 65, 511, 512, 513, 40_001])
@pytest.mark.parametrize("density", [0.0, 0.02, 0.5, 1.0])
def test_compact_equals_its_twin(device, words, density):
    bits = np.random.default_rng(words).random((words, 32)) < density
    mask = np.packbits(bits, axis=1, bitorder="little").view("<u4").ravel().astype(np.uint32)
    compacted = compact(device, upload(device, mask), words)
    assert compacted.count == bits.sum()
    positions = download(device, np.empty(compacted.count, np.uint32), compacted.positions_d)
    assert np.array_equal(positions, twin.compact(mask))
