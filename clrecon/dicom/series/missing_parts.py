"""Missing files of a concatenation: at an end of the stack they would leave no hole."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from clrecon.dicom.headers.concatenation import Concatenation
from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.system.text import join_names


def describe_missing_parts(slices: Iterable[SliceHeader]) -> list[str]:
    """Describe missing files of concatenations: at an end of the stack they would leave no hole.

    slices: All slices of a series.
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
