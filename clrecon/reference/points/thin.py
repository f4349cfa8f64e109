"""Twin of `clrecon.operators.points.thinning`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.reference.points.grid import make_grid


def choose_points(points: NDArray[np.float32], spacing: float) -> NDArray[np.uint32]:
    """Return the number of the point nearest to the mean of each cell, in the order of the cells.

    points: ndarray, shape (n, 3), float32. mm.
    spacing: Edge of the cells in mm.
    """
    grid = make_grid(points, spacing)
    chosen = []
    for begin, end in zip(grid.starts[:-1], grid.starts[1:], strict=True):
        places = grid.points[begin:end] - grid.points[begin]
        total = np.cumsum(places, axis=0, dtype=np.float32)[-1]
        dx, dy, dz = (np.float32(len(places)) * places - total).T
        chosen.append(grid.order[begin + np.argmin(dx * dx + dy * dy + dz * dz)])
    return np.array(chosen, dtype=np.uint32)
