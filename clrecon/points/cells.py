"""Paper B's equations of a grid over scattered points: how many cells it has, and in which a point lies.

Equation 1 prints the margin as "natural constant 2.71828", equation 2 has none: here both begin at the lowest
coordinates less the same small margin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MARGIN = 1e-3
"""Margin around the points, in edges of a cell."""


def count_cells(points: NDArray[np.floating], edge: float) -> tuple[int, int, int]:
    """Return the number of cells along each axis: ``int(((max + e) - (min - e)) / edge) + 1``.

    points: ndarray, shape (n, 3). mm; at least one.
    edge: Edge of the cells in mm.

    References
    ----------
    Liu et al. 2019, equation 1.
    """
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    margin = MARGIN * edge
    nx, ny, nz = (((high + margin) - (low - margin)) / edge).astype(np.int64) + 1
    return int(nx), int(ny), int(nz)


def find_cell_numbers(points: NDArray[np.floating], edge: float) -> NDArray[np.int64]:
    """Return the number of the cell of each point: ``a + nx (b + ny c)`` with ``a = int((x - (min - e)) / edge)``.

    points: ndarray, shape (n, 3). mm; at least one.
    edge: Edge of the cells in mm.

    Returns: ndarray, shape (n,), int64

    References
    ----------
    Liu et al. 2019, equation 2.
    """
    nx, ny, _ = count_cells(points, edge)
    a, b, c = ((points - (points.min(axis=0).astype(np.float64) - MARGIN * edge)) / edge).astype(np.int64).T
    return np.asarray(a + nx * (b + ny * c))
