"""Regular grids that enclose sheared or uneven grids, copies of volumes on them, and HU at points of the patient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, apply_affine
from clrecon.geometry.blocks import find_extent, take_report
from clrecon.geometry.grid import AIR_HU, BaseVolume, Grid
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

    def sample_span(span: slice) -> None:
        piece = points[span]
        if not np.isfinite(piece).all():
            piece = np.where(np.isfinite(piece).all(axis=1, keepdims=True), piece, np.nan)
        places = volume.lps_to_ijk(piece)
        is_inside = find_inside(places, volume)
        if is_inside.any():
            rows = np.ascontiguousarray((places if is_inside.all() else places[is_inside]).T)
            np.clip(rows, 0.0, np.array(volume.shape_ijk)[:, None] - 1.0, out=rows)
            values[span][is_inside] = interpolate(volume.voxels, rows)

    in_threads(sample_span, len(points), max(len(points), 1) if order == 3 else CHUNK)
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

    def blend_values(numbers: NDArray[np.intp], axis: int) -> Float64Array:
        if axis < 0:
            return values.take(numbers).astype(np.float64)
        low, high = blend_values(numbers, axis - 1), blend_values(numbers + steps[axis], axis - 1)
        low *= rests[axis]
        high *= parts[axis]
        low += high
        return low

    return blend_values((low[0] + ni * (low[1] + nj * low[2])).astype(np.intp), 2)


def _spline(voxels: NDArray[Any], places: Float64Array) -> Float64Array:
    from scipy import ndimage

    first = np.maximum(np.floor(places.min(axis=1)).astype(int) - _SPLINE_MARGIN, 0)
    end = np.ceil(places.max(axis=1)).astype(int) + _SPLINE_MARGIN + 1
    block = voxels[tuple(slice(low, high) for low, high in zip(first[::-1], end[::-1], strict=True))]
    in_block = (places - first[:, None])[::-1]
    return np.asarray(ndimage.map_coordinates(block, in_block, np.float64, order=3, mode="nearest"))


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
        sampled, is_inside = (_sample_uneven if volume.uneven else _sample_even)(volume, target, k)
        if volume.dtype.kind != "f":
            np.rint(sampled, out=sampled)
        np.copyto(plane, sampled, where=is_inside, casting="unsafe")
    return values


def _sample_even(volume: BaseVolume, target: BaseVolume, k: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Sample an even volume at the pixels of a slice of another: along rows and columns its indices run linearly."""
    from scipy import ndimage

    corners = target.ijk_to_lps(np.array([[0.0, 0.0, k], [1.0, 0.0, k], [0.0, 1.0, k]]))
    first, right, down = volume.lps_to_ijk(corners)
    right, down = right - first, down - first
    nj, ni = target.shape[1:]
    matrix = np.column_stack([np.zeros(3), down[::-1], right[::-1]])
    sampled = ndimage.affine_transform(
        volume.voxels, matrix, first[::-1], (1, nj, ni), np.float32, order=1, mode="nearest"
    )
    row, column = np.ogrid[:nj, :ni]
    is_inside = np.ones((nj, ni), bool)
    for axis, count in enumerate(volume.shape_ijk):
        coordinate = first[axis] + column * right[axis] + row * down[axis]
        is_inside &= (coordinate >= -0.5) & (coordinate <= count - 0.5)
    return sampled[0], is_inside


def _sample_uneven(volume: BaseVolume, target: BaseVolume, k: int) -> tuple[Float64Array, NDArray[np.bool_]]:
    """Sample a volume of uneven slices at each pixel of a slice of another."""
    nj, ni = target.shape[1:]
    row, column = np.indices((nj, ni))
    pixels = target.ijk_to_lps(np.column_stack([column.ravel(), row.ravel(), np.full(ni * nj, k)]))
    sampled = sample_volume(volume, pixels, 1, np.nan).reshape(nj, ni)
    return sampled, find_inside(volume.lps_to_ijk(pixels), volume).reshape(nj, ni)


LARGEST_SHEAR_DEGREES = 0.01
"""Axes this near to right angles count as rectangular, because directions in headers are rounded.  A file or an image
gets the affine's own axes, so its points are those of the volume."""

