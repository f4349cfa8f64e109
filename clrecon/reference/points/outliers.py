"""Twin of `clrecon.operators.points.denoising`: points whose mean distance to their neighbours is unusual."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def mean_distances(distances: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean distance of each point to its others: distances (n, k) without the first, its own."""
    return distances[:, 1:].astype(np.float64).mean(axis=1)


def find_outliers(distances: NDArray[np.floating], deviations: float) -> NDArray[np.bool_]:
    """Return True where a mean distance exceeds the mean of all by more than `deviations` standard deviations."""
    means = mean_distances(distances)
    outliers: NDArray[np.bool_] = means > means.mean() + deviations * means.std(ddof=1)
    return outliers
