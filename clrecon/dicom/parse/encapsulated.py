"""The places of the frames of compressed pixel data in a file (DICOM PS3.5 A.4).

Pixel data is a sequence of items: first the basic offset table, which may be empty, then fragments.  They are walked
once for each file.  An extended offset table (7FE0,0001) is not needed: it is allowed only where every frame is one
fragment (PS3.3 C.7.6.3.1.8), and then the fragments alone tell the frames.
"""

from __future__ import annotations

import struct
from typing import BinaryIO

from clrecon.dicom.parse.transfer_syntaxes import RLE
from clrecon.errors import RefusedInputError

Pieces = list[tuple[int, int]]
"""For each fragment of a frame: offset of its first byte in the file, and number of bytes."""

MAX_FRAGMENTS = 1_000_000
FRAGMENTS_PER_FRAME = 1000
"""Highest mean number of fragments in a frame: writers make one, or pieces of some KiB."""
_ITEM, _END = (0xFFFE, 0xE000), (0xFFFE, 0xE0DD)
_STARTS = (b"\xff\xd8\xff", b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP")
"""First bytes of the codestreams: JPEG and JPEG-LS, JPEG 2000, and JP2."""


def find_frames(file: BinaryIO, start: int, file_bytes: int, frames: int, transfer_syntax: str) -> list[Pieces]:
    """Find the fragments of every frame.

    file: Buffered, opened for reading.
    start: Offset of the first item, bytes.
    file_bytes: Size of the file.
    frames: Number of frames according to the header.
    """
    table, fragments, _ = _walk_items(file, start, file_bytes, min(MAX_FRAGMENTS, FRAGMENTS_PER_FRAME * (frames + 1)))
    if not fragments:
        raise RefusedInputError("truncated: there are no compressed pixels")
    if len(fragments) == frames:
        return [[fragment] for fragment in fragments]
    if len(fragments) < frames:
        raise RefusedInputError(f"truncated: {frames} frames expected, {len(fragments)} fragments found")
    if transfer_syntax == RLE:
        if frames == 1:
            return [fragments]
        raise RefusedInputError(f"{len(fragments)} fragments for {frames} RLE frames, which have one each")
    firsts = _firsts_by_table(file, table, fragments, frames) or [
        n for n, (place, length) in enumerate(fragments) if _read(file, place, min(length, 6)).startswith(_STARTS)
    ]
    if len(firsts) != frames or firsts[0] != 0:
        raise RefusedInputError(
            f"{frames} frame{'s' * (frames != 1)} expected, {len(firsts)} found in {len(fragments)} fragments"
        )
    return [fragments[a:b] for a, b in zip(firsts, [*firsts[1:], len(fragments)], strict=True)]


def find_end(file: BinaryIO, start: int, file_bytes: int) -> int:
    """Return the offset of the byte after the compressed pixel data; parameters and errors as for `find_frames`."""
    return _walk_items(file, start, file_bytes, MAX_FRAGMENTS)[2]


def read_pieces(file: BinaryIO, pieces: Pieces) -> bytes:
    """Read the fragments of one frame."""
    return b"".join([_read(file, place, length) for place, length in pieces])


def _walk_items(file: BinaryIO, start: int, file_bytes: int, most: int) -> tuple[tuple[int, int], Pieces, int]:
    """Return the offset table, the fragments, and the offset of the byte after them.

    A cut codestream still decodes to an image, so a cut must be noticed here.
    """
    items: Pieces = []
    place = start
    file.seek(start)
    while place + 8 <= file_bytes:
        group, element, length = struct.unpack("<HHL", _read(file, place, 8))
        place += 8
        if (group, element) == _END:
            return (items[0] if items else (place, 0)), items[1:], place
        if (group, element) != _ITEM:
            raise RefusedInputError(
                f"truncated: no item of compressed pixels where one is expected ({group:04X},{element:04X})"
            )
        if length > file_bytes - place:
            raise RefusedInputError(
                f"truncated: {length} bytes of compressed pixels expected, {file_bytes - place} found"
            )
        items.append((place, length))
        if len(items) > most:
            raise RefusedInputError(f"the compressed pixels are in more than {most} fragments")
        place += length
    raise RefusedInputError("truncated: the compressed pixels have no end mark")


def _firsts_by_table(file: BinaryIO, table: tuple[int, int], fragments: Pieces, frames: int) -> list[int]:
    """Return the index of the first fragment of each frame by the basic offset table; empty if that does not fit."""
    place, length = table
    if length != 4 * frames:
        return []
    offsets = struct.unpack(f"<{frames}L", _read(file, place, length))
    number = {fragment[0] - fragments[0][0]: n for n, fragment in enumerate(fragments)}
    firsts = [number.get(offset, -1) for offset in offsets]
    rising = all(a < b for a, b in zip(firsts, firsts[1:], strict=False))
    return firsts if rising and firsts[0] == 0 else []


def _read(file: BinaryIO, place: int, count: int) -> bytes:
    if file.tell() != place:
        file.seek(place)
    data = file.read(count)
    if len(data) < count:
        raise RefusedInputError(f"truncated: {count} bytes of compressed pixels expected, {len(data)} found")
    return data
