"""Steepness of a transfer function: where it is steep, volume rendering divides its segments into parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The kernels have these three numbers too, in cl/rays/steep_segments.h; a test compares them.
PARTS = 4
"""Number of parts of a segment where the transfer function is steep."""

STEEP = 0.1
"""Change of opacity within a ray step from which on it is steep."""

DENSE = 0.7
"""Opacity of a ray step from which on only its front is visible."""

STEEP_HU = 50.0
"""Widest range of HU for the change `STEEP`. Over wider ranges, parts are no better than the samples alone, and cost
time."""


@dataclass(frozen=True)
class Steepness:
    """The steepness of a table of opacities over one ray step.

    changes: ndarray, shape (nodes,), float64. Sum of the changes of opacity, up and down, from the first node to each
        node.
    narrow: Number of nodes within which the opacity changes by at most `STEEP`.
    has_dense: The opacity is above `DENSE` somewhere.
    is_steep: The opacity changes by more than `STEEP` within `STEEP_HU` somewhere.
    """

    changes: NDArray[np.float64]
    narrow: float
    has_dense: bool
    is_steep: bool

    @classmethod
    def of(cls, opacities: NDArray[np.float32], nodes_per_hu: float) -> Steepness:
        """Compute the steepness of opacities (nodes,) over one ray step."""
        changes = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(opacities.astype(np.float64))))])
        ends = np.searchsorted(changes, changes + STEEP, side="right")
        reached = ends < len(changes)
        apart = (ends - np.arange(len(changes)))[reached]
        # Values this far apart may be rounded to nodes that are one more apart.
        narrow = float(max(apart.min() - 1, 0)) if len(apart) else float(len(changes))
        return cls(changes, narrow, bool((opacities > DENSE).any()), narrow <= STEEP_HU * nodes_per_hu)
