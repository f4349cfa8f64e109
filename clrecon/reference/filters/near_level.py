"""Which groups of 16 voxels lie near a level, in plain numpy: the specification of cl/filters/near_level.cl."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

GROUP = 16
"""Voxels of a group, along i."""


def mark_mixed_groups(voxels: NDArray[Any], level: float, reach: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Mark the groups of which some voxel has both sides of a level in the box around it.

    voxels: ndarray, shape (nk, nj, ni)
    level: Inside are values from here on; NaN is not.
    reach: Half the size of the box along i, j, k, without the voxel in its middle.

    Returns: ndarray, shape (nk, nj, groups), bool. Group g is the voxels 16 g to 16 g + 15 of a row; the last one may
        be shorter.
    """
    from scipy import ndimage

    inside = voxels >= level
    size = tuple(2 * n + 1 for n in reversed(reach))
    some = ndimage.maximum_filter(inside, size, mode="nearest")
    every = ndimage.minimum_filter(inside, size, mode="nearest")
    mixed = some & ~every
    ni = voxels.shape[2]
    padded = np.zeros((*voxels.shape[:2], -(-ni // GROUP) * GROUP), np.bool_)
    padded[:, :, :ni] = mixed
    return np.asarray(padded.reshape(*voxels.shape[:2], -1, GROUP).any(axis=3))
