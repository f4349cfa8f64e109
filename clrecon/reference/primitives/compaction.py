"""Twins of `clrecon.operators.primitives.compaction`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["compact", "exclusive_scan"]


def exclusive_scan(counts: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], int]:
    """Return the sum of all counts before each element, (n,) uint32, and the sum of all."""
    sums = np.cumsum(counts, dtype=np.uint64)
    total = int(sums[-1]) if sums.size else 0
    return (sums - counts).astype(np.uint32), total


def compact(mask: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the positions of the set bits of a bit mask, ascending; bit b of word w is position 32 w + b."""
    bits = mask[:, None] >> np.arange(32, dtype=np.uint32) & 1
    return np.flatnonzero(bits).astype(np.uint32)
