"""Voxels as numbers: a third of the memory of their indices, which are made of them when somebody asks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class VoxelNumbers:
    """Voxels of a volume by number.

    numbers: ndarray, shape (n,), uint32 or int64. ``i + ni * (j + nj * k)``.
    shape_ijk: (ni, nj, nk)
    """

    numbers: NDArray[Any]
    shape_ijk: tuple[int, int, int]

    def slices(self) -> NDArray[Any]:
        """Return the slice k of each voxel, shape (n,)."""
        ni, nj, _ = self.shape_ijk
        kind = self.numbers.dtype.type
        return self.numbers // kind(ni) // kind(nj)  # a slice may have 2^32 voxels, their product is no uint32 then

    def take(self, chosen: NDArray[np.intp]) -> VoxelNumbers:
        """Return some of the voxels, by their places in the list."""
        return VoxelNumbers(self.numbers.take(chosen), self.shape_ijk)

    def indices(self) -> NDArray[np.int32]:
        """Return the voxel indices (i, j, k), shape (n, 3)."""
        ni, nj, _ = self.shape_ijk
        found = np.empty((len(self.numbers), 3), np.int32)
        rows = self.numbers // self.numbers.dtype.type(ni)
        slices = rows // self.numbers.dtype.type(nj)
        found[:, 0] = self.numbers - rows * self.numbers.dtype.type(ni)
        found[:, 1] = rows - slices * self.numbers.dtype.type(nj)
        found[:, 2] = slices
        return found
