"""Checks of what is made of clouds of points: the grid, the nearest points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.jobs.selftest.check import Check, require_equal
from clrecon.opencl import Device, download
from clrecon.operators.points.grid import make_grid
from clrecon.operators.points.neighbours import find_neighbours
from clrecon.reference.points import grid as grid_twin
from clrecon.reference.points import neighbours as neighbours_twin


def scattered_points(n: int) -> NDArray[np.float32]:
    """Return points in a box of 60 x 40 x 30 mm, one in twenty of them twice."""
    points = np.random.default_rng(23).random((n, 3), np.float32) * np.array([60, 40, 30], np.float32)
    points[n // 2 : n // 2 + n // 20] = points[: n // 20]
    return points


def _check_grid(device: Device) -> str:
    points = scattered_points(20_000)
    for edge in (0.5, 2.3):
        made, twin = make_grid(device, points, edge), grid_twin.make_grid(points, edge)
        what = f"of a grid of {edge} mm"
        require_equal(made.cells, len(twin.starts) - 1, f"the number of cells {what}")
        for name, buffer, expected in (
            ("mask", made.mask_d, twin.mask),
            ("ranks", made.ranks_d, twin.ranks),
            ("starts", made.starts_d, twin.starts),
            ("order", made.order_d, twin.order),
            *zip("xyz", (made.x_d, made.y_d, made.z_d), twin.points.T, strict=True),
        ):
            found = download(device, np.empty(expected.shape, expected.dtype), buffer)
            require_equal(found, expected, f"{name} {what}")
    return "2 grids over 20,000 points equal"


def _check_neighbours(device: Device) -> str:
    """Compare neighbours of scattered points with far ones, a crowd and many at one place, and of a lattice."""
    scattered = scattered_points(6_000)
    scattered[:500] *= 0.01
    scattered[500:540] = scattered[0]
    scattered[540:545] += np.float32(40.0)  # not farther: rows of cells are steps too, and llvmpipe ends long loops
    lattice = np.argwhere(np.ones((20, 20, 20))).astype(np.float32)
    many = scattered_points(30_000)  # in some 15,000 cells, of which a work-item takes 16
    for points, k in ((scattered, 16), (scattered, 5), (lattice, 16), (many, 2)):
        found = find_neighbours(points, k, device=device)
        indices, distances = neighbours_twin.find_neighbours(points, k)
        require_equal(found.indices, indices, f"{k} nearest of {len(points):,} points")
        require_equal(found.distances, distances, f"distances of the {k} nearest of {len(points):,} points")
    return "2 to 16 neighbours of up to 30,000 points equal"


CHECKS = (
    Check(
        "grid of points", ("clear_cells", "mark_cells", "count_marked", "number_points", "gather_points"), _check_grid
    ),
    Check("nearest points", ("list_neighbours",), _check_neighbours),
)
