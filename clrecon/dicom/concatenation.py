"""Concatenations: one multi-frame image written as several files, of which none may be missing.

Source: DICOM PS3.3 C.7.6.16.1.1.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clrecon.dicom.sequences import Item, decode_number, name_tag
from clrecon.dicom.text import join_names
from clrecon.dicom.values import ValueProblem, decode_text

if TYPE_CHECKING:
    from clrecon.dicom.slice_header import SliceHeader

__all__ = ["CONCATENATION_TAGS", "Concatenation", "describe_missing_parts", "read_concatenation"]

UID, PART, PARTS, FIRST_FRAME = 0x00209161, 0x00209162, 0x00209163, 0x00209228
CONCATENATION_TAGS = (UID, PART, PARTS, FIRST_FRAME)
"""ConcatenationUID, InConcatenationNumber, InConcatenationTotalNumber, ConcatenationFrameOffsetNumber."""


@dataclass(frozen=True)
class Concatenation:
    """The place of a file in a concatenation: one multi-frame image written as several files.

    Attributes
    ----------
    uid : str
        Only to compare.
    part, parts : int, int or None
        InConcatenationNumber, from 1, and InConcatenationTotalNumber.
    first_frame, frames : int or None, int
        ConcatenationFrameOffsetNumber, and the frames of this file.
    """

    uid: str
    part: int
    parts: int | None
    first_frame: int | None
    frames: int


def read_concatenation(top: Item, frames: int, little: bool) -> Concatenation | None:
    """Read the place of a file in its concatenation from its top level; None where it is in none."""
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


def describe_missing_parts(slices: Iterable[SliceHeader]) -> list[str]:
    """Describe files of concatenations that are not there: lost at an end of the stack they would leave no hole.

    Parameters
    ----------
    slices : iterable of SliceHeader
        All slices of a series.
    """
    found: dict[str, set[Concatenation]] = defaultdict(set)
    for header in slices:
        if header.concatenation is not None:
            found[header.concatenation.uid].add(header.concatenation)
    problems = []
    for parts in found.values():
        there = {part.part for part in parts}
        last = max(max(part.parts or 0, part.part) for part in parts)
        missing = [str(number) for number in range(1, last + 1) if number not in there]
        if missing:
            files = f"file {missing[0]}" if len(missing) == 1 else f"files {join_names(missing)}"
            problems.append(
                f"{files} of the {last} of a concatenation {'is' if len(missing) == 1 else 'are'} missing "
                "(InConcatenationNumber (0020,9162))"
            )
            continue
        ends = {part.part: part.first_frame + part.frames for part in parts if part.first_frame is not None}
        if len(ends) < last:
            continue
        for part in sorted(parts, key=lambda part: part.part):
            before = ends.get(part.part - 1, 0)
            if part.first_frame is not None and part.first_frame != before:
                problems.append(
                    f"file {part.part} of a concatenation starts at frame {part.first_frame}, the one before it ends "
                    f"at frame {before} (ConcatenationFrameOffsetNumber (0020,9228))"
                )
    return problems
