"""The occupancy of a label, and the level at which its surface has the volume of its voxels.

The occupancy of a sample is the sum over the 5 x 5 x 5 samples around it that carry the label, weighted by [1 4 6 4 1]
/ 16 along each axis (two rounds of [1 2 1] / 4); beyond the map its outermost samples are repeated.
"""

from __future__ import annotations

from collections.abc import Sequence

REACH = 2
"""Samples each way that count; the kernels have the same number, in cl/surface/label_masks.h."""

FULL = 4 * 16**3
"""The occupancy deep in a label, where it is counted in whole numbers; levels are given in the same unit."""

KEEP = 1 / 16
"""Least distance of a vertex from a sample, as a share of the edge.  Where the mask is rougher than its occupancy, the
vertices around a voxel would otherwise meet in its centre and form triangles without width."""

STEEPNESS = 0.39
"""Change of the occupancy per voxel across a flat border, as a share of `FULL`: 3/8 along the axes, up to 0.40 else."""

START = round(0.475 * FULL)
"""First level that is tried.  Bodies of ten to fifty voxels across keep their volume at 0.46 to 0.485 of `FULL`."""

LEVELS = (FULL // 64, FULL - FULL // 64)
"""Lowest and highest level that is tried.  They include that of a single voxel, whose occupancy is 0.053."""

VOLUME_SHARE = 3e-4
"""Accepted error, as a share of the label's volume: a level with this error or less is kept."""

MOST_TRIALS = 14
"""Most levels that are tried.  Large bodies need 2 or 3; tiny ones, whose vertices reach the ends of their edges, need
more."""


def next_level(tried: Sequence[tuple[int, float]], wanted: float, rise: float) -> int:
    """Return the level to try next: by Newton's method, then the secant method, then interpolation between two levels.

    tried: sequence of (int, float). Levels and their volumes, in the order of the trials.
    wanted: The wanted volume.
    rise: Approximate change of the volume when the level rises by one: below 0.

    Returns: The next level; or the best of the tried levels, where no further trial is useful.
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
        level = low + round(min(max(share, 0.1), 0.9) * (high - low))  # keeps away from both ends
    else:
        if len(tried) > 1:
            (one, volume), (other, other_volume) = sorted(tried, key=lambda trial: abs(trial[1] - wanted))[:2]
            rise = min((other_volume - volume) / (other - one), 0.1 * rise)
        level = best[0] + round((wanted - best[1]) / rise)
    if not low < level < high:
        level = (low + high) // 2
    return level if low < level < high else best[0]
