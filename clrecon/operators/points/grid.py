"""Grids over free points: points sorted by cubic cells; the host's side of cl/points/grid.cl."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry.vertices import is_far
from clrecon.opencl import Device, Program
from clrecon.operators.primitives.scan import BitRows, exclusive_scan, prepare_sort, radix_sort, sort_bytes
from clrecon.points.spacing import MARGIN
from clrecon.system.light_dataclass import dataclass

STEPS_A_POINT = 16
"""Steps with each point of a cloud that a work-item may make where all others are candidates: four passes at least."""

MARKED_TOGETHER = ocl.kernel_constant("points/grid.cl", "MARKED_TOGETHER")
"""Points a work-item of mark_cells on a CPU."""

MOST_CELLS = 2**31
"""Most cells of a grid, with and without points."""

MOST_CELLS_ALONG = 2**17
"""Most cells along an axis: float32 then places a point to 0.03 of a cell."""

MOST_PAIRS = 10**12
"""Most pairs of points that may have to be compared because they lie in near cells: minutes to hours."""

CELL_ROUNDING = ocl.kernel_number("points/grid.h", "GRID_ROUNDING")
"""A point may lie outside of its cell by this share of its distance from the grid's origin: float32 chose the cell."""

PADDING = 8
"""Elements after the coordinates of a grid."""

_CHUNK = 256
"""Points that numpy compares together: reductions of rows of three numbers are slow."""


@dataclass(frozen=True, eq=False)
class GridPlan(BitRows):
    """A grid before its points are sorted: all that is known without a device.

    points: ndarray, shape (n, 3), float32. mm relative to `base`.
    base: ndarray, shape (3,), float64. LPS mm: whole millimetres near the centre of a far cloud, see
        `clrecon.geometry.vertices`, else zeros.
    corner: ndarray, shape (3,), float32. Corner of cell (0, 0, 0) relative to `base`: the lowest coordinates less 1e-3
        of the edge.
    edge: mm.
    shape: (nx, ny, nz)
    """

    points: NDArray[np.float32]
    base: NDArray[np.float64]
    corner: NDArray[np.float32]
    edge: np.float32
    shape: tuple[int, int, int]

    def needs(self, device: Device) -> dict[str, int]:
        """Return the bytes that `fill_grid` takes at most, by description; the grid itself is what it keeps of them."""
        n = len(self.points)
        sorting = 4 * n + sort_bytes(device, n, _bits(n))
        gathering = 8 * n + 12 * (n + PADDING) + 4 * (n + 1)
        return {
            "points": self.points.nbytes,
            "sorted points": max(sorting, gathering),
            "cells of the grid": 8 * self.total_words,
        }


@dataclass(frozen=True, eq=False)
class PointGrid:
    """A grid over `n` points on a device: cubic cells, points sorted by cell; cl/points/grid.h shows how it is read.

    edge: mm, a float32.
    origin: (3,), float64. LPS mm of the corner of cell (0, 0, 0).
    base: (3,), float64. LPS mm; coordinates on the device are relative to it.
    shape: (nx, ny, nz). Number of cells; at most 2^31 in all, and 2^17 along an axis.
    mask_d: (nz, ny, words) uint32. A bit for each cell with points; `words` of 32 cells in a row along x.
    ranks_d: (nz, ny, words) uint32. Number of cells with points before each word; of all cells `cells`.
    starts_d: (cells + 1,) uint32. First sorted point of each cell with points, then `n`.
    order_d: (n,) uint32. Number of the point at each place of the sorted order; those of a cell as in the input.
    x_d, y_d, z_d: (n + PADDING,) float32. Sorted mm relative to `base`; a vector can be read from any point on.
    """

    device: Device
    n: int
    edge: float
    origin: NDArray[np.float64]
    base: NDArray[np.float64]
    shape: tuple[int, int, int]
    words: int
    mask_d: Any
    ranks_d: Any
    cells: int
    starts_d: Any
    order_d: Any
    x_d: Any
    y_d: Any
    z_d: Any

    @property
    def origin_and_scale(self) -> tuple[float, float, float, float]:
        """The float4 of kernels: the origin relative to `base`, and 1 / edge as float32."""
        x, y, z = (float(value) for value in self.origin - self.base)
        return x, y, z, float(np.float32(1.0) / np.float32(self.edge))

    @property
    def nbytes(self) -> int:
        return 16 * self.n + 12 * PADDING + 4 * (self.cells + 1) + 8 * self.words * self.shape[1] * self.shape[2]


def _bits(numbers: int) -> int:
    return max(numbers - 1, 0).bit_length()


