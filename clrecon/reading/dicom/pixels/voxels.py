"""Pixels of a stack to HU voxels, read in parallel straight into the volume.

The steps for every slice, which are correct only in this order: stored bits, padding (a stored value, found before
rescale), sign extension, rescale by the slice's own slope and intercept, padding to air (`padding`). Integer HU stay
integers: int16 where every value fits, else int32; other slopes give float32. Integer steps run in the memory of the
volume in modular arithmetic, which is exact because the result is known to fit beforehand.  Float pixel data are HU as
they are (float32, from 64 bits too): the standard gives them no rescale (PS3.3 C.7.6.24).

Stray bits are those of stored values above HighBit: by the standard the extended sign or, in old files, overlays (PS3.5
8.1.1). They are cut off.  Where they were part of the value, because BitsStored is too small, the HU wrap around: metal
turns into air.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.reading.common.padding import (
    PaddingMasks,
    count_masked_tissue,
    describe_masked_tissue,
    fill_disc_padding,
    pack_mask,
)
from clrecon.reading.common.source_facts import PixelFacts
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.reading.dicom.parse.elements import read_elements
from clrecon.reading.dicom.parse.plain import CorruptFileError, NotDicomError
from clrecon.reading.dicom.pixels.stored import StoredPixels
from clrecon.system.memory import allocate_voxels
from clrecon.system.pieces import count_readers
from clrecon.system.progress import Progress

OVERLAY_BITS = tuple(0x60000102 + (group << 16) for group in range(0, 32, 2))
"""The tags OverlayBitPosition of the 16 overlays that an image may have."""


class StrayBits(NamedTuple):
    """The bits of a slice before they are cut: counts of odd values, with bits above HighBit that are neither sign nor
    overlay, and of plain ones, which HighBit makes negative and which have none above it.

    signs: Some values have their sign extended to the highest bit, so the plain ones are large and not negative.
    example: The first odd value, else the first plain one, as stored and as read.
    """

    odd: int = 0
    plain: int = 0
    signs: bool = False
    example: tuple[int, int] | None = None


def find_stray_bits(header: SliceHeader, stored: NDArray[Any], left_out: NDArray[np.bool_] | None) -> StrayBits | None:
    """Examine stored values (rows, columns) of a file, but padding `left_out`; None where no bit can be stray."""
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
    """Return the bits of stored values that hold overlays by the header; position 0 is an overlay with its own data."""
    try:
        values = read_elements(header.file, OVERLAY_BITS, force=True).values
    except (OSError, CorruptFileError, NotDicomError):
        return []
    order: Literal["little", "big"] = "little" if header.little_endian else "big"
    return [bit for raw in values.values() if (bit := int.from_bytes(raw[:2], order)) > 0]


def describe_stray_bits(stray_bits: Iterable[StrayBits | None], headers: Iterable[SliceHeader]) -> tuple[int, str]:
    """Return how many values of a stack lost bits of their own, and one line about it; 0 and "" if there are none."""
    pairs = [(one, header) for one, header in zip(stray_bits, headers, strict=True) if one is not None]
    signs = any(one.signs for one, _ in pairs)
    counts = [one.odd + (one.plain if signs else 0) for one, _ in pairs]
    count = sum(counts)
    if not count:
        return 0, ""
    stray, header = next(pair for pair, own in zip(pairs, counts, strict=True) if own)
    assert stray.example is not None
    return count, (
        f"values beyond the {header.bits_stored} stored bits (bits above HighBit {header.high_bit}, neither sign nor "
        f"overlay) in {sum(own > 0 for own in counts)} of the slices, cut off, so that their HU wrap around (stored "
        f"{stray.example[0]} is read as {stray.example[1]})"
    )


MAX_READERS = 8
_MAX_DECODERS = 32
_DECODER_WORTH_BYTES = 4 << 20
"""Least bytes of pixels for one more decoder: they take about as long to decode as a process takes to start."""
_FLOAT_LIMIT = 1e9
"""Larger values are not HU; float32 and every later step can hold this value."""


class _SliceFacts(NamedTuple):
    """Figures of one slice: packed padding, range of measured HU, unusual bits, padding that looks like tissue."""

    padding: tuple[bytes, int] | None
    low: float
    high: float
    stray: StrayBits | None
    tissue: int


class _RangeError(Exception):
    """The HU of a slice do not fit the type of the volume; a wider type is then used."""


def read_voxels(
    slices: Sequence[SliceHeader], progress: Progress | None = None, source: StoredPixels | None = None
) -> tuple[NDArray[Any], PixelFacts]:
    """Read slices of one size, sorted by k, as HU (n, rows, columns): int16, int32, float32; a `source` stays open."""
    integral = all(
        float(h.slope).is_integer() and float(h.intercept).is_integer() and not h.float_pixels for h in slices
    )
    # A missing decoder shows here, before memory is allocated.
    with StoredPixels(slices) if source is None else nullcontext(source) as source:
        for dtype in (np.int16, np.int32) if integral else (np.float32,):
            voxels = allocate_voxels((len(slices), slices[0].rows, slices[0].columns), dtype)
            try:
                return voxels, _fill_volume(source, slices, voxels, progress)
            except _RangeError:
                del voxels
    raise RefusedInputError("the rescaled values do not fit into 32 bits")


def _fill_volume(
    source: StoredPixels, slices: Sequence[SliceHeader], voxels: NDArray[Any], progress: Progress | None
) -> PixelFacts:
    padding = PaddingMasks(voxels)
    low = np.inf
    high = -np.inf
    tissue = 0
    stray: list[StrayBits | None] = [None] * len(slices)
    blank: list[int] = []
    most = MAX_READERS
    if source.compressed:
        most = min(_MAX_DECODERS, 1 + len(slices) * slices[0].pixel_bytes // _DECODER_WORTH_BYTES)
    with ThreadPoolExecutor(count_readers(len(slices), most)) as pool:
        try:
            jobs = {pool.submit(_fill_slice, source, header, voxels[k]): k for k, header in enumerate(slices)}
            for done, job in enumerate(as_completed(jobs), start=1):
                seen = job.result()
                padding.add(jobs[job], seen.padding)
                low, high = min(low, seen.low), max(high, seen.high)
                stray[jobs[job]] = seen.stray
                if seen.low >= seen.high:
                    blank.append(jobs[job])
                tissue += seen.tissue
                if progress is not None:
                    progress("read", done, len(slices))
        except _RangeError:
            pool.shutdown(cancel_futures=True)  # the decoders are needed again
            raise
        except BaseException:
            source.stop()
            pool.shutdown(cancel_futures=True)
            raise
        padding_hu = padding.fill(pool.map)
    padded, notes = padding.count, describe_masked_tissue(tissue)
    disc = fill_disc_padding(voxels) if padding_hu is None else None
    if disc is not None:
        padded, padding_hu = disc.voxels, disc.filled
        notes = disc.describe(voxels.size)
    if padding_hu is not None:
        low, high = min(low, padding_hu), max(high, padding_hu)
    count, text = describe_stray_bits(stray, slices)
    return PixelFacts(
        padded / voxels.size, float(low), float(high), padding_hu, count, text, notes, disc and disc.value,
        tuple(find_between(sorted(blank), len(slices))),
    )  # fmt: skip


def find_between(blank: Sequence[int], count: int) -> list[int]:
    """Return the blank slices of `count` that have others before and behind them; at the ends they are padding."""
    shown = sorted(set(range(count)) - set(blank))
    return [k for k in blank if shown and shown[0] < k < shown[-1]]


def _fill_slice(source: StoredPixels, header: SliceHeader, out: NDArray[Any]) -> _SliceFacts:
    stored = source.load(header, out)
    whole_cell = header.padding is not None and not header.float_pixels and not _fits_stored_bits(header)
    padding = _find_padding(header, stored) if whole_cell else None  # padding may fill unused bits too
    stray = None
    if not header.float_pixels:
        stray = find_stray_bits(header, stored, padding)
        _extend_sign(header, stored)
    if header.padding is not None and not whole_cell:
        padding = _find_padding(header, stored)
    packed = None if padding is None else pack_mask(padding)
    tissue = 0
    if padding is not None and header.padding is not None:
        tissue = count_masked_tissue(header.padding, header, stored, padding)
    if padding is not None and packed is not None:
        if packed[1] == padding.size:
            return _SliceFacts(packed, np.inf, -np.inf, stray, tissue)
        # A measured value at this place does not matter: this saves one pass over the slice.
        np.copyto(stored, stored.flat[padding.argmin()], where=padding)
    low, high = stored.min(), stored.max()
    if header.float_pixels and not (abs(low) <= _FLOAT_LIMIT and abs(high) <= _FLOAT_LIMIT):
        raise RefusedInputError(f"{header.name}: Float Pixel Data holds {_describe_unfit(stored)}: those are no HU")
    hu_low, hu_high = float(low) * header.slope + header.intercept, float(high) * header.slope + header.intercept
    if hu_low > hu_high:
        hu_low, hu_high = hu_high, hu_low
    if out.dtype.kind == "f":
        if header.slope == 1.0 and header.intercept == 0.0:
            if not np.may_share_memory(stored, out):
                out[...] = stored
        else:
            out[...] = stored * np.float64(header.slope) + header.intercept
    else:
        _rescale_integers(header, stored, out, hu_low, hu_high)
    return _SliceFacts(packed, hu_low, hu_high, stray, tissue)


def _rescale_integers(
    header: SliceHeader, stored: NDArray[Any], out: NDArray[Any], hu_low: float, hu_high: float
) -> None:
    """Rescale in the memory of the volume, modulo its width: this is exact, because the result fits."""
    if not (_fits_dtype(int(hu_low), out.dtype) and _fits_dtype(int(hu_high), out.dtype)):
        raise _RangeError
    if not np.may_share_memory(stored, out):
        np.copyto(out, stored, casting="unsafe")
    if header.slope != 1.0:
        np.multiply(out, np.int64(header.slope).astype(out.dtype), out=out)
    if header.intercept != 0.0:
        np.add(out, np.int64(header.intercept).astype(out.dtype), out=out)


def _fits_dtype(value: int, dtype: np.dtype[Any]) -> bool:
    limits = np.iinfo(dtype)
    return int(limits.min) <= value <= int(limits.max)


def _describe_unfit(stored: NDArray[Any]) -> str:
    """Count values of float pixels that cannot be HU."""
    nan = int(np.count_nonzero(np.isnan(stored)))
    infinite = int(np.count_nonzero(np.isinf(stored)))
    if nan or infinite:
        return f"{nan} NaN and {infinite} infinite values of {stored.size}"
    return f"values from {float(stored.min()):g} to {float(stored.max()):g}"


def _extend_sign(header: SliceHeader, stored: NDArray[Any]) -> None:
    """Drop the bits around the stored ones (overlays may be there) and extend the sign, in place."""
    if header.bits_stored == header.bits_allocated:
        return
    np.left_shift(stored, header.bits_allocated - 1 - header.high_bit, out=stored)
    np.right_shift(stored, header.bits_allocated - header.bits_stored, out=stored)


def _fits_stored_bits(header: SliceHeader) -> bool:
    """True when the padding values can be written in the stored bits."""
    assert header.padding is not None
    half = 1 << (header.bits_stored - 1)
    low, high = (-half, half - 1) if header.signed else (0, 2 * half - 1)
    return low <= header.padding[0] and header.padding[1] <= high


def _find_padding(header: SliceHeader, stored: NDArray[Any]) -> NDArray[np.bool_] | None:
    assert header.padding is not None
    low, high = header.padding
    if header.float_pixels:
        low, high = stored.dtype.type(low), stored.dtype.type(high)
        if np.isnan(low) or np.isnan(high):
            mask = np.isnan(stored)  # PS3.3 C.7.6.24: NaN may be the padding value
            return mask if mask.any() else None
    else:
        limits = np.iinfo(stored.dtype)
        low, high = max(low, int(limits.min)), min(high, int(limits.max))
        if low > high:
            return None
    mask = stored == low if low == high else (stored >= low) & (stored <= high)
    return mask if mask.any() else None
