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
from clrecon.points.cloud import PointCloud
from clrecon.proof.points import clusters as twin


def assert_grid_equals_twin(device, points, *, edge):
    """All arrays of the grid equal those of the twin; return the grid."""
    grid, expected = make_grid(device, points, edge), twin.make_grid(points, edge)
    assert (grid.n, grid.shape, grid.words) == (len(points), expected.shape, expected.mask.shape[2])
    assert np.array_equal((grid.origin - grid.base).astype(np.float32), expected.corner)
    assert grid.cells == len(expected.starts) - 1
    for name, array in fetch_grid(grid).items():
        np.testing.assert_array_equal(array, getattr(expected, name), err_msg=name)
    return grid


def test_making_a_grid_leaves_the_points_as_they_are(device):
    points = scattered_points(4097)
    before = points.copy()
    make_grid(device, points, edge=1.0)
    assert np.array_equal(points, before)


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 63, 64, 65, 4097, 20_001])
@pytest.mark.parametrize("edge", [0.37, 1.0, 11.0])
def test_grid_of_scattered_points_equals_the_twin(device, n, edge):
    assert_grid_equals_twin(device, scattered_points(n), edge=edge)


@pytest.mark.parametrize("cells", [31, 32, 33, 64, 65])
def test_grid_of_rows_around_whole_words_equals_the_twin(device, cells):
    """A point in each cell of one row; a word marks 32 cells."""
    points = np.zeros((cells, 3), np.float32)
    points[:, 0] = np.random.default_rng(cells).permutation(cells) + 0.5
    grid = assert_grid_equals_twin(device, points, edge=1.0)
    assert grid.shape == (cells, 1, 1)
    assert grid.cells == cells


@pytest.mark.oclgrind
def test_grid_of_a_small_cloud_equals_the_twin(device):
    assert_grid_equals_twin(device, scattered_points(700), edge=2.0)


def test_grid_of_points_on_borders_of_cells_equals_the_twin(device):
    lattice = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3, indexing="ij"), -1).reshape(-1, 3)
    assert_grid_equals_twin(device, (0.7 * lattice).astype(np.float32), edge=0.7)


def test_equal_points_lie_in_one_cell(device):
    grid = assert_grid_equals_twin(device, np.full((5000, 3), (3.25, -7.5, 11.0), np.float32), edge=1.0)
    assert grid.cells == 1
    assert grid.shape == (1, 1, 1)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_far_points_leave_an_empty_grid_between_them(device, axis):
    points = np.zeros((2, 3), np.float32)
    points[1, axis] = 3000.0
    grid = assert_grid_equals_twin(device, points, edge=0.5)
    assert grid.shape[axis] == 3000 / 0.5 + 1
    assert grid.cells == 2  # with points


def test_points_lie_in_their_cells_except_for_the_rounding_of_float32(device):
    points = scattered_points(20_000, size=(900.0, 20.0, 20.0))
    grid = make_grid(device, points, edge=0.21)
    cells = twin.find_cells(points, (grid.origin - grid.base).astype(np.float32), np.float32(grid.edge))
    from_origin = points.astype(np.float64) - grid.origin
    assert (from_origin > 0).all()
    rounding = CELL_ROUNDING * from_origin
    assert (from_origin >= grid.edge * cells - rounding).all()
    assert (from_origin <= grid.edge * (cells + 1) + rounding).all()


SHIFT = np.array((100_000.0, -50_000.0, 70_000.0))  # mm
EDGE_OF_FAR = 1.5


@pytest.fixture(scope="module")
def far_grid(device):
    """A cloud 130 m from the origin, and its grid."""
    far = scattered_points(3000).astype(np.float64) + SHIFT
    return far, make_grid(device, PointCloud(far), EDGE_OF_FAR)


def test_base_of_a_far_grid_is_whole_millimetres_within_its_points(far_grid):
    far, grid = far_grid
    assert np.array_equal(grid.base, np.rint(grid.base))
    assert (far.min(axis=0) < grid.base).all()
    assert (grid.base < far.max(axis=0)).all()


def test_points_of_a_far_grid_and_its_base_are_the_cloud(far_grid):
    far, grid = far_grid
    found = fetch_grid(grid)
    step_of_float32 = np.spacing(np.float32(20.0))  # as far as points lie from their base, mm
    assert np.abs(found["points"] + grid.base - far[found["order"]]).max() <= step_of_float32


def test_points_of_a_far_grid_are_sorted_as_those_relative_to_its_base(far_grid):
    far, grid = far_grid
    expected = twin.make_grid((far - grid.base).astype(np.float32), EDGE_OF_FAR)
    assert np.array_equal(fetch_grid(grid)["order"], expected.order)


def test_base_of_a_grid_around_the_origin_is_the_origin(device):
    assert np.array_equal(make_grid(device, scattered_points(3000), edge=1.5).base, np.zeros(3))


