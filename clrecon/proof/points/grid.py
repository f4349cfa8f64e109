"""Twins of grids over points, and of what their cells decide: thinning and sparse cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class GridTwin:
    """The arrays of a grid: names and contents are those of `clrecon.operators.points.grid.PointGrid`."""

    corner: NDArray[np.float32]
    shape: tuple[int, int, int]
    mask: NDArray[np.uint32]
    ranks: NDArray[np.uint32]
    starts: NDArray[np.uint32]
    order: NDArray[np.uint32]
    points: NDArray[np.float32]


def find_cells(points: NDArray[np.float32], corner: NDArray[np.float32], edge: np.float32) -> NDArray[np.int64]:
    """Return the cell (x, y, z) of each point, in the arithmetic of float32."""
    return ((points - corner) * (np.float32(1.0) / edge)).astype(np.int64)


def make_grid(points: NDArray[np.float32], edge: float) -> GridTwin:
    """Sort points, (n, 3) float32, mm from the base of a far cloud, by cubic cells; the edge is rounded to float32."""
    cell = np.float32(edge)
    corner = (points.min(axis=0).astype(np.float64) - 1e-3 * float(cell)).astype(np.float32)
    x, y, z = find_cells(points, corner, cell).T
    nx, ny, nz = (int(axis.max()) + 1 for axis in (x, y, z))
    words = -(-nx // 32)
    has_points = np.zeros((nz, ny, 32 * words), dtype=bool)
    has_points[z, y, x] = True
    bits = np.packbits(has_points.reshape(-1, 32), axis=1, bitorder="little")
    mask = bits.view("<u4").astype(np.uint32).reshape(nz, ny, words)
    counts = has_points.reshape(-1, 32).sum(axis=1)
    ranks = (np.cumsum(counts) - counts).astype(np.uint32).reshape(nz, ny, words)
    linear = (z * ny + y) * 32 * words + x
    order = np.argsort(linear, kind="stable")
    starts = np.append(np.unique(linear[order], return_index=True)[1], len(points))
    return GridTwin(corner, (nx, ny, nz), mask, ranks, starts.astype(np.uint32), order.astype(np.uint32), points[order])


def choose_points(points: NDArray[np.float32], spacing: float) -> NDArray[np.uint32]:
    """Return the point nearest to the mean of each cell with an edge of `spacing` mm, in the order of the cells."""
    grid = make_grid(points, spacing)
    chosen = []
    for begin, end in zip(grid.starts[:-1], grid.starts[1:], strict=True):
        places = grid.points[begin:end] - grid.points[begin]
        total = np.cumsum(places, axis=0, dtype=np.float32)[-1]
        dx, dy, dz = (np.float32(len(places)) * places - total).T
        chosen.append(grid.order[begin + np.argmin(dx * dx + dy * dy + dz * dz)])
    return np.array(chosen, dtype=np.uint32)


def grow_cells(
    points: NDArray[np.float32], edge: float, fewest: int, threshold: int, largest: bool
) -> NDArray[np.uint8]:
    """Say of each point: 0 kept, 1 in a cell with few points, 2 not reached by growth, 3 in a smaller component."""
    from scipy import ndimage

    grid = make_grid(points, edge)
    nx, ny, nz = grid.shape
    counts = np.zeros((nz, ny, nx), dtype=np.int64)
    x, y, z = find_cells(points, grid.corner, np.float32(edge)).T
    np.add.at(counts, (z, y, x), 1)
    parts, number = ndimage.label(counts >= fewest, np.ones((3, 3, 3), bool))
    kinds = np.full(number + 1, 2, dtype=np.uint8)
    kinds[np.unique(parts[counts >= max(threshold, fewest)])] = 0
    kinds[0] = 1
    if largest and (kinds == 0).any():
        cells = np.bincount(parts.reshape(-1), minlength=number + 1)
        held = np.bincount(parts.reshape(-1), weights=counts.reshape(-1), minlength=number + 1)
        best = max(np.flatnonzero(kinds == 0), key=lambda part: (cells[part], held[part], -part))
        kinds[(kinds == 0) & (np.arange(number + 1) != best)] = 3
    return kinds[parts[z, y, x]]
