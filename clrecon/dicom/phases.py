"""Several slices at one place: copies of each other, or the phases of a series that holds more than one volume.

Copies are slices with the same pixels; one of them is kept.  What differs is told apart by an element of the
headers (a temporal position, an acquisition, a time, a reconstruction kernel): the first one that parts the slices
into stacks with one slice at each place.  Nothing is ever chosen here.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from clrecon.dicom.header import PHASE_KEYWORDS, SliceHeader
from clrecon.dicom.pixels import read_voxels
from clrecon.dicom.stored import StoredPixels
from clrecon.dicom.text import join_names
from clrecon.errors import UsageError

__all__ = ["Phase", "Places", "choose_phase", "describe_phases", "have_same_pixels", "sort_places"]

PLACES_SHOWN = 4
PHASES_SHOWN = 12
SMALLEST_PHASE = 3
"""More groups than there are slices at the fullest place are phases only if each has this many slices."""
TIME_KEYWORDS = ("AcquisitionTime", "ContentTime")
DATE_KEYWORDS = ("AcquisitionDate", "ContentDate")
RANK_KEYWORDS = (
    ("TemporalPositionIdentifier",),
    ("TriggerTime",),
    ("AcquisitionDate", "AcquisitionTime"),
    ("AcquisitionTime",),
    ("ContentDate", "ContentTime"),
    ("ContentTime",),
)


@dataclass(frozen=True)
class Phase:
    """One of several volumes in a series.

    Attributes
    ----------
    number : int
        From 1, what ``phase=`` takes.
    keyword, value : str
        The element that tells the phases apart, and what it says of this one; times count from the first phase.
    headers : tuple of SliceHeader
    """

    number: int
    keyword: str
    value: str
    headers: tuple[SliceHeader, ...]

    def __str__(self) -> str:
        count = len(self.headers)
        return f"{self.number}: {self.keyword} {self.value}, {count} slice{'s' * (count != 1)}"


@dataclass(frozen=True)
class Places:
    """Slices sorted out by their places.

    Attributes
    ----------
    headers : tuple of SliceHeader
        Without copies.
    copies : int
        Slices that were left out as copies of others.
    phases : tuple of Phase
        Empty where each place has one slice; None of them is chosen yet.
    problem : str
        Why slices at one place can neither be left out nor told apart; empty where there is nothing to say.
    """

    headers: tuple[SliceHeader, ...]
    copies: int = 0
    phases: tuple[Phase, ...] = field(default=())
    problem: str = ""


def sort_places(places: Sequence[Sequence[SliceHeader]], same: Callable[[SliceHeader, SliceHeader], bool]) -> Places:
    """Leave out copies and find phases.

    Parameters
    ----------
    places : sequence of sequences of SliceHeader
        The slices at each place, in the order of the places.
    same : callable
        True where two slices have the same pixels.
    """
    kept = [_leave_out_copies(slices, same) for slices in places]
    headers = tuple(header for slices in kept for header in slices)
    copies = sum(map(len, places)) - len(headers)
    if max(map(len, kept), default=0) <= 1:
        return Places(headers, copies)
    phases = _find_phases(kept)
    if phases:
        return Places(headers, copies, phases)
    crowded = [slices for slices in kept if len(slices) > 1]
    shown = "; ".join(join_names(header.name for header in slices) for slices in crowded[:PLACES_SHOWN])
    more = f"; and {len(crowded) - PLACES_SHOWN} more" if len(crowded) > PLACES_SHOWN else ""
    return Places(
        headers,
        copies,
        problem=f"duplicate slices with different pixels at {len(crowded)} place{'s' * (len(crowded) > 1)}, and no "
        f"element of their headers parts them into phases: {shown}{more}",
    )


def have_same_pixels(one: SliceHeader, other: SliceHeader, source: StoredPixels | None = None) -> bool:
    """True when two slices hold the same HU; reads both, from `source` where many are compared.

    Raises
    ------
    RefusedInputError
        The pixels of one cannot be read.
    """
    if (one.rows, one.columns) != (other.rows, other.columns):
        return False
    return bool(np.array_equal(read_voxels([one], source=source)[0], read_voxels([other], source=source)[0]))


def _leave_out_copies(
    slices: Sequence[SliceHeader], same: Callable[[SliceHeader, SliceHeader], bool]
) -> list[SliceHeader]:
    kept: list[SliceHeader] = []
    for header in slices:
        if not any(same(earlier, header) for earlier in kept):
            kept.append(header)
    return kept


def _find_phases(places: Sequence[Sequence[SliceHeader]]) -> tuple[Phase, ...]:
    most = max(map(len, places))
    for keywords in _keyword_choices(places):
        groups: dict[tuple[str, ...], list[SliceHeader]] = defaultdict(list)
        clean = True
        for slices in places:
            values = [_values(header, keywords) for header in slices]
            clean = clean and len(set(values)) == len(values)
            for value, header in zip(values, slices, strict=True):
                groups[value].append(header)
        if clean and (len(groups) == most or min(map(len, groups.values())) >= SMALLEST_PHASE):
            ordered = sorted(groups, key=_order)
            shown = _show(keywords, ordered)
            return tuple(
                Phase(number, " and ".join(keywords), text, tuple(groups[value]))
                for number, (value, text) in enumerate(zip(ordered, shown, strict=True), start=1)
            )
    return _rank_by_time(places, most)


def _keyword_choices(places: Sequence[Sequence[SliceHeader]]) -> Iterator[tuple[str, ...]]:
    """Keywords that differ at some place, single ones first, then pairs; the most telling first."""
    present: dict[str, None] = dict.fromkeys(PHASE_KEYWORDS)
    differing: set[str] = set()
    for slices in places:
        for keyword in dict.fromkeys(keyword for header in slices for keyword, _ in header.phase):
            present.setdefault(keyword)
            if len({_values(header, (keyword,)) for header in slices}) > 1:
                differing.add(keyword)
    ordered = [keyword for keyword in present if keyword in differing]
    yield from ((keyword,) for keyword in ordered)
    yield from combinations(ordered, 2)


def _rank_by_time(places: Sequence[Sequence[SliceHeader]], most: int) -> tuple[Phase, ...]:
    """Where every place was visited equally often and each visit has its time: the first visits, the second..."""
    if any(len(slices) != most for slices in places):
        return ()
    for keywords in RANK_KEYWORDS:
        groups: list[list[SliceHeader]] = [[] for _ in range(most)]
        for slices in places:
            ordered = sorted(slices, key=lambda header: _order(_values(header, keywords)))
            values = [_values(header, keywords) for header in ordered]
            if len(set(values)) < most or any("" in value for value in values):
                break
            for group, header in zip(groups, ordered, strict=True):
                group.append(header)
        else:
            return tuple(
                Phase(number, f"order of {' and '.join(keywords)}", str(number), tuple(group))
                for number, group in enumerate(groups, start=1)
            )
    return ()


def _values(header: SliceHeader, keywords: Sequence[str]) -> tuple[str, ...]:
    own = dict(header.phase)
    return tuple(own.get(keyword, "") for keyword in keywords)


def _order(value: tuple[str, ...]) -> list[tuple[int, float, str]]:
    """Numbers by size and before text."""
    return [(0, number, "") if (number := _number(part)) is not None else (1, 0.0, part) for part in value]


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _show(keywords: Sequence[str], values: Sequence[tuple[str, ...]]) -> list[str]:
    """Values for a listing: of dates and times, which may tell who it is, only what has passed since the first."""
    columns = []
    for place, keyword in enumerate(keywords):
        column = [value[place] for value in values]
        if keyword in TIME_KEYWORDS:
            seconds = [_seconds(text) for text in column]
            column = _since_first(seconds, "s")
        elif keyword in DATE_KEYWORDS:
            column = [f"date {1 + sorted(set(column)).index(text)}" for text in column]
        columns.append([text or "(none)" for text in column])
    return [", ".join(parts) for parts in zip(*columns, strict=True)]


def _seconds(text: str) -> float | None:
    number = _number(text)
    if number is None:
        return None
    hours, rest = divmod(number, 10000)
    minutes, seconds = divmod(rest, 100)
    return hours * 3600 + minutes * 60 + seconds


def _since_first(seconds: Sequence[float | None], unit: str) -> list[str]:
    known = [value for value in seconds if value is not None]
    first = min(known, default=0.0)
    return ["(none)" if value is None else f"+{value - first:g} {unit}" for value in seconds]


def describe_phases(phases: Sequence[Phase]) -> str:
    """The problem of a series whose phases have not been chosen from."""
    shown = [str(phase) for phase in phases[:PHASES_SHOWN]]
    more = f" and {len(phases) - PHASES_SHOWN} more" if len(phases) > PHASES_SHOWN else ""
    return f"{len(phases)} phases at the same places, choose one with --phase: [{'], ['.join(shown)}]{more}"


def choose_phase(phases: Sequence[Phase], wanted: int) -> Phase:
    """The phase of that number.

    Raises
    ------
    UsageError
        There is none.
    """
    for phase in phases:
        if phase.number == wanted:
            return phase
    if not phases:
        raise UsageError(f"there is no phase {wanted!r}: the series has one slice at each place")
    raise UsageError(f"there is no phase {wanted!r}: {describe_phases(phases)}")
