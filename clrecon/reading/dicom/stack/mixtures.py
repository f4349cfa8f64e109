"""Mixtures: slices of several volumes that lie between each other, and elements that alternate along a stack.

Two reconstructions half a gap apart, or two acquisitions that overlap, share no place.  Any element may distinguish
them, so all headers of the stack are read again for every element whose values repeat in a fixed order along it: ABAB,
ABCABC, AABB.  Within one volume values stay, count on, change at single places, or alternate with the turns of the
gantry: so in an even stack only elements that are constant within a volume make phases, of others the pixels decide.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.reading.dicom.parse.elements import read_elements
from clrecon.reading.dicom.parse.plain import CorruptFileError, NotDicomError
from clrecon.reading.dicom.parse.values import name_element
from clrecon.reading.dicom.stack.fit import median
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import list_distinct

_CERTAIN = (
    "TemporalPositionIndex",
    "TemporalPositionIdentifier",
    "NominalPercentageOfCardiacPhase",
    "NominalPercentageOfRespiratoryPhase",
    "StackID",
    "ConvolutionKernel",
    "KVP",
)
"""Elements that are constant within a volume."""
_POSSIBLE = ("AcquisitionNumber", "FrameAcquisitionNumber", "AcquisitionTime", "ImageType")
"""Elements that may change within one volume, from rotation to rotation or from file to file.  They divide a stack only
if it is uneven as a whole and each part is even."""
_SMALLEST_VOLUME = 3
_EVEN = 0.05
"""Relative difference up to which gaps count as equal here."""
_THICKNESS_TOLERANCE = 0.01
_ALTERNATING = ("AcquisitionNumber", "FrameAcquisitionNumber")
_CODING: dict[str, Callable[[SliceHeader], float]] = {
    "RescaleSlope": lambda header: header.slope,
    "RescaleIntercept": lambda header: header.intercept,
    "BitsStored": lambda header: header.bits_stored,
    "HighBit": lambda header: header.high_bit,
    "PixelRepresentation": lambda header: header.signed,
}
"""Numbers that turn stored values into HU.  A slice may have its own, but where most agree, one that differs is
doubtful."""


def values_of(header: SliceHeader, keywords: Sequence[str]) -> tuple[str, ...]:
    """Return the values that distinguish phases; empty if there are none."""
    phase_values = dict(header.phase)
    return tuple(phase_values.get(keyword, "") for keyword in keywords)


def find_mixture(
    headers: Sequence[SliceHeader],
) -> tuple[tuple[str, ...], Mapping[tuple[str, ...], Sequence[SliceHeader]]] | None:
    """Find the keyword that divides a stack into volumes of three slices or more, and the slices of each value."""
    for keyword, values in _values_along(headers, (*_CERTAIN, *_POSSIBLE)):
        groups = _find_interleaved(values, headers)
        if groups and (keyword in _CERTAIN or not _is_even(headers) and all(map(_is_even, groups.values()))):
            return (keyword,), groups
    return None


def _values_along(headers: Sequence[SliceHeader], keywords: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    phase_values = [dict(header.phase) for header in headers]
    for keyword in keywords:
        values = [one.get(keyword, "") for one in phase_values]
        if len(set(values)) > 1:
            yield keyword, values


def _find_interleaved(
    values: Sequence[str], headers: Sequence[SliceHeader]
) -> dict[tuple[str, ...], list[SliceHeader]]:
    """Group the slices by their values if these come back after others; empty if they do not."""
    changes = sum(one != other for one, other in zip(values, values[1:], strict=False))
    groups: dict[tuple[str, ...], list[SliceHeader]] = defaultdict(list)
    for value, header in zip(values, headers, strict=True):
        groups[(value,)].append(header)
    if changes < len(groups) or ("",) in groups or min(map(len, groups.values())) < _SMALLEST_VOLUME:
        return {}
    return groups


def _is_even(headers: Sequence[SliceHeader]) -> bool:
    steps = np.linalg.norm(np.diff(np.array([header.position_mm for header in headers]), axis=0), axis=1)
    return float(np.ptp(steps)) <= _EVEN * float(steps.min())


def describe_differences(headers: Sequence[SliceHeader]) -> Iterator[tuple[str, Callable[[SliceHeader], bool]]]:
    """Yield descriptions of values that differ within a stack but should not, and which slices have another one."""
    first = headers[0]
    for keyword, values in _values_along(headers, ("KVP", *_ALTERNATING)):
        if keyword == "KVP":
            text = "KVP differs along the stack: maybe parts of several volumes"
        elif _find_interleaved(values, headers):
            text = f"{keyword} alternates along the stack: maybe several volumes between each other"
        else:
            continue
        yield text, lambda h, k=(keyword,): values_of(h, k) != values_of(first, k)  # type: ignore[misc]
    stated = [thickness for thickness in map(_thickness, headers) if thickness > 0.0]
    usual = stated[0] if stated else 0.0

    def is_other(header: SliceHeader) -> bool:
        return _thickness(header) > 0.0 and abs(_thickness(header) - usual) > _THICKNESS_TOLERANCE * usual

    if any(map(is_other, headers)):
        yield "SliceThickness differs along the stack", is_other
    for keyword, number_of in _CODING.items():
        number, count = Counter(map(number_of, headers)).most_common(1)[0]
        if len(headers) / 2 < count < len(headers):
            text = f"{keyword} is not {number:g} as in the other slices: the HU may be wrong"
            yield text, lambda h, number_of=number_of, number=number: number_of(h) != number  # type: ignore[misc]
    padding, count = Counter(header.padding for header in headers).most_common(1)[0]
    if len(headers) / 2 < count < len(headers):
        text = "PixelPaddingValue is not as in the other slices: measured voxels may count as padding, or padding as HU"
        yield text, lambda h: h.padding != padding


def _thickness(header: SliceHeader) -> float:
    return header.slice_thickness_mm or 0.0


Verdict = Literal["phases", "pixels", "nothing"]


@dataclass(frozen=True)
class ElementKind:
    """Elements that alternate for one reason.

    verdict: What follows in an even stack: phases; phases if the pixels show two volumes, else a doubt; or nothing,
        since one volume alternates in it.
    """

    verdict: Verdict
    reason: str
    tags: frozenset[int]


ELEMENT_KINDS = (
    ElementKind(
        "phases",
        "each pass over the patient has its own time",
        frozenset({
            0x00080020, 0x00080021, 0x00080022, 0x00080023, 0x0008002A, 0x00080030, 0x00080031, 0x00080032, 0x00080033,
            0x00181060,
        }),
    ),
    ElementKind(
        "phases",
        "it numbers or names acquisitions",
        frozenset({0x00080017, 0x00083010, 0x00200012, 0x00200100, 0x00209056, 0x00209128, 0x00209156}),
    ),
    ElementKind(
        "phases",
        "a whole pass is with or without contrast medium",
        frozenset({
            0x00180010, 0x00180012, 0x00181040, 0x00181041, 0x00181042, 0x00181043, 0x00181044, 0x00181046, 0x00181047,
            0x00181048, 0x00181049,
        }),
    ),
    ElementKind(
        "phases",
        "voltage and filter are set for a whole pass",
        frozenset({0x00180060, 0x00181160, 0x00187050}),
    ),
    ElementKind(
        "phases",
        "one reconstruction is one volume",
        frozenset({0x00080008, 0x00082111, 0x00180050, 0x00181100, 0x00181210, 0x00189315}),
    ),
    ElementKind(
        "phases",
        "it describes a whole volume",
        frozenset({0x00080070, 0x00081010, 0x00081030, 0x0008103E, 0x00181030, 0x00204000, 0x00400254}),
    ),
    ElementKind("pixels", "it says how a slice is displayed", frozenset({0x00281050, 0x00281051, 0x00281055})),
    ElementKind("pixels", "the writer of the files chooses the order", frozenset({0x00200013})),
    ElementKind("pixels", "it says when a file was written", frozenset({0x00080012, 0x00080013})),
    ElementKind(
        "pixels",
        "the dose is adapted to the patient from slice to slice",
        frozenset({
            0x00181150, 0x00181151, 0x00181152, 0x00181153, 0x00181170, 0x00189330, 0x00189332, 0x00189345,
        }),
    ),
    ElementKind(
        "nothing",
        "it changes from one rotation of the gantry to the next",
        frozenset({0x00181140, 0x00189305}),
    ),
)  # fmt: skip
_VERDICTS = {tag: kind.verdict for kind in ELEMENT_KINDS for tag in kind.tags}


def find_verdict(tag: int, even: bool) -> Verdict:
    """Return what follows where an element alternates in a stack, `even` or not, of which two volumes overlap in part.

    There any standard element makes phases.  Private ones never do so alone: the number of the detector row is one.
    """
    known = _VERDICTS.get(tag)
    if even:
        return known or "pixels"
    if known == "nothing":
        return "pixels"
    return known or ("pixels" if tag >> 16 & 1 else "phases")


FEWEST_SLICES = 6
_LONGEST_PERIOD = 8
PERIODS = 3
"""The order of values has to repeat this often: by chance, 6 interchangeable slices show it."""
_MOST_TOGETHER = 2
"""Largest number of neighbouring slices of one volume; more are parts in which one volume may be scanned."""
_MOST_VALUES = 8
"""An element with more values is judged by heaps: groups of close numbers, such as the times of two passes."""
_MOST_HEAPS = 4
LONGEST_VALUE = 64
DENSER = 1.3
"""Where two volumes overlap in part, slices are this many times closer together than elsewhere."""
WINDOW, WINDOWS = 32, 3
"""Windows of an evenly spaced stack, and slices in each, that are examined before all slices are: it can only hold
volumes that overlap from end to end."""
_FEWEST_NUMBERED = 12
"""With fewer slices, InstanceNumber forms two heaps by chance."""

SERIES_UID, _SOP_INSTANCE, INSTANCE_NUMBER = 0x0020000E, 0x00080018, 0x00200013
NEVER = frozenset({_SOP_INSTANCE, SERIES_UID, INSTANCE_NUMBER, 0x00200032, 0x00200037, 0x00201041})
"""Identifiers and places of single slices, which are examined elsewhere."""
PIXEL_GROUP, _OVERLAY_GROUPS = 0x0028, range(0x5000, 0x6100)
"""Groups of elements that describe the stored values of single slices: rescale, extremes, padding, overlays."""
_WINDOW_TAGS = frozenset({0x00281050, 0x00281051, 0x00281055})


@dataclass(frozen=True)
class Alternation:
    """An element whose values alternate along a stack, with the places, from 0, of each volume in the order of the
    values.

    tag: 0 where the groups do not come from an element.
    certain: The element is constant within one volume.
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
        return name_element(self.tag)


