"""The mean spacing of a cloud, from the number of small cubes that it occupies."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

POINTS_A_CELL = 4.0
"""Points that a cell should hold: with fewer most cells are empty by chance, with more they hide the shape."""

MOST_CELLS = 1 << 28
"""Most cells of a search, each of them one byte."""

ROUNDS = 8


def mean_spacing(points: NDArray[np.floating]) -> float:
    """Estimate the distance between neighbouring points of a surface.

    A cloud of n points that occupies c cells of edge e covers an area of about ``c * e ** 2``, so that its spacing is
    ``e / sqrt(n / c)``.  The edge is chosen so that a cell holds about four points.  Of points that fill a body it is
    about four fifths of their spacing.

    points: ndarray, shape (n, 3), floating. Millimetres.

    Returns: Mm; 0 for clouds without extent, and for fewer than two points.
    """
    if len(points) < 2:
        return 0.0
    low = points.min(axis=0)
    extent = np.asarray(points.max(axis=0) - low, dtype=np.float64)
    if not extent.max() > 0.0:
        return 0.0
    # As if the points filled the largest face of their box; a surface with folds has smaller cells.
    face = float(np.prod(np.sort(extent)[1:])) or float(extent.max()) ** 2 / len(points)
    edge, dimension = math.sqrt(POINTS_A_CELL * face / len(points)), 2.0
    held = len(points) / _count_cells(points, low, extent, edge)
    for _ in range(ROUNDS):
        if 0.5 < held / POINTS_A_CELL < 2.0:
            break
        other = edge * (POINTS_A_CELL / held) ** (1.0 / dimension)
        if float(np.prod(np.floor(extent / other) + 1.0)) > MOST_CELLS:
            break
        before, held = held, len(points) / _count_cells(points, low, extent, other)
        dimension = min(max(math.log(held / before) / math.log(other / edge), 1.0), 3.0)
        edge = other
    return min(edge / math.sqrt(held), float(extent.max()) / len(points) ** (1.0 / 3.0))


def _count_cells(
    points: NDArray[np.floating], low: NDArray[np.floating], extent: NDArray[np.float64], edge: float
) -> int:
    """Count the cubes of a grid that hold points."""
    counts = np.floor(extent / edge).astype(np.int64) + 1
    if float(np.prod(counts.astype(np.float64))) > MOST_CELLS:  # a few points far apart
        return len(points)
    scale = points.dtype.type(1.0 / edge)
    place = np.zeros(len(points), np.int32)
    for axis in (2, 1, 0):
        along = ((points[:, axis] - low[axis]) * scale).astype(np.int32)
        np.minimum(along, np.int32(counts[axis] - 1), out=along)
        place *= np.int32(counts[axis])
        place += along
    occupied = np.zeros(int(np.prod(counts)), np.bool_)
    occupied[place] = True
    return int(np.count_nonzero(occupied))
