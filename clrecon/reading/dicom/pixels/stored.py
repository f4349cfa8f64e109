"""Stored pixel values of slices as in the files: plain, deflated or compressed, one frame or many in a file.

Only the bytes of the frame are read, the head of a compressed one (format, size, bits, sign) before a decoder sees it.
Facts about a whole file (the places of its compressed frames, its inflated data set) are found once and kept.

Sources: JPEG ITU-T T.81 B.2.2, JPEG-LS T.87 C.2.2, JPEG 2000 T.800 A.5.1 and I.2.2, RLE DICOM PS3.5 annex G.
"""

from __future__ import annotations

import struct
import sys
import threading
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.reading.dicom.headers.surplus import INFLATED_LIMIT
from clrecon.reading.dicom.parse.elements import inflate
from clrecon.reading.dicom.parse.transfer_syntaxes import (
    JPEG_2000,
    JPEG_LOSSLESS,
    JPEG_LS,
    RLE,
    Pieces,
    choose_decoder,
    find_frames,
    is_encapsulated,
    read_pieces,
)
from clrecon.reading.dicom.pixels.decoder_pool import DecoderError, DecoderPool
from clrecon.system.base_classes import Closing
from clrecon.system.light_dataclass import dataclass
from clrecon.system.paths import open_regular

_RLE_HEAD_BYTES = 64
_RLE_BEST_RATIO = 64
"""Highest compression ratio of RLE: a run of PackBits is two bytes for at most 128."""

_LARGE_FRAME_BYTES = 64 * 2**20
_LARGE_FRAME_RATIO = 1000
"""Highest accepted ratio of large frames (over 5,792 x 5,792 of 16 bits); beyond it they are taken for attacks.  Small
frames may be all air."""

_END_MARK = b"\xff\xd9"
_END_SEARCHED_BYTES = 64
_JP2_START = b"\0\0\0\x0cjP  \r\n\x87\n"
_J2K_START = b"\xff\x4f\xff\x51"
_LOSSLESS_FRAME, _LS_FRAME = 0xC3, 0xF7
_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # tables, though within the range of starts of frame


@dataclass(frozen=True)
class Codestream:
    """A compressed frame without its container, and the facts in its head, which may say nothing about the sign."""

    data: bytes
    rows: int
    columns: int
    bits: int
    signed: bool | None

    @property
    def dtype(self) -> str:
        """The type that decoders return, in native byte order."""
        width = next(width for width in (1, 2, 4) if self.bits <= 8 * width or width == 4)
        return f"{'i' if self.signed else 'u'}{width}"


def read_codestream(data: bytes, transfer_syntax: str, rows: int, columns: int, bits_allocated: int) -> Codestream:
    """Read the head of a frame, which may go on after its end mark, and compare it with the header of the image."""
    if transfer_syntax == RLE:
        frame = _read_rle(data, rows, columns, bits_allocated)
    elif transfer_syntax in JPEG_2000:
        frame = _read_jpeg_2000(data)
    else:
        frame = _read_jpeg(data, transfer_syntax)
    if (frame.rows, frame.columns) != (rows, columns):
        raise RefusedInputError(
            f"the compressed frame is {frame.columns} x {frame.rows}, the header says {columns} x {rows}"
        )
    if not 1 <= frame.bits <= bits_allocated:
        raise RefusedInputError(
            f"the compressed frame has {frame.bits} bits a pixel, the header allocates {bits_allocated}"
        )
    pixel_bytes = rows * columns * bits_allocated // 8
    if pixel_bytes > _LARGE_FRAME_BYTES and pixel_bytes > _LARGE_FRAME_RATIO * len(data):
        raise RefusedInputError(
            f"the compressed frame of {len(data)} bytes would unfold to {pixel_bytes}, more than "
            f"{_LARGE_FRAME_RATIO} times as many"
        )
    return frame


def _read_rle(data: bytes, rows: int, columns: int, bits_allocated: int) -> Codestream:
    """Check RLE.  Its head gives no size, only whether the segments fit the frame and the image."""
    if len(data) < _RLE_HEAD_BYTES:
        raise RefusedInputError("the compressed frame is shorter than the head of an RLE frame")
    count, *offsets = struct.unpack("<16L", data[:_RLE_HEAD_BYTES])
    segments = bits_allocated // 8
    if count != segments:
        raise RefusedInputError(f"the RLE frame has {count} segments, {segments} expected")
    ends = [*offsets[1:count], len(data)]
    if offsets[0] != _RLE_HEAD_BYTES or not all(a < b for a, b in zip(offsets[:count], ends, strict=True)):
        raise RefusedInputError("the RLE frame has a damaged table of segments")
    for start, end in zip(offsets, ends, strict=False):
        if (end - start) * _RLE_BEST_RATIO < rows * columns:
            raise RefusedInputError(f"truncated: an RLE segment of {end - start} bytes for {rows * columns} pixels")
    return Codestream(data, rows, columns, bits_allocated, None)


def _read_jpeg_2000(data: bytes) -> Codestream:
    if data.startswith(_JP2_START):
        data = _unwrap_jp2(data)
    if not data.startswith(_J2K_START) or len(data) < 45:
        raise RefusedInputError("the compressed frame is no JPEG 2000 codestream")
    # After SOC and the SIZ marker: Lsiz, Rsiz, the sizes and offsets of image and tiles, the number of components.
    width, height, left, top = struct.unpack(">4L", data[8:24])
    components, depth, step_x, step_y = struct.unpack(">H3B", data[40:45])
    _check_components(components)
    if (step_x, step_y) != (1, 1):
        raise RefusedInputError("the compressed frame has fewer samples than pixels")
    _check_end(data)
    return Codestream(data, height - top, width - left, (depth & 0x7F) + 1, depth >= 0x80)


