"""Data sets without preamble or meta header: the missing start is guessed.

DICOM files begin with a preamble, the mark "DICM" and a meta header that names the transfer syntax (PS3.10 7.1).
Network dumps and old archives hold bare data sets; their encoding has to be guessed, which is done only when a user
asks for it.  Without a transfer syntax, implicit VR little endian is the default (PS3.5 10.1); explicit VR shows two
capital letters after the first tag.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from clrecon.dicom.parse.raw import EXPLICIT_BIG, EXPLICIT_LITTLE, IMPLICIT_LITTLE
from clrecon.system.arguments import name_parameter

MARK_END = 132  # 128 bytes of preamble, then "DICM"
PREAMBLE = bytes(128) + b"DICM"
FIRST_GROUP = 0x0008
FIRST_LENGTH_LIMIT = 1024
"""Longest first element: data sets begin with short ones, such as group length, character set, type or date."""
ENCODINGS = {
    IMPLICIT_LITTLE: "implicit VR little endian",
    EXPLICIT_LITTLE: "explicit VR little endian",
    EXPLICIT_BIG: "explicit VR big endian",
}
PROGRAMS = {
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


def find_program(start: bytes) -> str:
    """Return the kind of program that a file begins with; empty for none.

    A file may be a DICOM image and a program at once: the preamble is free for any use (PS3.10 7.1).
    """
    return next((name for mark, name in PROGRAMS.items() if start.startswith(mark)), "")


def restore_start(data: bytes) -> Start | None:
    """Return the standard start for a file that has none.

    data: The first bytes of the file.

    Returns: None where the file has a meta header after its preamble, or does not begin like a data set.
    """
    marked = data[128:MARK_END] == b"DICM"
    skip = MARK_END if marked else 4 if data[:4] == b"DICM" else 0
    if data[skip : skip + 2] == b"\x02\0" and data[skip + 4 : skip + 6].isalpha():
        return None if marked else Start(PREAMBLE, skip, "no preamble: read on demand")
    syntax = _guess_syntax(data[skip : skip + 8])
    if syntax is None:
        return None
    value = syntax.encode() + b"\0" * (len(syntax) % 2)
    meta = struct.pack("<HH2sH", 0x0002, 0x0010, b"UI", len(value)) + value
    return Start(PREAMBLE + meta, skip, f"no meta header: read on demand, {ENCODINGS[syntax]} taken")


def _guess_syntax(head: bytes) -> str | None:
    """Return the transfer syntax of a data set that begins with these 8 bytes; None if they cannot begin one."""
    if len(head) < 8:
        return None
    explicit = all(0x41 <= letter <= 0x5A for letter in head[4:6])
    for syntax, order in ((EXPLICIT_LITTLE, "<"), (EXPLICIT_BIG, ">")):
        group, length = struct.unpack(order + "H4xH", head)
        if group == FIRST_GROUP and explicit and length < FIRST_LENGTH_LIMIT:
            return syntax
    group, length = struct.unpack("<H2xL", head)
    return IMPLICIT_LITTLE if group == FIRST_GROUP and length < FIRST_LENGTH_LIMIT and not explicit else None
