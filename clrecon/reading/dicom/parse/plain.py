"""The plain parser of headers of usual form, many times as fast as the careful one; what both return.

It reads by the lengths of the elements alone.  The usual form is: little endian, encoded as the transfer syntax says,
known value representations, no length beyond the bytes at hand, sequences of undefined length with well-formed items,
each wanted element once and in rising order, and pixel data at the end.  Any other form is left to `parse_carefully`;
the results of both are equal, which tests compare on mutated files.
"""

from __future__ import annotations

import re
import struct
from functools import lru_cache
from typing import NamedTuple

from clrecon.errors import RefusedInputError

IMPLICIT_LITTLE = "1.2.840.10008.1.2"
EXPLICIT_LITTLE = "1.2.840.10008.1.2.1"
DEFLATED = "1.2.840.10008.1.2.1.99"
EXPLICIT_BIG = "1.2.840.10008.1.2.2"
META_START = 132  # 128 bytes of preamble, then "DICM"
TRANSFER_SYNTAX, MEDIA_CLASS = 0x00020010, 0x00020002
UNDEFINED_LENGTH = 0xFFFFFFFF
FIRST_PIXEL_TAG = 0x7FE00008
PIXEL_TAGS = (0x7FE00008, 0x7FE00009, 0x7FE00010)
_PIXEL_VRS = (b"OB", b"OW", b"OF", b"OD", b"OL", b"OV", b"UN")


class NotDicomError(RefusedInputError):
    """There is no "DICM" at byte 128; `start` are the first bytes, all of a file no longer than `PREFIX_BYTES`."""

    def __init__(self, message: str, start: bytes):
        super().__init__(message)
        self.start = start


class CorruptFileError(RefusedInputError):
    """The file says that it is DICOM but cannot be parsed up to its pixel data."""


class DicomElements(NamedTuple):
    """Raw data elements of one file.

    values: Tag to undecoded value, of the wanted tags that are present and not empty.
    vrs: Value representations of these elements; None in implicit VR.
    encoding_differs: Implicit where the transfer syntax says explicit VR, or the other way round; parsed as found.
    pixel_tag: None where the file ends without pixel data.
    pixel_offset, pixel_length: First byte and count of bytes of the pixel data value in the file, or, in deflated
        files, in the inflated data set.  The length is -1 where it is undefined (encapsulated).
    pixel_vr: Empty in implicit VR.
    inflate_from: Offset in the file of the deflated data set, -1 where it is not deflated.
    restored: The file lacks the start of a DICOM file.
    """

    transfer_syntax: str
    media_class: str
    values: dict[int, bytes]
    vrs: dict[int, str | None]
    little_endian: bool
    encoding_differs: bool
    pixel_tag: int | None
    pixel_offset: int
    pixel_length: int
    pixel_vr: str
    inflate_from: int
    file_bytes: int
    remarks: tuple[str, ...] = ()
    restored: bool = False


@lru_cache(64)
def decode_uid(value: bytes | None) -> str:
    return (value or b"").rstrip(b"\0 ").decode("ascii", "replace")


def read_pixel_head(head: bytes, start: int, implicit: bool, little: bool) -> tuple[int | None, int, int, str]:
    """Read from 12 bytes at `start`, fewer at the end: tag of the pixel data, offset and length of its value, VR.

    The tag is None where this is another element, or the end; the length -1 where it is undefined; the VR empty if
    implicit.
    """
    if len(head) < 8:
        return None, -1, 0, ""
    order = "<" if little else ">"
    group, element = struct.unpack(order + "HH", head[:4])
    tag = group << 16 | element
    if tag not in PIXEL_TAGS:
        return None, -1, 0, ""
    # Implicit VR has the length in these bytes; no even length looks like one of the two-letter names.
    vr = head[4:6]
    if vr in _PIXEL_VRS and len(head) == 12:
        length = struct.unpack(order + "L", head[8:12])[0]
        offset = start + 12
        name = vr.decode("ascii")
    elif implicit:
        length = struct.unpack(order + "L", head[4:8])[0]
        offset = start + 8
        name = ""
    else:
        raise CorruptFileError("the head of the pixel data element is damaged")
    return tag, offset, -1 if length == UNDEFINED_LENGTH else length, name


SHORT_VRS = {name.encode(): name for name in "AE AS AT CS DA DS DT FD FL IS LO LT PN SH SL SS ST TM UI UL US".split()}
"""Value representations with a length of 16 bits in explicit VR."""
LONG_VRS = {name.encode(): name for name in "OB OD OF OL OV OW SQ SV UC UN UR UT UV".split()}
"""Value representations with a length of 32 bits, after two reserved bytes."""

