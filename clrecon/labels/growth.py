"""Which samples lie within some millimetres of a sample, nearest first: how labels grow, on host and device alike."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume

__all__ = ["GROW_STEPS", "checked_growth", "near_offsets"]

GROW_STEPS = 1.5
"""Default growth in the largest in-plane spacing: all eight neighbours in the slice."""

MOST_OFFSETS = 5000
SAME_DISTANCE = 1e-6
"""Relative; offsets whose lengths differ by rounding alone are equally near."""


def checked_growth(volume: Volume, grow_mm: float | None) -> float:
    """The growth in mm, the default where None is given.

    Raises
    ------
    UsageError
        It is no number, negative, or so large that whole bones would be swallowed.
    """
    if grow_mm is None:
        return GROW_STEPS * max(volume.spacing[:2])
    try:
        number = float(grow_mm)
    except (TypeError, ValueError) as error:
        raise UsageError(f"labels grow by a number of mm, not {grow_mm!r}") from error
    if not (math.isfinite(number) and number >= 0.0):
        raise UsageError(f"labels grow by 0 mm or more, not {number:g}")
    di, dj, dk = volume.spacing
    if 4 / 3 * math.pi * number**3 / (di * dj * dk) > MOST_OFFSETS:
        raise UsageError(
            f"labels cannot grow by {number:g} mm on voxels of {di:.3g} x {dj:.3g} x {dk:.3g} mm: growth mends the"
            " border of a mask, up to some ten voxels"
        )
    return number


def near_offsets(affine: NDArray[np.float64], grow_mm: float) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Offsets between samples that are at most `grow_mm` apart, shear included, nearest first.

    Returns
    -------
    offsets : ndarray, shape (n, 3), int32
        (di, dj, dk), without (0, 0, 0).
    shells : ndarray, shape (n,), int32
        From 0; equal for offsets of equal length.
    """
    steps = affine[:3, :3]
    reach = np.floor(grow_mm * np.linalg.norm(np.linalg.inv(steps), axis=1) + 1e-9).astype(int)
    grids: Any = np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij")
    offsets = np.stack([grid.ravel() for grid in grids], axis=1)
    lengths = np.linalg.norm(offsets @ steps.T, axis=1)
    near = (lengths <= grow_mm * (1.0 + SAME_DISTANCE)) & offsets.any(axis=1)
    offsets, lengths = offsets[near], lengths[near]
    order = np.lexsort((*offsets.T, lengths))
    offsets, lengths = offsets[order], lengths[order]
    shells = np.zeros(len(lengths), dtype=np.int32)
    if len(lengths):
        shells[1:] = np.cumsum(np.diff(lengths) > SAME_DISTANCE * lengths[:-1])
    # Equal lengths may come in any order of rounding: within a shell the order is that of the indices.
    order = np.lexsort((*offsets.T, shells))
    return np.ascontiguousarray(offsets[order], dtype=np.int32), shells
