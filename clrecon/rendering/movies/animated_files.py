"""GIF and APNG frame by frame.

Pillow writes both, but holds all frames in memory until the end.  Here Pillow compresses each frame as a separate
picture, whose compressed blocks are copied into the moving picture: the memory of one frame suffices.

Sources: CompuServe, Graphics Interchange Format, version 89a; W3C, Portable Network Graphics, third edition.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from itertools import chain
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

_REPEAT_FOR_EVER = b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def write_gif(stream: BinaryIO, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Write frames (h, w, 3), each with its own best 256 colours."""
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    first = next(frames)
    height, width = first.shape[:2]
    stream.write(b"GIF89a" + struct.pack("<HHBBB", width, height, 0x70, 0, 0) + _REPEAT_FOR_EVER)
    shown = 0
    for number, frame in enumerate(chain([first], frames)):
        # Durations in hundredths of a second, rounded so that the total is right.
        delay = round(100.0 * (number + 1) / fps) - shown
        shown += delay
        palette, blocks = _gif_picture(frame)
        bits = max(1, (len(palette) // 3 - 1).bit_length())
        palette = palette.ljust(3 << bits, b"\0")
        stream.write(b"\x21\xf9\x04" + struct.pack("<BHBB", 1 << 2, delay, 0, 0))
        stream.write(b"\x2c" + struct.pack("<HHHHB", 0, 0, width, height, 0x80 | (bits - 1)))
        stream.write(palette + blocks)
    stream.write(b"\x3b")


def _gif_picture(frame: NDArray[np.uint8]) -> tuple[bytes, bytes]:
    """Return the palette and the compressed pixels: everything after the last image descriptor of a one-picture GIF."""
    from PIL import Image

    picture = Image.fromarray(frame)
    best = picture.quantize(256, Image.Quantize.MEDIANCUT)
    dithered = picture.quantize(palette=best, dither=Image.Dither.FLOYDSTEINBERG)
    data = BytesIO()
    dithered.save(data, "GIF", optimize=False, interlace=False)
    content = data.getvalue()
    flags = content[10]
    at = 13
    palette = b""
    if flags & 0x80:
        palette = content[at : at + (3 << ((flags & 7) + 1))]
        at += len(palette)
    while content[at] == 0x21:  # extensions: a label, then blocks with their length, up to an empty block
        at += 2
        while content[at]:
            at += content[at] + 1
        at += 1
    assert content[at] == 0x2C and content[-1] == 0x3B
    local = content[at + 9]
    at += 10
    if local & 0x80:
        palette = content[at : at + (3 << ((local & 7) + 1))]
        at += len(palette)
    return palette, content[at:-1]


def write_apng(stream: BinaryIO, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Write frames (h, w, 3 or 4) without loss; `stream` must be seekable, as the number of frames comes first."""
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    first = next(frames)
    height, width = first.shape[:2]
    numerator, denominator = (1, round(fps)) if fps == round(fps) else (1000, round(1000 * fps))
    if denominator > 0xFFFF:
        numerator, denominator = 100, round(100 * fps)
    written = sequence = 0
    control_at = 0
    for frame in chain([first], frames):
        chunks = list(_png_chunks(frame))
        if written == 0:
            stream.write(b"\x89PNG\r\n\x1a\n")
            _write_chunk(stream, *chunks[0])  # IHDR
            control_at = stream.tell()
            _write_chunk(stream, b"acTL", bytes(8))
        control = struct.pack(">IIIIIHHBB", sequence, width, height, 0, 0, numerator, denominator, 0, 0)
        _write_chunk(stream, b"fcTL", control)
        sequence += 1
        for kind, body in chunks:
            if kind == b"IDAT" and written == 0:
                _write_chunk(stream, kind, body)
            elif kind == b"IDAT":
                _write_chunk(stream, b"fdAT", struct.pack(">I", sequence) + body)
                sequence += 1
        written += 1
    _write_chunk(stream, b"IEND", b"")
    end = stream.tell()
    stream.seek(control_at)
    _write_chunk(stream, b"acTL", struct.pack(">II", written, 0))
    stream.seek(end)


def _png_chunks(frame: NDArray[np.uint8]) -> Iterator[tuple[bytes, bytes]]:
    from PIL import Image

    data = BytesIO()
    Image.fromarray(frame).save(data, "PNG")
    content = data.getvalue()
    at = 8
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        yield kind, content[at + 8 : at + 8 + length]
        at += 12 + length


def _write_chunk(stream: BinaryIO, kind: bytes, body: bytes) -> None:
    stream.write(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)))
