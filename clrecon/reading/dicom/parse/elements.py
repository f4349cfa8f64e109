"""The raw data elements of one file, with undecoded values, and the place of its pixel data.

Only the start of a file is read: the first `PREFIX_BYTES` hold the header of nearly every CT image.  The plain parser
walks over it by lengths.  Files that it cannot handle are parsed with pydicom's element generator, all of its errors
caught, which most series never need to import.  No value is converted here, because pydicom accepts wrong values (text,
NaN, the wrong count) without an error.

DICOM files begin with a preamble, the mark "DICM" and a meta header that names the transfer syntax (PS3.10 7.1).
Network dumps and old archives hold bare data sets; their encoding is guessed, only when a user asks for it.  Implicit
VR little endian is the default (PS3.5 10.1); explicit VR shows two capital letters after the first tag.
"""

from __future__ import annotations

import io
import os
import stat
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, NamedTuple, cast

from clrecon.reading.dicom.parse import plain
from clrecon.reading.dicom.parse.plain import CorruptFileError, DicomElements
from clrecon.reading.dicom.parse.values import name_tag
from clrecon.system.arguments import name_parameter
from clrecon.system.paths import open_regular

MARK_END = 132  # 128 bytes of preamble, then "DICM"
_PREAMBLE = bytes(128) + b"DICM"
_FIRST_GROUP = 0x0008
_FIRST_LENGTH_LIMIT = 1024
"""Longest first element: data sets begin with short ones, such as group length, character set, type or date."""
ENCODINGS = {
    plain.IMPLICIT_LITTLE: "implicit VR little endian",
    plain.EXPLICIT_LITTLE: "explicit VR little endian",
    plain.EXPLICIT_BIG: "explicit VR big endian",
}
_PROGRAMS = {
    b"MZ": "Windows",
    b"\x7fELF": "Linux",
    b"\xcf\xfa\xed\xfe": "macOS",
    b"\xca\xfe\xba\xbe": "macOS",
    b"#!": "script",
}


class Start(NamedTuple):
    """The bytes that stand for the first `skip` bytes of a file, and a one-line remark about them."""

    head: bytes
    skip: int
    remark: str


def describe_way_out() -> str:
    """Say what can be done about a data set whose encoding is not recorded."""
    return f"{name_parameter('force', True)} guesses it"


def restore_start(data: bytes) -> Start | None:
    """Return the standard start for a file with these first bytes; None where it has one, or is no data set."""
    marked = data[128:MARK_END] == b"DICM"
    skip = 4 if data[:4] == b"DICM" else 0
    if marked:
        skip = MARK_END
    if data[skip : skip + 2] == b"\x02\0" and data[skip + 4 : skip + 6].isalpha():
        return None if marked else Start(_PREAMBLE, skip, "no preamble: read on demand")
    syntax = _guess_syntax(data[skip : skip + 8])
    if syntax is None:
        return None
    value = syntax.encode() + b"\0" * (len(syntax) % 2)
    meta = struct.pack("<HH2sH", 0x0002, 0x0010, b"UI", len(value)) + value
    return Start(_PREAMBLE + meta, skip, f"no meta header: read on demand, {ENCODINGS[syntax]} taken")


def _guess_syntax(head: bytes) -> str | None:
    """Return the transfer syntax of a data set that begins with these 8 bytes; None if they cannot begin one."""
    if len(head) < 8:
        return None
    explicit = all(0x41 <= letter <= 0x5A for letter in head[4:6])
    for syntax, order in ((plain.EXPLICIT_LITTLE, "<"), (plain.EXPLICIT_BIG, ">")):
        group, length = struct.unpack(order + "H4xH", head)
        if group == _FIRST_GROUP and explicit and length < _FIRST_LENGTH_LIMIT:
            return syntax
    group, length = struct.unpack("<H2xL", head)
    return plain.IMPLICIT_LITTLE if group == _FIRST_GROUP and length < _FIRST_LENGTH_LIMIT and not explicit else None


