"""Names of labels: found in any spelling, and made safe for messages and file names.

Names come from files that strangers wrote.  In messages they are escaped, in file names they are letters and digits.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from clrecon.errors import UsageError
from clrecon.system.text import escape_text

SUFFIX_LENGTH = 40
LABELS_LISTED = 60

_LEVEL = re.compile(r"(c|th?|l|s)(0?[1-9]|1[0-9])")
_VERTEBRA = ("vertebra", "vertebrae", "vert", "level")
"""Words beside the level in names of vertebrae: TotalSegmentator's ``vertebrae_L3``, 3D Slicer's ``L3 vertebra``."""


def check_name(name: str) -> str:
    """Return a name as one printable line of limited length."""
    if not isinstance(name, str):
        raise UsageError(f"the name of a label is text, not {type(name).__name__}")
    return escape_text(name.strip())


def list_labels(names: Mapping[int, str], numbers: Collection[int]) -> str:
    """Return the labels that occur for a message: ``27 vertebrae_L5, 28 vertebrae_L4``."""
    shown = [f"{number} {names[number]}" for number in sorted(numbers)][:LABELS_LISTED]
    more = len(numbers) - len(shown)
    return (", ".join(shown) or "none") + (f" and {more} more" if more > 0 else "")


def _parts(name: str) -> list[str]:
    return [part for part in re.split(r"[^a-z0-9]+", name.casefold()) if part]


def _level(text: str) -> str | None:
    """Return the level of the spine that a name says, ``l3`` of ``L3``, ``vertebrae_L3``, ``Vertebra L03``, ``Th12``.

    None where it says no level or several.
    """
    levels = {(match[1][0], int(match[2])) for part in _parts(text) if (match := _LEVEL.fullmatch(part))}
    others = [part for part in _parts(text) if not _LEVEL.fullmatch(part) and part not in _VERTEBRA]
    if len(levels) != 1 or others:
        return None
    letter, number = levels.pop()
    return f"{letter}{number}"


def find_number(label: str | int, names: Mapping[int, str], present: Collection[int]) -> int:
    """Return the number of `label`: a number itself, else the exact name, else the only name that says the same
    level of the spine, else the only one that contains it as a part.

    present: Numbers that occur in voxels.
    """
    text = str(label).strip()
    wanted = text.casefold()
    named = [number for number, name in names.items() if name.casefold() == wanted]
    if not named and re.fullmatch(r"[0-9]{1,9}", text):
        named = [int(text)]
    if not named and (level := _level(text)) is not None:
        named = [number for number, name in names.items() if _level(name) == level]
    if not named:
        parts = _parts(text)
        named = [number for number, name in names.items() if len(parts) == 1 and parts[0] in _parts(name)]
    named = [number for number in named if number in present] or named
    if len(named) > 1:
        raise UsageError(
            f"'{escape_text(text)}' names several labels: {list_labels(names, named)};"
            " give the number or the whole name"
        )
    if not named or named[0] not in present:
        what = "is not in the label map" if not named or named[0] not in names else "has no voxel in the label map"
        advice = ""
        if _level(text) is not None and any(re.fullmatch(r"vertebra_[0-9]+", name) for name in names.values()):
            advice = ". These are numbers and no levels: give clrecon vertebrae the level of one of them"
        raise UsageError(f"label '{escape_text(text)}' {what}; there are: {list_labels(names, present)}{advice}")
    return named[0]


def label_suffix(name: str) -> str:
    """Return a name as part of a file name: letters, digits, dot, hyphen and underscore, at most 40.

    Dots and hyphens at either end are taken off; a name without any letter or digit gives ``label``.
    """
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", name)[:SUFFIX_LENGTH].strip("._-")
    return safe or "label"


def file_suffixes(names: Mapping[int, str]) -> dict[int, str]:
    """Return `label_suffix` of each name, with the number added where two files would have one name (ignoring case)."""
    suffixes = {number: label_suffix(name) for number, name in names.items()}
    found = Counter(suffix.casefold() for suffix in suffixes.values())
    unique = {n: s if found[s.casefold()] == 1 else f"{s}_{n}" for n, s in suffixes.items()}
    if len({suffix.casefold() for suffix in unique.values()}) < len(unique):  # a suffix with number is also a name
        return {number: f"label_{number}" for number in names}
    return unique


def check_wanted(only: str | int | Iterable[str | int] | None) -> tuple[str | int, ...] | None:
    """Return `only` as a tuple; None stays None."""
    if only is None:
        return None
    wanted = (only,) if isinstance(only, str | int) else tuple(only)
    if not all(isinstance(label, str | int) for label in wanted):
        raise UsageError("labels are chosen by number or name")
    if not wanted:
        raise UsageError("no label is chosen: name one, or leave the choice out for all")
    return wanted
