"""The coarse grid on which the body is found: cells of about 2 mm, each with its mean HU and its number of dense
voxels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.volume import Volume

__all__ = ["DENSE_HU", "HARD_HU", "Cells", "Mask", "grow", "measure_cells"]

Mask = NDArray[np.bool_]

CELL_MM = 2.0
"""Size of the cells; a cell has at least one voxel."""
DENSE_HU = 300.0
"""Bone has voxels above this; plastic and carbon fibre may have them too."""
HARD_HU = 600.0
"""Compact bone, teeth and metal have voxels above this; plastic and carbon fibre have none (560 HU at most)."""


@dataclass(frozen=True)
class Cells:
    """Figures of the voxels in each cell.

    Attributes
    ----------
    mean : ndarray, shape (ck, cj, ci), float32
        Mean HU; cells at the far ends may hold fewer voxels.
    dense, hard : ndarray, shape (ck, cj, ci), uint16
        Number of voxels above `DENSE_HU` and above `HARD_HU`.
    step : (int, int, int)
        Number of voxels of a cell along i, j, k.
    size_mm : (float, float, float)
        Lengths of a cell along i, j, k.
    """

    mean: NDArray[np.float32]
    dense: NDArray[np.uint16]
    hard: NDArray[np.uint16]
    step: tuple[int, int, int]
    size_mm: tuple[float, float, float]

    @property
    def voxel_ml(self) -> float:
        """Volume of a voxel, ml, for slices spaced as `size_mm` says."""
        return math.prod(self.size_mm) / math.prod(self.step) / 1000.0

    @property
    def across(self) -> float:
        """Length of a cell within the slice, mm."""
        return math.sqrt(self.size_mm[0] * self.size_mm[1])


def measure_cells(volume: Volume) -> Cells:
    """Compute the cells, reading the voxels once, slab by slab."""
    nk, nj, ni = volume.voxels.shape
    si, sj, sk = (max(1, round(CELL_MM / length)) for length in volume.spacing)
    rows, columns = np.arange(0, nj, sj), np.arange(0, ni, si)
    shape = (-(-nk // sk), len(rows), len(columns))
    mean = np.empty(shape, dtype=np.float32)
    dense, hard = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint16)
    for place in range(shape[0]):
        first, end = place * sk, min((place + 1) * sk, nk)
        slab = volume.voxels[first:end]
        total = slab.sum(axis=0, dtype=np.float32)
        mean[place] = np.add.reduceat(np.add.reduceat(total, rows, axis=0), columns, axis=1) / (end - first)
        # Few voxels are dense: counting them one by one costs less than sums over all voxels.
        _, j, i = np.nonzero(slab > DENSE_HU)
        if len(i):
            cell = (j // sj) * shape[2] + i // si
            is_hard = slab[slab > DENSE_HU] > HARD_HU
            for counts, chosen in ((dense, cell), (hard, cell[is_hard])):
                counts[place] = np.bincount(chosen, minlength=shape[1] * shape[2]).reshape(shape[1:])
        volume.release_slices(first, end)
    for axis, (size, begin) in enumerate(((nj, rows), (ni, columns)), start=1):
        widths = np.diff(np.append(begin, size)).astype(np.float32)
        mean /= widths.reshape([-1 if place == axis else 1 for place in range(3)])
    di, dj, dk = volume.spacing
    return Cells(mean, dense, hard, (si, sj, sk), (si * di, sj * dj, sk * dk))


def grow(mask: Mask, cells: float) -> Mask:
    """Dilate slice by slice by `cells` cells, or erode where `cells` is below 0.

    Cross and square alternate, so a point grows to an octagon.
    """
    from scipy import ndimage

    change = ndimage.binary_dilation if cells > 0 else ndimage.binary_erosion
    for turn in range(max(1, round(abs(cells)))):
        shape = ndimage.generate_binary_structure(2, 1 + turn % 2)[None]
        mask = change(mask, shape, border_value=cells < 0)  # the border erodes nothing
    return mask
