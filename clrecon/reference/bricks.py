"""Twin of `clrecon.operators.bricks`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["compare_bricks", "measure_bricks"]


def measure_bricks(voxels: NDArray[Any], brick: int = 8) -> NDArray[Any]:
    """Lowest and highest value of each brick.

    Parameters
    ----------
    voxels : ndarray, shape (nk, nj, ni)
    brick : int
        Voxels along each side.

    Returns
    -------
    ndarray, shape (bk, bj, bi, 2), of the voxels' type
    """
    shape = [-(-n // brick) for n in voxels.shape]
    ranges = np.empty((*shape, 2), voxels.dtype)
    for at in np.ndindex(*shape):
        part = voxels[tuple(slice(brick * n, brick * (n + 1)) for n in at)]
        ranges[at] = part.min(), part.max()
    return ranges


def compare_bricks(ranges: NDArray[Any], level: float) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """State of each brick and extent of each row of bricks, as the device operator gives them."""
    outside, inside = ranges[..., 1] < level, ranges[..., 0] >= level
    states = np.where(outside, 0, np.where(inside, 1, 2)).astype(np.uint8)
    extents = np.zeros((*states.shape[:2], 2), np.uint16)
    for row in np.ndindex(*states.shape[:2]):
        used = np.flatnonzero(states[row])
        if len(used):
            extents[row] = used[0], used[-1] + 1
    return states, extents