# Tags are compared as stored in the file, read as one 32-bit number: the group is the lower half.
_ITEM, _ITEM_END, _SEQUENCE_END = 0xE000FFFE, 0xE00DFFFE, 0xE0DDFFFE
_CHARACTER_SET = 0x00050008
_PIXEL_GROUP = 0x7FE0
_DELIMITER_GROUP = 0xFFFE

SEQUENCE_TAGS = frozenset(
    int(tag, 16)
    for tag in """
    00080051 00080082 00080096 00080110 00081032 0008103F 00081072 00081084 00081110 00081111 00081115 00081120
    00081140 0008114A 00081199 00081250 00082112 00082218 00082228 00089092 00089121 00089124 00089215 00100024
    00100050 00100101 00101002 00101100 00120064 00180012 00180014 00180026 00180029 0018002A 00189301 00189304
    00189308 00189312 00189314 00189321 00189325 00189326 00189329 00189346 00189360 00189477 00189737 00209071
    00209111 00209113 00209116 00209221 00209222 00283000 00283010 00289110 00289132 00289145 00321064 00380004
    00380100 00400008 00400260 00400275 00400293 00400440 00400520 00400555 00400560 00400610 0040A043 0040A168
    0040A170 0040A370 0040A372 0040A504 0040A525 0040A730 00540220 00660002 00880200 04000550 04000561 52009229
    52009230
    """.split()
)
"""Sequences that occur in CT headers.  In implicit VR an undefined length alone does not prove a sequence."""
_SEQUENCE_KEYS = frozenset((tag & 0xFFFF) << 16 | tag >> 16 for tag in SEQUENCE_TAGS)
DEEPEST = 8
CHARACTER_SET = 0x00080005
_known_character_sets = re.compile(
    rb"(ISO_IR \d{1,3}|ISO 2022 IR \d{1,3}|GB18030|GBK)?(\\ISO 2022 IR \d{1,3})* ?"
).fullmatch
"""Names that pydicom knows; it looks up others among Python's codecs, which may fail."""

_explicit_head = struct.Struct("<L2sH").unpack_from
_implicit_head = struct.Struct("<LL").unpack_from
_long_length = struct.Struct("<L").unpack_from


class _NotPlainError(Exception):
    """The file is left to the careful parser."""


class _Everything(dict[int, int]):
    """A table of wanted tags that contains every element except those of undefined length."""

    def __contains__(self, key: object) -> bool:
        return True

    def __missing__(self, key: int) -> int:
        return (key & 0xFFFF) << 16 | key >> 16


def parse_plainly(data: bytes, size: int, wanted: tuple[int, ...] | None) -> DicomElements | None:
    """Parse the start of a file of `size` bytes, `wanted` tags or all; None for another form or an end beyond it."""
    try:
        return _parse_data(data, size, wanted)
    except (_NotPlainError, CorruptFileError, struct.error):
        return None


def _parse_data(data: bytes, size: int, wanted: tuple[int, ...] | None) -> DicomElements | None:
    meta, _, start = _walk_explicit(data, META_START, _keys((TRANSFER_SYNTAX, MEDIA_CLASS)), meta=True)
    transfer_syntax = decode_uid(meta.get(TRANSFER_SYNTAX))
    if not transfer_syntax or transfer_syntax in (DEFLATED, EXPLICIT_BIG):
        return None
    implicit = transfer_syntax == IMPLICIT_LITTLE
    # Explicit VR has two capital letters after the first tag.  The explicit walk ends at anything else.
    if implicit and 0x41 <= data[start + 4] <= 0x5A and 0x41 <= data[start + 5] <= 0x5A:
        return None
    vrs: dict[int, str | None]
    if implicit:
        values, position = _walk_implicit(data, start, _keys(wanted))
        vrs = dict.fromkeys(values)
    else:
        values, vrs, position = _walk_explicit(data, start, _keys(wanted))
    tag, offset, length, vr = read_pixel_head(data[position : position + 12], position, implicit, True)
    if tag is None or not _known_character_sets(values.get(CHARACTER_SET, b"")):
        return None
    return DicomElements(
        transfer_syntax,
        decode_uid(meta.get(MEDIA_CLASS)),
        values,
        vrs,
        little_endian=True,
        encoding_differs=False,
        pixel_tag=tag,
        pixel_offset=offset,
        pixel_length=length,
        pixel_vr=vr,
        inflate_from=-1,
        file_bytes=size,
    )


