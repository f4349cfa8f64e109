"""Alternating elements: elements of the files of a stack whose values alternate from slice to slice.

Two volumes half a gap apart sort into one evenly spaced stack.  Any element may distinguish them: a time, the contrast
medium, an acquisition number that only one of them has, a private element.  So all headers of the stack to be read are
read again completely.  Every element whose values repeat in a fixed order along the stack is found: ABAB, ABCABC, AABB.
Within one volume values stay, count on, or change at single places; or they alternate with the turns of the gantry, so
`clrecon.dicom.stack.element_kinds` has which elements mean what.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.parse.elements import CorruptFileError, NotDicomError, read_elements
from clrecon.dicom.stack.element_kinds import find_verdict
from clrecon.dicom.stack.numbers import median

FEWEST_SLICES = 6
SMALLEST_VOLUME = 3
LONGEST_PERIOD = 8
PERIODS = 3
"""The order of values has to repeat this often: by chance, 6 interchangeable slices show it."""
MOST_TOGETHER = 2
"""Largest number of neighbouring slices of one volume; more are parts in which one volume may be scanned."""
MOST_VALUES = 8
"""An element with more values is judged by heaps: groups of close numbers, such as the times of two passes."""
MOST_HEAPS = 4
LONGEST_VALUE = 64
DENSER = 1.3
"""Where two volumes overlap in part, slices are this many times closer together than elsewhere."""
WINDOW, WINDOWS = 32, 3
"""Windows of an evenly spaced stack, and slices in each, that are examined before all slices are: it can only hold
volumes that overlap from end to end."""
FEWEST_NUMBERED = 12
"""With fewer slices, InstanceNumber forms two heaps by chance."""

SERIES_UID, SOP_INSTANCE, INSTANCE_NUMBER = 0x0020000E, 0x00080018, 0x00200013
NEVER = frozenset({SOP_INSTANCE, SERIES_UID, INSTANCE_NUMBER, 0x00200032, 0x00200037, 0x00201041})
"""Identifiers and places of single slices, which are examined elsewhere."""
PIXEL_GROUP, OVERLAY_GROUPS = 0x0028, range(0x5000, 0x6100)
"""Groups of elements that describe the stored values of single slices: rescale, extremes, padding, overlays."""
WINDOW_TAGS = frozenset({0x00281050, 0x00281051, 0x00281055})


@dataclass(frozen=True)
class Alternation:
    """An element whose values alternate along a stack.

    tag: 0 where the groups do not come from an element.
    groups: The places, from 0, of each volume, in the order of the values.
    certain: The element is constant within one volume, see `clrecon.dicom.stack.element_kinds`.
    heaps: The groups are heaps of close numbers, and each slice has its own number.
    absent: The group that lacks the element.
    """

    tag: int
    groups: tuple[tuple[int, ...], ...]
    certain: bool
    heaps: bool = False
    absent: int | None = None

    @property
    def name(self) -> str:
        """Keyword of the element, or its tag."""
        from pydicom.datadict import keyword_for_tag

        private = (self.tag >> 16) % 2
        known = "" if private else keyword_for_tag(self.tag)
        return known or f"({self.tag >> 16:04X},{self.tag & 0xFFFF:04X})"


def find_alternation(headers: Sequence[SliceHeader], even: bool) -> Alternation | None:
    """Find an element that alternates along a stack; reads the headers of its files again.

    headers: One slice for each place, in the order of the places.
    even: All gaps are equal.  Fewer elements are certain then, and in a long stack some windows are examined first.

    Returns: A certain one before a doubtful one.  None for multi-frame images too, whose frames share one header.
    """
    count = len(headers)
    if count < FEWEST_SLICES or any(header.frames > 1 for header in headers):
        return None
    if even and count > WINDOW * WINDOWS:
        starts = [(count - WINDOW) * place // (WINDOWS - 1) for place in range(WINDOWS)]
        if not any(_find_in(headers[first : first + WINDOW], even) for first in starts):
            return None
    return _find_in(headers, even)


def alternate_places(count: int, period: int) -> Alternation:
    """Deal `count` slices in turn to `period` volumes, for period 4 in pairs to two volumes: groups that no header
    shows.
    """
    if period == 4:
        return Alternation(0, tuple(tuple(k for k in range(count) if k // 2 % 2 == half) for half in (0, 1)), False)
    return Alternation(0, tuple(tuple(range(first, count, period)) for first in range(period)), False)


def _find_in(headers: Sequence[SliceHeader], even: bool) -> Alternation | None:
    gaps = [float(np.linalg.norm(np.subtract(b.position_mm, a.position_mm))) for a, b in pairwise(headers)]
    doubtful = None
    for tag, column in sorted(_read_columns(headers).items()):
        verdict = find_verdict(tag, even)
        if verdict == "nothing":
            continue
        for codes, heaps in _code(tag, column):
            if not alternates(codes, gaps):
                continue
            groups = tuple(tuple(k for k, code in enumerate(codes) if code == one) for one in sorted(set(codes)))
            certain = verdict == "phases"
            absent = next((number for number, group in enumerate(groups) if column[group[0]] == b""), None)
            found = Alternation(tag, groups, certain, heaps, absent)
            if certain:
                return found
            doubtful = doubtful or found
            break
    return doubtful


def _read_columns(headers: Sequence[SliceHeader]) -> dict[int, list[bytes]]:
    """Return the values along the stack of each element that is not constant; empty where a slice lacks the element."""
    first: dict[int, bytes] = {}
    columns: dict[int, list[bytes]] = {}
    for k, header in enumerate(headers):
        values = _read_values(header)
        first = values if k == 0 else first
        if values != first:
            for tag in values.keys() | first.keys():
                if tag not in columns and values.get(tag) != first.get(tag):
                    columns[tag] = [first.get(tag, b"")] * k
        for tag, column in columns.items():
            column.append(values.get(tag, b""))
    return columns


def _read_values(header: SliceHeader) -> dict[int, bytes]:
    """Read the elements of one file that are compared: none if it has changed since the scan, which reading its pixels
    reports.
    """
    try:
        # A file that needed `force` is read with it again; for other files it changes nothing.
        values = read_elements(header.file, None, force=True).values
    except (OSError, CorruptFileError, NotDicomError):
        return {}
    return {tag: _shorten(raw.strip(b" \0")) for tag, raw in values.items() if _is_compared(tag)}


def _shorten(raw: bytes) -> bytes:
    """Shorten a long value to what distinguishes it from others: vendors keep whole files in one element."""
    return raw if len(raw) <= LONGEST_VALUE else hash(raw).to_bytes(8, "little", signed=True) + b"..."


def _is_compared(tag: int) -> bool:
    group = tag >> 16
    if tag == INSTANCE_NUMBER or tag in WINDOW_TAGS:
        return True
    return tag not in NEVER and group != PIXEL_GROUP and group not in OVERLAY_GROUPS and tag & 0xFFFF != 0


def _code(tag: int, column: Sequence[bytes]) -> Iterator[tuple[list[int], bool]]:
    """Return the ways to group the slices by the values of one element: group numbers, and whether these are heaps."""
    numbers = [_number(raw) for raw in column]
    if tag == INSTANCE_NUMBER:
        known = [number for number in numbers if number is not None]
        if len(known) == len(column) >= FEWEST_NUMBERED:
            middle = sorted(known)[len(known) // 2]
            yield [int(number >= middle) for number in known], True
        return
    values = set(column)
    if len(values) <= MOST_VALUES:
        ranks = {raw: rank for rank, raw in enumerate(sorted(values, key=lambda raw: (_number(raw) or 0.0, raw)))}
        yield [ranks[raw] for raw in column], False
    if len(values) == 2:
        return
    if b"" in values:
        yield [int(raw != b"") for raw in column], False
        return
    known = [number for number in numbers if number is not None]
    if len(known) == len(column):
        ordered = np.unique(known)
        steps = np.argsort(-np.diff(ordered), kind="stable")
        for heaps in range(2, min(MOST_HEAPS, len(ordered)) + 1):
            yield np.searchsorted(np.sort(ordered[steps[: heaps - 1]]), known).tolist(), True


def _number(raw: bytes) -> float | None:
    try:
        number = float(raw)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def alternates(codes: Sequence[int], gaps: Sequence[float]) -> bool:
    """True where values repeat in a fixed order, along the whole stack or where its slices are closer together.

    codes: A number for the value of each slice.
    gaps: Distances to the next slice, mm; one fewer than slices.
    """
    counts = Counter(codes)
    if len(counts) < 2 or min(counts.values()) < SMALLEST_VOLUME:
        return False
    for period in range(2, LONGEST_PERIOD + 1):
        for first, last in _runs([one == other for one, other in zip(codes, codes[period:], strict=False)]):
            end = last + period
            if end - first < max(PERIODS * period, FEWEST_SLICES) or len(set(codes[first:end])) < 2:
                continue
            slabs = any(len(set(codes[k : k + MOST_TOGETHER + 1])) == 1 for k in range(first, end - MOST_TOGETHER))
            if not slabs and _spans(codes, gaps, first, end):
                return True
    return False


def _spans(codes: Sequence[int], gaps: Sequence[float], first: int, end: int) -> bool:
    """True where only one volume lies before `first` and from `end` on, and its slices are farther apart."""
    left, right = codes[:first], codes[end:]
    if len(left) <= 1 and len(right) <= 1:
        return True
    beside = [*gaps[: max(first - 1, 0)], *gaps[end:]]
    alone = len(set(left)) <= 1 and len(set(right)) <= 1
    return alone and bool(beside) and median(beside) >= DENSER * median(gaps[first : end - 1])


def _runs(flags: Sequence[bool]) -> Iterator[tuple[int, int]]:
    """Return first index and end of each run of true flags."""
    start = 0
    for place, flag in enumerate([*flags, False]):
        if not flag:
            if place > start:
                yield start, place
            start = place + 1
