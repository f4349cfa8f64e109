"""The careful parser: pydicom's element generator for files of any form, with all of its errors caught.

It gets all files that the plain parser cannot handle.  pydicom is imported at the first call: most series never need
it.
"""

from __future__ import annotations

import io
import zlib
from typing import BinaryIO, cast

from clrecon.dicom.parse.raw import (
    DEFLATED,
    EXPLICIT_BIG,
    FIRST_PIXEL_TAG,
    IMPLICIT_LITTLE,
    MEDIA_CLASS,
    META_START,
    TRANSFER_SYNTAX,
    UNDEFINED_LENGTH,
    CorruptFileError,
    DicomElements,
    decode_uid,
    read_pixel_head,
)

INFLATE_STEP = 1 << 18
ITEM = b"\xfe\xff\x00\xe0"
"""Stands for a wanted sequence of undefined length: only whether it is there is asked."""
META_TAGS = (MEDIA_CLASS, TRANSFER_SYNTAX)
DESCRIPTIVE_TAGS = (0x00080005, 0x0008103E)
"""SpecificCharacterSet and SeriesDescription.  They only describe, so two different values in one file do no harm."""

READ_LIMIT = 4 * 1024 * 1024
"""Most bytes that are read of one file; values that are skipped by their length do not count.

pydicom turns everything inside sequences of undefined length into objects, which takes 50 times the memory and seconds
for each MiB. For other values of undefined length it searches the whole rest of the file for the end.
"""


def parse_carefully(file: BinaryIO, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    """Parse a file, or the start of one.

    file: Begins with the preamble; seekable.
    size: Bytes of the whole file.
    wanted: Tags to keep; None keeps all.
    """
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
        """Read as the file does."""
        self._left -= count
        if self._left < 0:
            raise CorruptFileError(f"its header takes more than {READ_LIMIT} bytes to read")
        return self._read(count)


def _parse_file(file: BinaryIO, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    file.seek(META_START)
    meta, _, meta_remarks = _collect(file, implicit=False, little=True, last_group=2, wanted=())
    transfer_syntax = decode_uid(meta.get(TRANSFER_SYNTAX))
    media_class = decode_uid(meta.get(MEDIA_CLASS))
    if not transfer_syntax:
        raise CorruptFileError("no transfer syntax (0002,0010)")

    start = file.tell()
    inflate_from = -1
    if transfer_syntax == DEFLATED:
        inflate_from, start = start, 0
        file = cast(BinaryIO, _MeteredFile(io.BytesIO(_inflate_header(file))))
    little = transfer_syntax != EXPLICIT_BIG
    implicit = transfer_syntax == IMPLICIT_LITTLE
    found = _looks_implicit(file, start)
    differs = found is not None and found != implicit
    implicit = implicit if found is None else found
    values, vrs, remarks = _collect(file, implicit=implicit, little=little, last_group=None, wanted=wanted)
    place = file.tell()
    tag, offset, length, vr = read_pixel_head(file.read(12), place, implicit, little)
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


def _collect(
    file: BinaryIO, *, implicit: bool, little: bool, last_group: int | None, wanted: tuple[int, ...] | None
) -> tuple[dict[int, bytes], dict[int, str | None], list[str]]:
    """Read elements up to the end of `last_group`, or up to the pixel data; the file position is left there.

    Returns values, their VRs, and remarks about their order.  pydicom's data sets silently keep the last of two
    elements of one tag; here each element is seen.
    """
    from pydicom.filereader import data_element_generator

    def stop(tag: int, vr: str | None, length: int) -> bool:
        return tag >> 16 != last_group if last_group is not None else int.__ge__(tag, FIRST_PIXEL_TAG)

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
            if element.length not in (len(value), UNDEFINED_LENGTH):
                raise CorruptFileError("ends within an element")
            values[int(element.tag)] = value
            vrs[int(element.tag)] = element.VR
        elif wanted is not None and element.tag in wanted and element.VR == "SQ" and value:
            values[int(element.tag)], vrs[int(element.tag)] = ITEM, "SQ"  # of undefined length: parsed already
        if last_group is None or element.tag in META_TAGS:
            order.add(int(element.tag), value if isinstance(value, bytes) else b"")
    return values, vrs, order.remarks


class _Order:
    """Watches for elements that occur twice, or after an element of a higher tag (PS3.5 7.1 allows neither).

    Of two different values nobody can tell which was meant: where this could change a result, the file is corrupt.  The
    same value twice, or a value in a wrong place, gives only a remark.
    """

    def __init__(self) -> None:
        self.remarks: list[str] = []
        self._values: dict[int, bytes] = {}
        self._last = 0

    def add(self, tag: int, value: bytes) -> None:
        """Add the next element."""
        from pydicom.datadict import keyword_for_tag

        place = f"{keyword_for_tag(tag)} ({tag >> 16:04X},{tag & 0xFFFF:04X})".lstrip()
        value = value.rstrip(b" \0")
        if tag not in self._values:
            if tag < self._last:
                self.remarks.append(f"{place} is not in the order of tags: taken all the same")
            self._last = max(tag, self._last)
        elif self._values[tag] == value:
            self.remarks.append(f"{place} is there twice, with the same value")
        elif tag in DESCRIPTIVE_TAGS:
            self.remarks.append(f"{place} is there twice, with two values: the last is taken")
        else:
            raise CorruptFileError(f"{place} is there twice, with two values")
        self._values[tag] = value


def _looks_implicit(file: BinaryIO, start: int) -> bool | None:
    """Tell the encoding from the first element: explicit VR has two capital letters there.  None at the end of the
    data.
    """
    head = file.read(6)
    file.seek(start)
    if len(head) < 6:
        return None
    return not all(0x41 <= letter <= 0x5A for letter in head[4:6])


def _inflate_header(file: BinaryIO) -> bytes:
    """Inflate the start of a deflated data set: enough for its header, and never more than a fixed limit."""
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    inflated = bytearray()
    while len(inflated) < READ_LIMIT and not inflater.eof:
        try:
            deflated = inflater.unconsumed_tail or file.read(INFLATE_STEP)
        except CorruptFileError:
            break  # the limit is that of other files; data up to it are used
        if not deflated:
            break
        inflated += inflater.decompress(deflated, READ_LIMIT - len(inflated))
    if not inflated:
        raise CorruptFileError("nothing in the deflated data set")
    return bytes(inflated)
