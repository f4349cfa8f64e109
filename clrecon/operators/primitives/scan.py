"""Exclusive scans, and what they make possible: compaction of set bits, and a stable sort of 32-bit keys that carry the
number of their element.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, allocate, download, kernel_constant, launch, load_program
from clrecon.system.light_dataclass import dataclass

SCAN_PER_ITEM = kernel_constant("primitives/scan.cl", "SCAN_PER_ITEM")
"""Elements a work-item."""

LARGEST_SCAN = 2**31


class BitRows:
    """A grid with a bit for each of (nx, ny, nz) places, rows along x of whole words of 32 bits."""

    if TYPE_CHECKING:  # a field of some grids, a property of others

        @property
        def shape(self) -> tuple[int, int, int]:
            raise NotImplementedError

    @property
    def words(self) -> int:
        return -(-self.shape[0] // 32)

    @property
    def rows(self) -> int:
        return self.shape[1] * self.shape[2]

    @property
    def total_words(self) -> int:
        return self.words * self.rows


@dataclass(frozen=True)
class Scanned:
    """Offsets on the device, (n,) uint32, modulo 2^32, and the exact total, to be checked, there (1,) uint64."""

    offsets_d: Any
    total_d: Any
    total: int


def prepare_scan(device: Device) -> Program:
    return load_program(device, "primitives/scan.cl", {"SCAN_GROUP": str(device.group_size)})


def exclusive_scan(device: Device, counts_d: Any, n: int, *, in_place: bool = False) -> Scanned:
    """Compute the sum of all counts, (n,) uint32, before each element; with `in_place` over the counts."""
    _check_size(n)
    offsets_d = counts_d if in_place else allocate(device, 4 * n)
    total_d = enqueue_scan(device, counts_d, offsets_d, n)
    return Scanned(offsets_d, total_d, int(download(device, np.empty(1, dtype=np.uint64), total_d)[0]))


def _check_size(n: int) -> None:
    if not 1 <= n <= LARGEST_SCAN:
        raise UsageError(f"{n:,} elements: a scan takes 1 to {LARGEST_SCAN:,}")


def enqueue_scan(device: Device, counts_d: Any, offsets_d: Any, n: int) -> Any:
    """Enqueue the same into offsets, or the counts, and wait for nothing; return the exact total, (1,) uint64."""
    _check_size(n)
    scan = prepare_scan(device)
    blocks = -(-n // (SCAN_PER_ITEM * device.group_size))
    sums_d, block_offsets_d = allocate(device, 4 * blocks), allocate(device, 4 * blocks)
    total_d = allocate(device, 8)
    items = blocks * device.group_size
    launch(device, scan["sum_blocks"], items, counts=counts_d, block_sums=sums_d, n=n)
    launch(
        device, scan["scan_block_sums"], device.group_size,
        block_sums=sums_d, block_offsets=block_offsets_d, total=total_d, blocks=blocks,
    )  # fmt: skip
    launch(device, scan["scan_blocks"], items, counts=counts_d, block_offsets=block_offsets_d, offsets=offsets_d, n=n)
    return total_d


_LARGEST_MASK = 2**27

COMPACT_WORDS = kernel_constant("primitives/compact.cl", "COMPACT_WORDS")
"""Words a work-item."""


@dataclass(frozen=True)
class Compacted:
    """Positions of the set bits on the device, (count,) uint32, ascending."""

    positions_d: Any
    count: int


def prepare_compact(device: Device) -> Program:
    prepare_scan(device)
    return load_program(device, "primitives/compact.cl")


def compact(device: Device, mask_d: Any, words: int) -> Compacted:
    """Find the set bits of a mask, (words,) uint32, words 1 to 2^27; bit b of word w is position ``32 * w + b``."""
    if not 1 <= words <= _LARGEST_MASK:
        raise UsageError(f"{words:,} words: a mask has 1 to {_LARGEST_MASK:,}, so that positions fit 32 bits")
    program = prepare_compact(device)
    chunks = -(-words // COMPACT_WORDS)
    counts_d = allocate(device, 4 * chunks)
    launch(device, program["count_set_bits"], chunks, mask=mask_d, counts=counts_d, words=words)
    scanned = exclusive_scan(device, counts_d, chunks)
    positions_d = allocate(device, 4 * scanned.total)
    launch(
        device, program["list_set_bits"], chunks,
        mask=mask_d, offsets=scanned.offsets_d, positions=positions_d, words=words,
    )  # fmt: skip
    return Compacted(positions_d, scanned.total)


RADIX_BITS = kernel_constant("primitives/radix_sort.cl", "RADIX_BITS")
"""Bits of a digit, at most."""

_KEY_BITS = 32
"""Bits of a key."""

FEWEST_PER_CHUNK = 4096
"""Fewest elements of a chunk, so that its table of digits costs less than its elements."""

MOST_CHUNKS = 4096
"""Most chunks, which bounds the table of digits to 32 MiB."""


@dataclass(frozen=True)
class Sorted:
    """Sorted keys on the device, (n,) uint32, and the number of each in the input; equal ones as in the input."""

    keys_d: Any
    values_d: Any


def prepare_sort(device: Device) -> Program:
    prepare_scan(device)
    variants = {"LANES": device.kernel_variants["LANES"], "RADIX_GROUP": str(device.group_size)}
    return load_program(device, "primitives/radix_sort.cl", variants)


def _plan_chunks(device: Device, n: int, fewest: int = FEWEST_PER_CHUNK) -> tuple[int, int]:
    wanted = MOST_CHUNKS
    if device.has_long_items:  # a chunk is the work of a core: some for each, for equal shares
        wanted = min(max(16, 8 * device.compute_units), MOST_CHUNKS)
    per_chunk = max(fewest, -(-n // wanted))
    return per_chunk, -(-n // per_chunk)


def _plan_digits(bits: int) -> list[tuple[int, int]]:
    """Return the lowest bit and the number of bits of each digit: as few digits as possible, of equal length."""
    passes = -(-bits // RADIX_BITS)
    borders = [which * bits // passes for which in range(passes + 1)]
    return [(low, high - low) for low, high in zip(borders, borders[1:], strict=False)]


def sort_bytes(device: Device, n: int, bits: int = _KEY_BITS) -> int:
    """Return the bytes that `radix_sort` takes beside the keys, its result among them."""
    buffers = 4 if len(_plan_digits(max(bits, 1))) > 1 else 2
    return 4 * buffers * n + (4 << min(RADIX_BITS, max(bits, 1))) * _plan_chunks(device, n)[1]


def radix_sort(device: Device, keys_d: Any, n: int, *, bits: int = _KEY_BITS, fewest: int = FEWEST_PER_CHUNK) -> Sorted:
    """Sort 1 to 2^31 keys, (n,) uint32, by their lowest `bits`, the only ones that can be set; they stay."""
    if not 1 <= n <= LARGEST_SCAN:
        raise UsageError(f"{n:,} elements: a sort takes 1 to {LARGEST_SCAN:,}")
    if not 0 <= bits <= _KEY_BITS:
        raise UsageError(f"{bits} bits: keys have 0 to {_KEY_BITS}")
    program = prepare_sort(device)
    per_chunk, chunks = _plan_chunks(device, n, fewest)
    items = chunks * device.group_size
    current, free = (keys_d, keys_d), [(allocate(device, 4 * n), allocate(device, 4 * n))]
    digits = _plan_digits(max(bits, 1))
    for number, (shift, width) in enumerate(digits):
        sizes = {"n": n, "shift": shift, "bins": 1 << width, "per_chunk": per_chunk, "chunks": chunks}
        counts_d = allocate(device, (4 << width) * chunks)
        launch(device, program["count_digits"], items, keys=current[0], counts=counts_d, **sizes)
        offsets_d = exclusive_scan(device, counts_d, chunks << width, in_place=True).offsets_d
        pair = free.pop() if free else (allocate(device, 4 * n), allocate(device, 4 * n))
        launch(
            device, program["scatter_by_digit"], items, keys=current[0], values=current[1], offsets=offsets_d,
            sorted_keys=pair[0], sorted_values=pair[1], numbered=int(number == 0), **sizes,
        )  # fmt: skip
        if number > 0:
            free.append(current)
        current = pair
    return Sorted(*current)
