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


def count_euler(solid: NDArray[np.bool_], connectivity: int) -> int:
    """Euler number of a digital solid: vertices less edges plus faces less cubes of a complex.

    Connected by faces (1), samples are the vertices, and a cell belongs to the solid when all its corners do.
    Connected by corners (3), samples are closed cubes, and a cell belongs to the solid when one of its cubes does.
    """
    join = np.logical_and if connectivity == 1 else np.logical_or
    sign, cells = (1, [solid]) if connectivity == 1 else (-1, [np.pad(solid, 1)])
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        cells += [join(array[tuple(low)], array[tuple(high)]) for array in cells]
    dimensions = [number.bit_count() for number in range(8)]  # pairs were made along the axes that are the bits
    counts = [np.count_nonzero(array) * (-1) ** dimension for array, dimension in zip(cells, dimensions, strict=True)]
    return sign * sum(counts)


def count_digital(inside: NDArray[np.bool_]) -> Numbers | None:
    """The numbers of a digital solid; None where samples connected by faces and by corners give different ones."""
    from scipy.ndimage import generate_binary_structure, label

    solids = inside, ~inside
    corners = generate_binary_structure(3, 3)
    parts = [(label(solids[0])[1], label(solids[1], corners)[1]), (label(solids[0], corners)[1], label(solids[1])[1])]
    if parts[0] != parts[1]:
        return None
    eulers = [tuple(count_euler(solid, c) for solid, c in zip(solids, pair, strict=True)) for pair in ((1, 3), (3, 1))]
    return (*parts[0], *eulers[0]) if eulers[0] == eulers[1] else None


def find_topology(heights: NDArray[np.float64], resolutions: tuple[int, ...]) -> Numbers | None:
    """Topology of the trilinear field between samples; None where no two of the resolutions in a row say it clearly."""
    before = None
    for steps in resolutions:
        found = count_digital(sample_finely(heights, steps) >= 0)
        if found is not None and found == before:
            return found
        before = found
    return None
