"""Stored pixel values of slices as in the files: plain, deflated or compressed, one frame or many in a file.

Only the bytes of the frame are read.  Facts about a whole file (the places of its compressed frames, its inflated data
set) are found once and kept while the volume is read.
"""

from __future__ import annotations

import sys
import threading
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.headers.surplus import INFLATED_LIMIT
from clrecon.dicom.parse.encapsulated import Pieces, find_frames, read_pieces
from clrecon.dicom.parse.transfer_syntaxes import choose_decoder, is_encapsulated
from clrecon.dicom.pixels.codestream import Codestream, read_codestream
from clrecon.dicom.pixels.decoder_pool import DecoderError, DecoderPool
from clrecon.errors import RefusedInputError
from clrecon.system.base_classes import Closing
from clrecon.system.paths import open_regular

INFLATE_STEP = 1 << 20

COMPRESSED_RATIO, COMPRESSED_EXTRA_BYTES = 4, 1 << 20
"""A compressed frame has at most this many times the bytes of its pixels, plus these bytes."""

Known = TypeVar("Known")


class StoredPixels(Closing):
    """Reads stored pixel values of the slices of one stack; a context manager, to be used from several threads.

    slices: All of one size.

    compressed: Some of the slices are compressed.
    """

    def __init__(self, slices: Sequence[SliceHeader]):
        compressed = sorted({h.transfer_syntax for h in slices if is_encapsulated(h.transfer_syntax)})
        self.compressed = bool(compressed)
        self._decoders = {syntax: choose_decoder(syntax) for syntax in compressed}
        self._pool = DecoderPool(sorted(set(self._decoders.values())), max(h.pixel_bytes for h in slices))
        self._locks = {h.file: threading.Lock() for h in slices if h.frames > 1}
        self._frames: dict[Path, list[Pieces]] = {}
        self._inflated: dict[Path, bytes] = {}

    def close(self) -> None:
        """Close the processes that decode."""
        self._pool.close()

    def stop(self) -> None:
        """End decoding at once; calls of `load` in other threads raise errors."""
        self._pool.kill()

    def load(self, header: SliceHeader, out: NDArray[Any]) -> NDArray[Any]:
        """Read one slice.

        out: ndarray, shape (rows, columns), C-contiguous. Memory that may be used for the result where its type has the
            same width.

        Returns: ndarray, shape (rows, columns). Stored values in the type that the header declares, unused bits
            included, in native byte order.
        """
        dtype = stored_dtype(header.float_pixels, header.signed, header.bits_allocated)
        fits = out.dtype.itemsize == dtype.itemsize and (out.dtype.kind == "f") == (dtype.kind == "f")
        stored = out.view(dtype) if fits else np.empty(out.shape, dtype)
        try:
            if is_encapsulated(header.transfer_syntax):
                return self._decode(header, stored)
            if header.inflate_from >= 0:
                self._inflate(header, stored)
            else:
                with open_regular(header.file, 0) as file:
                    file.seek(header.pixel_offset + header.frame * header.pixel_bytes)
                    _read_into(file, stored)
        except OSError as error:
            raise RefusedInputError(f"{header.name} cannot be read: {error.strerror or error}") from error
        except DecoderError as error:
            raise RefusedInputError(
                f"{header.name}: the compressed pixels (transfer syntax {header.transfer_syntax}) {error}"
            ) from error
        except RefusedInputError as error:
            raise RefusedInputError(f"{header.name}: {error}") from error
        except MemoryError as error:
            raise RefusedInputError(f"{header.name}: there is not enough memory to read its pixels") from error
        if header.little_endian != (sys.byteorder == "little"):
            stored.byteswap(inplace=True)
        return stored

    def _decode(self, header: SliceHeader, stored: NDArray[Any]) -> NDArray[Any]:
        with open_regular(header.file) as file:

            def find() -> list[Pieces]:
                return find_frames(file, header.pixel_offset, header.file_bytes, header.frames, header.transfer_syntax)

            pieces = self._know(self._frames, header, find)[header.frame]
            _check_compressed_bytes(sum(length for _, length in pieces), header.pixel_bytes)
            data = read_pieces(file, pieces)
        frame = read_codestream(data, header.transfer_syntax, header.rows, header.columns, header.bits_allocated)
        same = np.dtype(frame.dtype).itemsize == stored.dtype.itemsize
        decoded = stored.view(frame.dtype) if same else np.empty(stored.shape, frame.dtype)
        self._pool.decode(frame.data, self._decoders[header.transfer_syntax], decoded)
        _settle_sign(header, frame, decoded)
        if not same:
            np.copyto(stored, decoded, casting="unsafe")
        return stored

    def _inflate(self, header: SliceHeader, stored: NDArray[Any]) -> None:
        needed = header.pixel_offset + header.frames * stored.nbytes
        inflated = self._know(self._inflated, header, lambda: _inflate_data_set(header, needed))
        first = header.pixel_offset + header.frame * stored.nbytes
        found = max(len(inflated) - first, 0)
        if found < stored.nbytes:
            raise RefusedInputError(f"truncated: {stored.nbytes} bytes of pixels expected, {found} found")
        stored[...] = np.frombuffer(inflated, stored.dtype, stored.size, first).reshape(stored.shape)

    def _know(self, known: dict[Path, Known], header: SliceHeader, find: Callable[[], Known]) -> Known:
        """Return the facts about a file; the first thread that asks finds them if other threads will ask too."""
        if header.frames == 1:
            return find()
        with self._locks[header.file]:
            if header.file not in known:
                known[header.file] = find()
            return known[header.file]


