"""Local thickness of a mask in mm, by openings with balls, where it is more than two voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clrecon.operators.masks.mask import Mask
from clrecon.system.records import Record

MOST_RADIUS_MM = 8.0
"""Bone in which larger balls fit is no shell any more."""


@dataclass(frozen=True, eq=False)
class ShellThickness(Record):
    """How thick a shell of bone is.

    limit_mm: Two voxels, by their largest step: what is not thicker is not resolved.
    resolved_share: Share of the shell's voxels at places that are thicker.
    median_mm, p95_mm: Of the voxels at these places, to a voxel; None where there are none.
    """

    limit_mm: float
    resolved_share: float
    median_mm: float | None
    p95_mm: float | None


def measure_thickness(mask: Mask) -> ShellThickness:
    """Measure the local thickness of a mask: at each voxel that of the largest ball within the mask that holds it.

    The radii begin with the largest step of the voxels, so that three voxels fit across in each direction, and grow by
    half the smallest step.  A ball of lattice points fits into a plate of an odd number of voxels as long as its
    diameter is not above the plate's thickness; of an even number it tells one voxel less.

    References
    ----------
    Hildebrand and Rüegsegger 1997, A new method for the model-independent assessment of thickness in three-dimensional
    images.
    """
    spacing = mask.volume.spacing
    first, step = max(spacing), min(spacing) / 2.0
    radii = np.arange(first, max(MOST_RADIUS_MM, first) + step, step)
    counts = []
    for radius in radii:
        counts.append(mask.open(float(radius)).count)
        if not counts[-1]:
            break
    limit, total = 2.0 * first, mask.count
    if not total or not counts[0]:
        return ShellThickness(limit, 0.0, None, None)
    left = np.maximum.accumulate(np.array([*counts, 0])[::-1])[::-1]  # openings by lattice balls may grow again
    own = -np.diff(left)  # voxels whose largest ball is that of each radius
    thickness = 2.0 * radii[: len(own)]
    share = np.cumsum(own) / own.sum()
    median, p95 = (float(thickness[np.searchsorted(share, part)]) for part in (0.5, 0.95))
    return ShellThickness(limit, counts[0] / total, median, p95)
