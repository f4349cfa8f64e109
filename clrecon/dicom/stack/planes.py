"""Planes of a series: slices with nearly equal directions belong to one stack."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict

SPLIT_ANGLE_RAD = math.radians(1.0)
"""Slices of one SeriesInstanceUID whose directions differ by more are separate stacks (a localizer, another plane).
With smaller differences they are one stack, and the gate reports the difference."""


class Planes:
    """Pairs of directions, numbered in the order of arrival; pairs within `SPLIT_ANGLE_RAD` of an earlier one get its
    number.

    A series may have as many planes as files: beyond the first few they are looked up in a grid of cells of that size.
    """

    FEW = 4

    def __init__(self) -> None:
        self._planes: list[tuple[float, ...]] = []
        self._cells: dict[tuple[int, ...], list[int]] = defaultdict(list)

    def find(self, plane: tuple[float, ...]) -> int:
        """Return the number of the first plane near `plane`, which is added if there is none."""
        for number, known in enumerate(self._planes[: self.FEW]):
            if _are_near(known, plane):
                return number
        cell = tuple(int(value // SPLIT_ANGLE_RAD) for value in plane)
        if len(self._planes) > self.FEW:
            around = itertools.product(*((value - 1, value, value + 1) for value in cell))
            near = (n for key in around for n in self._cells.get(key, ()) if _are_near(self._planes[n], plane))
            number = min(near, default=-1)
            if number >= 0:
                return number
        self._planes.append(plane)
        self._cells[cell].append(len(self._planes) - 1)
        return len(self._planes) - 1


def _are_near(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return math.dist(one[:3], other[:3]) < SPLIT_ANGLE_RAD and math.dist(one[3:], other[3:]) < SPLIT_ANGLE_RAD
