"""Bits of stored values above HighBit: the sign, an overlay, or part of the value after all.

By the standard they hold the extended sign or, in old files, overlays (PS3.5 8.1.1). They are cut off.  Where they were
part of the value, because BitsStored is too small, the HU wrap around: metal turns into air.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.parse.elements import CorruptFileError, NotDicomError, read_elements

OVERLAY_BITS = tuple(0x60000102 + (group << 16) for group in range(0, 32, 2))
"""The tags OverlayBitPosition of the 16 overlays that an image may have."""


class StrayBits(NamedTuple):
    """Figures about the bits of one slice before they are cut.

    odd: Number of values with bits above HighBit that are neither sign nor overlay.
    plain: Number of values that are negative if HighBit is their sign, but have no bits above it.
    signs: Some values have their sign extended to the highest bit, so the plain ones are large and not negative.
    example: The first odd value, else the first plain one, as stored and as read.
    """

    odd: int = 0
    plain: int = 0
    signs: bool = False
    example: tuple[int, int] | None = None


def find_stray_bits(header: SliceHeader, stored: NDArray[Any], left_out: NDArray[np.bool_] | None) -> StrayBits | None:
    """Examine the stored values of a slice, (rows, columns), as they are in the file.

    stored: ndarray of int, shape (rows, columns)
    left_out: ndarray of bool, same shape, or None. Padding that fills unused bits too.

    Returns: None where no bit can be stray.
    """
    spare = header.bits_allocated - 1 - header.high_bit
    if header.float_pixels or spare == 0:
        return None
    top = 1 << (header.high_bit + 1)
    low, high = int(stored.min()), int(stored.max())
    if header.signed and -(top >> 1) <= low and high < top >> 1:
        return StrayBits(signs=True) if low < 0 else None
    if not header.signed and high < top:
        return None
    overlays = _read_overlay_bits(header)
    values = stored.view(f"u{stored.dtype.itemsize}")
    above = (values >> (header.high_bit + 1)).astype(np.int64)
    every = (1 << spare) - 1
    for bit in overlays:
        if bit > header.high_bit:
            above &= ~(1 << (bit - header.high_bit - 1))
            every &= ~(1 << (bit - header.high_bit - 1))
    negative = ((values >> header.high_bit) & 1).astype(bool) if header.signed else np.zeros(values.shape, bool)
    signs = negative & (above == every) if every else np.zeros(values.shape, bool)
    odd, plain = (above != 0) & ~signs, negative & (above == 0) & bool(every)
    if left_out is not None:
        odd, plain = odd & ~left_out, plain & ~left_out
    chosen = odd if odd.any() else plain
    example = None
    if chosen.any():
        value = int(stored.flat[int(chosen.argmax())])
        cut = value % top >> (header.high_bit + 1 - header.bits_stored)
        half = 1 << (header.bits_stored - 1)
        example = (value, cut - 2 * half if header.signed and cut >= half else cut)
    return StrayBits(int(odd.sum()), int(plain.sum()), bool(signs.any()), example)


def _read_overlay_bits(header: SliceHeader) -> list[int]:
    """Return the bits of the stored values that hold overlays by the header; position 0 is an overlay with its own
    data.
    """
    try:
        values = read_elements(header.file, OVERLAY_BITS, force=True).values
    except (OSError, CorruptFileError, NotDicomError):
        return []
    order: Literal["little", "big"] = "little" if header.little_endian else "big"
    return [bit for raw in values.values() if (bit := int.from_bytes(raw[:2], order)) > 0]


def describe_stray_bits(found: Iterable[StrayBits | None], headers: Iterable[SliceHeader]) -> tuple[int, str]:
    """Return how many values of a stack lost bits of their own, and one line about it; 0 and "" if there are none."""
    pairs = [(one, header) for one, header in zip(found, headers, strict=True) if one is not None]
    signs = any(one.signs for one, _ in pairs)
    counts = [one.odd + (one.plain if signs else 0) for one, _ in pairs]
    count = sum(counts)
    if not count:
        return 0, ""
    one, header = next(pair for pair, own in zip(pairs, counts, strict=True) if own)
    assert one.example is not None
    return count, (
        f"values beyond the {header.bits_stored} stored bits (bits above HighBit {header.high_bit}, neither sign nor "
        f"overlay) in {sum(own > 0 for own in counts)} of the slices, cut off, so that their HU wrap around (stored "
        f"{one.example[0]} is read as {one.example[1]})"
    )
