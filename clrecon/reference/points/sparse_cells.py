"""Twin of `clrecon.operators.points.thinning`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.reference.points.grid import find_cells, make_grid


def grow_cells(
    points: NDArray[np.float32], edge: float, fewest: int, threshold: int, largest: bool
) -> NDArray[np.uint8]:
    """Say for each point what becomes of it.

    points: ndarray, shape (n, 3), float32. mm.
    edge: mm.
    fewest, threshold: Fewest points of a cell that stays, and of one where growth begins.
    largest: Keep the component with the most cells alone; of several the one with the most points, then the first.

    Returns: ndarray, shape (n,), uint8. 0: kept, 1: in a cell with few points, 2: not reached by growth, 3: in a
        smaller component.
    """
    from scipy import ndimage

    grid = make_grid(points, edge)
    nx, ny, nz = grid.shape
    counts = np.zeros((nz, ny, nx), dtype=np.int64)
    x, y, z = find_cells(points, grid.corner, np.float32(edge)).T
    np.add.at(counts, (z, y, x), 1)
    parts, number = ndimage.label(counts >= fewest, np.ones((3, 3, 3), bool))
    kinds = np.full(number + 1, 2, dtype=np.uint8)
    kinds[np.unique(parts[counts >= max(threshold, fewest)])] = 0
    kinds[0] = 1
    if largest and (kinds == 0).any():
        cells = np.bincount(parts.reshape(-1), minlength=number + 1)
        held = np.bincount(parts.reshape(-1), weights=counts.reshape(-1), minlength=number + 1)
        best = max(np.flatnonzero(kinds == 0), key=lambda part: (cells[part], held[part], -part))
        kinds[(kinds == 0) & (np.arange(number + 1) != best)] = 3
    return kinds[parts[z, y, x]]