@cache
def stored_dtype(floating: bool, signed: bool, bits_allocated: int) -> np.dtype[Any]:
    """Return the type of stored values, in native byte order."""
    return np.dtype(f"{'f' if floating else 'i' if signed else 'u'}{bits_allocated // 8}")


def _read_into(file: Any, stored: NDArray[Any]) -> None:
    target = stored.data.cast("B")
    done = 0
    while done < len(target):
        count = file.readinto(target[done:])
        if not count:
            raise RefusedInputError(f"truncated: {len(target)} bytes of pixels expected, {done} found")
        done += count


def _check_compressed_bytes(found: int, pixel_bytes: int) -> None:
    """Refuse a frame of too many bytes: a failing compression makes an image only a little larger."""
    most = COMPRESSED_RATIO * pixel_bytes + COMPRESSED_EXTRA_BYTES
    if found > most:
        raise RefusedInputError(f"the compressed frame has {found} bytes for {pixel_bytes} of pixels, {most} at most")


def _inflate_data_set(header: SliceHeader, needed: int) -> bytes:
    """Return the first `needed` bytes of a deflated data set, or those that exist; memory is bounded by `needed`.

    zlib bounds its output and its state does not grow, so no separate process is needed.
    """
    if needed > INFLATED_LIMIT:
        raise RefusedInputError(f"deflated image of {needed} bytes, no more than {INFLATED_LIMIT} are inflated")
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    inflated = bytearray()
    try:
        with open_regular(header.file, 0) as file:
            file.seek(header.inflate_from)
            while len(inflated) < needed and not inflater.eof:
                deflated = inflater.unconsumed_tail or file.read(INFLATE_STEP)
                if not deflated:
                    break
                inflated += inflater.decompress(deflated, needed - len(inflated))
    except zlib.error as error:
        raise RefusedInputError("the deflated data set is damaged") from error
    return bytes(inflated)


def _settle_sign(header: SliceHeader, frame: Codestream, decoded: NDArray[Any]) -> None:
    """Give decoded values, in place, the sign that the header declares.

    A codestream may have fewer bits than its memory cell, and another sign than the header or none.  Its values then
    have bits without their sign, or the other way round.  From BitsStored bits on the value is certain, and unused bits
    are dropped later.  With fewer than BitsStored bits there are two readings, which agree as long as the highest bit
    is 0.
    """
    if frame.signed is None and not header.signed or frame.signed == header.signed:
        return
    if frame.bits >= header.bits_stored:
        return
    values = decoded.view(f"u{decoded.dtype.itemsize}")
    if int(values.max()) >> (frame.bits - 1):
        has = "no sign" if not frame.signed else "a sign"
        raise RefusedInputError(
            f"the compressed frame has {frame.bits} bits and {has}, the header says {header.bits_stored} bits "
            f"{'with' if header.signed else 'without'} one: values cannot be told from others"
        )