def find_alternation(headers: Sequence[SliceHeader], even: bool) -> Alternation | None:
    """Find an element that alternates along a stack, a certain one first; the headers of its files are read again.

    In an even stack fewer are certain, and some windows of a long one come first.  None for frames, which share a
    header.
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
    """Deal `count` slices in turn to `period` volumes, for period 4 in pairs to two: groups that no header shows."""
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
            alternation = Alternation(tag, groups, certain, heaps, absent)
            if certain:
                return alternation
            doubtful = doubtful or alternation
            break
    return doubtful


def _read_columns(headers: Sequence[SliceHeader]) -> dict[int, list[bytes]]:
    """Return the values along the stack of each element that is not constant; empty where a slice lacks the element."""
    first: dict[int, bytes] = {}
    columns: dict[int, list[bytes]] = {}
    for k, header in enumerate(headers):
        values = _read_values(header)
        first = values if k == 0 else first
        differing = {tag for tag, _ in values.items() ^ first.items() if tag not in columns}
        for tag in filter(_is_compared, differing):
            if _shorten(values.get(tag)) != _shorten(first.get(tag)):
                columns[tag] = [_shorten(first.get(tag))] * k
        for tag, column in columns.items():
            column.append(_shorten(values.get(tag)))
    return columns


def _read_values(header: SliceHeader) -> dict[int, bytes]:
    """Read the elements of a file: none if it changed since the scan, which its pixels will tell."""
    try:
        # A file that needed `force` is read with it again; for other files it changes nothing.
        return read_elements(header.file, None, force=True).values
    except (OSError, CorruptFileError, NotDicomError):
        return {}


def _shorten(raw: bytes | None) -> bytes:
    """Return a value without its filling, a long one as what distinguishes it: vendors keep files in one element."""
    value = b"" if raw is None else raw.strip(b" \0")
    return value if len(value) <= LONGEST_VALUE else hash(value).to_bytes(8, "little", signed=True) + b"..."


def _is_compared(tag: int) -> bool:
    group = tag >> 16
    if tag == INSTANCE_NUMBER or tag in _WINDOW_TAGS:
        return True
    return tag not in NEVER and group != PIXEL_GROUP and group not in _OVERLAY_GROUPS and tag & 0xFFFF != 0


def _code(tag: int, column: Sequence[bytes]) -> Iterator[tuple[list[int], bool]]:
    """Return the ways to group the slices by the values of one element: group numbers, and whether these are heaps."""
    numbers = [read_number(raw) for raw in column]
    if tag == INSTANCE_NUMBER:
        known = [number for number in numbers if number is not None]
        if len(known) == len(column) >= _FEWEST_NUMBERED:
            middle = sorted(known)[len(known) // 2]
            yield [int(number >= middle) for number in known], True
        return
    values = set(column)
    if len(values) <= _MOST_VALUES:
        ranks = {raw: rank for rank, raw in enumerate(sorted(values, key=lambda raw: (read_number(raw) or 0.0, raw)))}
        yield [ranks[raw] for raw in column], False
    if len(values) == 2:
        return
    if b"" in values:
        yield [int(raw != b"") for raw in column], False
        return
    known = [number for number in numbers if number is not None]
    if len(known) == len(column):
        ordered = list_distinct(np.array(known))
        steps = np.argsort(-np.diff(ordered), kind="stable")
        for heaps in range(2, min(_MOST_HEAPS, len(ordered)) + 1):
            yield np.searchsorted(np.sort(ordered[steps[: heaps - 1]]), known).tolist(), True


def read_number(raw: bytes | str) -> float | None:
    """Return a finite number in decimal digits, None for any other value."""
    try:
        number = float(raw)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def alternates(codes: Sequence[int], gaps: Sequence[float]) -> bool:
    """Tell whether `codes` repeat in a fixed order, in the whole stack or where the `gaps` to the next are shorter."""
    counts = Counter(codes)
    if len(counts) < 2 or min(counts.values()) < _SMALLEST_VOLUME:
        return False
    for period in range(2, _LONGEST_PERIOD + 1):
        for first, last in _runs([one == other for one, other in zip(codes, codes[period:], strict=False)]):
            end = last + period
            if end - first < max(PERIODS * period, FEWEST_SLICES) or len(set(codes[first:end])) < 2:
                continue
            slabs = any(len(set(codes[k : k + _MOST_TOGETHER + 1])) == 1 for k in range(first, end - _MOST_TOGETHER))
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
    for index, flag in enumerate([*flags, False]):
        if not flag:
            if index > start:
                yield start, index
            start = index + 1
