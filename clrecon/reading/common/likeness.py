"""Likeness of neighbouring slices: the pixels show two interleaved volumes that no header distinguishes.

Within one volume, slices differ the more the farther apart they are.  Where the slices of two volumes alternate, each
slice differs more from its neighbours than from the next but one, which is of its own volume; of three volumes from the
third slice, of two in pairs from the fourth.  Squares of differences between means of several pixels, which have less
noise, are compared over the whole picture and in small parts of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import TILT_REPORT_DEG
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.pieces import count_readers

LEAST_LIKENESS = 1.25
"""Ratio of the differences from neighbours to those one period on, from which on slices belong to several volumes.
Four real scans, whole and with every 2nd, 3rd and 4th slice: at most 0.58, for periods of 3 and 4 at most 0.74 and
0.82; water with noise: 0.99, 1.06, 1.12."""
PART_LIKENESS = 2.0
"""The same in parts of the picture, with period 2, for `PARTS` of them.  Those scans: at most 1.47 in any part (slices
17 mm apart), at most 0.89 where slices are nearer; water with noise 1.01."""
PARTS = 4
"""Number of parts that must reach it; of fewer, all.  One part alone must reach it along more slices
(`MOST_ALIKE_PART`), in a long stack in more than one window: a vessel with contrast medium in one of two volumes does.
A saw cut in bone of a sharp kernel alternates within one volume too: artefacts of a helical scan turn there."""
PERIODS = (2, 3, 4)
MOST_ALIKE, LEAST_ALIKE = 12, 4
"""Number of consecutive slices that must all reach it; of fewer slices all, but at least the second number."""
MOST_ALIKE_PART, LEAST_ALIKE_PART = 20, 6
HU_RANGE = (-1000, 2000)
"""Values are limited to this range; beyond are padding and metal.  Sums over a cell then fit 16 bits."""
CELL, FINE_CELL, COARSE_CELLS = 4, 2, 32
"""Pixels along the side of an averaged cell: `CELL` where that gives `COARSE_CELLS` cells along a side, else fewer."""
FEWEST_CELLS = 64
"""Least number of cells; in smaller pictures differences are due to chance."""
PART = 8
"""Cells along the side of a part of the picture."""
NOISE_HU2, PART_NOISE_HU2 = 1.0, 25.0
"""Lower limits of squared differences: pictures without noise are alike by chance."""
READERS = 4
WINDOW, WINDOWS = 32, 3
"""Number of slices in a window, and windows examined, in an evenly spaced stack with more slices: interleaved volumes
are interleaved from end to end, so parts of the picture must show it in two windows."""


@dataclass(frozen=True)
class Likeness:
    """Ratio of the differences from neighbours to those from a slice farther on.

    period: Number of slices from one slice to the most similar one.
    whole: Ratio over the whole picture; above 1 where neighbours are less alike.
    part: Ratio that `PARTS` parts of the picture reach, or one along more slices; None where parts were not examined.
    """

    period: int
    whole: float
    part: float | None

    @property
    def suspicion(self) -> float:
        """The larger of the two ratios, each divided by its bound: above 1 several volumes are interleaved."""
        return max(self.whole / LEAST_LIKENESS, (self.part or 0.0) / PART_LIKENESS)

    @property
    def is_mixed(self) -> bool:
        """True where several volumes are interleaved."""
        return self.suspicion > 1.0

    def __str__(self) -> str:
        if self.whole > LEAST_LIKENESS:
            where, times = "neighbouring slices", self.whole
        else:
            where, times = "in parts of the picture neighbouring slices", self.part or 0.0
        other = "the next but one" if self.period == 2 else f"those {self.period} further on"
        return (
            f"{where} are less alike than each is to {other} (differences {times:.3g} times as large): maybe "
            f"{'two' if self.period != 3 else 'three'} volumes between each other"
        )


def judge_slices(voxels: NDArray[Any], tilt_deg: float | None, *, uneven: bool | None = False) -> Likeness | None:
    """Apply `measure_likeness` to slices (n, rows, columns); to many where it is worst.  An unknown tilt is None."""
    parts = tilt_deg is not None and abs(tilt_deg) <= TILT_REPORT_DEG
    count = len(voxels)
    if uneven or count <= WINDOW * WINDOWS:
        return measure_likeness(voxels, parts)
    starts = [(count - WINDOW) * place // (WINDOWS - 1) for place in range(WINDOWS)]
    found = [one for first in starts if (one := measure_likeness(voxels[first : first + WINDOW], parts)) is not None]
    if not found:
        return None
    second = sorted(one.part or 0.0 for one in found)[-2] if parts and len(found) > 1 else None
    whole = max(found, key=lambda one: one.whole / LEAST_LIKENESS)
    return replace(whole, part=None if whole.part is None else second)


def measure_likeness(voxels: NDArray[Any], parts: bool = True) -> Likeness | None:
    """Compare slices (nk, nj, ni) of HU with their neighbours and those farther on; None for too few slices or pixels.

    `parts` of the picture are examined too, but not of a tilted gantry: scanners that measure several slices in one
    turn shift them against each other, which shows in objects that do not change along the table (a head holder).
    """
    if len(voxels) < min(PERIODS) + LEAST_ALIKE:
        return None
    cells = _average_cells(voxels)
    if cells.shape[1] * cells.shape[2] < FEWEST_CELLS:
        return None
    differences = [np.square(cells[step:] - cells[:-step]) for step in range(1, max(PERIODS) + 1)]
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
            ratios = _ratios(tiles, PART_NOISE_HU2)
            reached = np.sort(_steadily(ratios), axis=None)
            part = max(float(reached[-min(PARTS, len(reached))]), float(_steadily(ratios, MOST_ALIKE_PART).max()))
    best = max(found, key=lambda one: one.whole)
    if best.whole <= LEAST_LIKENESS:
        best = found[0]
    return Likeness(best.period, best.whole, part)


def _ratios(differences: Sequence[NDArray[np.float32]], noise: float) -> NDArray[np.float32]:
    """Return for each stretch of slices the largest mean difference over fewer steps than its length, over the last."""
    period = len(differences)
    count = len(differences[-1])
    nearer = []
    for step, one in enumerate(differences[:-1], start=1):
        nearer.append(np.mean([one[first : first + count] for first in range(period - step + 1)], axis=0))
    return np.asarray(np.max(nearer, axis=0) / np.maximum(differences[-1], noise))


def _steadily(ratios: NDArray[np.float32], most: int = MOST_ALIKE) -> NDArray[np.float32]:
    """Return the largest ratio that `most` consecutive stretches reach, or all if there are fewer."""
    count = min(most, len(ratios))
    lowest = [np.min(ratios[first : first + count], axis=0) for first in range(len(ratios) - count + 1)]
    return np.asarray(np.max(lowest, axis=0))


def _average_cells(voxels: NDArray[Any]) -> NDArray[np.float32]:
    """Average squares of pixels of each slice, (nk, rows, columns)."""
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
    """Average over squares of pictures (n, rows, columns), leaving out the rest at the ends."""
    rows, columns = pictures.shape[1] // side, pictures.shape[2] // side
    cut = pictures[:, : rows * side, : columns * side].reshape(len(pictures), rows, side, columns, side)
    return cut.mean(axis=(2, 4))
