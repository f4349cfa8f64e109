"""Features of a cloud: paper B's ratio of distances D_i with its threshold D0, and the surface variation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

D0_OF_MEDIAN = 1.2
"""D0 over the median of all D_i: the paper gives no value."""

VARIATION_OF_FEATURES = 0.05
"""Surface variation from which on a point is a feature: 0 on a plane, 1/3 where neighbours spread evenly."""


def distance_ratios(
    means: NDArray[np.floating], nearest: NDArray[np.floating], cells: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Return D_i of paper B, section 2.2, for each point: mean distance to its neighbours over the cell's spacing.

    The paper's "mean point distance" of the cell is read as the mean distance of its points to their nearest ones.

    means: ndarray, shape (n,), mm. Mean distance of each point to its neighbours, itself not among them.
    nearest: ndarray, shape (n,), mm. Distance of each point to the nearest other one.
    cells: ndarray, shape (n,), whole numbers from 0. Cell of each point.

    Returns: ndarray, shape (n,), float64. Infinite where all points of a cell coincide with others and the neighbours
        do not, 0 where these do too.
    """
    counts = np.bincount(cells)
    spacing = np.bincount(cells, nearest) / np.maximum(counts, 1)
    own = spacing[cells]
    apart = np.asarray(means, dtype=np.float64)
    return np.divide(apart, own, out=np.where(apart > 0.0, np.inf, 0.0), where=own > 0.0)


def ratio_threshold(ratios: NDArray[np.floating]) -> float:
    """Return D0: `D0_OF_MEDIAN` times the median of all D_i."""
    return D0_OF_MEDIAN * float(np.median(ratios))


def find_features(ratios: NDArray[np.floating], threshold: float) -> NDArray[np.bool_]:
    """Return True for features: D_i > D0.  What is equal is none, which the paper leaves open."""
    features: NDArray[np.bool_] = np.asarray(ratios) > threshold
    return features
