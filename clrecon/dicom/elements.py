"""From the bytes of one file to its raw data elements, values still undecoded, and the place of its pixel data.

Only the start of a file is read: the first `PREFIX_BYTES` hold the header of nearly every CT image, and the rest
of the file is opened only where they do not.  pydicom does the parsing (its element generator); no value is
converted here, because pydicom lets wrong ones through (text, NaN, the wrong count) without an error.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pydicom.filereader import data_element_generator

from clrecon.errors import RefusedInputError

__all__ = ["CorruptFileError", "DicomElements", "NotDicomError", "has_dicom_mark", "read_elements", "read_prefix"]

IMPLICIT_LITTLE = "1.2.840.10008.1.2"
EXPLICIT_LITTLE = "1.2.840.10008.1.2.1"
DEFLATED = "1.2.840.10008.1.2.1.99"
EXPLICIT_BIG = "1.2.840.10008.1.2.2"

PREFIX_BYTES = 32 * 1024
META_START = 132  # 128 bytes of preamble, then "DICM"
INFLATED_HEADER_LIMIT = 16 * 1024 * 1024
UNDEFINED_LENGTH = 0xFFFFFFFF
_PIXEL_TAGS = (0x7FE00008, 0x7FE00009, 0x7FE00010)
_LONG_VRS = (b"OB", b"OW", b"OF", b"OD", b"OL", b"OV", b"UN")


class NotDicomError(RefusedInputError):
    """The file is no DICOM file: no "DICM" at byte 128.

    Attributes
    ----------
    start : bytes
        The first bytes of the file; all of them where it is no longer than `PREFIX_BYTES`.
    """

    def __init__(self, message: str, start: bytes):
        super().__init__(message)
        self.start = start


class CorruptFileError(RefusedInputError):
    """The file says that it is DICOM but cannot be parsed up to its pixel data."""


@dataclass(frozen=True)
class DicomElements:
    """Raw data elements of one file.

    Attributes
    ----------
    transfer_syntax, media_class : str
        (0002,0010) and (0002,0002).
    values : dict of int to bytes
        Tag to undecoded value, of the wanted tags that are present and not empty.
    vrs : dict of int to str or None
        Their value representations; None in implicit VR.
    little_endian : bool
    encoding_differs : bool
        Implicit VR where the transfer syntax says explicit, or the other way round; parsed as found.
    pixel_tag : int or None
        None where the file ends without pixel data.
    pixel_offset, pixel_length : int
        First byte and count of bytes of the pixel data value in the file, or, in deflated files, in the inflated
        data set.  The length is -1 where it is undefined (encapsulated).
    pixel_vr : str
        Empty in implicit VR.
    inflate_from : int
        Byte of the file where the deflated data set starts, -1 where it is not deflated.
    file_bytes : int
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


def read_prefix(path: Path) -> tuple[bytes, int]:
    """Return the first `PREFIX_BYTES` of a file and its size in bytes."""
    with open(path, "rb", buffering=0) as file:
        return file.read(PREFIX_BYTES) or b"", os.fstat(file.fileno()).st_size


def has_dicom_mark(prefix: bytes) -> bool:
    """True when the bytes carry the mark of a DICOM file behind the preamble."""
    return prefix[128:META_START] == b"DICM"


def read_elements(path: Path, wanted: tuple[int, ...]) -> DicomElements:
    """Read the raw elements of one DICOM file.

    Parameters
    ----------
    path : Path
    wanted : tuple of int
        Tags to keep.

    Raises
    ------
    NotDicomError
        No "DICM" behind the preamble.
    CorruptFileError
        Cannot be parsed.
    OSError
        Cannot be opened or read.
    """
    prefix, size = read_prefix(path)
    if not has_dicom_mark(prefix):
        raise NotDicomError("no DICM mark at byte 128", prefix)
    if len(prefix) < size:
        try:
            elements = _parse(io.BytesIO(prefix), size, wanted)
        except CorruptFileError:
            elements = None  # most likely an element that reaches over the end of the prefix
        if elements is not None and elements.pixel_tag is not None:
            return elements
        with open(path, "rb") as file:
            return _parse(file, size, wanted)
    return _parse(io.BytesIO(prefix), size, wanted)


