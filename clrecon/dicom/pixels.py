"""Pixels of a stack to HU voxels, read in parallel straight into the volume.

Order of the steps for every slice, each in the one place where it is right: stored bits, padding (a stored value,
found before rescale), sign extension, rescale by the slice's own slope and intercept, padding to air (`padding`).
Integer HU stay integers: int16 where every value fits, else int32; other slopes give float32.  Integer steps run in
the memory of the volume in modular arithmetic, which is exact because the result is known to fit beforehand.
"""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.codecs import choose_decoder, decode_frame, is_encapsulated
from clrecon.dicom.header import SliceHeader
from clrecon.dicom.padding import PaddingMasks, pack_mask
from clrecon.dicom.scan import Progress
from clrecon.errors import RefusedInputError
from clrecon.geometry.aligned import aligned_empty

__all__ = ["PixelFacts", "read_voxels"]

INFLATED_SLICE_LIMIT = 256 * 1024 * 1024
MEMORY_SHARE = 0.9
MAX_READERS = 8


@dataclass(frozen=True)
class PixelFacts:
    """What was seen in the pixels.

    Attributes
    ----------
    padding_share : float
        Of the voxels, 0 to 1.
    hu_min, hu_max : float
        Lowest and highest HU of the volume, padding included.
    padding_hu : float or None
        What padding was filled with; None where there is none.
    """

    padding_share: float
    hu_min: float
    hu_max: float
    padding_hu: float | None = None


class _RangeError(Exception):
    """The HU of a slice do not fit the type of the volume; a wider one is taken."""


def read_voxels(slices: Sequence[SliceHeader], progress: Progress | None = None) -> tuple[NDArray[Any], PixelFacts]:
    """Read the pixels of sorted slices of one size into one volume.

    Parameters
    ----------
    slices : sequence of SliceHeader
        In the order of k.
    progress : callable, optional
        Called as ``progress("read", done, total)``.

    Returns
    -------
    voxels : ndarray, shape (n, rows, columns), int16, int32 or float32
        HU.
    facts : PixelFacts

    Raises
    ------
    RefusedInputError
        A file is cut short, cannot be read or decoded, or the volume does not fit into memory.
    """
    for syntax in sorted({header.transfer_syntax for header in slices}):
        if is_encapsulated(syntax):
            choose_decoder(syntax)  # a missing decoder shows before anything is allocated
    integral = all(float(h.slope).is_integer() and float(h.intercept).is_integer() for h in slices)
    for dtype in (np.int16, np.int32) if integral else (np.float32,):
        voxels = _allocate(slices, np.dtype(dtype))
        try:
            return voxels, _fill_volume(slices, voxels, progress)
        except _RangeError:
            del voxels
    raise RefusedInputError("the rescaled values do not fit into 32 bits")


