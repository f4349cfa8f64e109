"""A lattice of points finer than the voxels, as rows of runs: where the trilinear HU reach a level.

What is inside is written by its ends.  A row of the lattice runs along i; each point from which on the state differs
from that of the point before has a key, (k * nj + j) * (ni + 1) + i.  The state before a row is outside, and where its
last point is inside the run ends at i = ni, beyond the row: every row has an even number of keys.  Memory grows with
the surface, not with the lattice.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule

_SLAB_VOXELS = 1 << 23
"""Voxels at a time: some 200 MB with what is computed from them."""

Keys = NDArray[np.int64]


@dataclass(frozen=True)
class Lattice:
    """Points that divide each cell between voxel centres alike.

    finer: Points in a cell along each axis.
    offsets: Where the points of a cell begin, in steps of the lattice, from 0 to below 1.
    border: Layers of samples around the voxels.
    cells_ijk: Cells along each axis, those of the border included.
    """

    finer: int
    offsets: tuple[float, float, float]
    border: int
    cells_ijk: tuple[int, int, int]

    @classmethod
    def over(cls, volume: Volume, rule: IsoRule, finer: int, offsets: tuple[float, float, float]) -> Lattice:
        """Return the lattice over a volume and its border."""
        ni, nj, nk = (size + 2 * rule.border - 1 for size in volume.shape_ijk)
        return cls(finer, offsets, rule.border, (ni, nj, nk))

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        """Number of points along each axis."""
        ni, nj, nk = (cells * self.finer for cells in self.cells_ijk)
        return ni, nj, nk

    def number(self, ijk: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return index coordinates of the voxels, shape (n, 3), in numbers of points from the first."""
        return (ijk + self.border) * self.finer - np.array(self.offsets)

    def shares(self, axis: int) -> list[float]:
        """Return where the points of a cell lie along an axis, as shares of the cell."""
        return [(point + self.offsets[axis]) / self.finer for point in range(self.finer)]

    def row_of(self, keys: Keys) -> Keys:
        """Return the number of the row of each key."""
        return keys // (self.shape_ijk[0] + 1)


def count_points(keys: Keys) -> int:
    """Return the number of points inside, from the ends of their runs in ascending order."""
    return int((keys[1::2] - keys[::2]).sum())


def exclusive_or(one: Keys, other: Keys) -> Keys:
    """Return the ends of the runs of points that are in one but not in the other."""
    keys = np.sort(np.concatenate([one, other]), kind="stable")  # merges two ascending parts
    alone = np.ones(len(keys), dtype=bool)
    equal = keys[1:] == keys[:-1]
    alone[1:] &= ~equal
    alone[:-1] &= ~equal
    return np.asarray(keys[alone])


def find_level_runs(volume: Volume, rule: IsoRule, lattice: Lattice, told: Callable[[int], None]) -> Keys:
    """Find the runs of points at which the trilinear HU reach the level of a rule.

    A trilinear field has its extremes at the corners of a cell: only cells with corners on both sides have points on
    both sides.

    rule: Of one level, with what lies above it inside.
    told: Called with the number of layers of cells that are done.

    Returns: ndarray, shape (n,), int64, ascending. Ends of runs.
    """
    layers = lattice.cells_ijk[2]
    ni, nj, _ = volume.shape_ijk
    step = max(1, _SLAB_VOXELS // (ni * nj))
    found = [np.zeros(0, dtype=np.int64)]
    for first in range(0, layers, step):
        told(first)
        samples = _samples(volume, rule, first, min(first + step, layers) + 1)
        found.append(np.sort(_runs_in(samples, rule, lattice, first)))
    return np.concatenate(found)


def _samples(volume: Volume, rule: IsoRule, first: int, end: int) -> NDArray[Any]:
    """Return slices of the volume with its border, counted with it, shape (end - first, nj + 2 b, ni + 2 b)."""
    border = rule.border
    slices = volume.voxels[max(first - border, 0) : max(end - border, 0)]
    if not border:
        return slices
    before = max(border - first, 0)
    after = end - first - before - len(slices)
    widths = ((before, after), (border, border), (border, border))
    return np.pad(slices, widths, constant_values=np.array(rule.outside).astype(slices.dtype))


def _faces(corners: NDArray[np.bool_], join: Callable[..., NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Join the eight corners of every cell."""
    corners = join(corners[1:], corners[:-1])
    corners = join(corners[:, 1:], corners[:, :-1])
    return join(corners[:, :, 1:], corners[:, :, :-1])


def _runs_in(samples: NDArray[Any], rule: IsoRule, lattice: Lattice, first: int) -> Keys:
    """Return the ends of runs in some layers of cells, in no order."""
    inside = rule.mark_inside(samples)
    touched = _faces(inside, np.logical_or)
    wanted = touched & ~_faces(inside, np.logical_and)
    wanted[:, :, 1:] |= wanted[:, :, :-1].copy()  # a run may end before the first point of the next cell
    wanted[:, :, [0, -1]] |= touched[:, :, [0, -1]]
    k, j, i = np.nonzero(wanted)
    if len(i) == 0:
        return np.zeros(0, dtype=np.int64)
    corners = {
        (c, b, a): samples[k + c, j + b, i + a].astype(np.float32) for c, b, a in itertools.product((0, 1), repeat=3)
    }
    ni, nj, _ = lattice.shape_ijk
    finer = lattice.finer
    base = ((k + first) * finer * nj + j * finer) * (ni + 1) + i * finer
    # Where the cell before is left out, all its points have the state of the corner that both share.
    follows = np.concatenate([[False], (np.diff(i) == 1) & (np.diff(j) == 0) & (np.diff(k) == 0)])
    shared = inside[k, j, i] & (i > 0)
    last = np.flatnonzero(i == lattice.cells_ijk[0] - 1)
    found = []
    for (row_k, tk), (row_j, tj) in itertools.product(enumerate(lattice.shares(2)), enumerate(lattice.shares(1))):
        if row_j == 0:
            edges = {
                (b, a): _mix(corners[0, b, a], corners[1, b, a], tk) for b, a in itertools.product((0, 1), repeat=2)
            }
        low, high = (_mix(edges[0, a], edges[1, a], tj) for a in (0, 1))
        states = [_mix(low, high, ti) >= np.float32(rule.iso_level) for ti in lattice.shares(0)]
        before = shared.copy()
        before[follows] = states[-1][np.flatnonzero(follows) - 1]
        row = base + (row_k * nj + row_j) * (ni + 1)
        for point, state in enumerate(states):
            found.append(row[state != before] + point)
            before = state
        found.append(row[last[before[last]]] + finer)
    return np.concatenate(found)


def _mix(low: NDArray[np.float32], high: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    return np.asarray(low + np.float32(share) * (high - low))
