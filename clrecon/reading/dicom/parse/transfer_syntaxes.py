"""Transfer syntaxes that can be read, the decoder of each, and where the frames of compressed pixel data lie.

All decoders are under permissive licences; they run in a process of their own (see `decoder_pool`). JPEG baseline,
extended and the retired lossy JPEGs are refused: a CT image has 12 bits or more (DICOM PS3.3 C.8.2.1.1), so baseline
JPEG is never legal, and data stored under the names of the others often have 8 bits.  A wrong surface is worse than
none.

Compressed pixel data is a sequence of items: the basic offset table, which may be empty, then fragments (PS3.5 A.4). An
extended offset table (7FE0,0001) is not needed: it is allowed only where every frame is one fragment (PS3.3
C.7.6.3.1.8), and then the fragments alone tell the frames.
"""

from __future__ import annotations

import importlib.util
import struct
from typing import BinaryIO

from clrecon.errors import RefusedInputError
from clrecon.reading.dicom.parse.plain import DEFLATED, EXPLICIT_BIG, EXPLICIT_LITTLE, IMPLICIT_LITTLE
from clrecon.system.packages import install_command
from clrecon.system.text import escape_text

_NATIVE_SYNTAXES = (IMPLICIT_LITTLE, EXPLICIT_LITTLE, DEFLATED, EXPLICIT_BIG)

_JPEG = "1.2.840.10008.1.2.4."
JPEG_LOSSLESS = (_JPEG + "57", _JPEG + "70")
JPEG_LS = (_JPEG + "80", _JPEG + "81")
JPEG_2000 = tuple(_JPEG + part for part in ("90", "91", "201", "202", "203"))  # from 201: High-Throughput
RLE = "1.2.840.10008.1.2.5"

# For each transfer syntax: (name in `decoder_process`, package) in order of preference, and what to install.  The first
# installed decoder is used.  All give the same values; they differ in speed.
_DECODERS = {
    **dict.fromkeys(JPEG_LOSSLESS, ((("imagecodecs jpeg", "imagecodecs"),), "imagecodecs")),
    **dict.fromkeys(JPEG_LS, ((("jpeg_ls", "jpeg_ls"), ("imagecodecs jpeg_ls", "imagecodecs")), "pyjpegls")),
    **dict.fromkeys(
        JPEG_2000, ((("openjpeg", "openjpeg"), ("imagecodecs jpeg_2000", "imagecodecs")), "pylibjpeg-openjpeg")
    ),
    RLE: ((("rle", "rle"),), "pylibjpeg-rle"),
}

SYNTAX_NAMES = {
    IMPLICIT_LITTLE: "Implicit VR Little Endian",
    EXPLICIT_LITTLE: "Explicit VR Little Endian",
    DEFLATED: "Deflated Explicit VR Little Endian",
    EXPLICIT_BIG: "Explicit VR Big Endian",
    _JPEG + "57": "JPEG Lossless, Non-Hierarchical (Process 14)",
    _JPEG + "70": "JPEG Lossless, Non-Hierarchical, First-Order Prediction (Process 14 [Selection Value 1])",
    _JPEG + "80": "JPEG-LS Lossless Image Compression",
    _JPEG + "81": "JPEG-LS Lossy (Near-Lossless) Image Compression",
    _JPEG + "90": "JPEG 2000 Image Compression (Lossless Only)",
    _JPEG + "91": "JPEG 2000 Image Compression",
    _JPEG + "201": "High-Throughput JPEG 2000 Image Compression (Lossless Only)",
    _JPEG + "202": "High-Throughput JPEG 2000 with RPCL Options Image Compression (Lossless Only)",
    _JPEG + "203": "High-Throughput JPEG 2000 Image Compression",
    RLE: "RLE Lossless",
}
"""Names of all transfer syntaxes that can be read.  pydicom knows them too, but takes a quarter of a second to load."""

_OTHER_NAMES = {
    "1.2.840.113619.5.2": "implicit VR big endian, private to GE",
    "1.2.840.10008.1.2.8.1": "Deflated Image Frame Compression",
}
"""Names that pydicom's dictionary lacks."""


def is_encapsulated(transfer_syntax: str) -> bool:
    return transfer_syntax not in _NATIVE_SYNTAXES


def describe_undecodable(transfer_syntax: str) -> str:
    """Say why pixels of this transfer syntax cannot be read; empty if they can."""
    if transfer_syntax in _NATIVE_SYNTAXES or transfer_syntax in _DECODERS:
        return ""
    from pydicom.config import IGNORE
    from pydicom.uid import UID

    uid = UID(transfer_syntax, validation_mode=IGNORE)
    name = uid.name if uid.name != transfer_syntax else _OTHER_NAMES.get(transfer_syntax, "private or unknown")
    shown = escape_text(transfer_syntax)
    return f"transfer syntax {shown} ({escape_text(name)}) cannot be decoded: convert the series to an uncompressed one"