def _parse(file: BinaryIO, size: int, wanted: tuple[int, ...]) -> DicomElements:
    try:
        return _parse_file(file, size, wanted)
    except CorruptFileError:
        raise
    except RecursionError as error:
        raise CorruptFileError("sequences are nested too deep") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # of the disk; the parser's own, for a sequence that is cut, have no number
        # The parser meets hostile bytes here and may fail in any way; all of them mean the same to us.
        raise CorruptFileError(f"cannot be parsed ({type(error).__name__})") from error


def _parse_file(file: BinaryIO, size: int, wanted: tuple[int, ...]) -> DicomElements:
    file.seek(META_START)
    meta, _ = _collect(file, implicit=False, little=True, last_group=2, wanted=())
    transfer_syntax = _uid(meta.get(0x00020010))
    media_class = _uid(meta.get(0x00020002))
    if not transfer_syntax:
        raise CorruptFileError("no transfer syntax (0002,0010)")

    start = file.tell()
    inflate_from = -1
    if transfer_syntax == DEFLATED:
        inflate_from, start = start, 0
        file = io.BytesIO(_inflate_header(file))
    little = transfer_syntax != EXPLICIT_BIG
    implicit = transfer_syntax == IMPLICIT_LITTLE
    found = _looks_implicit(file, start)
    differs = found is not None and found != implicit
    implicit = implicit if found is None else found
    values, vrs = _collect(file, implicit=implicit, little=little, last_group=None, wanted=wanted)
    tag, offset, length, vr = _find_pixels(file, implicit, little)
    return DicomElements(
        transfer_syntax, media_class, values, vrs, little, differs, tag, offset, length, vr, inflate_from, size
    )


def _collect(
    file: BinaryIO, *, implicit: bool, little: bool, last_group: int | None, wanted: tuple[int, ...]
) -> tuple[dict[int, bytes], dict[int, str | None]]:
    """Read elements up to the end of `last_group`, or up to the pixel data; the file is left standing there."""

    def stop(tag: int, vr: str | None, length: int) -> bool:
        return tag >> 16 != last_group if last_group is not None else int.__ge__(tag, 0x7FE00008)

    values: dict[int, bytes] = {}
    vrs: dict[int, str | None] = {}
    for element in data_element_generator(
        file,
        implicit,
        little,
        stop_when=stop,
        specific_tags=list(wanted),  # type: ignore[arg-type]
    ):
        value = element.value
        if isinstance(value, bytes) and value:
            if element.length not in (len(value), UNDEFINED_LENGTH):
                raise CorruptFileError("ends within an element")
            values[int(element.tag)] = value
            vrs[int(element.tag)] = element.VR
    return values, vrs


def _uid(value: bytes | None) -> str:
    return (value or b"").rstrip(b"\0 ").decode("ascii", "replace")


def _looks_implicit(file: BinaryIO, start: int) -> bool | None:
    """Tell the encoding from the first element: explicit VR has two capital letters there. None at the end."""
    head = file.read(6)
    file.seek(start)
    if len(head) < 6:
        return None
    return not all(0x41 <= letter <= 0x5A for letter in head[4:6])


def _inflate_header(file: BinaryIO) -> bytes:
    """Inflate the start of a deflated data set: enough for its header, and never more than a fixed limit."""
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    inflated = inflater.decompress(file.read(), INFLATED_HEADER_LIMIT)
    if not inflated:
        raise CorruptFileError("nothing in the deflated data set")
    return inflated


def _find_pixels(file: BinaryIO, implicit: bool, little: bool) -> tuple[int | None, int, int, str]:
    """Read the head of the pixel data element that the file stands at: tag, offset, length (-1 undefined), VR."""
    order = "<" if little else ">"
    start = file.tell()
    head = file.read(12)
    if len(head) < 8:
        return None, -1, 0, ""
    group, element = struct.unpack(order + "HH", head[:4])
    tag = group << 16 | element
    if tag not in _PIXEL_TAGS:
        return None, -1, 0, ""
    # Implicit VR has the length in these bytes; no even length reads as one of the two-letter names.
    vr = head[4:6]
    if vr in _LONG_VRS and len(head) == 12:
        length, offset, name = struct.unpack(order + "L", head[8:12])[0], start + 12, vr.decode("ascii")
    elif implicit:
        length, offset, name = struct.unpack(order + "L", head[4:8])[0], start + 8, ""
    else:
        raise CorruptFileError("the head of the pixel data element is damaged")
    return tag, offset, -1 if length == UNDEFINED_LENGTH else length, name
