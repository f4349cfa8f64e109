"""Twin of `clrecon.operators.resident.tables`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def measure_bricks(voxels: NDArray[Any], brick: int = 8) -> NDArray[Any]:
    """Return the lowest and highest value of each brick.

    voxels: ndarray, shape (nk, nj, ni)
    brick: Voxels along each side.

    Returns: ndarray, shape (bk, bj, bi, 2), of the voxels' type
    """
    shape = [-(-n // brick) for n in voxels.shape]
    ranges = np.empty((*shape, 2), voxels.dtype)
    for at in np.ndindex(*shape):
        part = voxels[tuple(slice(brick * n, brick * (n + 1)) for n in at)]
        ranges[at] = part.min(), part.max()
    return ranges


def compare_bricks(
    ranges: NDArray[Any], level: float, ni: int, border: int, brick: int = 8
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return the state of each word of samples and the extent of each row of bricks, as the device operator does."""
    words = -(-(ni + 2 * border) // 32)
    states = np.zeros((*ranges.shape[:2], words), np.uint8)
    extents = np.zeros((*ranges.shape[:2], 2), np.uint16)
    for k, j in np.ndindex(*ranges.shape[:2]):
        for word in range(words):
            first, end = max(32 * word - border, 0), min(32 * word - border + 32, ni)
            if first < end:
                low, high = ranges[k, j, first // brick : (end - 1) // brick + 1].T
                states[k, j, word] = 0 if high.max() < level else 1 if low.min() >= level else 2
        used = np.flatnonzero(states[k, j])
        if len(used):
            extents[k, j] = used[0], used[-1] + 1
    return states, extents
