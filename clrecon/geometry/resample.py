"""Regular grids that enclose sheared or uneven grids, and copies of volumes on them."""

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
from clrecon.geometry.sampling import sample_onto
from clrecon.system.progress import Progress, ignore_progress

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
        first, columns, rows = corners[0], corners[1] - corners[0], corners[2] - corners[0]
        if not -0.5 <= first[2] <= grid.voxels.shape[0] - 0.5:
            continue
        found, inside = _sample_plane(_slice_at(grid, first[2]), first, columns, rows, (nj, ni))
        if dtype.kind != "f":
            np.rint(found, out=found)
        np.copyto(plane, found, where=inside, casting="unsafe")
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
    found = ndimage.affine_transform(values, matrix, first[1::-1], shape, np.float32, order=1, mode="nearest")
    row, column = np.ogrid[: shape[0], : shape[1]]
    inside = np.ones(shape, dtype=bool)
    for axis, count in enumerate(values.shape[::-1]):
        place = first[axis] + row * rows[axis] + column * columns[axis]
        inside &= (place >= -0.5) & (place <= count - 0.5)
    return found, inside


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
        made = volume.alike(sample_onto(volume, to, air, report), to.affine, None, positions)
        what = "the voxels of another volume"
        figures["step_mm"] = list(to.spacing)
    else:
        steps = np.atleast_1d(np.asarray(to, object)).tolist()
        for step in steps:
            check_step(step)
        if len(steps) not in (1, 3):
            raise UsageError(f"a resampled volume has one step, or one each along i, j and k, not {len(steps)}")
        figures["step_mm"] = to = float(steps[0]) if len(steps) == 1 else [float(step) for step in steps]
        what = " x ".join(f"{step:g}" for step in steps) + " mm"
        regular = regular_grid(volume, volume.slice_origins(), to)
        check_count(regular, f"in steps of {what}")
        made = volume.alike(resample_grid(volume, regular, air, report), regular.affine)
    before = " x ".join(f"{step:.4g}" for step in volume.spacing)
    said = f"resampled (trilinear) from {'uneven slices' if volume.uneven else f'{before} mm'} to {what}"
    take_report(made, volume, said, resampled=figures)
    return made
