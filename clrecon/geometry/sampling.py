"""HU at points of the patient, and volumes on the grids of others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import BaseVolume, Grid
from clrecon.system.pieces import CHUNK, in_threads
from clrecon.system.progress import Progress, ignore_progress

_ORDERS = (0, 1, 3)
"""Nearest voxel, trilinear, cubic spline."""

_SPLINE_MARGIN = 16
"""Voxels around the points that a spline looks at: those further away count for less than 1e-9 of a voxel's value."""


def sample_volume(volume: BaseVolume, points: Float64Array, order: int, outside: float) -> Float64Array:
    """Return HU at points (n, 3) in LPS mm, shape (n,); `outside` beyond the voxels and where a point is not finite.

    By numpy, in pieces that stay in the processor's cache: a kernel with its uploads takes as long (docs/geometry.md).
    """
    if order not in _ORDERS:
        raise UsageError(f"the order of an interpolation is one of {', '.join(map(str, _ORDERS))}, not {order!r}")
    values = np.full(len(points), float(outside))
    interpolate = {0: _nearest, 1: _trilinear, 3: _spline}[order]

    def sample(where: slice) -> None:
        own = points[where]
        if not np.isfinite(own).all():
            own = np.where(np.isfinite(own).all(axis=1, keepdims=True), own, np.nan)
        places = volume.lps_to_ijk(own)
        is_inside = find_inside(places, volume)
        if is_inside.any():
            rows = np.ascontiguousarray((places if is_inside.all() else places[is_inside]).T)
            np.clip(rows, 0.0, np.array(volume.shape_ijk)[:, None] - 1.0, out=rows)
            values[where][is_inside] = interpolate(volume.voxels, rows)

    in_threads(sample, len(points), max(len(points), 1) if order == 3 else CHUNK)
    return values


def _nearest(voxels: NDArray[Any], places: Float64Array) -> NDArray[Any]:
    """Return the values of the voxels nearest to places (3, n) in i, j and k within the volume."""
    i, j, k = np.floor(places + 0.5).astype(np.intp)
    return voxels[k, j, i]


def _trilinear(voxels: NDArray[Any], places: Float64Array) -> Float64Array:
    nk, nj, ni = voxels.shape
    strides, last = (1, ni, nj * ni), (ni - 1, nj - 1, nk - 1)
    low, values = np.floor(places), voxels.reshape(-1)
    parts = places - low
    rests = 1.0 - parts
    steps = [np.where(low[axis] < last[axis], strides[axis], 0) for axis in range(3)]

    def blend(numbers: NDArray[np.intp], axis: int) -> Float64Array:
        if axis < 0:
            return values.take(numbers).astype(np.float64)
        one, other = blend(numbers, axis - 1), blend(numbers + steps[axis], axis - 1)
        one *= rests[axis]
        other *= parts[axis]
        one += other
        return one

    return blend((low[0] + ni * (low[1] + nj * low[2])).astype(np.intp), 2)


def _spline(voxels: NDArray[Any], places: Float64Array) -> Float64Array:
    from scipy import ndimage

    first = np.maximum(np.floor(places.min(axis=1)).astype(int) - _SPLINE_MARGIN, 0)
    end = np.ceil(places.max(axis=1)).astype(int) + _SPLINE_MARGIN + 1
    block = voxels[tuple(slice(low, high) for low, high in zip(first[::-1], end[::-1], strict=True))]
    at = (places - first[:, None])[::-1]
    return np.asarray(ndimage.map_coordinates(block, at, np.float64, order=3, mode="nearest"))


def find_inside(places: Float64Array, grid: Grid) -> NDArray[np.bool_]:
    """Tell which places (..., 3) in i, j and k lie within the voxels: at most half of one beyond their centres."""
    is_inside = np.ones(places.shape[:-1], bool)
    with np.errstate(invalid="ignore"):
        for axis, count in enumerate(grid.shape_ijk):
            is_inside &= (places[..., axis] >= -0.5) & (places[..., axis] <= count - 0.5)
    return is_inside


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
