"""Distances in a cloud: its mean spacing, and paper B's grid of cells and ratio of distances D_i with its threshold D0.

Of paper B's (Liu et al. 2019) equations of a grid, equation 1 prints the margin as "natural constant 2.71828", equation
2 has none: here both begin at the lowest coordinates less the same small margin.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_POINTS_A_CELL = 4.0
"""Points that a cell should hold: with fewer most cells are empty by chance, with more they hide the shape."""

MOST_CELLS = 1 << 28
"""Most cells of a search, each of them one byte."""

ROUNDS = 8


def mean_spacing(points: NDArray[np.floating]) -> float:
    """Estimate the distance in mm between neighbouring points (n, 3) of a surface; 0 for clouds without extent.

    A cloud of n points that occupies c cells of edge e covers an area of about ``c * e ** 2``, so that its spacing is
    ``e / sqrt(n / c)``.  The edge is chosen so that a cell holds about four points.  Of points that fill a body it is
    about four fifths of their spacing.
    """
    if len(points) < 2:
        return 0.0
    low = points.min(axis=0)
    extent = np.asarray(points.max(axis=0) - low, dtype=np.float64)
    if not extent.max() > 0.0:
        return 0.0
    # As if the points filled the largest face of their box; a surface with folds has smaller cells.
    face = float(np.prod(np.sort(extent)[1:])) or float(extent.max()) ** 2 / len(points)
    edge, dimension = math.sqrt(_POINTS_A_CELL * face / len(points)), 2.0
    fill = len(points) / _count_cells(points, low, extent, edge)
    for _ in range(ROUNDS):
        if 0.5 < fill / _POINTS_A_CELL < 2.0:
            break
        next_edge = edge * (_POINTS_A_CELL / fill) ** (1.0 / dimension)
        if float(np.prod(np.floor(extent / next_edge) + 1.0)) > MOST_CELLS:
            break
        before, fill = fill, len(points) / _count_cells(points, low, extent, next_edge)
        dimension = min(max(math.log(fill / before) / math.log(next_edge / edge), 1.0), 3.0)
        edge = next_edge
    return min(edge / math.sqrt(fill), float(extent.max()) / len(points) ** (1.0 / 3.0))


def _count_cells(
    points: NDArray[np.floating], low: NDArray[np.floating], extent: NDArray[np.float64], edge: float
) -> int:
    counts = np.floor(extent / edge).astype(np.int64) + 1
    if float(np.prod(counts.astype(np.float64))) > MOST_CELLS:  # a few points far apart
        return len(points)
    scale = points.dtype.type(1.0 / edge)
    cell = np.zeros(len(points), np.int32)
    for axis in (2, 1, 0):
        along = ((points[:, axis] - low[axis]) * scale).astype(np.int32)
        np.minimum(along, np.int32(counts[axis] - 1), out=along)
        cell *= np.int32(counts[axis])
        cell += along
    occupied = np.zeros(int(np.prod(counts)), np.bool_)
    occupied[cell] = True
    return int(np.count_nonzero(occupied))


MARGIN = 1e-3
"""Margin around the points, in edges of a cell."""


def count_cells(points: NDArray[np.floating], edge: float) -> tuple[int, int, int]:
    """Return the cells along each axis: ``int(((max + e) - (min - e)) / edge) + 1``, equation 1 of paper B."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    margin = MARGIN * edge
    nx, ny, nz = (((high + margin) - (low - margin)) / edge).astype(np.int64) + 1
    return int(nx), int(ny), int(nz)


def find_cell_numbers(points: NDArray[np.floating], edge: float) -> NDArray[np.int64]:
    """Return the cell of each point: ``a + nx (b + ny c)`` with ``a = int((x - (min - e)) / edge)``, by equation 2."""
    nx, ny, _ = count_cells(points, edge)
    a, b, c = ((points - (points.min(axis=0).astype(np.float64) - MARGIN * edge)) / edge).astype(np.int64).T
    return np.asarray(a + nx * (b + ny * c))


D0_OF_MEDIAN = 1.2
"""D0 over the median of all D_i: the paper gives no value."""

VARIATION_OF_FEATURES = 0.05
"""Surface variation from which on a point is a feature: 0 on a plane, 1/3 where neighbours spread evenly."""


def distance_ratios(
    means: NDArray[np.floating], nearest: NDArray[np.floating], cells: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Return D_i of paper B, section 2.2, for each point: mean distance to its neighbours over the cell's spacing.

    The paper's "mean point distance" of the cell is read as the mean distance of its points to their nearest ones.
    Infinite where all points of a cell coincide with others and the neighbours do not, 0 where these do too.

    means, nearest: Mean distance of each point (n,) to its neighbours, itself not among them, and to the nearest, mm.
    """
    spacing = np.bincount(cells, nearest) / np.maximum(np.bincount(cells), 1)
    expected = spacing[cells]
    apart = np.asarray(means, dtype=np.float64)
    return np.divide(apart, expected, out=np.where(apart > 0.0, np.inf, 0.0), where=expected > 0.0)


def ratio_threshold(ratios: NDArray[np.floating]) -> float:
    """Return D0: `D0_OF_MEDIAN` times the median of all D_i."""
    return D0_OF_MEDIAN * float(np.median(ratios))


def find_features(ratios: NDArray[np.floating], threshold: float) -> NDArray[np.bool_]:
    """Return True for features: D_i > D0.  What is equal is none, which the paper leaves open."""
    features: NDArray[np.bool_] = np.asarray(ratios) > threshold
    return features
