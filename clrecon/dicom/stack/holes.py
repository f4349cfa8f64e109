"""Missing slices: gaps in a stack that are too wide for their neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]

MISSING_RATIO = 1.5
RUN_LENGTH = 3
RUN_TOLERANCE = 0.05
"""A gap over 1.5 times the usual gap means missing slices, unless it belongs to a run: at least 3 consecutive gaps that
are equal within 5 %. A run is a change of feed, a hole is not.  The usual gap is the median, with an even count the
smaller of the two in the middle, so that equally many holes and whole gaps do not make the holes usual.  Beside a run
the usual gap is that of the run (of two runs, the coarser), so that a hole where the feed is fine is found however
coarse it is elsewhere."""
PLACES_SHOWN = 4


@dataclass(frozen=True)
class Holes:
    """Gaps in a stack that are too wide, by the rule at `MISSING_RATIO`.

    places: The gap k lies between the slices k and k + 1.
    ends_mm: tuple of (float, float). Positions along the normal of the slices before and after the gap.
    usual_mm: The gap that would be there without a hole.
    """

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
        return _join_places(texts)


def find_holes(distances: Float64Array) -> Holes:
    """Find missing slices among sorted positions (n,) along the normal; with only two slices there are none."""
    gaps = np.diff(distances)
    if len(gaps) < 2:
        return Holes()
    if gaps.max() <= MISSING_RATIO * gaps.min():
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
        if gaps[k] > MISSING_RATIO * min(usual, beside):
            wide.append(k)
            usuals.append(beside if gaps[k] > MISSING_RATIO * beside else usual)
    ends = tuple((float(distances[k]), float(distances[k + 1])) for k in wide)
    return Holes(tuple(wide), tuple(float(gaps[k]) for k in wide), ends, tuple(usuals))


def _find_runs(gaps: Float64Array) -> NDArray[np.bool_]:
    """Mark gaps in runs: at least `RUN_LENGTH` consecutive gaps that are equal within `RUN_TOLERANCE`."""
    in_run = np.zeros(len(gaps), dtype=bool)
    for place, gap in enumerate(gaps.tolist()):
        low, high = max(place - RUN_LENGTH + 1, 0), min(place + RUN_LENGTH, len(gaps))
        like = (np.abs(gaps[low:high] - gap) <= RUN_TOLERANCE * gap).tolist()
        first = last = place - low
        while first > 0 and like[first - 1]:
            first -= 1
        while last < len(like) - 1 and like[last + 1]:
            last += 1
        in_run[place] = last - first + 1 >= RUN_LENGTH
    return in_run


def _join_places(places: list[str]) -> str:
    shown = "; ".join(places[:PLACES_SHOWN])
    return shown if len(places) <= PLACES_SHOWN else f"{shown}; and {len(places) - PLACES_SHOWN} more"
