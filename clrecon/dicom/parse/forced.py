"""Data sets without preamble or meta header: the start that they lack, guessed.

DICOM files begin with a preamble, the mark "DICM" and a meta header that names the transfer syntax (PS3.10 7.1).
Network dumps and old archives hold bare data sets; then the encoding has to be guessed, which is done only when a
user asks for it.  Without a transfer syntax implicit VR little endian is the rule (PS3.5 10.1); explicit VR shows by
the two capital letters behind the first tag.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from clrecon.system.wording import name_parameter

__all__ = ["Start", "describe_way_out", "find_program", "restore_start"]

MARK_END = 132  # 128 bytes of preamble, then "DICM"
PREAMBLE = bytes(128) + b"DICM"
FIRST_GROUP = 0x0008
FIRST_LENGTH_LIMIT = 1024
"""The first elements of a data set are short: group length, character set, type, date."""
ENCODINGS = {
    "1.2.840.10008.1.2": "implicit VR little endian",
    "1.2.840.10008.1.2.1": "explicit VR little endian",
    "1.2.840.10008.1.2.2": "explicit VR big endian",
}
IMPLICIT_LITTLE, EXPLICIT_LITTLE, EXPLICIT_BIG = ENCODINGS
PROGRAMS = {
    b"MZ": "Windows",
    b"\x7fELF": "Linux",
    b"\xcf\xfa\xed\xfe": "macOS",
    b"\xca\xfe\xba\xbe": "macOS",
    b"#!": "script",
}


class Start(NamedTuple):
    """What stands in place of the first `skip` bytes of a file, and one line that says so."""

    head: bytes
    skip: int
    remark: str


def describe_way_out() -> str:
    """What can be done about a data set whose encoding stands nowhere."""
    return f"{name_parameter('force', True)} guesses it"


def find_program(start: bytes) -> str:
    """Kind of the program that the first bytes of a file begin; empty for none.

    A file may be a DICOM image and a program at once: the preamble is free for any use (PS3.10 7.1).
    """
    return next((name for mark, name in PROGRAMS.items() if start.startswith(mark)), "")


def restore_start(data: bytes) -> Start | None:
    """The standard start of a file that has none.

    Parameters
    ----------
    data : bytes
        The first bytes of the file.

    Returns
    -------
    Start or None
        None where the file has a meta header behind its preamble, or does not begin as a data set does.
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
    """Transfer syntax of a data set that begins with these 8 bytes; None where none begins like that."""
    if len(head) < 8:
        return None
    explicit = all(0x41 <= letter <= 0x5A for letter in head[4:6])
    for syntax, order in ((EXPLICIT_LITTLE, "<"), (EXPLICIT_BIG, ">")):
        group, length = struct.unpack(order + "H4xH", head)
        if group == FIRST_GROUP and explicit and length < FIRST_LENGTH_LIMIT:
            return syntax
    group, length = struct.unpack("<H2xL", head)
    return IMPLICIT_LITTLE if group == FIRST_GROUP and length < FIRST_LENGTH_LIMIT and not explicit else None
