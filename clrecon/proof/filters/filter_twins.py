"""The bilateral filter of a volume in plain numpy, float64, and which groups of 16 voxels lie near a level: the
specification of cl/filters/bilateral.cl and cl/filters/near_level.cl.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume

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


def spatial_weights(volume: Volume, offsets: NDArray[np.integer[Any]], sigma_mm: float) -> NDArray[np.float64]:
    """Return the weights of neighbours by their true distance, exp(-|t|^2 / (2 sigma^2)).

    offsets: ndarray, shape (n, 3). Steps along i, j, k.

    Returns: ndarray, shape (nk, n), float64. For the voxels of each slice; beyond the ends the slices go on in the
        steps of the ends.
    """
    weights = np.empty((volume.shape_ijk[2], len(offsets)))
    for k, of_slice in enumerate(weights):
        here = np.array([3.0, 4.0, float(k)])
        steps = volume.ijk_to_lps(here + offsets) - volume.ijk_to_lps(here[None])
        of_slice[:] = np.exp(-np.einsum("ni,ni->n", steps, steps) / (2.0 * sigma_mm**2))
    return weights


def filter_bilateral(
    voxels: NDArray[Any], offsets: NDArray[np.integer[Any]], weights: NDArray[np.float64], sigma_hu: float
) -> NDArray[np.float64]:
    """Filter voxels: the weighted mean of the window, before it is rounded.

    voxels: ndarray, shape (nk, nj, ni). Beyond the border lies the value of the nearest voxel.  NaN and infinite ones
        stay, and count nowhere.
    offsets: ndarray, shape (n, 3). Steps along i, j, k to the voxels of the window, the voxel itself among them.
    weights: ndarray, shape (nk, n), float64. See `spatial_weights`.

    Returns: ndarray, shape (nk, nj, ni), float64
    """
    values = voxels.astype(np.float64)
    centre = np.where(np.isfinite(values), values, 0.0)
    sizes = values.shape[::-1]
    total, moved = np.zeros_like(values), np.zeros_like(values)
    for (i, j, k), of_slices in zip(offsets.tolist(), weights.T, strict=True):
        places = [np.clip(np.arange(n) + step, 0, n - 1) for n, step in zip(sizes, (i, j, k), strict=True)]
        near = values[np.ix_(*places[::-1])]
        counts = np.isfinite(near)
        away = np.where(counts, near, 0.0) - centre
        with np.errstate(over="ignore", under="ignore"):
            weight = of_slices[:, None, None] * np.exp(-0.5 * (away / sigma_hu) ** 2) * counts
        total += weight
        moved += weight * away
    with np.errstate(invalid="ignore"):
        filtered = centre + moved / total
    result: NDArray[np.float64] = np.where(np.isfinite(values), filtered, values)
    return result
