"""Stable sort of 32-bit keys that carry the number of their element: the host's side of cl/primitives/radix_sort.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch, allocate, kernel_constant, launch, load_program
from clrecon.operators.primitives.scan import LARGEST_SCAN, exclusive_scan, prepare_scan

RADIX_BITS = kernel_constant("primitives/radix_sort.cl", "RADIX_BITS")
"""Bits of a digit, at most."""

KEY_BITS = 32
"""Bits of a key."""

FEWEST_PER_CHUNK = 4096
"""Fewest elements of a chunk, so that its table of digits costs less than its elements."""

MOST_CHUNKS = 4096
"""Most chunks, which bounds the table of digits to 32 MiB."""


@dataclass(frozen=True)
class Sorted:
    """Sorted keys on the device.

    keys_d: buffer, (n,) uint32. Ascending.
    values_d: buffer, (n,) uint32. Number of each of them in the input; equal keys are in the order of the input.
    """

    keys_d: Any
    values_d: Any


def prepare_sort(device: Device) -> Program:
    """Build the kernels of `radix_sort`."""
    prepare_scan(device)
    variants = {"LANES": device.kernel_variants["LANES"], "RADIX_GROUP": str(device.group_size)}
    return load_program(device, "primitives/radix_sort.cl", variants)


def _plan_chunks(device: Device, n: int) -> tuple[int, int]:
    """Return the elements of a chunk and the number of chunks."""
    wanted = MOST_CHUNKS
    if device.has_long_items:  # a chunk is the work of a core: some for each, for equal shares
        wanted = min(max(16, 8 * device.compute_units), MOST_CHUNKS)
    per_chunk = max(FEWEST_PER_CHUNK, -(-n // wanted))
    return per_chunk, -(-n // per_chunk)


def _plan_digits(bits: int) -> list[tuple[int, int]]:
    """Return the lowest bit and the number of bits of each digit: as few digits as possible, of equal length."""
    passes = -(-bits // RADIX_BITS)
    borders = [which * bits // passes for which in range(passes + 1)]
    return [(low, high - low) for low, high in zip(borders, borders[1:], strict=False)]


def sort_bytes(device: Device, n: int, bits: int = KEY_BITS) -> int:
    """Return the bytes that `radix_sort` takes beside the keys, its result among them."""
    buffers = 4 if len(_plan_digits(max(bits, 1))) > 1 else 2
    return 4 * buffers * n + (4 << min(RADIX_BITS, max(bits, 1))) * _plan_chunks(device, n)[1]


def radix_sort(
    device: Device, keys_d: Any, n: int, *, bits: int = KEY_BITS, stopwatch: Stopwatch | None = None
) -> Sorted:
    """Sort keys, and find the number of each of them in the input; equal keys stay in the order of the input.

    keys_d: buffer, (n,) uint32. They stay as they are.
    n: Number of elements, 1 to 2^31.
    bits: Bits of the keys that can be set, from the lowest: as many passes are made as they need.
    """
    if not 1 <= n <= LARGEST_SCAN:
        raise UsageError(f"{n:,} elements: a sort takes 1 to {LARGEST_SCAN:,}")
    if not 0 <= bits <= KEY_BITS:
        raise UsageError(f"{bits} bits: keys have 0 to {KEY_BITS}")
    program = prepare_sort(device)
    per_chunk, chunks = _plan_chunks(device, n)
    items = chunks * device.group_size
    taken, free = (keys_d, keys_d), [(allocate(device, 4 * n), allocate(device, 4 * n))]
    digits = _plan_digits(max(bits, 1))
    for number, (shift, width) in enumerate(digits):
        sizes = {"n": n, "shift": shift, "bins": 1 << width, "per_chunk": per_chunk, "chunks": chunks}
        counts_d = allocate(device, (4 << width) * chunks)
        launch(device, program["count_digits"], items, stopwatch=stopwatch, keys=taken[0], counts=counts_d, **sizes)
        offsets_d = exclusive_scan(device, counts_d, chunks << width, in_place=True, stopwatch=stopwatch).offsets_d
        made = free.pop() if free else (allocate(device, 4 * n), allocate(device, 4 * n))
        launch(
            device, program["scatter_by_digit"], items, stopwatch=stopwatch,
            keys=taken[0], values=taken[1], offsets=offsets_d, sorted_keys=made[0], sorted_values=made[1],
            numbered=int(number == 0), **sizes,
        )  # fmt: skip
        if number > 0:
            free.append(taken)
        taken = made
    return Sorted(*taken)
