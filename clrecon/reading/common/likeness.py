"""Likeness of neighbouring slices: the pixels show two interleaved volumes that no header distinguishes.

Within one volume, slices differ the more the farther apart they are.  Where the slices of two volumes alternate, each
slice differs more from its neighbours than from the next but one, which is of its own volume; of three volumes from the
third slice, of two in pairs from the fourth.  Squares of differences between means of several pixels, which have less
noise, are compared over the whole picture and in small parts of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import TILT_REPORT_DEG
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.pieces import chunks, in_threads
from clrecon.system.records import Gate, none_of, unmeasured

_LEAST_LIKENESS = 1.25
"""Ratio of the differences from neighbours to those one period on, from which on slices belong to several volumes.
Four real scans, whole and with every 2nd, 3rd and 4th slice: at most 0.58, for periods of 3 and 4 at most 0.74 and
0.82; water with noise: 0.99, 1.06, 1.12."""
_PART_LIKENESS = 2.0
"""The same in parts of the picture, with period 2, for `PARTS` of them.  Those scans: at most 1.47 in any part (slices
17 mm apart), at most 0.89 where slices are nearer; water with noise 1.01."""
PARTS = 4
"""Number of parts that must reach it; of fewer, all.  One part alone must reach it along more slices
(`_MOST_ALIKE_PART`), in a long stack in more than one window: a vessel with contrast medium in one of two volumes does.
A saw cut in bone of a sharp kernel alternates within one volume too: artefacts of a helical scan turn there."""
PERIODS = (2, 3, 4)
_MOST_ALIKE, _LEAST_ALIKE = 12, 4
"""Number of consecutive slices that must all reach it; of fewer slices all, but at least the second number."""
_MOST_ALIKE_PART, _LEAST_ALIKE_PART = 20, 6
HU_RANGE = (-1000, 2000)
"""Values are limited to this range; beyond are padding and metal.  Sums over a cell, of values above the lowest, then
fit 16 bits."""
_CELL = 4
_FINE_CELL = 2
_COARSE_CELLS = 32
"""Pixels along the side of an averaged cell: `_CELL` where that gives `_COARSE_CELLS` along a side, else fewer."""
FEWEST_CELLS = 64
"""Least number of cells; in smaller pictures differences are due to chance."""
PART = 8
"""Cells along the side of a part of the picture."""
_NOISE_HU2, _PART_NOISE_HU2 = 1.0, 25.0
"""Lower limits of squared differences: pictures without noise are alike by chance."""
_PIECE, _CACHED = 8, 1 << 17
"""Slices that a thread takes at a time, and cells whose differences are taken at a time."""
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
        return max(self.whole / _LEAST_LIKENESS, (self.part or 0.0) / _PART_LIKENESS)

    @property
    def is_mixed(self) -> bool:
        """True where several volumes are interleaved."""
        return self.suspicion > 1.0

    def __str__(self) -> str:
        if self.whole > _LEAST_LIKENESS:
            subject, times = "neighbouring slices", self.whole
        else:
            subject, times = "in parts of the picture neighbouring slices", self.part or 0.0
        further = "the next but one" if self.period == 2 else f"those {self.period} further on"
        return (
            f"{subject} are less alike than each is to {further} (differences {times:.3g} times as large): maybe "
            f"{'two' if self.period != 3 else 'three'} volumes between each other"
        )


def judge_slices(voxels: NDArray[Any], tilt_deg: float | None, *, uneven: bool | None = False) -> Likeness | None:
    """Apply `measure_likeness` to slices (n, rows, columns); to many where it is worst.  An unknown tilt is None."""
    parts = tilt_deg is not None and abs(tilt_deg) <= TILT_REPORT_DEG
    count = len(voxels)
    if uneven or count <= WINDOW * WINDOWS:
        return measure_likeness(voxels, parts=parts)
    starts = [(count - WINDOW) * place // (WINDOWS - 1) for place in range(WINDOWS)]
    likenesses = [
        one for first in starts if (one := measure_likeness(voxels[first : first + WINDOW], parts=parts)) is not None
    ]
    if not likenesses:
        return None
    second = sorted(one.part or 0.0 for one in likenesses)[-2] if parts and len(likenesses) > 1 else None
    whole = max(likenesses, key=lambda one: one.whole / _LEAST_LIKENESS)
    return replace(whole, part=None if whole.part is None else second)


def measure_likeness(voxels: NDArray[Any], *, parts: bool = True) -> Likeness | None:
    """Compare slices (nk, nj, ni) of HU with their neighbours and those farther on; None for too few slices or pixels.

    `parts` of the picture are examined too, but not of a tilted gantry: scanners that measure several slices in one
    turn shift them against each other, which shows in objects that do not change along the table (a head holder).
    """
    if len(voxels) < min(PERIODS) + _LEAST_ALIKE:
        return None
    cells = _average_cells(voxels)
    if cells.shape[1] * cells.shape[2] < FEWEST_CELLS:
        return None
    parts = parts and len(voxels) >= min(PERIODS) + _LEAST_ALIKE_PART
    steps = [_compare_cells(cells, step, parts=parts and step <= 2) for step in range(1, max(PERIODS) + 1)]
    likenesses = []
    for period in PERIODS:
        if len(voxels) < period + _LEAST_ALIKE:
            break
        whole = [of_slices for of_slices, _ in steps[:period]]
        likenesses.append(Likeness(period, float(_steadily(_ratios(whole, _NOISE_HU2))), None))
    part = None
    if parts:
        tiles = [of_parts for _, of_parts in steps[:2]]
        if tiles[0].size:
            ratios = _ratios(tiles, _PART_NOISE_HU2)
            reached = np.sort(_steadily(ratios), axis=None)
            part = max(float(reached[-min(PARTS, len(reached))]), float(_steadily(ratios, _MOST_ALIKE_PART).max()))
    best = max(likenesses, key=lambda one: one.whole)
    if best.whole <= _LEAST_LIKENESS:
        best = likenesses[0]
    return Likeness(best.period, best.whole, part)


def _compare_cells(
    cells: NDArray[np.float32], step: int, *, parts: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the mean squared differences of slices `step` apart, (n,), and those of `parts` of the picture or none."""
    count = max(len(cells) - step, 0)
    whole = np.empty(count, np.float32)
    tiles = np.empty((count, *(side // PART * parts for side in cells.shape[1:])), np.float32)
    for piece in chunks(count, max(1, _CACHED // cells[0].size)):
        apart = cells[step:][piece] - cells[piece]
        np.square(apart, out=apart)
        whole[piece] = apart.mean(axis=(1, 2))
        if parts:
            tiles[piece] = _average(apart, PART)
    return whole, tiles


def _ratios(differences: Sequence[NDArray[np.float32]], noise: float) -> NDArray[np.float32]:
    """Return for each stretch of slices the largest mean difference over fewer steps than its length, over the last."""
    period = len(differences)
    count = len(differences[-1])
    nearer = []
    for step, of_step in enumerate(differences[:-1], start=1):
        nearer.append(np.mean([of_step[first : first + count] for first in range(period - step + 1)], axis=0))
    return np.asarray(np.max(nearer, axis=0) / np.maximum(differences[-1], noise))


def _steadily(ratios: NDArray[np.float32], most: int = _MOST_ALIKE) -> NDArray[np.float32]:
    """Return the largest ratio that `most` consecutive stretches reach, or all if there are fewer."""
    count = min(most, len(ratios))
    lowest = [np.min(ratios[first : first + count], axis=0) for first in range(len(ratios) - count + 1)]
    return np.asarray(np.max(lowest, axis=0))


def _average_cells(voxels: NDArray[Any]) -> NDArray[np.float32]:
    """Average squares of pixels of each slice, (nk, rows, columns)."""
    least = min(voxels.shape[1:])
    side = next((side for side in (_CELL, _FINE_CELL) if least >= side * _COARSE_CELLS), 1)
    rows, columns = voxels.shape[1] // side, voxels.shape[2] // side
    cells = np.empty((len(voxels), rows, columns), np.float32)
    word, ones = np.dtype(f"u{2 * side}"), sum(1 << 16 * place for place in range(side))

    def average(piece: slice) -> None:
        picture = np.empty((rows * side, columns * side), np.int16)  # new memory a slice takes as long as the rest
        band = np.empty((rows, columns * side), np.int16)
        words = band.view(word)
        for slice_cells, layer in zip(cells[piece], voxels[piece, : rows * side, : columns * side], strict=True):
            np.clip(layer, *HU_RANGE, out=picture, casting="unsafe")
            picture -= HU_RANGE[0]
            band[...] = picture[::side]
            for row in range(1, side):
                band += picture[row::side]
            # A cell's pixels of a row of sums are one word: this product has their sum in its highest 16 bits.
            words *= word.type(ones)
            words >>= word.type(16 * (side - 1))
            slice_cells[...] = words

    in_threads(average, len(voxels), _PIECE)
    cells += side * side * HU_RANGE[0]
    cells /= side * side
    return cells


def _average(pictures: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Average over squares of pictures (n, rows, columns), leaving out the rest at the ends."""
    count, (rows, columns) = len(pictures), (length // side for length in pictures.shape[1:])
    bands = pictures[:, : rows * side, : columns * side].reshape(count, rows, side, columns * side).sum(axis=2)
    return np.asarray(bands.reshape(count, rows, columns, side).sum(axis=3) / np.float32(side * side))


SHOWN_SAID = "pictures that are not where their headers put them: slices in each other's place, rows of a wrong length"

_LEAST_EXCHANGE, _MOST_EXCHANGES = 1.25, 2
"""How much less alike two slices in each other's place are to their neighbours there, and most pairs of them: more are
two volumes.  Five scans, whole and with every 2nd, 3rd and 5th slice: at most 1.01; exchanged 1.5 to 3 where slices lie
up to 4 mm apart."""
FEWEST_SLICES = 6
_FEWEST_SAMPLES = 512
SAMPLES = 64
_FEWEST_MOVED = 25
"""Fewest slices and samples of a slice that are compared, most samples along a side, and fewest that must differ:
square of the sum of their differences by the sum of the squares."""
_WRONG_ROW = 4.0
_NARROWEST = 16
PICTURES = 4
"""How much less alike pixels of neighbouring rows are than those of a row, and than those of rows as long as columns
are; least pixels along a side, and pictures looked at."""


def judge_shown_places(voxels: NDArray[Any]) -> Gate:
    """Judge the gate ``shown_places`` of slices (nk, nj, ni) of HU: order of the slices, and length of the rows."""
    nk, nj, ni = voxels.shape
    samples = _sample_rows(voxels)
    comparable = nk >= FEWEST_SLICES and samples.shape[1] >= _FEWEST_SAMPLES
    pairs = [f"slices {a + 1} and {b + 1} of {nk}" for a, b in _find_exchanged(samples)] if comparable else []
    texts = [f"{' and '.join(pairs)} seem to lie in each other's place, by what they show"] if pairs else []
    if _has_swapped_sides(voxels):
        texts.append(f"rows of {nj} pixels fit better than those of {ni}: Rows and Columns seem to be swapped")
    if not texts and not comparable:
        return unmeasured("shown_places", 0, None, f"{SHOWN_SAID}: too few slices or pixels")
    return none_of("shown_places", len(texts), f"{SHOWN_SAID} ({'; '.join(texts)})" if texts else SHOWN_SAID)


def _sample_rows(voxels: NDArray[Any]) -> NDArray[np.int16]:
    """Return means along pieces of some rows of each slice, (nk, n)."""
    nk, nj, ni = voxels.shape
    side = -(-min(nj, ni) // SAMPLES)
    rows = range(side // 2, nj, side)
    samples = np.empty((nk, len(rows) * (ni // side)), np.int16)

    def sample(piece: slice) -> None:
        for means, layer in zip(samples[piece], voxels[piece, side // 2 :: side, : ni // side * side], strict=True):
            sums = np.clip(layer, *HU_RANGE).astype(np.float64).reshape(-1, side) @ np.ones(side)  # exact for integers
            np.rint(sums / side, out=means, casting="unsafe")

    in_threads(sample, nk, _PIECE)
    return samples


def _find_exchanged(samples: NDArray[np.int16]) -> list[tuple[int, int]]:
    """Return pairs of slices (n, samples) that each are more like the other's neighbours; none if there are many."""

    def differ(a: int, b: int) -> float:
        apart = np.square(np.subtract(samples[a], samples[b], dtype=np.float32))
        total, squares = float(apart.sum()), float(apart @ apart)
        few = total**2 < _FEWEST_MOVED * squares
        return np.nan if few else max(total / apart.size, _NOISE_HU2)

    count, exchanged = len(samples), []
    first, second, third = (np.array([differ(k, k + step) for k in range(count - step)]) for step in (1, 2, 3))
    odd = (np.flatnonzero(np.minimum(first[:-1], first[1:]) > _LEAST_EXCHANGE * second) + 1).tolist()
    for position, a in enumerate(odd if len(odd) <= 2 * _MOST_EXCHANGES else ()):
        for b in odd[position + 1 :]:
            there = [differ(a - 1, b) + differ(a + 1, b), differ(b - 1, a) + differ(b + 1, a)]
            here = [first[a - 1] + first[a], first[b - 1] + first[b]]
            if b - a > 2 and all(one > _LEAST_EXCHANGE * other for one, other in zip(here, there, strict=True)):
                exchanged.append((a, b))
    for apart, further in () if exchanged else ((1, second), (2, third)):  # a stretch of the stack is turned round
        ratios = np.minimum(first[: -apart - 1] / further[:-1], first[apart + 1 :] / further[1:])
        exchanged += [(k + 1, k + 1 + apart) for k in np.flatnonzero(ratios > _LEAST_EXCHANGE).tolist()]
    return exchanged if len(exchanged) <= _MOST_EXCHANGES else []


def _has_swapped_sides(voxels: NDArray[Any]) -> bool:
    """True where pixels one after the other make a picture only with rows as long as the columns are said to be."""
    nk, nj, ni = voxels.shape
    if min(nj, ni) < _NARROWEST or nj % ni == 0 or ni % nj == 0:
        return False
    beside, across = 0.0, 0.0
    below = 0.0
    for picture in voxels[:: -(-nk // PICTURES)]:
        flat = np.clip(picture, *HU_RANGE).astype(np.float32).ravel()
        apart = [float(np.square(flat[lag:] - flat[:-lag]).mean()) for lag in (1, nj, ni)]
        beside, across = beside + apart[0], across + apart[1]
        below = below + apart[2]
    return below > _WRONG_ROW * max(beside, across) and across * _WRONG_ROW > beside