ON_GRID = 1e-6
"""Tolerance in steps: a volume that ends this near to a point of the regular grid needs no further point."""


class RegularGrid(NamedTuple):
    """Points in even steps along axes at right angles, right-handed."""

    affine: Float64Array
    shape_ijk: tuple[int, int, int]


def shear_degrees(affine: Float64Array) -> float:
    """Largest deviation of the angles between the three axes from right angles, degrees."""
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    cosines = axes.T @ axes
    return float(np.degrees(np.arcsin(np.clip(np.abs(cosines - np.diag(np.diag(cosines))).max(), 0.0, 1.0))))


def describe_unevenness(origins: Float64Array) -> str:
    """Describe slices that lie at positions (n, 3) in uneven steps."""
    gaps = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    return f"the slices of this volume are uneven ({gaps.min():.4g} to {gaps.max():.4g} mm apart)"


def regular_grid(grid: Grid, origins: Float64Array, steps_mm: float | Sequence[float] | None = None) -> RegularGrid:
    """Return the smallest regular grid that encloses all voxel centres of a grid with slices at `origins` (nk, 3), LPS
    mm.

    i runs as in the grid, j within the plane of the slices, k along their normal.  Without `steps_mm`, i and j have the
    steps of the grid and k the smallest distance of slices along the normal: where a volume is sheared but even, the
    planes are those of its slices.
    """
    di, dj, _ = grid.spacing
    first = grid.affine[:3, 0] / di
    second = grid.affine[:3, 1] - (grid.affine[:3, 1] @ first) * first
    second /= np.linalg.norm(second)
    axes = np.column_stack([first, second, np.cross(first, second)])
    ni, nj, nk = grid.shape_ijk
    in_plane = np.array([(i, j) for i, j in product((0, ni - 1), (0, nj - 1))]) @ grid.affine[:3, :2].T
    places = (origins[:, None, :] + in_plane).reshape(-1, 3) @ axes
    heights = origins @ axes[:, 2]
    dk = np.abs(np.diff(heights)).min() if nk > 1 else abs(grid.affine[:3, 2] @ axes[:, 2])
    spacing = np.array([di, dj, dk]) if steps_mm is None else np.broadcast_to(steps_mm, 3).astype(float)
    low, high = places.min(axis=0), places.max(axis=0)
    counts = np.ceil((high - low) / spacing - ON_GRID).astype(int) + 1
    affine = np.eye(4)
    affine[:3, :3] = axes * spacing
    affine[:3, 3] = axes @ low
    return RegularGrid(affine, (int(counts[0]), int(counts[1]), int(counts[2])))


def resample_grid(grid: Grid, regular: RegularGrid, air: float, progress: Progress = ignore_progress) -> NDArray[Any]:
    """Resample a grid (trilinear, integers rounded) at the points of a regular one, by planes; `air` beyond it."""
    ni, nj, nk = regular.shape_ijk
    dtype = grid.voxels.dtype
    values = np.full((nk, nj, ni), air, dtype)
    for k, plane in enumerate(values):
        progress("resample", k, nk)
        # The plane is parallel to the slices: one k for all of it, and i and j run linearly along its rows and columns.
        corners = grid.lps_to_ijk(apply_affine(regular.affine, [[0.0, 0.0, k], [1.0, 0.0, k], [0.0, 1.0, k]]))
        first = corners[0]
        columns, rows = corners[1] - corners[0], corners[2] - corners[0]
        if not -0.5 <= first[2] <= grid.voxels.shape[0] - 0.5:
            continue
        sampled, inside = _sample_plane(_slice_at(grid, first[2]), first, columns, rows, (nj, ni))
        if dtype.kind != "f":
            np.rint(sampled, out=sampled)
        np.copyto(plane, sampled, where=inside, casting="unsafe")
    return values


def _slice_at(grid: Grid, k: float) -> NDArray[np.float32]:
    """Return the slice at a fractional index, shape (nj, ni); beyond the ends the outermost slice."""
    k = min(max(k, 0.0), grid.voxels.shape[0] - 1.0)
    below = int(k)
    values = grid.voxels[below].astype(np.float32)
    if k > below:
        values += np.float32(k - below) * (grid.voxels[below + 1].astype(np.float32) - values)
    return values


