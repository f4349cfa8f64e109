"""Grids over points that tests read back, and clouds with awkward places."""

from __future__ import annotations

from typing import Any

import numpy as np

from clrecon.opencl import download


def fetch_grid(grid: Any) -> dict[str, np.ndarray]:
    """All arrays of a `PointGrid`, by the names of the twin; `points` has shape (n, 3), in the sorted order."""

    def fetch(buffer: Any, n: int, dtype: type) -> np.ndarray:
        return download(grid.device, np.empty(n, dtype), buffer)

    nx, ny, nz = grid.shape
    rows = (nz, ny, grid.words)
    return {
        "mask": fetch(grid.mask_d, int(np.prod(rows)), np.uint32).reshape(rows),
        "ranks": fetch(grid.ranks_d, int(np.prod(rows)), np.uint32).reshape(rows),
        "starts": fetch(grid.starts_d, grid.cells + 1, np.uint32),
        "order": fetch(grid.order_d, grid.n, np.uint32),
        "points": np.column_stack([fetch(part, grid.n, np.float32) for part in (grid.x_d, grid.y_d, grid.z_d)]),
    }


def scattered_points(n: int, *, size: tuple[float, float, float] = (40.0, 25.0, 30.0), seed: int = 1) -> np.ndarray:
    """Random points in a box around the origin, some of them equal, float32 mm."""
    rng = np.random.default_rng(seed)
    points = ((rng.random((n, 3)) - 0.5) * size).astype(np.float32)
    points[n // 2 : n // 2 + n // 20] = points[: n // 20]
    return points
