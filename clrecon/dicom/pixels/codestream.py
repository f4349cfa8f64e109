"""The head of a compressed frame, read before a decoder sees it: format, size, bits, sign.

Sources: JPEG ITU-T T.81 B.2.2, JPEG-LS T.87 C.2.2, JPEG 2000 T.800 A.5.1 and I.2.2, RLE DICOM PS3.5 annex G.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from clrecon.dicom.parse.transfer_syntaxes import JPEG_2000, JPEG_LOSSLESS, JPEG_LS, RLE
from clrecon.errors import RefusedInputError

RLE_HEAD_BYTES = 64
RLE_BEST_RATIO = 64
"""Highest compression ratio of RLE: a run of PackBits is two bytes for at most 128."""

LARGE_FRAME_BYTES = 64 * 2**20
LARGE_FRAME_RATIO = 1000
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
    """A compressed frame and the facts in its head.

    data: The codestream alone, without a container around it.
    signed: None where the format does not tell.
    """

    data: bytes
    rows: int
    columns: int
    bits: int
    signed: bool | None

    @property
    def dtype(self) -> str:
        """The type that decoders return, in native byte order."""
        width = 1 if self.bits <= 8 else 2 if self.bits <= 16 else 4
        return f"{'i' if self.signed else 'u'}{width}"


def read_codestream(data: bytes, transfer_syntax: str, rows: int, columns: int, bits_allocated: int) -> Codestream:
    """Read the head of a frame and compare it with the header of the image.

    data: One frame; bytes after its end mark are allowed.
    transfer_syntax: A compressed transfer syntax.
    rows, columns, bits_allocated: From the header.
    """
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
    if pixel_bytes > LARGE_FRAME_BYTES and pixel_bytes > LARGE_FRAME_RATIO * len(data):
        raise RefusedInputError(
            f"the compressed frame of {len(data)} bytes would unfold to {pixel_bytes}, more than "
            f"{LARGE_FRAME_RATIO} times as many"
        )
    return frame


def _read_rle(data: bytes, rows: int, columns: int, bits_allocated: int) -> Codestream:
    """Check RLE.  Its head gives no size, only whether the segments fit the frame and the image."""
    if len(data) < RLE_HEAD_BYTES:
        raise RefusedInputError("the compressed frame is shorter than the head of an RLE frame")
    count, *offsets = struct.unpack("<16L", data[:RLE_HEAD_BYTES])
    segments = bits_allocated // 8
    if count != segments:
        raise RefusedInputError(f"the RLE frame has {count} segments, {segments} expected")
    ends = [*offsets[1:count], len(data)]
    if offsets[0] != RLE_HEAD_BYTES or not all(a < b for a, b in zip(offsets[:count], ends, strict=True)):
        raise RefusedInputError("the RLE frame has a damaged table of segments")
    for start, end in zip(offsets, ends, strict=False):
        if (end - start) * RLE_BEST_RATIO < rows * columns:
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
    place = 0
    while place + 8 <= len(data):
        length, kind = struct.unpack(">L4s", data[place : place + 8])
        head = 8
        if length == 1 and place + 16 <= len(data):
            length, head = struct.unpack(">Q", data[place + 8 : place + 16])[0], 16
        if kind == b"jp2c":
            return data[place + head : place + length if length else len(data)]
        if length < head:
            break
        place += length
    raise RefusedInputError("the compressed frame is a JP2 file without a codestream")


def _read_jpeg(data: bytes, transfer_syntax: str) -> Codestream:
    wanted, name = (_LS_FRAME, "JPEG-LS") if transfer_syntax in JPEG_LS else (_LOSSLESS_FRAME, "JPEG lossless")
    assert transfer_syntax in (*JPEG_LS, *JPEG_LOSSLESS)
    place = 2 if data.startswith(b"\xff\xd8") else len(data)
    while place + 10 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # fill byte
            place += 1
            continue
        if marker == _LS_FRAME or (0xC0 <= marker <= 0xCF and marker not in _NO_FRAMES):
            if marker != wanted:
                break
            bits, rows, columns, components = struct.unpack(">B2HB", data[place + 4 : place + 10])
            _check_components(components)
            _check_end(data)
            return Codestream(data, rows, columns, bits, None)
        place += 2 + struct.unpack(">H", data[place + 2 : place + 4])[0]
    raise RefusedInputError(f"the compressed frame is no {name} codestream")


def _check_components(count: int) -> None:
    if count != 1:
        raise RefusedInputError(f"the compressed frame has {count} components, a CT slice has one")


def _check_end(data: bytes) -> None:
    """Check the end mark, which cannot occur in the data: decoders silently make an image of half a codestream."""
    if _END_MARK not in data[-_END_SEARCHED_BYTES:]:
        raise RefusedInputError("truncated: the compressed frame has no end mark")
