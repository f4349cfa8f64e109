"""The grid over points equals its twin, whatever the cloud, and says which grids are too large."""

from __future__ import annotations

import numpy as np
import pytest
from point_grids import fetch_grid, scattered_points
from refusals import refused

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.operators.points.grid import (
    CELL_ROUNDING,
    MOST_CELLS,
    MOST_CELLS_ALONG,
    PADDING,
    STEPS_A_POINT,
    fill_grid,
    make_grid,
    plan_grid,
)
from clrecon.points import PointCloud
from clrecon.proof.points import clusters as twin


def check_equal(device, points, edge):
    before = points.copy()
    made, expected = make_grid(device, points, edge), twin.make_grid(points, edge)
    assert (made.n, made.shape, made.words) == (len(points), expected.shape, expected.mask.shape[2])
    assert np.array_equal((made.origin - made.base).astype(np.float32), expected.corner)
    assert made.cells == len(expected.starts) - 1
    for name, array in fetch_grid(made).items():
        np.testing.assert_array_equal(array, getattr(expected, name), err_msg=name)
    assert np.array_equal(points, before)
    return made


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 63, 64, 65, 4097, 20_001])
@pytest.mark.parametrize("edge", [0.37, 1.0, 11.0])
def test_grid_of_scattered_points_equals_the_twin(device, n, edge):
    check_equal(device, scattered_points(n), edge)


@pytest.mark.parametrize("cells", [31, 32, 33, 64, 65])
def test_grid_of_rows_around_whole_words_equals_the_twin(device, cells):
    points = np.zeros((cells, 3), np.float32)
    points[:, 0] = np.random.default_rng(cells).permutation(cells) + 0.5
    made = check_equal(device, points, 1.0)
    assert made.shape == (cells, 1, 1)
    assert made.cells == cells


@pytest.mark.oclgrind
def test_small_grid_of_every_kernel_equals_the_twin(device):
    check_equal(device, scattered_points(700), 2.0)


def test_grid_of_points_on_borders_of_cells_equals_the_twin(device):
    lattice = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3, indexing="ij"), -1).reshape(-1, 3)
    check_equal(device, (0.7 * lattice).astype(np.float32), 0.7)


def test_equal_points_lie_in_one_cell(device):
    made = check_equal(device, np.full((5000, 3), (3.25, -7.5, 11.0), np.float32), 1.0)
    assert made.cells == 1
    assert made.shape == (1, 1, 1)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_far_points_leave_an_empty_grid_between_them(device, axis):
    points = np.zeros((2, 3), np.float32)
    points[1, axis] = 3000.0
    made = check_equal(device, points, 0.5)
    assert made.shape[axis] == 6001
    assert made.cells == 2


def test_points_lie_in_their_cells_but_for_the_rounding(device):
    points = scattered_points(20_000, (900.0, 20.0, 20.0))
    made = make_grid(device, points, 0.21)
    cells = twin.find_cells(points, (made.origin - made.base).astype(np.float32), np.float32(made.edge))
    from_corner = points.astype(np.float64) - made.origin
    slack = CELL_ROUNDING * from_corner
    assert ((from_corner >= made.edge * cells - slack) & (from_corner <= made.edge * (cells + 1) + slack)).all()
    assert (from_corner > 0).all()


def test_far_clouds_are_sorted_relative_to_their_base(device):
    near = scattered_points(3000).astype(np.float64)
    far = near + (100_000.0, -50_000.0, 70_000.0)
    grid = make_grid(device, PointCloud(far), 1.5)
    assert np.array_equal(grid.base, np.rint(grid.base))
    assert np.abs(grid.base - far.mean(axis=0)).max() < 10.0
    found = fetch_grid(grid)
    assert np.abs(found["points"] + grid.base - far[found["order"]]).max() < 2e-6
    shifted = far - grid.base
    assert np.array_equal(found["order"], twin.make_grid(shifted.astype(np.float32), 1.5).order)
    assert np.array_equal(make_grid(device, near, 1.5).base, np.zeros(3))


def test_grids_that_are_too_large_are_refused_with_their_numbers():
    points = np.array([(0, 0, 0), (3000, 2000, 1000)], np.float32)
    with refused(UsageError, 0.5, 3000, 2000, 1000, 6001, 4001, 2001, 2**31, 2**17):
        plan_grid(points, 0.5)
    line = np.array([(0, 0, 0), (MOST_CELLS_ALONG, 0, 0)], np.float32)
    with refused(UsageError, 131_073):
        plan_grid(line, 1.0)
    assert plan_grid(line[:, [1, 0, 2]], 1.00001).shape == (1, MOST_CELLS_ALONG - 1, 1)
    plan = plan_grid(points * np.float32(0.25), 0.72)
    assert np.prod(plan.shape) <= MOST_CELLS
    with refused(UsageError, 1e-36):
        plan_grid(points, 1e-36)


@pytest.mark.parametrize("edge", [0.0, -1.0, np.nan, np.inf, 1e-60])
def test_edges_that_are_no_length_are_refused(edge):
    with pytest.raises(UsageError, match="their edge is a positive number of mm"):
        plan_grid(np.zeros((1, 3), np.float32), edge)


def test_points_that_are_none_are_refused():
    with refused(UsageError, 0, 3):
        plan_grid(np.zeros((0, 3)), 1.0)
    points = scattered_points(1000)
    points[[3, 500], [0, 2]] = np.nan, np.inf
    with refused(UsageError, 2, 1000):
        plan_grid(points, 1.0)


def test_the_forecast_is_refused_before_anything_is_taken(device):
    plan = plan_grid(scattered_points(10_000), 1.0)
    needs = plan.needs(device)
    assert needs["points"] == 120_000
    assert needs["cells of the grid"] == 8 * plan.total_words
    assert needs["sorted points"] <= 28 * 10_000 + 2**20
    with refused(DeviceMemoryError, "points", "cells", 120000):
        fill_grid(device, plan, memory=sum(needs.values()) - 1)
    grid = fill_grid(device, plan, memory=sum(needs.values()))
    assert grid.nbytes <= sum(needs.values())


def test_buffers_are_as_long_as_what_the_kernels_write(device):
    grid = make_grid(device, scattered_points(1000), 0.9)
    words = grid.words * grid.shape[1] * grid.shape[2]
    assert [grid.mask_d.size, grid.ranks_d.size] == [4 * words] * 2
    assert [grid.x_d.size, grid.y_d.size, grid.z_d.size] == [4 * (1000 + PADDING)] * 3
    assert grid.starts_d.size == 4 * (grid.cells + 1)
    buffers = (grid.mask_d, grid.ranks_d, grid.x_d, grid.y_d, grid.z_d, grid.order_d, grid.starts_d)
    assert grid.nbytes == sum(buffer.size for buffer in buffers)


def test_clouds_beyond_the_end_of_loops_alone_are_warned_of(device, monkeypatch):
    told: list[str] = []
    monkeypatch.setattr(device, "most_steps", 1000 * STEPS_A_POINT)
    monkeypatch.setattr(device, "remark", told.append)
    for n in (999, 1000):
        make_grid(device, scattered_points(n), 0.9)
    assert told == []
    make_grid(device, scattered_points(1001), 0.9)
    (text,) = told
    assert f"after {1000 * STEPS_A_POINT:,} steps" in text
