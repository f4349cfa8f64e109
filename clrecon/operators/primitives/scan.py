"""Exclusive scan, the sums of all counts before each: the host's side of cl/primitives/scan.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch, allocate, download, kernel_constant, launch, load_program

SCAN_PER_ITEM = kernel_constant("primitives/scan.cl", "SCAN_PER_ITEM")
"""Elements a work-item."""

LARGEST_SCAN = 2**31


@dataclass(frozen=True)
class Scanned:
    """Offsets on the device, (n,) uint32, and the exact total.  Offsets are modulo 2^32, so check the total.

    ``total_d`` is the total on the device, (1,) uint64.
    """

    offsets_d: Any
    total_d: Any
    total: int


def prepare_scan(device: Device) -> None:
    """Build the kernels of `exclusive_scan`."""
    _load_scan(device)


def _load_scan(device: Device) -> Program:
    return load_program(device, "primitives/scan.cl", {"SCAN_GROUP": str(device.group_size)})


def exclusive_scan(
    device: Device, counts_d: Any, n: int, *, in_place: bool = False, stopwatch: Stopwatch | None = None
) -> Scanned:
    """Compute the sum of all counts before each element.

    counts_d: buffer, (n,) uint32
    n: Number of elements, at least 1.
    in_place: The offsets overwrite the counts and need no memory of their own.
    """
    _check_size(n)
    offsets_d = counts_d if in_place else allocate(device, 4 * n)
    total_d = enqueue_scan(device, counts_d, offsets_d, n, stopwatch=stopwatch)
    total = download(device, np.empty(1, dtype=np.uint64), total_d)
    return Scanned(offsets_d, total_d, int(total[0]))


def _check_size(n: int) -> None:
    if not 1 <= n <= LARGEST_SCAN:
        raise UsageError(f"{n:,} elements: a scan takes 1 to {LARGEST_SCAN:,}")


def enqueue_scan(device: Device, counts_d: Any, offsets_d: Any, n: int, *, stopwatch: Stopwatch | None = None) -> Any:
    """Enqueue the same for offsets in a buffer that is there, which may be that of the counts.

    Returns:
    total_d: buffer, (1,) uint64. The exact total; nothing is waited for.
    """
    _check_size(n)
    scan = _load_scan(device)
    blocks = -(-n // (SCAN_PER_ITEM * device.group_size))
    sums_d, block_offsets_d, total_d = (allocate(device, 4 * blocks), allocate(device, 4 * blocks), allocate(device, 8))
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
    return total_d
