"""Surplus bytes beyond the pixels that a header promises: padding, further elements, or a sign of damage.

A header with one column too few shears the picture.  A transfer as text (each LF became CRLF) moves all pixels after
the first LF.  Surplus bytes are the only sign of both, so they must be explained: zeros within the pixel data are
padding, which some scanners write; after the pixel data there may be elements with rising tags, the last of them
(FFFC,FFFC), or nothing (DICOM PS3.5 7.1, PS3.10 7.2).
"""

from __future__ import annotations

import io
import struct
import zlib
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.reading.dicom.parse.elements import inflate
from clrecon.reading.dicom.parse.plain import PIXEL_TAGS, UNDEFINED_LENGTH, CorruptFileError, DicomElements
from clrecon.reading.dicom.parse.transfer_syntaxes import find_end, is_encapsulated
from clrecon.reading.dicom.parse.values import LONG_VRS, ValueProblem, skip_sequence
from clrecon.system.arguments import name_parameter
from clrecon.system.paths import open_regular

_PADDING_TAG = 0xFFFCFFFC
INFLATED_LIMIT = 1 << 30
"""Most bytes of one data set that are inflated."""
_LOOKED_AT_BYTES = 16 * 2**20
"""Most bytes that are examined of a sequence without length, or of a deflated data set after its pixels."""
_MOST_PADDING_BYTES = 64 * 2**20
"""Longest padding of zeros, and most bytes of pixels that are examined: a sparse file can hold zeros without end."""
_MOST_ELEMENTS = 10_000
SHEARED = 0.98
"""Ratio of row differences below which another number of columns explains the pixels better.  Noise gives 1."""
_CHUNK = 2**20


def check_surplus(elements: DicomElements, header: SliceHeader, *, force: bool = False) -> tuple[str, ...]:
    """Examine the surplus bytes of a file, by its first header; `force` takes other ones than zeros as padding."""
    if is_encapsulated(header.transfer_syntax):
        return _check_encapsulated(elements, header, force)
    expected = header.frames * header.pixel_bytes
    length = expected + expected % 2  # after an odd count the standard asks for one padding byte
    end = header.pixel_offset + header.pixel_length
    if header.pixel_length in (expected, length) and end == header.file_bytes and header.inflate_from < 0:
        return ()
    size = header.file_bytes
    with open_regular(header.file) as opened:
        file: BinaryIO = opened
        if header.inflate_from >= 0:
            if header.pixel_offset + expected > INFLATED_LIMIT:
                return ()  # reading refuses this
            inflated = _inflate(file, header.inflate_from, header.pixel_offset + expected)
            file, size = io.BytesIO(inflated), len(inflated)
            if size < header.pixel_offset + expected:
                return ()  # the file is cut off, which reading reports
        warnings = []
        if header.pixel_length > length:
            warnings.append(_judge_excess(file, header, expected, min(end, size) - header.pixel_offset, force))
        if end < size:
            warnings += _judge_tail(file, elements, end, size, force)
    return tuple(warnings)


def _check_encapsulated(elements: DicomElements, header: SliceHeader, force: bool) -> tuple[str, ...]:
    with open_regular(header.file) as file:
        try:
            end = find_end(file, header.pixel_offset, header.file_bytes)
        except RefusedInputError:
            return ()  # cut off or damaged, which reading reports
        return tuple(_judge_tail(file, elements, end, header.file_bytes, force)) if end < header.file_bytes else ()


def _judge_excess(file: BinaryIO, header: SliceHeader, expected: int, size: int, force: bool) -> str:
    frames = f"{header.frames} x " if header.frames > 1 else ""
    counts = (
        f"Pixel Data has {header.pixel_length} bytes, {frames}{header.columns} x {header.rows} x "
        f"{header.bits_allocated} bit take {expected}"
    )
    if size < header.pixel_length:
        counts += f", {size} are there: the file is cut"
    elif _is_zero(file, header.pixel_offset + expected, size - expected):
        columns = _find_hidden_columns(file, header, size)
        if not columns:
            return f"{counts}: the rest is zeros, taken as padding"
        counts += f": rows are more alike with {columns} columns"
    else:
        counts += ": more pixels than the header says"
    if force:
        return f"{counts}; the rest was left out on demand"
    raise ValueProblem(f"{counts} ({name_parameter('force', True)} leaves the rest out)")


def _is_zero(file: BinaryIO, start: int, count: int) -> bool:
    """True for bytes of 0; False for more than `_MOST_PADDING_BYTES`, which are not examined."""
    if count > _MOST_PADDING_BYTES:
        return False
    file.seek(start)
    while count > 0:
        part = file.read(min(count, _CHUNK))
        if not part or part.strip(b"\0"):
            return False
        count -= len(part)
    return True


