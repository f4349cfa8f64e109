"""Where a transfer function is so steep that volume rendering takes its segments in parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["DENSE", "PARTS", "STEEP", "STEEP_HU", "Steepness"]

# The kernels have these three numbers too, in cl/rays/steep_segments.h; a test compares them.
PARTS = 4
"""Of a segment where the transfer function is steep."""

STEEP = 0.1
"""Opacity that comes or goes within a ray step where it is steep."""

DENSE = 0.7
"""Opacity of a ray step of which only the front is seen."""

STEEP_HU = 50.0
"""Where it takes more HU, segments in parts are no better than their samples alone, and cost time."""


@dataclass(frozen=True)
class Steepness:
    """How steep a table of opacities over one ray step is.

    Attributes
    ----------
    changes : ndarray, shape (nodes,), float64
        How much the opacity changes up to each node, up or down.
    narrow : float
        Nodes within which it changes by no more than `STEEP`.
    has_dense : bool
        Whether it is above `DENSE` anywhere.
    is_steep : bool
        Whether it changes by more than `STEEP` within `STEEP_HU`.
    """

    changes: NDArray[np.float64]
    narrow: float
    has_dense: bool
    is_steep: bool

    @classmethod
    def of(cls, opacities: NDArray[np.float32], nodes_per_hu: float) -> Steepness:
        """That of opacities (nodes,) over one ray step."""
        changes = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(opacities.astype(np.float64))))])
        ends = np.searchsorted(changes, changes + STEEP, side="right")
        reached = ends < len(changes)
        apart = (ends - np.arange(len(changes)))[reached]
        # Values that far apart may be rounded to nodes that are one more.
        narrow = float(max(apart.min() - 1, 0)) if len(apart) else float(len(changes))
        return cls(changes, narrow, bool((opacities > DENSE).any()), narrow <= STEEP_HU * nodes_per_hu)
