"""Twin of `clrecon.operators.masks.regions`: every voxel is asked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry import Volume


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
