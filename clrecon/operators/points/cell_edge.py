"""The edge of grid cells with which the nearest points are found soonest."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clrecon.operators.points.grid import MOST_CELLS_ALONG, find_box

CANDIDATES = 5.6
"""Points in 27 cells for each neighbour that is searched: fewer send points to farther cells, more are compared in
vain."""

FEWEST_CANDIDATES = 40
"""Points in 27 cells for few neighbours."""

ALONE = 0.5
"""Share of the points of a thinned cloud that are alone in their block, at the edge that is searched."""

SAMPLED = 4096
"""Points that are looked at: the share is then right to 0.01, the edge to 2 %."""

STEPS = 8
"""Halvings of the interval of the edge's logarithm, which is 12 wide at most."""

CELLS_A_POINT = 256
MANY_CELLS = 2**24
"""Most cells of a grid: so many for each point, or this number if that is more."""


_MIXERS = np.array([0x1E3779B97F4A7C15, 0x2545F4914F6CDD1D, 0x369DEA0F31A53F85, 0x1B873593CC9E2D51], np.int64)
"""Odd numbers that make one key of cell and group; that two cells share one is as unlikely as 2^-40."""


def choose_cell_edge(points: NDArray[np.floating], k: int) -> float:
    """Choose the edge so that the 27 cells around a typical point hold some `CANDIDATES` times `k` points.

    A cloud that is thinned to a share f at random leaves a point with c others in its block alone there with
    probability (1 - f)^c.  So a small sample tells the density of the whole cloud, in points of any dimension, and a
    dense spot does not outweigh the rest.

    points: ndarray, shape (n, 3). At least one, finite.

    Returns: mm.  Results do not depend on it.
    """
    n = len(points)
    low, high = find_box(points).astype(np.float64)
    extent = float((high - low).max())
    if extent == 0.0:
        return 1.0
    wanted = max(FEWEST_CANDIDATES, CANDIDATES * k)
    share = min(-math.log(ALONE) / wanted, 1.0)
    groups = max(1, min(round(1.0 / share), round(SAMPLED / max(share * n, 1.0))))
    rng = np.random.default_rng(0)
    chosen = np.unique(rng.integers(0, n, min(n, round(groups * share * n) + 1)))
    places = np.asarray(points[chosen], dtype=np.float64) - low
    group = rng.integers(0, groups, len(chosen))
    shortest = max(extent / (0.99 * MOST_CELLS_ALONG), _edge_of_box(high - low, max(MANY_CELLS, CELLS_A_POINT * n)))
    small, large = math.log(shortest), math.log(max(extent, shortest))
    for _ in range(STEPS):
        middle = 0.5 * (small + large)
        if _share_alone(places, group, 3.0 * math.exp(middle)) > ALONE:
            small = middle
        else:
            large = middle
    return math.exp(0.5 * (small + large))


def _edge_of_box(size: NDArray[np.float64], cells: int) -> float:
    """Return the edge with which a box has so many cells."""
    low, high = 0.0, float(size.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.prod(np.floor(size / middle) + 1.0) <= cells else (middle, high)
    return high


def _share_alone(places: NDArray[np.float64], group: NDArray[np.int64], block: float) -> float:
    """Return the share of points without another of their group in the same block."""
    cells = np.floor(places / block).astype(np.int64)
    keys = np.sort(np.column_stack([cells, group]) @ _MIXERS)
    new = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1], [True]]))
    return float(np.count_nonzero(np.diff(new) == 1)) / len(keys)