CORNERS = np.array([(0, 0, 0), (3000, 2000, 1000)], np.float32)
LINE = np.array([(0, 0, 0), (MOST_CELLS_ALONG, 0, 0)], np.float32)  # one mm too long for cells of 1 mm


def test_grid_of_too_many_cells_is_refused_with_extent_cells_and_limits():
    with refused(UsageError, 0.5, 3000, 2000, 1000, 6001, 4001, 2001, MOST_CELLS, MOST_CELLS_ALONG):
        plan_grid(CORNERS, edge=0.5)


def test_grid_of_fewer_than_the_most_cells_is_planned():
    cells = np.prod(plan_grid(CORNERS * np.float32(0.25), edge=0.72).shape)  # 750 x 500 x 250 mm / 0.72^3 = 2.5e8
    assert 2e8 < cells <= MOST_CELLS


def test_grid_of_too_many_cells_along_an_axis_is_refused_with_their_number():
    with refused(UsageError, MOST_CELLS_ALONG + 1):
        plan_grid(LINE, edge=1.0)


def test_grid_of_as_many_cells_along_an_axis_as_allowed_is_planned():
    along_y = LINE[:, [1, 0, 2]]
    along_y[1, 1] -= 0.5  # mm, of cells of 1 mm
    assert plan_grid(along_y, edge=1.0).shape == (1, MOST_CELLS_ALONG, 1)


def test_grid_of_cells_so_small_that_their_number_overflows_is_refused():
    with refused(UsageError, 1e-36, MOST_CELLS):
        plan_grid(CORNERS, edge=1e-36)


@pytest.mark.parametrize("edge", [0.0, -1.0, np.nan, np.inf, 1e-60])
def test_edges_that_are_no_length_are_refused(edge):
    with pytest.raises(UsageError, match="their edge is a positive number of mm"):
        plan_grid(np.zeros((1, 3), np.float32), edge)


def test_grid_of_no_points_is_refused():
    with refused(UsageError, 0, 3):
        plan_grid(np.zeros((0, 3)), edge=1.0)


def test_grid_of_points_that_are_not_finite_is_refused_with_their_number():
    points = scattered_points(1000)
    points[[3, 500], [0, 2]] = np.nan, np.inf
    with refused(UsageError, 2, 1000):
        plan_grid(points, edge=1.0)


def test_needs_of_a_grid_are_the_bytes_of_its_points_and_cells(device):
    plan = plan_grid(scattered_points(10_000), edge=1.0)
    needs = plan.needs(device)
    assert needs["points"] == 10_000 * 3 * 4
    assert needs["cells of the grid"] == 2 * 4 * plan.total_words  # a mask, and the cells before each word
    gathered = (3 + 1 + 2) * 4 * 10_000  # places, order and keys
    assert gathered <= needs["sorted points"] <= gathered + 2**20  # tables of the sort, by the cores of the device


def test_grid_is_refused_with_a_byte_less_than_it_needs(device):
    plan = plan_grid(scattered_points(10_000), edge=1.0)
    point_bytes = 10_000 * 3 * 4
    with refused(DeviceMemoryError, "points", "cells", point_bytes):
        fill_grid(device, plan, memory=sum(plan.needs(device).values()) - 1)


def test_grid_fits_into_the_bytes_it_needs(device):
    plan = plan_grid(scattered_points(10_000), edge=1.0)
    needed = sum(plan.needs(device).values())
    assert fill_grid(device, plan, memory=needed).nbytes <= needed


def test_buffers_of_a_grid_are_as_long_as_what_the_kernels_write(device):
    grid = make_grid(device, scattered_points(1000), edge=0.9)
    words = grid.words * grid.shape[1] * grid.shape[2]
    assert [grid.mask_d.size, grid.ranks_d.size] == [4 * words] * 2
    assert [grid.x_d.size, grid.y_d.size, grid.z_d.size] == [4 * (1000 + PADDING)] * 3
    assert grid.starts_d.size == 4 * (grid.cells + 1)


def test_bytes_of_a_grid_are_those_of_its_buffers(device):
    grid = make_grid(device, scattered_points(1000), edge=0.9)
    buffers = (grid.mask_d, grid.ranks_d, grid.x_d, grid.y_d, grid.z_d, grid.order_d, grid.starts_d)
    assert grid.nbytes == sum(buffer.size for buffer in buffers)


@pytest.mark.parametrize(("n", "warned"), [(999, False), (1000, False), (1001, True)])
def test_clouds_of_more_points_than_the_loops_of_a_device_can_take_are_warned_of(device, monkeypatch, n, warned):
    most_steps = 1000 * STEPS_A_POINT
    told: list[str] = []
    monkeypatch.setattr(device, "most_steps", most_steps)
    monkeypatch.setattr(device, "remark", told.append)
    make_grid(device, scattered_points(n), edge=0.9)
    assert [f"after {most_steps:,} steps" in text for text in told] == [True] * warned
