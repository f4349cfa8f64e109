"""Mixtures: slices of several volumes that lie between each other, and differences along a stack.

Two reconstructions half a gap apart, or two acquisitions that overlap, share no place.  Sorted by position they look
like one stack that alternates between two volumes, evenly spaced or not.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from clrecon.dicom.headers.slice_header import SliceHeader

CERTAIN = (
    "TemporalPositionIndex",
    "TemporalPositionIdentifier",
    "NominalPercentageOfCardiacPhase",
    "NominalPercentageOfRespiratoryPhase",
    "StackID",
    "ConvolutionKernel",
    "KVP",
)
"""Elements that are constant within a volume."""
POSSIBLE = ("AcquisitionNumber", "FrameAcquisitionNumber", "AcquisitionTime", "ImageType")
"""Elements that may change within one volume, from rotation to rotation or from file to file.  They divide a stack only
if it is uneven as a whole and each part is even."""
SMALLEST_VOLUME = 3
EVEN = 0.05
"""Relative difference up to which gaps count as equal here."""
THICKNESS_TOLERANCE = 0.01
ALTERNATING = ("AcquisitionNumber", "FrameAcquisitionNumber")
CODING: dict[str, Callable[[SliceHeader], float]] = {
    "RescaleSlope": lambda header: header.slope,
    "RescaleIntercept": lambda header: header.intercept,
    "BitsStored": lambda header: header.bits_stored,
    "HighBit": lambda header: header.high_bit,
    "PixelRepresentation": lambda header: header.signed,
}
"""Numbers that turn stored values into HU.  A slice may have its own, but then each has: where most agree, one that
differs is doubtful."""


def values_of(header: SliceHeader, keywords: Sequence[str]) -> tuple[str, ...]:
    """Return the values that distinguish phases; empty if there are none."""
    own = dict(header.phase)
    return tuple(own.get(keyword, "") for keyword in keywords)


def find_mixture(
    headers: Sequence[SliceHeader],
) -> tuple[tuple[str, ...], Mapping[tuple[str, ...], Sequence[SliceHeader]]] | None:
    """Find the element that divides a stack into volumes whose slices lie between each other.

    headers: One slice for each place, in the order of the places.

    Returns: (keywords, groups) or None. The slices by their value of the keyword: each group has at least three slices
        and all have a value.
    """
    for keyword, values in _values_along(headers, (*CERTAIN, *POSSIBLE)):
        groups = _find_interleaved(values, headers)
        if groups and (keyword in CERTAIN or not _is_even(headers) and all(map(_is_even, groups.values()))):
            return (keyword,), groups
    return None


def _values_along(headers: Sequence[SliceHeader], keywords: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Return the keywords whose values differ along the slices, with these values."""
    own = [dict(header.phase) for header in headers]
    for keyword in keywords:
        values = [one.get(keyword, "") for one in own]
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
    if changes < len(groups) or ("",) in groups or min(map(len, groups.values())) < SMALLEST_VOLUME:
        return {}
    return groups


def _is_even(headers: Sequence[SliceHeader]) -> bool:
    steps = np.linalg.norm(np.diff(np.array([header.position_mm for header in headers]), axis=0), axis=1)
    return float(np.ptp(steps)) <= EVEN * float(steps.min())


def describe_differences(headers: Sequence[SliceHeader]) -> Iterator[tuple[str, Callable[[SliceHeader], bool]]]:
    """Describe values that differ within a stack but should be equal, and the slices that differ from the first one.

    headers: In the order of their places.

    Yields: (text, is_so). Keywords and slices, without values that could tell of the patient.
    """
    first = headers[0]
    for keyword, values in _values_along(headers, ("KVP", *ALTERNATING)):
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
        return _thickness(header) > 0.0 and abs(_thickness(header) - usual) > THICKNESS_TOLERANCE * usual

    if any(map(is_other, headers)):
        yield "SliceThickness differs along the stack", is_other
    for keyword, number_of in CODING.items():
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
