"""Types and helpers that the plain and the careful parser share."""

from __future__ import annotations

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
PIXEL_VRS = (b"OB", b"OW", b"OF", b"OD", b"OL", b"OV", b"UN")


class NotDicomError(RefusedInputError):
    """The file is not a DICOM file: there is no "DICM" at byte 128.

    start: The first bytes of the file; all of them where it is no longer than `PREFIX_BYTES`.
    """

    def __init__(self, message: str, start: bytes):
        super().__init__(message)
        self.start = start


class CorruptFileError(RefusedInputError):
    """The file says that it is DICOM but cannot be parsed up to its pixel data."""


class DicomElements(NamedTuple):
    """Raw data elements of one file.

    values: Tag to undecoded value, of the wanted tags that are present and not empty.
    vrs: Value representations of these elements; None in implicit VR.
    encoding_differs: Implicit VR where the transfer syntax says explicit, or explicit where it says implicit; parsed as
        found.
    pixel_tag: None where the file ends without pixel data.
    pixel_offset, pixel_length: First byte and count of bytes of the pixel data value in the file, or, in deflated
        files, in the inflated data set.  The length is -1 where it is undefined (encapsulated).
    pixel_vr: Empty in implicit VR.
    inflate_from: Offset in the file of the deflated data set, -1 where it is not deflated.
    remarks: Unusual points of the start of the file.
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
    """Decode a UID without its padding."""
    return (value or b"").rstrip(b"\0 ").decode("ascii", "replace")


def read_pixel_head(head: bytes, start: int, implicit: bool, little: bool) -> tuple[int | None, int, int, str]:
    """Read the head of the pixel data element.

    head: 12 bytes of the data set from byte `start` on, fewer at its end.

    Returns:
    tag: None where this is another element, or the end.
    offset, length: Place and length of the value; the length is -1 where it is undefined.
    vr: Empty in implicit VR.
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
    if vr in PIXEL_VRS and len(head) == 12:
        length, offset, name = struct.unpack(order + "L", head[8:12])[0], start + 12, vr.decode("ascii")
    elif implicit:
        length, offset, name = struct.unpack(order + "L", head[4:8])[0], start + 8, ""
    else:
        raise CorruptFileError("the head of the pixel data element is damaged")
    return tag, offset, -1 if length == UNDEFINED_LENGTH else length, name