INFLATE_STEP = 1 << 18
ITEM = b"\xfe\xff\x00\xe0"
"""Stands for a wanted sequence of undefined length: only whether it is there is asked."""
_META_TAGS = (plain.MEDIA_CLASS, plain.TRANSFER_SYNTAX)
_DESCRIPTIVE_TAGS = (0x00080005, 0x0008103E)
"""SpecificCharacterSet and SeriesDescription.  They only describe, so two different values in one file do no harm."""

READ_LIMIT = 4 * 1024 * 1024
"""Most bytes that are read of one file; values that are skipped by their length do not count. pydicom turns everything
inside sequences of undefined length into objects, which takes 50 times the memory and seconds for each MiB, and for
other values of undefined length it searches the whole rest of the file for the end."""


def parse_carefully(file: BinaryIO, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    """Parse a file of `size` bytes, or its start, from the preamble on; `wanted` are the tags to keep, None for all."""
    try:
        return _parse_file(cast(BinaryIO, _MeteredFile(file)), size, wanted)
    except CorruptFileError:
        raise
    except Exception as error:
        if _is_of_recursion(error):
            raise CorruptFileError("sequences are nested too deep") from error
        if isinstance(error, OSError) and error.errno is not None:
            raise  # errors of the disk have a number; those of the parser, for a cut sequence, have none
        # The parser meets hostile bytes here and may fail in any way; all of them mean the same to us.
        raise CorruptFileError(f"cannot be parsed ({type(error).__name__})") from error


def _is_of_recursion(error: BaseException | None) -> bool:
    """True for a RecursionError, and for an error that the parser made of one on its way up."""
    while error is not None:
        if isinstance(error, RecursionError):
            return True
        error = error.__context__
    return False


class _MeteredFile:
    """A file of which at most `READ_LIMIT` bytes are read."""

    def __init__(self, file: BinaryIO):
        self.seek, self.tell = file.seek, file.tell
        self._read, self._left = file.read, READ_LIMIT

    def read(self, count: int) -> bytes:
        self._left -= count
        if self._left < 0:
            raise CorruptFileError(f"its header takes more than {READ_LIMIT} bytes to read")
        return self._read(count)


def _parse_file(file: BinaryIO, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    file.seek(plain.META_START)
    meta, _, meta_remarks = _collect_values(file, implicit=False, little=True, last_group=2, wanted=())
    transfer_syntax = plain.decode_uid(meta.get(plain.TRANSFER_SYNTAX))
    media_class = plain.decode_uid(meta.get(plain.MEDIA_CLASS))
    if not transfer_syntax:
        raise CorruptFileError("no transfer syntax (0002,0010)")

    start = file.tell()
    inflate_from = -1
    if transfer_syntax == plain.DEFLATED:
        inflate_from, start = start, 0
        file = cast(BinaryIO, _MeteredFile(io.BytesIO(_inflate_header(file))))
    little = transfer_syntax != plain.EXPLICIT_BIG
    implicit = transfer_syntax == plain.IMPLICIT_LITTLE
    seen_implicit = _looks_implicit(file, start)
    differs = seen_implicit is not None and seen_implicit != implicit
    implicit = implicit if seen_implicit is None else seen_implicit
    values, vrs, remarks = _collect_values(file, implicit=implicit, little=little, last_group=None, wanted=wanted)
    position = file.tell()
    tag, offset, length, vr = plain.read_pixel_head(file.read(12), position, implicit, little)
    return DicomElements(
        transfer_syntax,
        media_class,
        values,
        vrs,
        little,
        differs,
        tag,
        offset,
        length,
        vr,
        inflate_from,
        size,
        tuple(dict.fromkeys(meta_remarks + remarks)),
    )


def _collect_values(
    file: BinaryIO, *, implicit: bool, little: bool, last_group: int | None, wanted: tuple[int, ...] | None
) -> tuple[dict[int, bytes], dict[int, str | None], list[str]]:
    """Read values up to the end of `last_group` or the pixel data, VRs, and remarks on order, which pydicom hides."""
    from pydicom.filereader import data_element_generator

    def stop(tag: int, vr: str | None, length: int) -> bool:
        return tag >> 16 != last_group if last_group is not None else int.__ge__(tag, plain.FIRST_PIXEL_TAG)

    values: dict[int, bytes] = {}
    vrs: dict[int, str | None] = {}
    order = _Order()
    for element in data_element_generator(
        file,
        implicit,
        little,
        stop_when=stop,
        specific_tags=None if wanted is None else list(wanted),  # type: ignore[arg-type]
    ):
        value = element.value
        if isinstance(value, bytes) and value:
            if element.length not in (len(value), plain.UNDEFINED_LENGTH):
                raise CorruptFileError("ends within an element")
            values[int(element.tag)] = value
            vrs[int(element.tag)] = element.VR
        elif wanted is not None and element.tag in wanted and element.VR == "SQ" and value:
            values[int(element.tag)], vrs[int(element.tag)] = ITEM, "SQ"  # of undefined length: parsed already
        if last_group is None or element.tag in _META_TAGS:
            order.add(int(element.tag), value if isinstance(value, bytes) else b"")
    return values, vrs, order.remarks


class _Order:
    """Watches for elements that occur twice, or after an element of a higher tag (PS3.5 7.1 allows neither).

    Of two different values nobody can tell which was meant: where this could change a result, the file is corrupt.
    """

    def __init__(self) -> None:
        self.remarks: list[str] = []
        self._values: dict[int, bytes] = {}
        self._last = 0

    def add(self, tag: int, value: bytes) -> None:
        tag_name = name_tag(tag)
        value = value.rstrip(b" \0")
        if tag not in self._values:
            if tag < self._last:
                self.remarks.append(f"{tag_name} is not in the order of tags: taken all the same")
            self._last = max(tag, self._last)
        elif self._values[tag] == value:
            self.remarks.append(f"{tag_name} is there twice, with the same value")
        elif tag in _DESCRIPTIVE_TAGS:
            self.remarks.append(f"{tag_name} is there twice, with two values: the last is taken")
        else:
            raise CorruptFileError(f"{tag_name} is there twice, with two values")
        self._values[tag] = value


def _looks_implicit(file: BinaryIO, start: int) -> bool | None:
    """Tell the encoding from the first element: explicit VR has two capital letters.  None at the end of the data."""
    head = file.read(6)
    file.seek(start)
    if len(head) < 6:
        return None
    return not all(0x41 <= letter <= 0x5A for letter in head[4:6])


def _inflate_header(file: BinaryIO) -> bytes:
    """Inflate the start of a deflated data set: enough for its header, and never more than a fixed limit."""

    def read_bytes(count: int) -> bytes:
        try:
            return file.read(count)
        except CorruptFileError:
            return b""  # the limit is that of other files; data up to it are used

    inflated, _ = inflate(read_bytes, READ_LIMIT, INFLATE_STEP)
    if not inflated:
        raise CorruptFileError("nothing in the deflated data set")
    return inflated


def inflate(read: Callable[[int], bytes], most: int, step: int) -> tuple[bytes, bytes]:
    """Inflate raw Deflate up to `most` bytes, read `step` bytes at a time; also return what was read beyond its end."""
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    inflated = bytearray()
    while len(inflated) < most and not inflater.eof:
        deflated = inflater.unconsumed_tail or read(step)
        if not deflated:
            break
        inflated += inflater.decompress(deflated, most - len(inflated))
    return bytes(inflated), inflater.unused_data


PREFIX_BYTES = 16 * 1024
_LONG_PREFIX_BYTES = 256 * 1024
"""Bytes read at once where the first prefix does not hold the whole header: large private elements, many frames."""
_RESTORED_LIMIT = 16 * 1024 * 1024
"""For a file without its standard start: the header must end within this many bytes."""
_LONGEST_PREFIX_BYTES = (16 * 2**20, 256 * 2**20)
"""Bytes read where that is not enough either: contours, segments and other objects that are nearly all header."""
# A pipe or device in the place of a listed file must not make the reader wait for a writer.
_OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


class FileStart(NamedTuple):
    """The first bytes of a file, at most `PREFIX_BYTES`, and the size of the file."""

    prefix: bytes
    size: int


def read_start(path: str | Path, limit: int = PREFIX_BYTES) -> FileStart:
    descriptor = os.open(path, _OPEN_FLAGS)
    try:
        facts = os.fstat(descriptor)
        if not stat.S_ISREG(facts.st_mode):
            raise OSError("no regular file")
        return FileStart(os.read(descriptor, min(limit, facts.st_size)), facts.st_size)
    finally:
        os.close(descriptor)


def has_dicom_mark(prefix: bytes) -> bool:
    """True when the bytes carry the mark of a DICOM file behind the preamble."""
    return prefix[128 : plain.META_START] == b"DICM"


def read_elements(
    path: Path, wanted: tuple[int, ...] | None, start: FileStart | None = None, *, force: bool = False
) -> DicomElements:
    """Read the raw elements of a DICOM file, wanted ones or all; `start` was read before; `force` guesses the form."""
    prefix, size = start or read_start(path)
    restored = restore_start(prefix)
    if restored is not None and force:
        return _read_restored(path, restored, size, wanted)
    if not has_dicom_mark(prefix):
        raise plain.NotDicomError("no DICM mark at byte 128", prefix)
    if restored is not None:
        raise CorruptFileError(f"no meta header ({describe_way_out()})")
    elements = _read_marked(path, prefix, size, wanted)
    program = next((name for mark, name in _PROGRAMS.items() if prefix.startswith(mark)), "")
    if program:
        remark = f"the preamble starts a program ({program}): neither run nor copied"
        elements = elements._replace(remarks=(remark, *elements.remarks))
    return elements


def _read_restored(path: Path, restored: Start, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    """Read a file as if it had the standard start that it lacks; all offsets are those of the file itself."""
    with open_regular(path) as file:
        file.seek(restored.skip)
        data = restored.head + file.read(_RESTORED_LIMIT)
    added = len(restored.head) - restored.skip
    elements = parse_carefully(io.BytesIO(data), size + added, wanted)
    deflated = elements.inflate_from >= 0
    return elements._replace(
        pixel_offset=elements.pixel_offset - (0 if deflated else added),
        inflate_from=elements.inflate_from - added if deflated else -1,
        file_bytes=size,
        remarks=(restored.remark, *elements.remarks),
        restored=True,
    )


def _read_marked(path: Path, prefix: bytes, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    elements = plain.parse_plainly(prefix, size, wanted)
    if elements is None and len(prefix) < size:
        prefix, size = read_start(path, _LONG_PREFIX_BYTES)
        elements = plain.parse_plainly(prefix, size, wanted)
    if elements is not None:
        return elements
    if len(prefix) >= size:
        return parse_carefully(io.BytesIO(prefix), size, wanted)
    try:
        elements = parse_carefully(io.BytesIO(prefix), size, wanted)
    except CorruptFileError:
        elements = None  # most likely an element that extends beyond the prefix
    if elements is not None and elements.pixel_tag is not None:
        return elements
    for limit in _LONGEST_PREFIX_BYTES:
        if len(prefix) < size:
            prefix, size = read_start(path, limit)
            elements = plain.parse_plainly(prefix, size, wanted)
            if elements is not None:
                return elements
    del prefix
    with open_regular(path) as file:
        return parse_carefully(file, size, wanted)
