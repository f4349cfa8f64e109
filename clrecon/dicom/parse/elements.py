"""The raw data elements of one file, with undecoded values, and the place of its pixel data.

Only the start of a file is read: the first `PREFIX_BYTES` hold the header of nearly every CT image.  The plain parser
walks over it by lengths.  Files that it cannot handle are parsed with pydicom.  No value is converted here, because
pydicom accepts wrong values (text, NaN, the wrong count) without an error.
"""

from __future__ import annotations

import io
import os
import stat
from pathlib import Path
from typing import NamedTuple

from clrecon.dicom.parse.careful import parse_carefully
from clrecon.dicom.parse.forced import Start, describe_way_out, find_program, restore_start
from clrecon.dicom.parse.plain import parse_plainly
from clrecon.dicom.parse.raw import META_START, CorruptFileError, DicomElements, NotDicomError
from clrecon.system.paths import open_regular

PREFIX_BYTES = 16 * 1024
LONG_PREFIX_BYTES = 256 * 1024
"""Bytes read at once where the first prefix does not hold the whole header: large private elements, many frames."""
RESTORED_LIMIT = 16 * 1024 * 1024
"""For a file without its standard start: the header must end within this many bytes."""
LONGEST_PREFIX_BYTES = (16 * 2**20, 256 * 2**20)
"""Bytes read where that is not enough either: contours, segments and other objects that are nearly all header."""
# A pipe or device in the place of a listed file must not make the reader wait for a writer.
_OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


class FileStart(NamedTuple):
    """The first bytes of a file, at most `PREFIX_BYTES`, and the size of the file."""

    prefix: bytes
    size: int


def read_start(path: str | Path, limit: int = PREFIX_BYTES) -> FileStart:
    """Read the start of a regular file."""
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
    return prefix[128:META_START] == b"DICM"


def read_elements(
    path: Path, wanted: tuple[int, ...] | None, start: FileStart | None = None, force: bool = False
) -> DicomElements:
    """Read the raw elements of one DICOM file.

    wanted: Tags to keep; None keeps all whose length is defined.
    start: The result of `read_start` for this file, so that it is not read twice.
    force: Also read a data set without preamble or meta header.
    """
    prefix, size = start or read_start(path)
    restored = restore_start(prefix)
    if restored is not None and force:
        return _read_restored(path, restored, size, wanted)
    if not has_dicom_mark(prefix):
        raise NotDicomError("no DICM mark at byte 128", prefix)
    if restored is not None:
        raise CorruptFileError(f"no meta header ({describe_way_out()})")
    elements = _read_marked(path, prefix, size, wanted)
    program = find_program(prefix)
    if program:
        remark = f"the preamble starts a program ({program}): neither run nor copied"
        elements = elements._replace(remarks=(remark, *elements.remarks))
    return elements


def _read_restored(path: Path, restored: Start, size: int, wanted: tuple[int, ...] | None) -> DicomElements:
    """Read a file as if it had the standard start that it lacks; all offsets are those of the file itself."""
    with open_regular(path) as file:
        file.seek(restored.skip)
        data = restored.head + file.read(RESTORED_LIMIT)
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
    elements = parse_plainly(prefix, size, wanted)
    if elements is None and len(prefix) < size:
        prefix, size = read_start(path, LONG_PREFIX_BYTES)
        elements = parse_plainly(prefix, size, wanted)
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
    for limit in LONGEST_PREFIX_BYTES:
        if len(prefix) < size:
            prefix, size = read_start(path, limit)
            elements = parse_plainly(prefix, size, wanted)
            if elements is not None:
                return elements
    del prefix
    with open_regular(path) as file:
        return parse_carefully(file, size, wanted)
