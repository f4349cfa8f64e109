"""Twins of what `clrecon.operators.masks.shapes` does: components of voxels that share a face."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def fill_holes(chosen: ArrayLike, by_slice: bool = False) -> NDArray[np.bool_]:
    """Return the chosen voxels and those that they enclose, (nk, nj, ni): what a flood from beyond never meets."""
    bits = np.asarray(chosen, dtype=bool)
    if by_slice:
        return np.stack([fill_holes(layer) for layer in bits])
    beyond = np.pad(~bits, 1, constant_values=True)
    return ~_flood(beyond, (0,) * bits.ndim)[(slice(1, -1),) * bits.ndim]


def grow(chosen: ArrayLike, voxels: ArrayLike) -> NDArray[np.bool_]:
    """Return the components of the chosen voxels that hold a voxel (k, j, i) of a list."""
    bits = np.asarray(chosen, dtype=bool)
    found = np.zeros_like(bits)
    for voxel in np.asarray(voxels).tolist():
        if not found[tuple(voxel)]:
            found |= _flood(bits, tuple(voxel))
    return found


def _flood(bits: NDArray[np.bool_], start: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the component that holds `start`, one element at a time."""
    met = np.zeros_like(bits)
    met[start] = bits[start]
    open_ends = [start] if bits[start] else []
    while open_ends:
        place = open_ends.pop()
        for axis, size in enumerate(bits.shape):
            for step in (-1, 1):
                near = (*place[:axis], place[axis] + step, *place[axis + 1 :])
                if 0 <= near[axis] < size and bits[near] and not met[near]:
                    met[near] = True
                    open_ends.append(near)
    return met