def _unwrap_jp2(data: bytes) -> bytes:
    """Return the codestream in a JP2 file, which some writers put into DICOM against its rules."""
    position = 0
    while position + 8 <= len(data):
        length, kind = struct.unpack(">L4s", data[position : position + 8])
        head = 8
        if length == 1 and position + 16 <= len(data):
            length, head = struct.unpack(">Q", data[position + 8 : position + 16])[0], 16
        if kind == b"jp2c":
            return data[position + head : position + length if length else len(data)]
        if length < head:
            break
        position += length
    raise RefusedInputError("the compressed frame is a JP2 file without a codestream")


def _read_jpeg(data: bytes, transfer_syntax: str) -> Codestream:
    wanted, name = (_LS_FRAME, "JPEG-LS") if transfer_syntax in JPEG_LS else (_LOSSLESS_FRAME, "JPEG lossless")
    assert transfer_syntax in (*JPEG_LS, *JPEG_LOSSLESS)
    position = 2 if data.startswith(b"\xff\xd8") else len(data)
    while position + 10 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _LS_FRAME or (0xC0 <= marker <= 0xCF and marker not in _NO_FRAMES):
            if marker != wanted:
                break
            bits, rows, columns, components = struct.unpack(">B2HB", data[position + 4 : position + 10])
            _check_components(components)
            _check_end(data)
            return Codestream(data, rows, columns, bits, None)
        position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    raise RefusedInputError(f"the compressed frame is no {name} codestream")


def _check_components(count: int) -> None:
    if count != 1:
        raise RefusedInputError(f"the compressed frame has {count} components, a CT slice has one")


def _check_end(data: bytes) -> None:
    """Check the end mark, which cannot occur in the data: decoders silently make an image of half a codestream."""
    if _END_MARK not in data[-_END_SEARCHED_BYTES:]:
        raise RefusedInputError("truncated: the compressed frame has no end mark")


INFLATE_STEP = 1 << 20

_COMPRESSED_RATIO, _COMPRESSED_EXTRA_BYTES = 4, 1 << 20
"""A compressed frame has at most this many times the bytes of its pixels, plus these bytes."""

Known = TypeVar("Known")


class StoredPixels(Closing):
    """Reads stored pixel values of the slices of one stack; a context manager, to be used from several threads."""

    def __init__(self, slices: Sequence[SliceHeader]):
        compressed = sorted({h.transfer_syntax for h in slices if is_encapsulated(h.transfer_syntax)})
        self.compressed = bool(compressed)
        self._decoders = {syntax: choose_decoder(syntax) for syntax in compressed}
        self._pool = DecoderPool(sorted(set(self._decoders.values())), max(h.pixel_bytes for h in slices))
        self._locks = {h.file: threading.Lock() for h in slices if h.frames > 1}
        self._frames: dict[Path, list[Pieces]] = {}
        self._inflated: dict[Path, bytes] = {}

    def close(self) -> None:
        self._pool.close()

    def stop(self) -> None:
        """End decoding at once; calls of `load` in other threads raise errors."""
        self._pool.kill()

    def load(self, header: SliceHeader, out: NDArray[Any]) -> NDArray[Any]:
        """Read one slice as declared, in native byte order, into C-contiguous `out` where its type is as wide."""
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

            def find_pieces() -> list[Pieces]:
                return find_frames(file, header.pixel_offset, header.file_bytes, header.frames, header.transfer_syntax)

            pieces = self._know(self._frames, header, find_pieces)[header.frame]
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
        size = max(len(inflated) - first, 0)
        if size < stored.nbytes:
            raise RefusedInputError(f"truncated: {stored.nbytes} bytes of pixels expected, {size} found")
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
    whole = "i" if signed else "u"
    return np.dtype(f"{'f' if floating else whole}{bits_allocated // 8}")


def _read_into(file: Any, stored: NDArray[Any]) -> None:
    target = stored.data.cast("B")
    done = 0
    while done < len(target):
        count = file.readinto(target[done:])
        if not count:
            raise RefusedInputError(f"truncated: {len(target)} bytes of pixels expected, {done} found")
        done += count


def _check_compressed_bytes(size: int, pixel_bytes: int) -> None:
    """Refuse a frame of too many bytes: a failing compression makes an image only a little larger."""
    most = _COMPRESSED_RATIO * pixel_bytes + _COMPRESSED_EXTRA_BYTES
    if size > most:
        raise RefusedInputError(f"the compressed frame has {size} bytes for {pixel_bytes} of pixels, {most} at most")


def _inflate_data_set(header: SliceHeader, needed: int) -> bytes:
    """Return the first `needed` bytes of a deflated data set, or those that exist; zlib takes no more memory."""
    if needed > INFLATED_LIMIT:
        raise RefusedInputError(f"deflated image of {needed} bytes, no more than {INFLATED_LIMIT} are inflated")
    try:
        with open_regular(header.file, 0) as file:
            file.seek(header.inflate_from)
            return inflate(file.read, needed, INFLATE_STEP)[0]
    except zlib.error as error:
        raise RefusedInputError("the deflated data set is damaged") from error


def _settle_sign(header: SliceHeader, frame: Codestream, decoded: NDArray[Any]) -> None:
    """Give decoded values, in place, the sign that the header declares.

    A codestream may have fewer bits than its memory cell, and another sign than the header or none.  From BitsStored
    bits on the value is certain, and unused bits are dropped later.  With fewer there are two readings, which agree as
    long as the highest bit is 0.
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
