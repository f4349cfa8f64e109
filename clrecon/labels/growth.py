"""Growth of labels: the samples around a sample, nearest first, for host and device alike."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume

MOST_OFFSETS = 5000
SAME_DISTANCE = 1e-6
"""Relative difference; offsets whose lengths differ by less, by rounding alone, are equally near."""


@dataclass(frozen=True)
class Growth:
    """The growth of labels on one grid.

    grow_mm: Distance of growth; None: one voxel in each direction.
    offsets: ndarray, shape (n, 3), int32. (di, dj, dk) to the samples around, without (0, 0, 0), nearest in mm first,
        shear included.
    shells: ndarray, shape (n,), int32. Shell numbers from 0; offsets of equal length have the same.
    """

    grow_mm: float | None
    offsets: NDArray[np.int32]
    shells: NDArray[np.int32]

    @classmethod
    def of(cls, volume: Volume, grow_mm: float | None) -> Growth:
        """Make the growth by `grow_mm` on the grid of a volume."""
        steps = volume.affine[:3, :3]
        if grow_mm is None:
            return cls(None, *_sort(_offsets_within((1, 1, 1)), steps))
        limit = _checked(grow_mm, volume)
        reach = np.floor(limit * np.linalg.norm(np.linalg.inv(steps), axis=1) + 1e-9).astype(int)
        offsets = _offsets_within(tuple(reach))
        near = np.linalg.norm(offsets @ steps.T, axis=1) <= limit * (1.0 + SAME_DISTANCE)
        return cls(limit, *_sort(offsets[near], steps))

    @property
    def table(self) -> NDArray[np.int32]:
        """Offsets and shells for a device, shape (n, 4)."""
        return np.concatenate([self.offsets, self.shells[:, None]], axis=1)

    @property
    def reach(self) -> tuple[int, int, int]:
        """Largest offset along i, j, k in samples."""
        i, j, k = np.abs(self.offsets).max(axis=0, initial=0)
        return int(i), int(j), int(k)


def _checked(grow_mm: float, volume: Volume) -> float:
    try:
        number = float(grow_mm)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"labels grow by a number of mm, not {grow_mm!r}") from error
    if not (math.isfinite(number) and number >= 0.0):
        raise UsageError(f"labels grow by 0 mm or more, not {number:g}")
    di, dj, dk = volume.spacing
    if 4 / 3 * math.pi * number * number * number / (di * dj * dk) > MOST_OFFSETS:  # number**3 may overflow
        raise UsageError(
            f"labels cannot grow by {number:g} mm on voxels of {di:.3g} x {dj:.3g} x {dk:.3g} mm: growth mends the"
            " border of a mask, up to some ten voxels"
        )
    return number


def _offsets_within(reach: tuple[Any, ...]) -> NDArray[np.int32]:
    grids: Any = np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij")
    offsets = np.stack([grid.ravel() for grid in grids], axis=1).astype(np.int32)
    return offsets[offsets.any(axis=1)]


def _sort(offsets: NDArray[np.int32], steps: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Sort offsets by length and number their shells; within a shell they keep index order despite rounding."""
    lengths = np.linalg.norm(offsets @ steps.T, axis=1)
    order = np.argsort(lengths, kind="stable")
    offsets, lengths = offsets[order], lengths[order]
    shells = np.zeros(len(lengths), dtype=np.int32)
    if len(lengths):
        shells[1:] = np.cumsum(np.diff(lengths) > SAME_DISTANCE * lengths[:-1])
    order = np.lexsort((*offsets.T, shells))
    return np.ascontiguousarray(offsets[order], dtype=np.int32), shells
