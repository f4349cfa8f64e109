"""Twins of `clrecon.operators.masks`: boxes and tubes, where every voxel is asked; balls, by distances of the voxels'
places, one nearest voxel at a time; components of voxels that share a face.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume


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


def find_places(volume: Volume, border: tuple[int, int, int] = (0, 0, 0)) -> NDArray[np.float64]:
    """Return LPS mm of all voxels, and of as many beyond them along i, j and k as `border` says, (nk, nj, ni, 3)."""
    shape = [n + 2 * more for n, more in zip(volume.voxels.shape, border[::-1], strict=True)]
    ijk = np.indices(shape)[::-1].reshape(3, -1).T - border
    return volume.ijk_to_lps(ijk).reshape(*shape, 3)


def find_in_box(volume: Volume, sides: ArrayLike) -> NDArray[np.bool_]:
    """Return the voxels in a box, its sides included, shape (nk, nj, ni).

    sides: array_like, shape (3, 2). Lower and upper side in x, y and z, LPS mm; infinity leaves a side open.  Voxels up
        to 1e-6 mm beyond are in.
    """
    low, high = np.asarray(sides, dtype=np.float64).T
    places = find_places(volume)
    found: NDArray[np.bool_] = ((places >= low - 1e-6) & (places <= high + 1e-6)).all(axis=-1)
    return found


def find_in_tube(volume: Volume, points: ArrayLike, radius_mm: float) -> NDArray[np.bool_]:
    """Return the voxels within ``radius_mm * (1 + 1e-6)`` of a line through points, shape (nk, nj, ni)."""
    line: NDArray[Any] = np.asarray(points, dtype=np.float64)
    places = find_places(volume)
    nearest = np.linalg.norm(places - line[0], axis=-1)
    for begin, end in zip(line[:-1], line[1:], strict=True):
        along = end - begin
        square = float(along @ along)
        part = np.clip(((places - begin) @ along) / square, 0.0, 1.0) if square else np.zeros(places.shape[:-1])
        nearest = np.minimum(nearest, np.linalg.norm(places - begin - part[..., None] * along, axis=-1))
    found: NDArray[np.bool_] = nearest <= radius_mm * (1.0 + 1e-6)
    return found


Bits = NDArray[np.bool_]


def dilate(volume: Volume, chosen: ArrayLike, mm: float, by_slice: bool = False) -> Bits:
    """Return the voxels within ``mm * (1 + 1e-6)`` of a chosen one, shape (nk, nj, ni)."""
    return _spread(find_places(volume), np.asarray(chosen, dtype=bool), mm, by_slice)


def erode(volume: Volume, chosen: ArrayLike, mm: float, by_slice: bool = False, beyond: bool = False) -> Bits:
    """Return the voxels without one within ``mm * (1 + 1e-6)`` that is not chosen; `beyond`: those beyond are."""
    bits = np.asarray(chosen, dtype=bool)
    if beyond:
        return ~_spread(find_places(volume), ~bits, mm, by_slice)
    border = _border(volume, mm)
    padded = np.pad(~bits, [(n, n) for n in border[::-1]], constant_values=True)
    inner = tuple(slice(n, n + size) for n, size in zip(border[::-1], bits.shape, strict=True))
    return ~_spread(find_places(volume, border), padded, mm, by_slice, inner)


def _border(volume: Volume, mm: float) -> tuple[int, int, int]:
    """Return enough voxels along i, j and k that those beyond them are farther than `mm` from the volume."""
    steps = volume.affine[:3, :3].copy()
    ends = np.diff(volume.slice_origins(1), axis=0)[[0, -1]]
    borders = []
    for end in ends:
        steps[:, 2] = end
        borders.append(2 + np.ceil(mm * np.linalg.norm(np.linalg.inv(steps), axis=1)).astype(int))
    i, j, k = np.max(borders, axis=0).tolist()
    return i, j, k


def close(volume: Volume, chosen: ArrayLike, mm: float, by_slice: bool = False) -> Bits:
    """Return a dilation, eroded as if all beyond the volume were chosen."""
    return erode(volume, dilate(volume, chosen, mm, by_slice), mm, by_slice, beyond=True)


def _spread(
    places: NDArray[np.float64], chosen: Bits, mm: float, by_slice: bool, inner: tuple[slice, ...] = (slice(None),) * 3
) -> Bits:
    """Return the voxels of the part `inner` that are near chosen ones."""
    from scipy.spatial import cKDTree

    wanted, k = places[inner], np.arange(len(places))[inner[0]]
    found = np.zeros(wanted.shape[:-1], bool)
    layers = [(slice(n, n + 1), slice(at, at + 1)) for n, at in enumerate(k)] if by_slice else [(slice(None),) * 2]
    for own, layer in layers:
        if chosen[layer].any():
            tree = cKDTree(places[layer][chosen[layer]])
            distances = tree.query(wanted[own].reshape(-1, 3), distance_upper_bound=2.0 * mm)[0]
            found[own] = (distances <= mm * (1.0 + 1e-6)).reshape(found[own].shape)
    return found