def _find_hidden_columns(file: BinaryIO, header: SliceHeader, byte_count: int) -> int:
    """Return the number of columns that the first frame's pixels suggest, if the bytes suffice for more; else 0."""
    item = header.bits_allocated // 8
    columns, rest = divmod(byte_count, header.frames * header.rows * item)
    if rest or columns <= header.columns or header.rows < 2:
        return 0
    rows = min(header.rows, _MOST_PADDING_BYTES // (columns * item))
    file.seek(header.pixel_offset)
    data = file.read(rows * columns * item)
    if rows < 2 or len(data) < rows * columns * item:
        return 0
    whole = "i" if header.signed else "u"
    kind = f"{'<' if header.little_endian else '>'}{'f' if header.float_pixels else whole}{item}"
    pixels = np.frombuffer(data, kind).astype(np.float64)
    steps_as_told = _measure_steps(pixels[: rows * header.columns].reshape(rows, header.columns))
    steps = _measure_steps(pixels.reshape(rows, columns))
    return columns if steps < SHEARED * steps_as_told else 0


def _measure_steps(picture: NDArray[np.float64]) -> float:
    """Return the mean difference between rows; float pixels may hold NaN."""
    with np.errstate(all="ignore"):
        return float(np.mean(np.abs(np.diff(picture, axis=0))))


def _judge_tail(file: BinaryIO, elements: DicomElements, end: int, size: int, force: bool) -> list[str]:
    """Judge the bytes after the pixel data, from `end` to `size`."""
    if _is_zero(file, end, size - end):
        counts = f"{size - end} zero bytes behind the pixel data"
        if not force:
            raise CorruptFileError(f"{counts} ({name_parameter('force', True)} leaves the rest out)")
        return [f"{counts}: left out on demand"]
    try:
        _check_tail(file, end, size, implicit=not elements.pixel_vr, little_endian=elements.little_endian)
    except CorruptFileError as error:
        how = ""
        if _was_sent_as_text(file, elements.pixel_offset, size):
            how = "; no LF in its pixels stands without CR: it was sent as text, send it as binary data"
        raise CorruptFileError(f"{error}{how}") from error
    return []


def _check_tail(file: BinaryIO, start: int, size: int, *, implicit: bool, little_endian: bool) -> None:
    """Walk over the bytes after the pixel data, from `start` to the end of the file at `size`."""
    wrong = CorruptFileError(f"{size - start} bytes behind the pixel data are no elements of DICOM")
    position, last = start, PIXEL_TAGS[-1]
    for _ in range(_MOST_ELEMENTS):
        if position == size:
            return
        file.seek(position)
        head = file.read(12)
        if len(head) < 8:
            raise wrong
        tag, length, value = _read_head(head, implicit, little_endian)
        if tag <= last:
            raise wrong
        if length == UNDEFINED_LENGTH:
            file.seek(position + value)
            try:
                length = skip_sequence(file.read(_LOOKED_AT_BYTES), implicit=implicit, little_endian=little_endian)
            except ValueProblem as problem:
                raise wrong from problem
        position += value + length
        last = tag
        if position > size or tag == _PADDING_TAG and position < size:
            raise wrong
    raise wrong


def _read_head(head: bytes, implicit: bool, little: bool) -> tuple[int, int, int]:
    """Return tag and length of an element, and the size of its head; the tag is 0 where the bytes are not a head."""
    order = "<" if little else ">"
    group, element = struct.unpack(order + "HH", head[:4])
    tag = group << 16 | element
    if implicit:
        return tag, struct.unpack(order + "L", head[4:8])[0], 8
    vr = head[4:6]
    if vr in LONG_VRS:
        return (tag, struct.unpack(order + "L", head[8:12])[0], 12) if len(head) == 12 else (0, 0, 12)
    capitals = all(0x41 <= letter <= 0x5A for letter in vr)
    return (tag if capitals else 0), struct.unpack(order + "H", head[6:8])[0], 8


def _was_sent_as_text(file: BinaryIO, start: int, size: int) -> bool:
    """True where every LF follows a CR; in random data one of 256 does."""
    file.seek(start)
    data = file.read(min(size - start, _CHUNK))
    return data.count(b"\n") > 8 and data.count(b"\n") == data.count(b"\r\n")


def _inflate(file: BinaryIO, start: int, needed: int) -> bytes:
    """Inflate a deflated data set: `needed` bytes of it and at most `_LOOKED_AT_BYTES` more."""
    file.seek(start)
    limit = needed + _LOOKED_AT_BYTES
    try:
        inflated, behind = inflate(file.read, limit + 1, _CHUNK)
    except zlib.error as error:
        raise CorruptFileError("the deflated data set is damaged") from error
    if len(inflated) > limit:
        raise CorruptFileError(f"over {_LOOKED_AT_BYTES} bytes follow the pixels of a deflated data set")
    if behind.strip(b"\0"):
        raise CorruptFileError(f"{len(behind)} bytes behind the deflated data set")
    return inflated
