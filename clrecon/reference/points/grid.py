"""Twin of `clrecon.operators.points.grid`."""

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
    """Sort points by cubic cells.

    points: ndarray, shape (n, 3), float32. mm; a cloud that is far from the origin is relative to its base.
    edge: mm, rounded to float32.

    Returns: `points` has shape (n, 3), in the sorted order.
    """
    cell = np.float32(edge)
    corner = (points.min(axis=0).astype(np.float64) - 1e-3 * float(cell)).astype(np.float32)
    x, y, z = find_cells(points, corner, cell).T
    nx, ny, nz = int(x.max()) + 1, int(y.max()) + 1, int(z.max()) + 1
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