def available_memory_bytes() -> int | None:
    """Memory that can be taken without swapping; None where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        pass  # not Linux: ask for the physical memory below
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _allocate(slices: Sequence[SliceHeader], dtype: np.dtype[Any]) -> NDArray[Any]:
    shape = (len(slices), slices[0].rows, slices[0].columns)
    needed = shape[0] * shape[1] * shape[2] * dtype.itemsize
    available = available_memory_bytes()
    what = f"the volume of {shape[2]} x {shape[1]} x {shape[0]} voxels needs {needed / 2**30:.2f} GiB of memory"
    if available is not None and needed > MEMORY_SHARE * available:
        raise RefusedInputError(f"{what}, {available / 2**30:.2f} GiB are free")
    try:
        return aligned_empty(shape, dtype)
    except MemoryError as error:
        raise RefusedInputError(f"{what}, which cannot be had") from error


def _fill_volume(slices: Sequence[SliceHeader], voxels: NDArray[Any], progress: Progress | None) -> PixelFacts:
    padding, low, high = PaddingMasks(voxels), np.inf, -np.inf
    with ThreadPoolExecutor(min(MAX_READERS, os.cpu_count() or 1, len(slices))) as pool:
        jobs = {pool.submit(_fill_slice, header, voxels[k]): k for k, header in enumerate(slices)}
        try:
            for done, job in enumerate(as_completed(jobs), start=1):
                slice_padding, slice_low, slice_high = job.result()
                padding.add(jobs[job], slice_padding)
                low, high = min(low, slice_low), max(high, slice_high)
                if progress is not None:
                    progress("read", done, len(slices))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        padding_hu = padding.fill(pool.map)
    if padding_hu is not None:
        low, high = min(low, padding_hu), max(high, padding_hu)
    return PixelFacts(padding.count / voxels.size, float(low), float(high), padding_hu)


def _fill_slice(header: SliceHeader, out: NDArray[Any]) -> tuple[Any, float, float]:
    """Read one slice into `out`; returns its padding, packed, or None, and its lowest and highest measured HU."""
    stored = _load_stored(header, out)
    padding = None
    if header.padding is not None and not _fits_stored_bits(header):
        padding = _find_padding(header, stored)  # the value fills the whole cell, unused bits included
    _extend_sign(header, stored)
    if header.padding is not None and padding is None:
        padding = _find_padding(header, stored)
    if padding is not None and padding.all():
        return pack_mask(padding), np.inf, -np.inf

    low, high = _measured_range(stored, padding)
    ends = (low * header.slope + header.intercept, high * header.slope + header.intercept)
    hu_low, hu_high = min(ends), max(ends)
    if out.dtype.kind == "f":
        out[...] = stored * np.float64(header.slope) + header.intercept
    else:
        limits = np.iinfo(out.dtype)
        if hu_low < limits.min or hu_high > limits.max:
            raise _RangeError
        if not np.may_share_memory(stored, out):
            np.copyto(out, stored, casting="unsafe")
        if header.slope != 1.0:
            np.multiply(out, np.int64(header.slope).astype(out.dtype), out=out)
        if header.intercept != 0.0:
            np.add(out, np.int64(header.intercept).astype(out.dtype), out=out)
    return None if padding is None else pack_mask(padding), hu_low, hu_high


def _load_stored(header: SliceHeader, out: NDArray[Any]) -> NDArray[Any]:
    """Stored values, unused bits included, in native byte order; in the memory of `out` where the sizes agree."""
    dtype = np.dtype(f"{'i' if header.signed else 'u'}{header.bits_allocated // 8}")
    try:
        with open(header.file, "rb", buffering=0) as file:
            if is_encapsulated(header.transfer_syntax):
                file.seek(header.pixel_offset)
                frame = decode_frame(header, file.read() or b"")
                return np.array(frame, dtype=dtype)
            stored = out.view(dtype) if out.dtype.itemsize == dtype.itemsize and out.dtype.kind != "f" else None
            if stored is None:
                stored = np.empty(out.shape, dtype)
            if header.inflate_from >= 0:
                file.seek(header.inflate_from)
                _inflate_into(header, file.read() or b"", stored)
            else:
                file.seek(header.pixel_offset + header.frame * header.pixel_bytes)
                _read_into(header, file, stored)
    except OSError as error:
        raise RefusedInputError(f"{header.name} cannot be read: {error.strerror or error}") from error
    if header.little_endian != (sys.byteorder == "little"):
        stored.byteswap(inplace=True)
    return stored


def _read_into(header: SliceHeader, file: Any, stored: NDArray[Any]) -> None:
    target = stored.data.cast("B")
    done = 0
    while done < len(target):
        count = file.readinto(target[done:])
        if not count:
            raise RefusedInputError(f"{header.name}: truncated: {len(target)} bytes of pixels expected, {done} found")
        done += count


def _inflate_into(header: SliceHeader, deflated: bytes, stored: NDArray[Any]) -> None:
    first = header.pixel_offset + header.frame * stored.nbytes
    needed = first + stored.nbytes
    if needed > INFLATED_SLICE_LIMIT:
        raise RefusedInputError(
            f"{header.name}: deflated image of {needed} bytes, no more than {INFLATED_SLICE_LIMIT} are inflated"
        )
    try:
        inflated = zlib.decompressobj(-zlib.MAX_WBITS).decompress(deflated, needed)
    except zlib.error as error:
        raise RefusedInputError(f"{header.name}: the deflated data set is damaged") from error
    found = max(len(inflated) - first, 0)
    if found < stored.nbytes:
        raise RefusedInputError(f"{header.name}: truncated: {stored.nbytes} bytes of pixels expected, {found} found")
    stored[...] = np.frombuffer(inflated, stored.dtype, stored.size, first).reshape(stored.shape)


def _extend_sign(header: SliceHeader, stored: NDArray[Any]) -> None:
    """Drop the bits around the stored ones (overlays live there) and extend the sign, in place."""
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
    if high < int(stored.min()) or low > int(stored.max()):
        return None
    limits = np.iinfo(stored.dtype)
    low, high = max(low, int(limits.min)), min(high, int(limits.max))
    mask = stored == low if low == high else (stored >= low) & (stored <= high)
    return mask if mask.any() else None


def _measured_range(stored: NDArray[Any], padding: NDArray[np.bool_] | None) -> tuple[int, int]:
    """Lowest and highest stored value outside of the padding; not everything is padding."""
    if padding is None:
        return int(stored.min()), int(stored.max())
    measured = stored[~padding]
    return int(measured.min()), int(measured.max())