def _sample_plane(
    values: NDArray[np.float32], first: Float64Array, columns: Float64Array, rows: Float64Array, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Sample a slice (bilinear) at ``first + column * columns + row * rows``; mark all up to half a voxel beyond."""
    from scipy import ndimage

    matrix = np.array([[rows[1], columns[1]], [rows[0], columns[0]]])
    sampled = ndimage.affine_transform(values, matrix, first[1::-1], shape, np.float32, order=1, mode="nearest")
    row, column = np.ogrid[: shape[0], : shape[1]]
    inside = np.ones(shape, dtype=bool)
    for axis, count in enumerate(values.shape[::-1]):
        coordinate = first[axis] + row * rows[axis] + column * columns[axis]
        inside &= (coordinate >= -0.5) & (coordinate <= count - 0.5)
    return sampled, inside


Own = TypeVar("Own", bound=BaseVolume)

_SMALLEST_STEP_MM = 0.01
MOST_VOXELS = 2**31
"""Most voxels of a resampled volume: 4 GiB of int16."""


def check_step(step_mm: float) -> None:
    number = isinstance(step_mm, int | float | np.integer | np.floating)
    if not (number and math.isfinite(step_mm) and step_mm >= _SMALLEST_STEP_MM):
        shown = f"{step_mm:g}" if number else repr(step_mm)[:40]
        raise UsageError(
            f"the step of a resampled volume is a length of at least {_SMALLEST_STEP_MM:g} mm, not {shown}"
        )


def check_count(regular: RegularGrid, steps: str) -> None:
    """Refuse a grid that is too large; `steps` says for the message what its steps are."""
    if math.prod(regular.shape_ijk) > MOST_VOXELS:
        shape = " x ".join(f"{n:,}" for n in regular.shape_ijk)
        raise RefusedInputError(
            f"{steps} the volume has {shape} voxels, at most {MOST_VOXELS:,} are made: take a longer step, or crop it"
        )


def air_of(dtype: np.dtype[Any]) -> float:
    """Return the value of voxels that hold no measurement, `AIR_HU` or the lowest value that the type has."""
    return AIR_HU if dtype.kind == "f" else max(AIR_HU, int(np.iinfo(dtype).min))


def resample_volume(volume: Own, to: float | Sequence[float] | BaseVolume, *, progress: Progress | None = None) -> Own:
    report, air = progress or ignore_progress, air_of(volume.dtype)
    figures: dict[str, Any] = {"method": "trilinear"}
    if isinstance(to, BaseVolume):
        (low, high), (first, last) = find_extent(volume), find_extent(to)
        away = np.maximum(first - high, low - last)
        if (away > 0.0).any():
            axis = int(np.argmax(away))
            raise UsageError(
                f"the two volumes have no place in common: along {'xyz'[axis]} they lie {away[axis]:.1f} mm apart"
            )
        positions = to.slice_origins() if to.uneven else None
        resampled = volume.alike(sample_onto(volume, to, air, report), to.affine, None, positions)
        target = "the voxels of another volume"
        figures["step_mm"] = list(to.spacing)
    else:
        steps = np.atleast_1d(np.asarray(to, object)).tolist()
        for step in steps:
            check_step(step)
        if len(steps) not in (1, 3):
            raise UsageError(f"a resampled volume has one step, or one each along i, j and k, not {len(steps)}")
        figures["step_mm"] = to = float(steps[0]) if len(steps) == 1 else [float(step) for step in steps]
        target = " x ".join(f"{step:g}" for step in steps) + " mm"
        regular = regular_grid(volume, volume.slice_origins(), to)
        check_count(regular, f"in steps of {target}")
        resampled = volume.alike(resample_grid(volume, regular, air, report), regular.affine)
    before = " x ".join(f"{step:.4g}" for step in volume.spacing)
    warning = f"resampled (trilinear) from {'uneven slices' if volume.uneven else f'{before} mm'} to {target}"
    take_report(resampled, volume, warning, resampled=figures)
    return resampled
