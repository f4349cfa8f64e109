"""The topology of trilinear fields by brute force: sampled finely and counted as digital solids.

A sampling is believed where two resolutions and both ways to connect samples (by faces, by corners) give the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = tuple[int, int, int, int]
"""(inside components, outside components, Euler number of the inside, of the outside)."""


def sample_finely(field: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    """Trilinear interpolation of samples at `steps` points a cell along each axis."""
    for axis in range(3):
        rows = np.moveaxis(field, axis, 0)
        at = np.arange(steps * (len(rows) - 1) + 1) / steps
        low = np.minimum(at.astype(int), len(rows) - 2)
        part = (at - low)[:, None, None]
        field = np.moveaxis((1 - part) * rows[low] + part * rows[low + 1], 0, axis)
    return field


def count_digital(inside: NDArray[np.bool_]) -> set[Numbers]:
    """The numbers of a digital solid with its samples connected by faces, and by corners (the outside otherwise)."""
    from scipy.ndimage import generate_binary_structure, label
    from skimage.measure import euler_number

    found = set()
    for own, other in ((1, 3), (3, 1)):
        parts = [
            label(solid, generate_binary_structure(3, connectivity))[1]
            for solid, connectivity in ((inside, own), (~inside, other))
        ]
        eulers = [euler_number(solid, connectivity=c) for solid, c in ((inside, own), (~inside, other))]
        found.add((parts[0], parts[1], int(eulers[0]), int(eulers[1])))
    return found


def find_topology(heights: NDArray[np.float64], resolutions: tuple[int, ...]) -> Numbers | None:
    """Topology of the trilinear field between samples; None where no two of the resolutions in a row say it clearly."""
    before: set[Numbers] = set()
    for steps in resolutions:
        found = count_digital(sample_finely(heights, steps) >= 0)
        if len(found) == 1 and found == before:
            return found.pop()
        before = found
    return None
