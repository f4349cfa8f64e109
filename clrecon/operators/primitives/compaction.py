"""Exclusive scan and stream compaction: the two words that the other operators are written with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    download,
    launch,
    load_program,
)

__all__ = ["Compacted", "Scanned", "compact", "exclusive_scan", "prepare_scan"]

SCAN_PER_ITEM = 16
"""Elements a work-item of cl/compaction/scan.cl."""

LARGEST_SCAN = 2**31
LARGEST_MASK = 2**27

COMPACT_WORDS = 8
"""Words a work-item of cl/compaction/compact.cl."""


@dataclass(frozen=True)
class Scanned:
    """Offsets on the device, (n,) uint32, and the exact total.  Offsets are modulo 2^32: check the total.

    ``total_d`` is the total on the device, (1,) uint64.
    """

    offsets_d: Any
    total_d: Any
    total: int


@dataclass(frozen=True)
class Compacted:
    """Positions of the set bits on the device, (count,) uint32, ascending."""

    positions_d: Any
    count: int


def prepare_scan(device: Device) -> None:
    """Build the kernels of `exclusive_scan`."""
    _load_scan(device)


def _load_scan(device: Device) -> Program:
    return load_program(device, "compaction/scan.cl", {"SCAN_GROUP": str(device.group_size)})


def exclusive_scan(
    device: Device, counts_d: Any, n: int, *, in_place: bool = False, stopwatch: Stopwatch | None = None
) -> Scanned:
    """Sum of all counts before each element.

    Parameters
    ----------
    device : Device
    counts_d : buffer, (n,) uint32
    n : int
        Elements, at least 1.
    in_place : bool
        The offsets take the place of the counts: no memory of their own.
    stopwatch : Stopwatch, optional

    Returns
    -------
    Scanned

    Raises
    ------
    UsageError
        `n` is out of range.
    DeviceError
        The device fails.
    """
    if not 1 <= n <= LARGEST_SCAN:
        raise UsageError(f"{n:,} elements: a scan takes 1 to {LARGEST_SCAN:,}")
    scan = _load_scan(device)
    blocks = -(-n // (SCAN_PER_ITEM * device.group_size))
    sums_d, block_offsets_d, total_d = (allocate(device, 4 * blocks), allocate(device, 4 * blocks), allocate(device, 8))
    offsets_d = counts_d if in_place else allocate(device, 4 * n)
    items = blocks * device.group_size
    launch(device, scan["sum_blocks"], items, stopwatch=stopwatch, counts=counts_d, block_sums=sums_d, n=n)
    launch(
        device, scan["scan_block_sums"], device.group_size, stopwatch=stopwatch,
        block_sums=sums_d, block_offsets=block_offsets_d, total=total_d, blocks=blocks,
    )  # fmt: skip
    launch(
        device, scan["scan_blocks"], items, stopwatch=stopwatch,
        counts=counts_d, block_offsets=block_offsets_d, offsets=offsets_d, n=n,
    )  # fmt: skip
    total = download(device, np.empty(1, dtype=np.uint64), total_d)
    return Scanned(offsets_d, total_d, int(total[0]))


def compact(device: Device, mask_d: Any, words: int, *, stopwatch: Stopwatch | None = None) -> Compacted:
    """Positions of the set bits of a bit mask.

    Parameters
    ----------
    device : Device
    mask_d : buffer, (words,) uint32
        Bit b of word w is position ``32 * w + b``.
    words : int
        At least 1, at most 2^27, so that positions fit 32 bits.
    stopwatch : Stopwatch, optional

    Returns
    -------
    Compacted

    Raises
    ------
    UsageError
        `words` is out of range.
    DeviceError
        The device fails.
    """
    if not 1 <= words <= LARGEST_MASK:
        raise UsageError(f"{words:,} words: a mask has 1 to {LARGEST_MASK:,}, so that positions fit 32 bits")
    program = load_program(device, "compaction/compact.cl")
    chunks = -(-words // COMPACT_WORDS)
    counts_d = allocate(device, 4 * chunks)
    launch(
        device, program["count_set_bits"], chunks, stopwatch=stopwatch, mask=mask_d, counts=counts_d, words=words
    )  # fmt: skip
    scanned = exclusive_scan(device, counts_d, chunks, stopwatch=stopwatch)
    positions_d = allocate(device, 4 * scanned.total)
    launch(
        device, program["list_set_bits"], chunks, stopwatch=stopwatch,
        mask=mask_d, offsets=scanned.offsets_d, positions=positions_d, words=words,
    )  # fmt: skip
    return Compacted(positions_d, scanned.total)
