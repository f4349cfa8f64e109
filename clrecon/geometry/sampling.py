"""HU at points of the patient, and volumes on the grids of others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import BaseVolume, Grid
from clrecon.system.progress import Progress, ignore_progress

ORDERS = (0, 1, 3)
"""Nearest voxel, trilinear, cubic spline."""

SPLINE_MARGIN = 16
"""Voxels around the points that a spline looks at: those further away count for less than 1e-9 of a voxel's value."""


def sample_volume(volume: BaseVolume, points: Float64Array, order: int, outside: float) -> Float64Array:
    """Return HU at points (n, 3) in LPS mm, shape (n,); `outside` beyond the voxels and where a point is not finite."""
    from scipy import ndimage

    if order not in ORDERS:
        raise UsageError(f"the order of an interpolation is one of {', '.join(map(str, ORDERS))}, not {order!r}")
    places = volume.lps_to_ijk(np.where(np.isfinite(points).all(axis=1, keepdims=True), points, np.nan))
    is_inside = find_inside(places, volume)
    values = np.full(len(places), float(outside))
    if not is_inside.any():
        return values
    places = np.clip(places[is_inside], 0.0, np.array(volume.shape_ijk) - 1.0)
    if order == 0:
        i, j, k = np.floor(places + 0.5).astype(np.intp).T
        values[is_inside] = volume.voxels[k, j, i]
        return values
    margin = SPLINE_MARGIN if order == 3 else 1
    first = np.maximum(np.floor(places.min(axis=0)).astype(int) - margin, 0)
    end = np.ceil(places.max(axis=0)).astype(int) + margin + 1
    block = volume.voxels[tuple(slice(low, high) for low, high in zip(first[::-1], end[::-1], strict=True))]
    at = (places - first)[:, ::-1].T
    values[is_inside] = ndimage.map_coordinates(block, at, np.float64, order=order, mode="nearest")
    return values


def find_inside(places: Float64Array, grid: Grid) -> NDArray[np.bool_]:
    """Tell which places (..., 3) in i, j and k lie within the voxels: at most half of one beyond their centres."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((places >= -0.5) & (places <= np.array(grid.shape_ijk) - 0.5)).all(axis=-1))


def sample_onto(
    volume: BaseVolume, target: BaseVolume, air: float, progress: Progress = ignore_progress
) -> NDArray[Any]:
    """Resample a volume (trilinear, whole numbers rounded) at the voxel centres of another, by slices; `air` beyond."""

    nk = target.shape_ijk[2]
    values = np.full(target.shape, air, volume.dtype)
    for k, plane in enumerate(values):
        progress("resample", k, nk)
        found, is_inside = (_sample_uneven if volume.uneven else _sample_even)(volume, target, k)
        if volume.dtype.kind != "f":
            np.rint(found, out=found)
        np.copyto(plane, found, where=is_inside, casting="unsafe")
    return values


def _sample_even(volume: BaseVolume, target: BaseVolume, k: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Sample an even volume at the pixels of a slice of another: along rows and columns its indices run linearly."""
    from scipy import ndimage

    corners = target.ijk_to_lps(np.array([[0.0, 0.0, k], [1.0, 0.0, k], [0.0, 1.0, k]]))
    first, right, down = volume.lps_to_ijk(corners)
    right, down = right - first, down - first
    nj, ni = target.shape[1:]
    matrix = np.column_stack([np.zeros(3), down[::-1], right[::-1]])
    found = ndimage.affine_transform(
        volume.voxels, matrix, first[::-1], (1, nj, ni), np.float32, order=1, mode="nearest"
    )
    row, column = np.ogrid[:nj, :ni]
    is_inside = np.ones((nj, ni), bool)
    for axis, count in enumerate(volume.shape_ijk):
        place = first[axis] + column * right[axis] + row * down[axis]
        is_inside &= (place >= -0.5) & (place <= count - 0.5)
    return found[0], is_inside


def _sample_uneven(volume: BaseVolume, target: BaseVolume, k: int) -> tuple[Float64Array, NDArray[np.bool_]]:
    """Sample a volume of uneven slices at each pixel of a slice of another."""
    nj, ni = target.shape[1:]
    row, column = np.indices((nj, ni))
    pixels = target.ijk_to_lps(np.column_stack([column.ravel(), row.ravel(), np.full(ni * nj, k)]))
    found = sample_volume(volume, pixels, 1, np.nan).reshape(nj, ni)
    return found, find_inside(volume.lps_to_ijk(pixels), volume).reshape(nj, ni)
