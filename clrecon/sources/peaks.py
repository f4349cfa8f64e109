"""Peaks of the values of a volume: the materials of which it holds a lot, on any scale."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SMOOTHING, FINEST_BIN, MOST_BINS = 20.0, 5.0, 8000
"""Standard deviation of the smoothing and width of a bin, HU; of wider ranges the bins get wider."""
TAILS = 0.0005
"""Share of the values that is left out at either end."""
VALLEY = 0.5
"""Two peaks are two where the histogram between them falls below this share of the lower one."""
LEAST_SHARE = 0.02


class Peak(NamedTuple):
    """A peak: its place, its width at half of its height, and the share of the values within that width."""

    at: float
    width: float
    share: float

    @property
    def height(self) -> float:
        """The share for each HU of the width."""
        return self.share / self.width


def find_peaks(values: NDArray[Any]) -> list[Peak]:
    """Return the peaks of sorted values that hold `LEAST_SHARE` of them, from the lowest to the highest."""
    end = int(TAILS * len(values))
    inner = values[end : len(values) - end].astype(np.float64)
    low, high = float(inner[0]), float(inner[-1])
    width = max(FINEST_BIN, (high - low) / MOST_BINS)
    sigma = max(SMOOTHING / width, 1.0)
    border = int(4 * sigma) + 1
    counts = np.bincount(((inner - low) / width).astype(np.int64) + border)
    weights = np.exp(-0.5 * (np.arange(-border, border + 1) / sigma) ** 2)
    smooth = np.convolve(np.pad(counts, (0, border)), weights / weights.sum(), mode="same")
    peaks = []
    for top in _find_tops(smooth):
        below, above = (np.flatnonzero(half <= smooth[top] / 2.0) for half in (smooth[:top], smooth[top:]))
        first, last = (int(below[-1]) if len(below) else 0), top + (int(above[0]) if len(above) else len(smooth))
        share = float(smooth[first : last + 1].sum()) / len(values)
        if share >= LEAST_SHARE:
            peaks.append(Peak(low + (top - border + 0.5) * width, (last - first) * width, share))
    return peaks


def _find_tops(smooth: NDArray[np.float64]) -> list[int]:
    """Return the places of the maxima with a valley between each two of them."""
    inner = smooth[1:-1]
    tops = np.flatnonzero((inner > smooth[:-2]) & (inner >= smooth[2:])) + 1
    floors = np.array([smooth[a : b + 1].min() for a, b in zip(tops[:-1], tops[1:], strict=True)])
    while len(tops) > 1:
        depths = floors / np.minimum(smooth[tops[:-1]], smooth[tops[1:]])
        shallow = int(np.argmax(depths))
        if depths[shallow] <= VALLEY:
            break
        lower = shallow + int(smooth[tops[shallow]] >= smooth[tops[shallow + 1]])
        beside = floors[max(lower - 1, 0) : lower + 1].min()
        tops, floors = np.delete(tops, lower), np.delete(floors, shallow)
        if 0 < lower <= len(floors):
            floors[lower - 1] = beside
    return [int(top) for top in tops]