def find_box(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the lowest and the highest coordinates, shape (2, 3)."""
    whole = len(points) // _CHUNK * _CHUNK
    parts = [points[whole:]]
    if whole:
        rows = points[:whole].reshape(-1, 3 * _CHUNK)
        parts = [*parts, rows.min(axis=0).reshape(-1, 3), rows.max(axis=0).reshape(-1, 3)]
    corners = np.concatenate(parts)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def plan_grid(points: ArrayLike, edge: float) -> GridPlan:
    """Lay a grid of cells with an edge in mm over at least one point."""
    places = np.asarray(points)
    if places.ndim != 2 or places.shape[1] != 3 or len(places) == 0:
        raise UsageError(f"a grid is laid over points of shape (n, 3), at least one, not {places.shape}")
    if not (np.isfinite(edge) and np.float32(edge) >= np.finfo(np.float32).tiny):
        raise UsageError(f"cells of {edge:g} mm: their edge is a positive number of mm")
    places = np.ascontiguousarray(places, dtype=None if places.dtype == np.float32 else np.float64)
    box = find_box(places)
    if not np.isfinite(box).all():
        wrong = int((~np.isfinite(places).all(axis=1)).sum())
        raise UsageError(f"{wrong:,} of {len(places):,} points are not finite: remove them first")
    base = np.rint(box.astype(np.float64).mean(axis=0)) if is_far(box) else np.zeros(3)
    if places.dtype != np.float32 or base.any():
        places, box = (places - base).astype(np.float32), (box - base).astype(np.float32)
    cell = np.float32(edge)
    corner = (box[0].astype(np.float64) - MARGIN * float(cell)).astype(np.float32)
    return GridPlan(places, base, corner, cell, _count_cells(box, corner, cell))


def _count_cells(box: NDArray[np.float32], corner: NDArray[np.float32], edge: np.float32) -> tuple[int, int, int]:
    """Return the cells along each axis, counted as the kernels place points."""
    with np.errstate(over="ignore"):
        last = np.floor((box[1] - corner) * (np.float32(1.0) / edge)).astype(np.float64)
    counts = [int(min(value, 2.0**62)) + 1 for value in last]
    if max(counts) > MOST_CELLS_ALONG or math.prod(counts) > MOST_CELLS:
        size = " x ".join(f"{float(length):.6g}" for length in box[1].astype(np.float64) - box[0])
        raise UsageError(
            f"cells of {float(edge):.6g} mm: the box of the points, {size} mm, has"
            f" {' x '.join(f'{count:,}' for count in counts)} of them, possible are {MOST_CELLS:,} in all and"
            f" {MOST_CELLS_ALONG:,} along an axis: take larger cells, or remove points that lie far from all others"
        )
    return counts[0], counts[1], counts[2]


def prepare_grid(device: Device) -> Program:
    prepare_sort(device)
    return ocl.load_program(device, "points/grid.cl", {"LANES": device.kernel_variants["LANES"]})


def make_grid(device: Device, points: ArrayLike, edge: float, *, memory: int | None = None) -> PointGrid:
    """Sort at least one point by the cubic cells of a grid, equal on every device: `plan_grid`, then `fill_grid`."""
    return fill_grid(device, plan_grid(points, edge), memory=memory)


def fill_grid(device: Device, plan: GridPlan, *, memory: int | None = None) -> PointGrid:
    """Sort the points of a plan by cells; see `make_grid`."""
    ocl.require_room(ocl.memory_limits(device, memory), plan.needs(device), "the points cannot be sorted by cells")
    program, n = prepare_grid(device), len(plan.points)
    total = plan.total_words
    if device.most_steps is not None and n > device.most_steps // STEPS_A_POINT:
        device.remark(
            f"{device.label} ends the loops of a work-item after {device.most_steps:,} steps and tells nobody: what is"
            " found around points far from all others, or among thousands within a cell, may be wrong; PoCL does not"
        )
    (nx, ny, nz), words = plan.shape, plan.words
    scale = np.float32(1.0) / plan.edge
    grid = {"origin": (*map(float, plan.corner), float(scale)), "n": n, "nx": nx, "ny": ny, "nz": nz, "words": words}
    points_d = ocl.upload(device, plan.points)
    mask_d, ranks_d = ocl.allocate(device, 4 * total), ocl.allocate(device, 4 * total)
    run = ocl.launcher(device, program)
    run("clear_cells", total, mask=mask_d, total=total)
    together = MARKED_TOGETHER if int(device.kernel_variants["LANES"]) > 1 else 1
    run("mark_cells", -(-n // together), points=points_d, mask=mask_d, **grid)
    run("count_marked", total, mask=mask_d, counts=ranks_d, total=total)
    cells = exclusive_scan(device, ranks_d, total, in_place=True).total
    if not 1 <= cells <= n:
        raise DeviceError(f"{device.label} computes wrongly: {n:,} points in {cells:,} cells")
    keys_d = ocl.allocate(device, 4 * n)
    run("number_points", n, points=points_d, mask=mask_d, ranks=ranks_d, keys=keys_d, **grid)
    by_cell = radix_sort(device, keys_d, n, bits=_bits(cells))
    ocl.wait(device)  # what the sort used is free then
    del keys_d
    x_d, y_d, z_d = (ocl.allocate(device, 4 * (n + PADDING)) for _ in range(3))
    starts_d = ocl.allocate(device, 4 * (cells + 1))
    run(
        "gather_points", n,
        points=points_d, keys=by_cell.keys_d, order=by_cell.values_d, x=x_d, y=y_d, z=z_d, starts=starts_d, n=n,
        cells=cells,
    )  # fmt: skip
    origin = plan.base + plan.corner.astype(np.float64)
    return PointGrid(
        device, n, float(plan.edge), origin, plan.base, plan.shape, words, mask_d, ranks_d, cells, starts_d,
        by_cell.values_d, x_d, y_d, z_d,
    )  # fmt: skip
