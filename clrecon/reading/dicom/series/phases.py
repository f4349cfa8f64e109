"""Several slices at one place: copies of each other, or the phases of a series that holds more than one volume.

Copies are slices with the same pixels and the same geometry; one of them is kept.  Others are distinguished by the
first element of the headers (a temporal position, an acquisition, a time, a reconstruction kernel) that divides them
into stacks with one slice at each place.  Slices of several volumes may also lie between each other (`mixtures`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, combinations

import numpy as np

from clrecon.errors import UsageError
from clrecon.reading.dicom.headers.slice_header import PHASE_KEYWORDS, SliceHeader
from clrecon.reading.dicom.pixels.stored import StoredPixels
from clrecon.reading.dicom.pixels.voxels import read_voxels
from clrecon.reading.dicom.stack.fit import measure_gap, measure_unit
from clrecon.reading.dicom.stack.mixtures import Alternation, find_mixture, read_number, values_of
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, field, replace
from clrecon.system.text import join_names

PLACES_SHOWN = 4
_PHASES_SHOWN = 12
_SMALLEST_PHASE = 3
"""With more groups than slices at the fullest place, groups are phases only if each has this many slices."""
_TIME_KEYWORDS = ("AcquisitionTime", "ContentTime")
_DATE_KEYWORDS = ("AcquisitionDate", "ContentDate")
_HALF_A_DAY_S = 43_200.0
SAME_POSITION_MM = 0.01
_SAME_SPACING = 1e-5
_SAME_DIRECTION = 1e-4
"""Tolerances for the geometry of copies, for rounding: those of `clrecon.reading.dicom.stack.fit`."""
_RANK_KEYWORDS = (
    ("TemporalPositionIdentifier",),
    ("TriggerTime",),
    ("AcquisitionDate", "AcquisitionTime"),
    ("AcquisitionTime",),
    ("ContentDate", "ContentTime"),
    ("ContentTime",),
)


@dataclass(frozen=True)
class Phase:
    """One of the volumes in a series, from 1, and the element that distinguishes it; times count from the first."""

    number: int
    keyword: str
    value: str
    headers: tuple[SliceHeader, ...]

    def __str__(self) -> str:
        count = len(self.headers)
        return f"{self.number}: {self.keyword} {self.value}, {count} slice{'s' * (count != 1)}"


@dataclass(frozen=True)
class Places:
    """Slices grouped by their places, without copies.

    phases: Empty where each place has one slice; none is chosen yet.
    problem: Why the slices are no volume and no phase of them is one; empty if there is no problem.
    interleaved: The phases share no place, and the slices of one lie between those of another.
    doubt: Description of an alternation along the stack that may still be one volume; empty if there is none.
    """

    headers: tuple[SliceHeader, ...]
    copies: int = 0
    phases: tuple[Phase, ...] = field(default=())
    problem: str = ""
    interleaved: bool = False
    doubt: str = ""


def sort_places(places: Sequence[Sequence[SliceHeader]], same: Callable[[SliceHeader, SliceHeader], bool]) -> Places:
    """Leave out copies and find phases of the slices at each place; `same` tells whether two have the same pixels."""
    sorted_out = [_sort_copies(slices, same) for slices in places]
    distinct = [[copies[0] for copies in found] for found in sorted_out]
    count = sum(map(len, places))
    headers = tuple(chain(*distinct))
    if len(places) == 1 and count > 1:
        phases = _find_phases(sorted_out)
        problem = _describe_one_place(count, headers, phases)
        return Places(headers, count - len(headers), phases, problem=problem)
    if max(map(len, distinct), default=0) <= 1:
        phases = _part(find_mixture(headers))
        return Places(headers, count - len(headers), phases, interleaved=bool(phases))
    phases = _find_phases(sorted_out)
    if phases:
        # A slice that is equal in two phases (air, at the ends) is a copy, but belongs to both.
        headers = tuple(chain(*(phase.headers for phase in phases)))
        return Places(headers, count - len(headers), phases)
    crowded = [slices for slices in distinct if len(slices) > 1]
    shown = "; ".join(join_names(header.name for header in slices) for slices in crowded[:PLACES_SHOWN])
    more = f"; and {len(crowded) - PLACES_SHOWN} more" if len(crowded) > PLACES_SHOWN else ""
    alike = all(lie_alike(slices[0], header) for slices in crowded for header in slices[1:])
    return Places(
        headers,
        count - len(headers),
        problem=f"duplicate slices with different pixels{'' if alike else ' or geometry'} at {len(crowded)} "
        f"place{'s' * (len(crowded) > 1)}, and no element of their headers parts them into phases: {shown}{more}"
        f"{_describe_digits(headers)}",
    )


def _describe_digits(headers: Sequence[SliceHeader]) -> str:
    """Say that places fall together because positions have too few digits; empty if they have enough."""
    unit, digits = measure_unit(headers, np.cross(headers[0].row_cosines, headers[0].column_cosines))
    thickness = headers[0].slice_thickness_mm or 0.0
    if not 0.0 < thickness < unit:
        return ""
    return (
        f"; positions are written with {digits} decimal{'s' * (digits != 1)}, too few for slices of {thickness:g} mm: "
        "write them with more digits"
    )


def _describe_one_place(count: int, headers: Sequence[SliceHeader], phases: Sequence[Phase]) -> str:
    """Describe the problem of a series whose images all lie at one place."""
    kind = "copies of each other"
    if phases:
        kind = f"{len(phases)} phases of one slice each, which differ in {phases[0].keyword}"
    elif len(headers) > 1:
        kind = f"{len(headers)} of them with different pixels, and no element of their headers parts them into phases"
    position = ", ".join(f"{value:g}" for value in headers[0].position_mm)
    return (
        f"all {count} images lie in one plane, at ImagePositionPatient ({position}) mm ({kind}): a single slice"
        " cannot make"
        f" a volume{', and choosing a phase does not help' if phases else ''}. If one slice was scanned repeatedly"
        " (cine, perfusion, bolus tracking), use another series; if these are different slices, their positions were"
        " lost or overwritten: export the series again"
    )


def part_alternating(places: Places, alternation: Alternation) -> Places:
    """Divide slices, one at each place, into phases by an alternation along them; the phases share no place."""
    members = [tuple(places.headers[k] for k in group) for group in alternation.groups]
    if not alternation.tag:
        shown = [f"{number} of {len(members)}" for number in range(1, len(members) + 1)]
        keyword = "place"
    elif alternation.heaps:
        shown, keyword = [str(number) for number in range(1, len(members) + 1)], f"order of {alternation.name}"
    elif alternation.name in PHASE_KEYWORDS:
        keyword = alternation.name
        shown = _show_values((keyword,), [values_of(headers[0], (keyword,)) for headers in members])
    else:  # free text may contain anything
        shown = ["(none)" if number == alternation.absent else f"value {number + 1}" for number in range(len(members))]
        keyword = alternation.name
    phases = tuple(
        Phase(number, keyword, text, headers)
        for number, (text, headers) in enumerate(zip(shown, members, strict=True), start=1)
    )
    return replace(places, phases=phases, interleaved=True, doubt="")


def lie_alike(first: SliceHeader, second: SliceHeader) -> bool:
    """True when two slices at one place have the same geometry: empty slices have equal pixels at every place."""
    return (
        first.frame_of_reference == second.frame_of_reference
        and _is_near(first.position_mm, second.position_mm, SAME_POSITION_MM)
        and _is_near(
            (first.di_mm, first.dj_mm), (second.di_mm, second.dj_mm), _SAME_SPACING * min(first.di_mm, first.dj_mm)
        )
        and _is_near(first.row_cosines, second.row_cosines, _SAME_DIRECTION)
        and _is_near(first.column_cosines, second.column_cosines, _SAME_DIRECTION)
    )


def _is_near(first: Sequence[float], second: Sequence[float], tolerance: float) -> bool:
    return all(abs(a - b) <= tolerance for a, b in zip(first, second, strict=True))


def have_same_pixels(first: SliceHeader, second: SliceHeader, source: StoredPixels | None = None) -> bool:
    """True when two slices hold the same HU; reads both, from `source` where many are compared."""
    if (first.rows, first.columns) != (second.rows, second.columns):
        return False
    voxels, _ = read_voxels([first, second], source=source)
    return np.array_equal(voxels[0], voxels[1])


def _sort_copies(
    slices: Sequence[SliceHeader], same: Callable[[SliceHeader, SliceHeader], bool]
) -> list[list[SliceHeader]]:
    """Sort the slices at one place so that copies are together."""
    copy_groups: list[list[SliceHeader]] = []
    for header in slices:
        for copies in copy_groups:
            if lie_alike(copies[0], header) and same(copies[0], header):
                copies.append(header)
                break
        else:
            copy_groups.append([header])
    return copy_groups


def _find_phases(places: Sequence[Sequence[Sequence[SliceHeader]]]) -> tuple[Phase, ...]:
    """Find phases among slices that are grouped by place, and at each place by copies."""
    distinct = [[copies[0] for copies in found] for found in places]
    for keywords in _keyword_choices(distinct):
        groups: dict[tuple[str, ...], list[SliceHeader]] = defaultdict(list)
        clean, most = True, 0
        for copy_groups in places:
            here = [{values_of(header, keywords): header for header in reversed(copies)} for copies in copy_groups]
            values = list(chain(*here))
            clean, most = clean and len(set(values)) == len(values), max(most, len(values))
            for headers_at in here:
                for value, header in headers_at.items():
                    groups[value].append(header)
        if clean and (len(groups) == most or min(map(len, groups.values())) >= _SMALLEST_PHASE):
            return _part((keywords, groups))
    everything = [list(chain(*slices)) for slices in places]
    return _rank_by_time(distinct) or _rank_by_time(everything)


def _part(choice: tuple[tuple[str, ...], Mapping[tuple[str, ...], Sequence[SliceHeader]]] | None) -> tuple[Phase, ...]:
    """Make phases of groups of slices, by the values of keywords."""
    if choice is None:
        return ()
    keywords, groups = choice
    ordered = sorted(groups, key=_order)
    shown = _show_values(keywords, ordered)
    return tuple(
        Phase(number, " and ".join(keywords), text, tuple(groups[value]))
        for number, (value, text) in enumerate(zip(ordered, shown, strict=True), start=1)
    )


def _keyword_choices(places: Sequence[Sequence[SliceHeader]]) -> Iterator[tuple[str, ...]]:
    """Return the keywords that differ at some place, single ones first, then pairs; the most specific first."""
    present: dict[str, None] = dict.fromkeys(PHASE_KEYWORDS)
    differing: set[str] = set()
    for slices in places:
        for keyword in dict.fromkeys(keyword for header in slices for keyword, _ in header.phase):
            present.setdefault(keyword)
            if len({values_of(header, (keyword,)) for header in slices}) > 1:
                differing.add(keyword)
    ordered = [keyword for keyword in present if keyword in differing]
    yield from ((keyword,) for keyword in ordered)
    yield from combinations(ordered, 2)


def _rank_by_time(places: Sequence[Sequence[SliceHeader]]) -> tuple[Phase, ...]:
    """Rank slices by time, first visits, second visits..., where all places have equally many, each with a time."""
    most = max(map(len, places))
    if any(len(slices) != most for slices in places):
        return ()
    for keywords in _RANK_KEYWORDS:
        ordered = [sorted(slices, key=lambda header: _order(values_of(header, keywords))) for slices in places]
        values = [[values_of(header, keywords) for header in slices] for slices in ordered]
        if any(len(set(visits)) < most or any("" in value for value in visits) for visits in values):
            continue
        if _are_passes(values, keywords):
            return tuple(
                Phase(number, f"order of {' and '.join(keywords)}", str(number), tuple(group))
                for number, group in enumerate(zip(*ordered, strict=True), start=1)
            )
    return ()


def _are_passes(values: Sequence[Sequence[tuple[str, ...]]], keywords: tuple[str, ...]) -> bool:
    """True when the n-th visits of all places were one pass: before any place was visited again.

    Where the table stopped at some places for all their visits before it moved on, this must hold for each stop.  Times
    of reconstruction tell nothing about stops.  Without a date, times around midnight have no order.
    """
    if keywords in (("AcquisitionTime",), ("ContentTime",)):
        seconds = [_seconds(value[0]) or 0.0 for value in chain(*values)]
        if max(seconds) - min(seconds) > _HALF_A_DAY_S:
            return False
    ranks = {value: rank for rank, value in enumerate(sorted(set(chain(*values)), key=_order))}
    times = np.array([[ranks[value] for value in visits] for visits in values])
    times = times[np.argsort(times[:, 0], kind="stable")]
    if keywords[-1] == "ContentTime":
        stops = [times]
    else:
        ends = np.maximum.accumulate(times[:, -1])
        stops = np.split(times, np.flatnonzero(times[1:, 0] > ends[:-1]) + 1)
    return all(bool((stop[:, :-1].max(axis=0) < stop[:, 1:].min(axis=0)).all()) for stop in stops)


def _order(value: tuple[str, ...]) -> list[tuple[int, float, str]]:
    """Return a sort key: numbers by size, before text."""
    return [(0, number, "") if (number := read_number(part)) is not None else (1, 0.0, part) for part in value]


def _show_values(keywords: Sequence[str], values: Sequence[tuple[str, ...]]) -> list[str]:
    """Return values for a listing; dates and times, which may identify the patient, only since the first one."""
    columns = []
    for index, keyword in enumerate(keywords):
        column = [value[index] for value in values]
        if keyword in _TIME_KEYWORDS:
            seconds = [_seconds(text) for text in column]
            first = min((value for value in seconds if value is not None), default=0.0)
            column = ["(none)" if value is None else f"+{value - first:g} s" for value in seconds]
        elif keyword in _DATE_KEYWORDS:
            column = [f"date {1 + sorted(set(column)).index(text)}" for text in column]
        columns.append([text or "(none)" for text in column])
    return [", ".join(parts) for parts in zip(*columns, strict=True)]


def _seconds(text: str) -> float | None:
    number = read_number(text)
    if number is None:
        return None
    hours, rest = divmod(number, 10000)
    minutes, seconds = divmod(rest, 100)
    return hours * 3600 + minutes * 60 + seconds


def describe_phases(places: Places) -> str:
    """Describe the problem of a series with several phases of which none was chosen."""
    if places.problem:
        return places.problem
    phases = places.phases
    listed = join_names((f"[{phase}]" for phase in phases), _PHASES_SHOWN)
    arrangement = "whose slices lie between each other" if places.interleaved else "at the same places"
    spacing = f"; {describe_spacing(phases, phases[0])}" if places.interleaved else ""
    return f"{len(phases)} phases {arrangement}, choose one with {name_parameter('phase')}: {listed}{spacing}"


def describe_spacing(phases: Sequence[Phase], chosen: Phase) -> str:
    """Say what the choice of one of several interleaved phases does to the distance of the slices."""
    everything = list(chain(*(phase.headers for phase in phases)))
    return (
        f"slices of phase {chosen.number} lie {measure_gap(chosen.headers):.4g} mm apart, those of all phases "
        f"{measure_gap(everything):.4g} mm"
    )


def choose_phase(places: Places, wanted: int) -> Phase:
    for phase in places.phases:
        if phase.number == wanted:
            return phase
    known = describe_phases(places) if places.phases or places.problem else "the series has one slice at each place"
    raise UsageError(f"there is no phase {wanted!r}: {known}")