@lru_cache(maxsize=8)
def _keys(tags: tuple[int, ...] | None) -> dict[int, int]:
    if tags is None:
        return _Everything()
    return {(tag & 0xFFFF) << 16 | tag >> 16: tag for tag in tags}


def _walk_explicit(
    data: bytes, position: int, wanted: dict[int, int], *, meta: bool = False
) -> tuple[dict[int, bytes], dict[int, str | None], int]:
    """Walk to the pixel data, or the meta header's end; return values, VRs and the offset, perhaps beyond `data`."""
    values: dict[int, bytes] = {}
    vrs: dict[int, str | None] = {}
    last = 0
    while True:
        key, name, length = _explicit_head(data, position)
        group = key & 0xFFFF
        if meta:
            if group != 2:
                if group == _DELIMITER_GROUP:
                    raise _NotPlainError
                return values, vrs, position
        elif group >= _PIXEL_GROUP and (group << 16 | key >> 16) >= FIRST_PIXEL_TAG:
            return values, vrs, position
        if name in SHORT_VRS:
            vr = SHORT_VRS[name]
            position += 8
        elif name in LONG_VRS:
            vr = LONG_VRS[name]
            (length,) = _long_length(data, position + 8)
            position += 12
            if length == UNDEFINED_LENGTH:
                if vr != "SQ" or meta or wanted.get(key):
                    raise _NotPlainError
                position = _skip_items(data, position, False, DEEPEST)
                continue
        else:
            raise _NotPlainError
        if key in wanted:
            tag = wanted[key]
            if tag <= last:
                raise _NotPlainError
            last = tag
            if length:
                values[tag] = data[position : position + length]
                vrs[tag] = vr
        position += length


def _walk_implicit(data: bytes, position: int, wanted: dict[int, int]) -> tuple[dict[int, bytes], int]:
    """Do the same as `_walk_explicit` for a data set in implicit VR."""
    values: dict[int, bytes] = {}
    last = 0
    while True:
        key, length = _implicit_head(data, position)
        group = key & 0xFFFF
        if group >= _PIXEL_GROUP and (group << 16 | key >> 16) >= FIRST_PIXEL_TAG:
            return values, position
        position += 8
        if length == UNDEFINED_LENGTH:
            if wanted.get(key) or not _is_sequence(data, position, key):
                raise _NotPlainError
            position = _skip_items(data, position, True, DEEPEST)
            continue
        if key in wanted:
            tag = wanted[key]
            if tag <= last:
                raise _NotPlainError
            last = tag
            if length:
                values[tag] = data[position : position + length]
        position += length


def _is_sequence(data: bytes, position: int, key: int) -> bool:
    """True where an element of undefined length in implicit VR is certainly a sequence."""
    private = key & 1  # private: the group is odd
    return key in _SEQUENCE_KEYS or bool(private) and _long_length(data, position)[0] == _ITEM


def _skip_items(data: bytes, position: int, implicit: bool, levels: int) -> int:
    """Walk over the items of a sequence of undefined length; return the offset after its delimiter."""
    if not levels:
        raise _NotPlainError
    while True:
        key, length = _implicit_head(data, position)
        position += 8
        if key == _SEQUENCE_END and length == 0:
            return position
        if key != _ITEM:
            raise _NotPlainError
        end = None if length == UNDEFINED_LENGTH else position + length
        position = _skip_elements(data, position, end, implicit, levels - 1)


def _skip_elements(data: bytes, position: int, end: int | None, implicit: bool, levels: int) -> int:
    """Walk over the elements of an item, to `end` or to its delimiter; return the offset after it."""
    while end is None or position < end:
        key, length = _implicit_head(data, position)
        if key == _ITEM_END and length == 0 and end is None:
            return position + 8
        if key & 0xFFFF == _DELIMITER_GROUP or key == _CHARACTER_SET:
            raise _NotPlainError
        name = data[position + 4 : position + 6]
        position += 8
        if not implicit:
            if name in SHORT_VRS:
                length >>= 16
            elif name in LONG_VRS:
                (length,) = _long_length(data, position)
                position += 4
            else:
                raise _NotPlainError
        if length != UNDEFINED_LENGTH:
            position += length
        elif name == b"SQ" if not implicit else _is_sequence(data, position, key):
            position = _skip_items(data, position, implicit, levels)
        else:
            raise _NotPlainError
    if position != end:
        raise _NotPlainError
    return position
