"""Concatenations: one multi-frame image written as several files, all of which must be present.

Source: DICOM PS3.3 C.7.6.16.1.1.
"""

from __future__ import annotations

from dataclasses import dataclass

from clrecon.dicom.parse.sequences import Item, decode_number, name_tag
from clrecon.dicom.parse.values import ValueProblem, decode_text

UID, PART, PARTS, FIRST_FRAME = 0x00209161, 0x00209162, 0x00209163, 0x00209228
CONCATENATION_TAGS = (UID, PART, PARTS, FIRST_FRAME)
"""The tags of ConcatenationUID, InConcatenationNumber, InConcatenationTotalNumber, ConcatenationFrameOffsetNumber."""


@dataclass(frozen=True)
class Concatenation:
    """The place of a file in a concatenation: one multi-frame image written as several files.

    uid: Used only for comparison.
    part, parts: InConcatenationNumber, from 1, and InConcatenationTotalNumber.
    first_frame, frames: ConcatenationFrameOffsetNumber, and the number of frames in this file.
    """

    uid: str
    part: int
    parts: int | None
    first_frame: int | None
    frames: int


def read_concatenation(top: Item, frames: int, little: bool) -> Concatenation | None:
    """Read the place of a file in its concatenation from its top level; None where it belongs to none."""
    uid = decode_text(top.values.get(UID, b""))
    if not uid:
        return None
    part = decode_number(top.values.get(PART, b""), "H", little)
    if not part:
        raise ValueProblem(f"{name_tag(PART)} is missing or 0, expected the place of the file in its concatenation")
    parts = decode_number(top.values.get(PARTS, b""), "H", little)
    first = decode_number(top.values.get(FIRST_FRAME, b""), "L", little)
    return Concatenation(
        uid, int(part), None if parts is None else int(parts), None if first is None else int(first), frames
    )