def choose_decoder(transfer_syntax: str) -> str:
    """Return the name of the decoder for a compressed transfer syntax, one of `decoder_process.DECODERS`."""
    reason = describe_undecodable(transfer_syntax)
    if reason:
        raise RefusedInputError(reason)
    decoders, packages = _DECODERS[transfer_syntax]
    for decoder, package in decoders:
        if importlib.util.find_spec(package) is not None:
            return decoder
    raise RefusedInputError(
        f"transfer syntax {transfer_syntax} needs a decoder that is not installed: {install_command(*packages.split())}"
    )


Pieces = list[tuple[int, int]]
"""For each fragment of a frame: offset of its first byte in the file, and number of bytes."""

_MAX_FRAGMENTS = 1_000_000
_FRAGMENTS_PER_FRAME = 1000
"""Highest mean number of fragments in a frame: writers make one, or pieces of some KiB."""
_ITEM, _END = (0xFFFE, 0xE000), (0xFFFE, 0xE0DD)
_STARTS = (b"\xff\xd8\xff", b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP")
"""First bytes of the codestreams: JPEG and JPEG-LS, JPEG 2000, and JP2."""


def find_frames(file: BinaryIO, start: int, file_bytes: int, frames: int, transfer_syntax: str) -> list[Pieces]:
    """Find the fragments of all frames, as many as the header says, in a buffered file from byte `start` on."""
    table, fragments, _ = _walk_items(file, start, file_bytes, min(_MAX_FRAGMENTS, _FRAGMENTS_PER_FRAME * (frames + 1)))
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
        n for n, (place, length) in enumerate(fragments) if _read_bytes(file, place, min(length, 6)).startswith(_STARTS)
    ]
    if len(firsts) != frames or firsts[0] != 0:
        raise RefusedInputError(
            f"{frames} frame{'s' * (frames != 1)} expected, {len(firsts)} found in {len(fragments)} fragments"
        )
    return [fragments[a:b] for a, b in zip(firsts, [*firsts[1:], len(fragments)], strict=True)]


def find_end(file: BinaryIO, start: int, file_bytes: int) -> int:
    """Return the offset of the byte after the compressed pixel data; parameters and errors as for `find_frames`."""
    return _walk_items(file, start, file_bytes, _MAX_FRAGMENTS)[2]


def read_pieces(file: BinaryIO, pieces: Pieces) -> bytes:
    return b"".join([_read_bytes(file, place, length) for place, length in pieces])


def _walk_items(file: BinaryIO, start: int, file_bytes: int, most: int) -> tuple[tuple[int, int], Pieces, int]:
    """Return the offset table, the fragments, and the offset of the byte after them; a cut stream would decode too."""
    items: Pieces = []
    position = start
    file.seek(start)
    while position + 8 <= file_bytes:
        group, element, length = struct.unpack("<HHL", _read_bytes(file, position, 8))
        position += 8
        if (group, element) == _END:
            return (items[0] if items else (position, 0)), items[1:], position
        if (group, element) != _ITEM:
            raise RefusedInputError(
                f"truncated: no item of compressed pixels where one is expected ({group:04X},{element:04X})"
            )
        if length > file_bytes - position:
            raise RefusedInputError(
                f"truncated: {length} bytes of compressed pixels expected, {file_bytes - position} found"
            )
        items.append((position, length))
        if len(items) > most:
            raise RefusedInputError(f"the compressed pixels are in more than {most} fragments")
        position += length
    raise RefusedInputError("truncated: the compressed pixels have no end mark")


def _firsts_by_table(file: BinaryIO, table: tuple[int, int], fragments: Pieces, frames: int) -> list[int]:
    """Return the index of the first fragment of each frame by the basic offset table; empty if that does not fit."""
    position, length = table
    if length != 4 * frames:
        return []
    offsets = struct.unpack(f"<{frames}L", _read_bytes(file, position, length))
    number = {fragment[0] - fragments[0][0]: n for n, fragment in enumerate(fragments)}
    firsts = [number.get(offset, -1) for offset in offsets]
    rising = all(a < b for a, b in zip(firsts, firsts[1:], strict=False))
    return firsts if rising and firsts[0] == 0 else []


def _read_bytes(file: BinaryIO, position: int, count: int) -> bytes:
    if file.tell() != position:
        file.seek(position)
    data = file.read(count)
    if len(data) < count:
        raise RefusedInputError(f"truncated: {count} bytes of compressed pixels expected, {len(data)} found")
    return data
