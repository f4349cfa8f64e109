"""Twin of `clrecon.operators.masks.shapes`: distances of the voxels' places, one nearest voxel at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume
from clrecon.reference.masks.regions import find_places

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


def open_up(volume: Volume, chosen: ArrayLike, mm: float, by_slice: bool = False) -> Bits:
    """Return what remains of an erosion, dilated."""
    return dilate(volume, erode(volume, chosen, mm, by_slice), mm, by_slice)


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
