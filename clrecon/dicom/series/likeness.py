"""Are neighbouring slices alike?  Two volumes between each other show in the pixels where no header tells them apart.

Within one volume slices differ the more the farther apart they lie.  Where the slices of two volumes alternate, each
differs more from its neighbours than from the next but one, which is of its own volume; of three volumes, more than
from the third; where two alternate in pairs, more than from the fourth.  Squares of differences are compared: those of
means of some pixels, so that noise counts for little, over the whole picture and in small parts of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.pixels.stored import count_readers
from clrecon.dicom.stack.fit import TILT_REPORT_DEG, Stack

__all__ = ["Likeness", "judge_likeness", "judge_slices", "measure_likeness"]

LEAST_LIKENESS = 1.25
"""Differences from neighbours over those from the slice one period on, from which slices of several volumes lie between
each other.  Four real scans, taken whole and by every 2nd, 3rd and 4th slice: at most 0.58, for periods of 3 and 4 at
most 0.74 and 0.82; water with noise: 0.99, 1.06, 1.12."""
PART_LIKENESS = 2.0
"""The same in the part of the picture where it is most, with period 2.  Those scans: at most 1.47 (slices 17 mm apart),
at most 0.89 where they are nearer.  A part need not hold much of anything: water with noise 1.01."""
PERIODS = (2, 3, 4)
MOST_ALIKE, LEAST_ALIKE = 12, 4
"""So many slices in a row must all be so, or as many as there are, and no fewer."""
LEAST_ALIKE_PART = 6
HU_RANGE = (-1000, 2000)
"""What lies beyond is padding and metal.  Sums over a cell fit 16 bits."""
CELL, FINE_CELL, COARSE_CELLS = 4, 2, 32
"""Pixels along the sides of what is averaged: `CELL` where that gives `COARSE_CELLS` cells a side, else fewer."""
FEWEST_CELLS = 64
"""Of a picture with fewer, differences are chance."""
PART = 8
"""Cells along the sides of a part."""
NOISE_HU2, PART_NOISE_HU2 = 1.0, 25.0
"""Squares of differences below these are taken as these: pictures without noise are alike by chance."""
READERS = 4
WINDOW, WINDOWS = 32, 3
"""Of an even stack with more, so many slices in so many places: volumes between each other are so from end to end."""


@dataclass(frozen=True)
class Likeness:
    """How much more slices differ from their neighbours than from one farther on.

    Attributes
    ----------
    period : int
        Slices from one to the one that it is most like.
    whole : float
        Of the whole picture; over 1 where neighbours are less alike.
    part : float or None
        Of the part of the picture where it is most; None where it was not looked at.
    """

    period: int
    whole: float
    part: float | None

    @property
    def suspicion(self) -> float:
        """The larger of the two figures, each over its bound: above 1 several volumes lie between each other."""
        return max(self.whole / LEAST_LIKENESS, (self.part or 0.0) / PART_LIKENESS)

    @property
    def is_mixed(self) -> bool:
        """Several volumes lie between each other."""
        return self.suspicion > 1.0

    def __str__(self) -> str:
        if self.whole > LEAST_LIKENESS:
            where, times = "neighbouring slices", self.whole
        else:
            where, times = "somewhere in the picture neighbouring slices", self.part or 0.0
        other = "the next but one" if self.period == 2 else f"those {self.period} further on"
        return (
            f"{where} are less alike than each is to {other} (differences {times:.3g} times as large): maybe "
            f"{'two' if self.period != 3 else 'three'} volumes between each other"
        )


def judge_likeness(voxels: NDArray[Any], stack: Stack) -> Likeness | None:
    """`measure_likeness` of a stack that was read, voxels (nk, nj, ni); of a long one where it is most suspicious."""
    return judge_slices(voxels, stack.tilt_deg, uneven=stack.line.uneven)


def judge_slices(voxels: NDArray[Any], tilt_deg: float | None, *, uneven: bool | None = False) -> Likeness | None:
    """The same of slices (n, rows, columns) along any axis of a grid; None for the tilt: not known."""
    parts = tilt_deg is not None and tilt_deg <= TILT_REPORT_DEG
    count = len(voxels)
    if uneven or count <= WINDOW * WINDOWS:
        return measure_likeness(voxels, parts)
    starts = [(count - WINDOW) * place // (WINDOWS - 1) for place in range(WINDOWS)]
    found = [measure_likeness(voxels[first : first + WINDOW], parts) for first in starts]
    return max((one for one in found if one is not None), key=lambda one: one.suspicion, default=None)


def measure_likeness(voxels: NDArray[Any], parts: bool = True) -> Likeness | None:
    """Compare slices with their neighbours and with those some way on.

    Parameters
    ----------
    voxels : ndarray, shape (nk, nj, ni)
        HU, one slice at each place, in the order of the places.
    parts : bool
        Look at parts of the picture too.  Not where the gantry is tilted: scanners that measure several slices in one
        turn then move those of one turn against each other, which shows in what does not change along the table (a
        head holder) on real scans.

    Returns
    -------
    Likeness or None
        None where there are too few slices or pixels.
    """
    if len(voxels) < min(PERIODS) + LEAST_ALIKE:
        return None
    cells = _average_cells(voxels)
    if cells.shape[1] * cells.shape[2] < FEWEST_CELLS:
        return None
    differences = [_square_differences(cells, step) for step in range(1, max(PERIODS) + 1)]
    found = []
    for period in PERIODS:
        if len(voxels) < period + LEAST_ALIKE:
            break
        whole = [one.mean(axis=(1, 2)) for one in differences[:period]]
        found.append(Likeness(period, float(_steadily(_ratios(whole, NOISE_HU2))), None))
    part = None
    if parts and len(voxels) >= min(PERIODS) + LEAST_ALIKE_PART:
        tiles = [_average(one, PART) for one in differences[:2]]
        if tiles[0].size:
            part = float(_steadily(_ratios(tiles, PART_NOISE_HU2)).max())
    best = max(found, key=lambda one: one.whole)
    if best.whole <= LEAST_LIKENESS:
        best = found[0]
    return Likeness(best.period, best.whole, part)


def _ratios(differences: Sequence[NDArray[np.float32]], noise: float) -> NDArray[np.float32]:
    """For each stretch of `period` slices the largest mean difference of fewer steps over that of all its steps."""
    period = len(differences)
    count = len(differences[-1])
    nearer = []
    for step, one in enumerate(differences[:-1], start=1):
        nearer.append(np.mean([one[first : first + count] for first in range(period - step + 1)], axis=0))
    return np.asarray(np.max(nearer, axis=0) / np.maximum(differences[-1], noise))


def _steadily(ratios: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest ratio that `MOST_ALIKE` in a row reach, or as many as there are."""
    count = min(MOST_ALIKE, len(ratios))
    lowest = [np.min(ratios[first : first + count], axis=0) for first in range(len(ratios) - count + 1)]
    return np.asarray(np.max(lowest, axis=0))


