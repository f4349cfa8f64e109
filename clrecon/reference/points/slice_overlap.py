"""Twin of `clrecon.operators.points.slice_overlap`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def count_overlaps(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Count the voxels of each slice, and those that it has in common with the next slice and with the one after.

    inside: ndarray, shape (nk, nj, ni), bool

    Returns: ndarray, shape (3, nk), int64. 0 where there is no such slice.
    """
    counts = np.zeros((3, len(inside)), np.int64)
    for apart in range(3):
        both = inside[: len(inside) - apart] & inside[apart:] if apart < len(inside) else inside[:0]
        counts[apart, : len(both)] = both.sum(axis=(1, 2))
    return counts
