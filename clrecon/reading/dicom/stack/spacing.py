"""Steps from slice to slice: gaps too wide for their neighbours, and positions written with few digits.

Steps of 0.0105 mm written with two digits are 0.01 mm, and every twentieth 0.02 mm.  A slice that is missing leaves the
same gap.  The two are told apart by the digits and by a distance that the headers state beside the positions: where all
positions are even steps of that distance, each rounded to its last digit, none is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.system.light_dataclass import dataclass


def median(values: Sequence[float] | NDArray[Any]) -> float:
    """Return what `numpy.median` does, which is slow for few values and loads masked arrays, 10 ms at every start."""
    ordered = np.sort(values)
    middle = len(ordered) // 2
    return float(ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2)


_MISSING_RATIO = 1.5
RUN_LENGTH = 3
_RUN_TOLERANCE = 0.05
"""A gap over 1.5 times the usual gap means missing slices, unless it belongs to a run: at least 3 consecutive gaps that
are equal within 5 %. A run is a change of feed, a hole is not.  The usual gap is the median, with an even count the
smaller of the two in the middle, so that equally many holes and whole gaps do not make the holes usual.  Beside a run
it is that of the run (of two, the coarser): a hole where the feed is fine is found however coarse it is elsewhere."""
PLACES_SHOWN = 4


@dataclass(frozen=True)
class Holes:
    """Gaps k, from slice k to k + 1, that are too wide (`_MISSING_RATIO`), positions of their ends, usual gap, mm."""

    places: tuple[int, ...] = ()
    gaps_mm: tuple[float, ...] = ()
    ends_mm: tuple[tuple[float, float], ...] = ()
    usual_mm: tuple[float, ...] = ()

    @property
    def missing(self) -> int:
        """Number of slices that would fill the gaps at the usual distance."""
        return sum(self._counts())

    def _counts(self) -> list[int]:
        return [max(round(gap / usual) - 1, 1) for gap, usual in zip(self.gaps_mm, self.usual_mm, strict=True)]

    def describe(self, names: Sequence[str] = ()) -> str:
        """Describe where the holes are; given the names of all slices, also between which slices."""
        texts = []
        columns = (self.places, self.gaps_mm, self.ends_mm, self.usual_mm, self._counts())
        for k, gap, (low, high), usual, count in zip(*columns, strict=True):
            between = f": {names[k]}, {names[k + 1]}" if names else ""
            texts.append(
                f"{count} slice{'s' * (count > 1)} missing between {low:.2f} and {high:.2f} mm "
                f"(gap {gap:.3f} mm, usual {usual:.3f} mm){between}"
            )
        shown = "; ".join(texts[:PLACES_SHOWN])
        return shown if len(texts) <= PLACES_SHOWN else f"{shown}; and {len(texts) - PLACES_SHOWN} more"


def find_holes(distances: Float64Array) -> Holes:
    """Find missing slices among sorted positions (n,) along the normal; with only two slices there are none."""
    gaps = np.diff(distances)
    if len(gaps) < 2:
        return Holes()
    if gaps.max() <= _MISSING_RATIO * gaps.min():
        return Holes()  # the usual case
    usual = float(np.sort(gaps)[(len(gaps) - 1) // 2])
    if usual <= 0.0:
        return Holes()  # only where the directions are wrong
    in_run = _find_runs(gaps)
    runs = np.flatnonzero(in_run)
    wide, usuals = [], []
    for k in np.flatnonzero(~in_run).tolist():
        after = int(np.searchsorted(runs, k))
        beside = max(gaps[runs[max(after - 1, 0) : after + 1]].tolist(), default=usual)
        if gaps[k] > _MISSING_RATIO * min(usual, beside):
            wide.append(k)
            usuals.append(beside if gaps[k] > _MISSING_RATIO * beside else usual)
    ends = tuple((float(distances[k]), float(distances[k + 1])) for k in wide)
    return Holes(tuple(wide), tuple(float(gaps[k]) for k in wide), ends, tuple(usuals))


def _find_runs(gaps: Float64Array) -> NDArray[np.bool_]:
    """Mark gaps in runs: at least `RUN_LENGTH` consecutive gaps that are equal within `_RUN_TOLERANCE`."""
    in_run = np.zeros(len(gaps), dtype=bool)
    for place, gap in enumerate(gaps.tolist()):
        low, high = max(place - RUN_LENGTH + 1, 0), min(place + RUN_LENGTH, len(gaps))
        like = (np.abs(gaps[low:high] - gap) <= _RUN_TOLERANCE * gap).tolist()
        first = last = place - low
        while first > 0 and like[first - 1]:
            first -= 1
        while last < len(like) - 1 and like[last + 1]:
            last += 1
        in_run[place] = last - first + 1 >= RUN_LENGTH
    return in_run


SLACK = 1e-6
"""Relative excess over the unit of the last digit that is due to float64."""
WHOLE = 1e-3
"""A distance that is a multiple of the unit, within this part of it, is not changed by rounding."""


@dataclass(frozen=True)
class Rounding:
    """Even steps of `stated_mm` by `keyword` that explain positions rounded to `unit_mm`, the last of their digits."""

    unit_mm: float
    digits: int
    keyword: str
    stated_mm: float

    def __str__(self) -> str:
        plural = "s" * (self.digits != 1)
        return (
            f"positions are written with {self.digits} decimal{plural}, too few for slices that are "
            f"{self.stated_mm:g} mm apart by {self.keyword}: all of them are even steps, rounded"
        )


def measure_unit(headers: Sequence[SliceHeader], normal: Float64Array) -> tuple[float, int]:
    """Return the last digit of positions along the normal in mm, by the slice with most digits, and its decimals."""
    digits = np.max([header.position_digits for header in headers], axis=0)
    return float(np.abs(normal) @ 10.0 ** -digits.astype(np.float64)), int(digits[np.argmax(np.abs(normal))])


def find_rounding(
    headers: Sequence[SliceHeader], distances: Float64Array, normal: Float64Array, tolerance: float
) -> Rounding | None:
    """Explain uneven positions along the normal (3,), at sorted distances (n,), mm, n >= 2, by their digits.

    Returns None where positions have digits enough, no distance is stated, or a stated one does not explain them, if
    they are further off than `tolerance`, mm.
    """
    unit, digits = measure_unit(headers, normal)
    if len(headers) < 3 or unit / 2.0 <= SLACK or np.ptp(np.diff(distances)) < min(unit / 2.0, tolerance):
        return None
    k = np.arange(len(distances), dtype=np.float64)
    fitted = float((k - k.mean()) @ distances / np.sum((k - k.mean()) ** 2))
    for keyword, stated in (
        ("SpacingBetweenSlices", _stated(headers, "stated_gap_mm")),
        ("SliceThickness", _stated(headers, "slice_thickness_mm")),
    ):
        if stated is None or stated <= unit or abs(stated / unit - round(stated / unit)) < WHOLE:
            continue
        # A missing slice would move the ends by a whole step against even steps of the stated distance.
        steps = [stated, fitted] if abs(fitted - stated) * (len(distances) - 1) < stated / 2.0 else [stated]
        if any(float(np.ptp(distances - k * step)) <= unit * (1.0 + SLACK) for step in steps):
            return Rounding(unit, digits, keyword, stated)
    return None


def _stated(headers: Sequence[SliceHeader], field: str) -> float | None:
    """Return the distance that the headers state, if all of them state it and about the same one."""
    values = [getattr(header, field) for header in headers]
    if any(value is None or value <= 0.0 for value in values):
        return None
    middle = median(values)
    return middle if max(values) - min(values) <= WHOLE * middle else None