def _square_differences(cells: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    return np.square(cells[step:] - cells[:-step])


def _average_cells(voxels: NDArray[Any]) -> NDArray[np.float32]:
    """Means of squares of pixels, (nk, rows, columns)."""
    least = min(voxels.shape[1:])
    side = next((side for side in (CELL, FINE_CELL) if least >= side * COARSE_CELLS), 1)
    rows, columns = voxels.shape[1] // side, voxels.shape[2] // side
    cells = np.zeros((len(voxels), rows, columns), np.float32)

    def average(k: int) -> None:
        picture = np.empty((rows * side, columns * side), np.int16)
        np.clip(voxels[k, : rows * side, : columns * side], *HU_RANGE, out=picture, casting="unsafe")
        band = picture[::side]
        for row in range(1, side):
            band = band + picture[row::side]
        for column in range(side):
            cells[k] += band[:, column::side]

    with ThreadPoolExecutor(count_readers(len(voxels), READERS)) as pool:
        for _ in pool.map(average, range(len(voxels))):
            pass
    cells /= side * side
    return cells


def _average(pictures: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Means over squares of pictures (n, rows, columns), what is left over at the ends not among them."""
    rows, columns = pictures.shape[1] // side, pictures.shape[2] // side
    cut = pictures[:, : rows * side, : columns * side].reshape(len(pictures), rows, side, columns, side)
    return cut.mean(axis=(2, 4))
