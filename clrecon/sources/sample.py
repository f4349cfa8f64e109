"""A sample of the values of a volume, of which shares and peaks are taken in a few milliseconds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.sources.facts import PixelFacts

SAMPLED_SLICES, SAMPLED_VOXELS = 16, 1 << 16
LEAST_SAMPLE = 1000
"""Least number of sampled voxels for stating a share."""
SPIKE_SHARE, SPIKE_RATIO = 0.01, 10.0
"""A value that so many voxels have, so many times more than have the values next to it, was not measured."""


def sample_slices(count: int) -> range:
    """Return the places of the slices that are sampled, of `count`."""
    return range(0, count, -(-count // SAMPLED_SLICES))


class ValueSample:
    """Sorted values of voxels; `between` returns the share in a range."""

    def __init__(self, values: NDArray[Any]):
        self.values = values

    @classmethod
    def of(cls, voxels: NDArray[Any], facts: PixelFacts) -> ValueSample | None:
        """Take a sample of the measured voxels; None where it is too small for shares."""
        places = sample_slices(voxels.shape[0])
        step = max(1, int((len(places) * voxels[0].size / SAMPLED_VOXELS) ** 0.5))
        values = voxels[:: places.step, ::step, ::step].ravel()
        if facts.padding_hu is not None:
            values = values[values != facts.padding_hu]  # measured air of this value is left out too
        return cls(np.sort(values)) if len(values) >= LEAST_SAMPLE else None

    def between(self, low: float, high: float) -> float:
        """Return the share with ``low <= value < high``."""
        first, end = np.searchsorted(self.values, (low, high))
        return float(end - first) / len(self.values)

    def median_between(self, low: float, high: float) -> float:
        """Return the median of the values with ``low <= value < high``, of which there must be some."""
        first, end = np.searchsorted(self.values, (low, high))
        return float(self.values[(first + end) // 2])

    def commonest_below(self, limit: float) -> tuple[float, float] | None:
        """Return the most frequent value below `limit`, and its share of all voxels."""
        low = self.values[: np.searchsorted(self.values, limit)]
        if not len(low):
            return None
        found, counts = np.unique(low, return_counts=True)
        return float(found[counts.argmax()]), float(counts.max()) / len(self.values)

    def without_spikes(self, low: float, high: float) -> ValueSample | None:
        """Return the sample without values outside of a range that stand out of the values beside them; None where too
        few are left.
        """
        found, counts = np.unique(self.values, return_counts=True)
        before, after = np.pad(counts, (1, 0))[:-1], np.pad(counts, (0, 1))[1:]
        beside = (before + after) / 2.0
        spikes = (counts >= SPIKE_SHARE * len(self.values)) & (counts >= SPIKE_RATIO * beside)
        spikes &= (found < low) | (found > high)
        values = self.values[np.repeat(~spikes, counts)]
        return ValueSample(values) if len(values) >= LEAST_SAMPLE else None
