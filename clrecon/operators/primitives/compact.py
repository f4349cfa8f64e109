"""Stream compaction: the positions of the set bits of a mask; the host's side of cl/primitives/compact.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch, allocate, kernel_constant, launch, load_program
from clrecon.operators.primitives.scan import exclusive_scan, prepare_scan

LARGEST_MASK = 2**27

COMPACT_WORDS = kernel_constant("primitives/compact.cl", "COMPACT_WORDS")
"""Words a work-item."""


@dataclass(frozen=True)
class Compacted:
    """Positions of the set bits on the device, (count,) uint32, ascending."""

    positions_d: Any
    count: int


def prepare_compact(device: Device) -> None:
    """Build the kernels of `compact`."""
    prepare_scan(device)
    _load_compact(device)


def _load_compact(device: Device) -> Program:
    return load_program(device, "primitives/compact.cl")


def compact(device: Device, mask_d: Any, words: int, *, stopwatch: Stopwatch | None = None) -> Compacted:
    """Find the positions of the set bits of a bit mask.

    mask_d: buffer, (words,) uint32. Bit b of word w is position ``32 * w + b``.
    words: Number of words, 1 to 2^27, so that positions fit 32 bits.
    """
    if not 1 <= words <= LARGEST_MASK:
        raise UsageError(f"{words:,} words: a mask has 1 to {LARGEST_MASK:,}, so that positions fit 32 bits")
    program = _load_compact(device)
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
