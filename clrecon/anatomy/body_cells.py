"""The coarse grid on which the body is found: cells of about 2 mm, each with its mean HU and count of dense voxels."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.geometry.regions import Mask
from clrecon.geometry.volume import Volume
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads

CELL_MM = 2.0
"""Size of the cells in which the body is searched; a cell has at least one voxel."""
DENSE_HU = 300
"""Bone has voxels above this value; plastic and carbon fibre may have such voxels too."""
HARD_HU = 600
"""Compact bone, teeth and metal have voxels above this value; plastic and carbon fibre have at most 560 HU."""
SURE_METAL_HU = 2200
"""Metal has voxels above this value; bone has only a few, in tooth enamel and the densest cortex."""

PIECE = 4
"""Slices that a thread works out together."""


@dataclass(frozen=True)
class Cells:
    """Figures of the voxels in each cell (ck, cj, ci), of which those at the far ends hold fewer: mean HU, counts above
    `DENSE_HU`, `HARD_HU` and `SURE_METAL_HU` (the type holds a full cell); voxels and mm of a cell along i, j, k.
    """

    mean: NDArray[np.float32]
    dense: NDArray[np.unsignedinteger[Any]]
    hard: NDArray[np.unsignedinteger[Any]]
    metal: NDArray[np.unsignedinteger[Any]]
    step: tuple[int, int, int]
    size_mm: tuple[float, float, float]

    @property
    def voxel_ml(self) -> float:
        return math.prod(self.size_mm) / math.prod(self.step) / 1000.0

    @property
    def across(self) -> float:
        """Length of a cell within the slice, mm."""
        return math.sqrt(self.size_mm[0] * self.size_mm[1])


def _voxels_of_a_cell(volume: Volume) -> tuple[int, int, int]:
    """Return the number of voxels of a cell along i, j, k."""
    si, sj, sk = (max(1, round(CELL_MM / length)) for length in volume.spacing)
    return si, sj, sk


def count_cells(volume: Volume) -> tuple[int, int, int]:
    sizes = zip(volume.shape_ijk, _voxels_of_a_cell(volume), strict=True)
    ci, cj, ck = (-(-size // step) for size, step in sizes)
    return ck, cj, ci


def measure_cells(volume: Volume, done: Callable[[slice], None] | None = None) -> Cells:
    """Compute the cells of a scan, reading the voxels once, slab by slab.

    done: Called in the thread of the caller with the slices of cells that are finished.
    """
    nk, nj, ni = volume.voxels.shape
    si, sj, sk = _voxels_of_a_cell(volume)
    shape = count_cells(volume)
    mean = np.empty(shape, dtype=np.float32)
    # A cell of micro-CT has more voxels than 16 bits count.
    dtype = np.promote_types(np.uint16, np.min_scalar_type(si * sj * sk))
    dense, hard, metal = (np.zeros(shape, dtype=dtype) for _ in range(3))

    def measure_layers(layers: slice) -> None:
        for layer in range(layers.start, layers.stop):
            first, end = layer * sk, min((layer + 1) * sk, nk)
            slab = volume.voxels[first:end]
            mean[layer] = sum_blocks(slab, sj, si) / (end - first)
            _count_dense(slab, {DENSE_HU: dense[layer], HARD_HU: hard[layer], SURE_METAL_HU: metal[layer]}, sj, si)
            volume.release_slices(first, end)

    in_threads(measure_layers, shape[0], PIECE, done)
    for axis, (size, step) in enumerate(((nj, sj), (ni, si)), start=1):
        widths = np.diff(np.append(np.arange(0, size, step), size)).astype(np.float32)
        mean /= widths.reshape([-1 if place == axis else 1 for place in range(3)])
    di, dj, dk = volume.spacing
    return Cells(mean, dense, hard, metal, (si, sj, sk), (si * di, sj * dj, sk * dk))


def sum_blocks(slab: NDArray[Any], sj: int, si: int, dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Sum a slab over all its slices and over blocks of sj x si voxels; those at the far ends may hold fewer."""
    total = slab[0].astype(dtype)
    for layer in slab[1:]:
        total += layer
    # Sums of long rows: numpy is slow where it adds a few values at a time.
    rows = total[::sj].copy()
    for n in range(1, sj):
        part = total[n::sj]
        rows[: len(part)] += part
    blocks = rows[:, ::si].copy()
    for n in range(1, si):
        part = rows[:, n::si]
        blocks[:, : part.shape[1]] += part
    return blocks


def _count_dense(slab: NDArray[Any], counts: dict[float, NDArray[Any]], sj: int, si: int) -> None:
    """Count the voxels of a slab above each bound in each cell, into zeros; `DENSE_HU` is the lowest bound."""
    # Few voxels are dense: counting them one by one costs less than sums over all voxels.
    _, nj, ni = slab.shape
    dense = np.flatnonzero(slab > DENSE_HU)
    if not len(dense):
        return
    cell = (dense // ni % nj // sj) * counts[DENSE_HU].shape[1] + dense % ni // si
    values = slab.reshape(-1)[dense]
    for bound, count in counts.items():
        count[...] = np.bincount(cell[values > bound], minlength=count.size).reshape(count.shape)


def grow(mask: Mask, cells: float) -> Mask:
    """Dilate by `cells` cells slice by slice, erode below 0; cross and square alternate: a point becomes an octagon."""
    turns = max(1, round(abs(cells)))
    changed = np.empty(mask.shape, dtype=bool)
    ni = mask.shape[2]

    def change_layers(layers: slice) -> None:
        # The border erodes nothing: an eroded mask is what is left of the grown rest.
        source = mask[layers] if cells > 0 else ~mask[layers]
        packed = np.zeros((*source.shape[:2], ni // 64 + 1, 8), dtype=np.uint8)
        rows = packed.reshape(*source.shape[:2], -1)
        rows[..., : -(-ni // 8)] = np.packbits(source, axis=2, bitorder="little")
        _grow_bits(packed.view("<u8")[..., 0], ni, turns)
        bits = np.unpackbits(rows, axis=2, count=ni, bitorder="little")
        np.equal(bits, cells > 0, out=changed[layers])

    in_threads(change_layers, len(mask), 4 * PIECE)
    return changed


def _grow_bits(words: NDArray[np.uint64], ni: int, turns: int) -> None:
    """Dilate slices of rows of `ni` bits in place: cross and square alternate.  At least a bit after each row is 0."""
    flat, beyond = words.reshape(-1), np.uint64((1 << ni % 64) - 1)
    for turn in range(turns):
        before = words.copy()
        carry = before.reshape(-1)
        words |= before << 1
        words |= before >> 1
        flat[1:] |= carry[:-1] >> 63
        flat[:-1] |= carry[1:] << 63
        words[..., -1] &= beyond
        is_square = turn % 2 == 1
        if is_square:
            before = words.copy()
        words[:, 1:] |= before[:, :-1]
        words[:, :-1] |= before[:, 1:]


def spread_mask(mask: Mask, turns: int = 1) -> Mask:
    """Dilate by so many cells in three dimensions, over the faces of the cells."""
    for _ in range(turns):
        before, mask = mask, mask.copy()
        for axis in range(3):
            low, high = np.moveaxis(before, axis, 0), np.moveaxis(mask, axis, 0)
            high[1:] |= low[:-1]
            high[:-1] |= low[1:]
    return mask
