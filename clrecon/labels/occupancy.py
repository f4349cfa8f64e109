"""The occupancy of a label, and the level at which its surface has the volume of its voxels.

The occupancy of a sample is the sum over the 5 x 5 x 5 samples around it that carry the label, weighted by
[1 4 6 4 1] / 16 along each axis (two rounds of [1 2 1] / 4); beyond the map its outermost samples go on.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["FULL", "KEEP", "LEVELS", "REACH", "START", "STEEPNESS", "VOLUME_SHARE", "next_level"]

REACH = 2
"""Samples each way that count; the kernels have the same number, in cl/surface/label_masks.h."""

FULL = 4 * 16**3
"""The occupancy of a sample deep in a label, as whole numbers count it: levels are as fine as these."""

KEEP = 1 / 16
"""Of an edge: no vertex comes nearer to a sample.  Where the mask is rougher than its occupancy the vertices of a voxel
would otherwise meet in its centre, with triangles of no width."""

STEEPNESS = 0.39
"""Change of the occupancy per voxel across a flat border, as a share of `FULL`: from 3/8 along the axes to 0.40."""

START = round(0.475 * FULL)
"""Bodies of ten to fifty voxels across keep their volume at 0.46 to 0.485."""

LEVELS = (FULL // 64, FULL - FULL // 64)
"""Lowest and highest level that is tried: that of a single voxel, whose occupancy is 0.053, lies between."""

VOLUME_SHARE = 3e-4
"""Of the label's volume: a level that keeps it as well as this is kept."""

MOST_TRIALS = 14
"""Large bodies need 2 or 3; those of some voxels, whose vertices come to the ends of their edges, more."""


def next_level(tried: Sequence[tuple[int, float]], wanted: float, rise: float) -> int:
    """The level to try next: a step of Newton's method, then of the secant method, between what is known by shares.

    Parameters
    ----------
    tried : sequence of (int, float)
        Levels, and the volumes that they gave, in the order of the trials.
    wanted : float
        The volume that is looked for.
    rise : float
        About by how much the volume grows with the level: below 0.

    Returns
    -------
    int
        One of those that were tried, the best, where no other is worth a trial.
    """
    if not tried:
        return START
    best = min(tried, key=lambda trial: abs(trial[1] - wanted))
    if abs(best[1] - wanted) <= VOLUME_SHARE * wanted or len(tried) == MOST_TRIALS:
        return best[0]
    volumes = dict(tried)
    low = max((level for level, volume in tried if volume >= wanted), default=LEVELS[0] - 1)
    high = min((level for level, volume in tried if volume < wanted), default=LEVELS[1] + 1)
    if low in volumes and high in volumes:
        share = (volumes[low] - wanted) / (volumes[low] - volumes[high])
        level = low + round(min(max(share, 0.1), 0.9) * (high - low))  # never stuck at one end of a bend
    else:
        if len(tried) > 1:
            (one, volume), (other, other_volume) = sorted(tried, key=lambda trial: abs(trial[1] - wanted))[:2]
            rise = min((other_volume - volume) / (other - one), 0.1 * rise)
        level = best[0] + round((wanted - best[1]) / rise)
    if not low < level < high:
        level = (low + high) // 2
    return level if low < level < high else best[0]
