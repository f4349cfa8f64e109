"""The nearest points equal their twin, whatever the cloud, the number of neighbours and the cells."""

from __future__ import annotations

import numpy as np
import pytest
from point_grids import scattered_points
from refusals import refused
from tolerances import TREE_DISTANCE_STEPS
from variants import daily

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.opencl import download
from clrecon.operators.points import neighbours
from clrecon.operators.points.grid import fill_grid, plan_grid
from clrecon.operators.points.neighbours import check_pairs, choose_cell_edge, find_neighbours
from clrecon.points.cloud import PointCloud
from clrecon.proof.points import neighbours as twin

RNG = np.random.default_rng(7)
CLOUDS = {
    "lattice": 0.8 * np.argwhere(np.ones((14, 15, 16))),
    "uneven density": np.r_[RNG.uniform(0, 1, (1500, 3)), RNG.uniform(0, 100, (1500, 3))],
    "each point 20 times": np.repeat(RNG.uniform(0, 20, (100, 3)), 20, axis=0),
    "all equal": np.full((3000, 3), (3.0, -7.0, 11.0)),
    "two places": np.repeat([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]], 700, axis=0),
    "a line": np.c_[np.arange(900.0), np.zeros((900, 2))],
    "far outliers": np.r_[RNG.uniform(0, 10, (1000, 3)), [[900.0, 0, 0], [0, -700, 40], [0, -701, 40]]],
    "a dense spot": np.r_[RNG.normal(0, 0.01, (600, 3)), RNG.normal(0, 20, (600, 3))],
}


def assert_neighbours_equal_twin(device, points, *, k):
    found = find_neighbours(points, k, device=device)
    indices, distances = twin.find_neighbours(np.asarray(points, np.float32), k)
    assert found.indices.dtype == np.int32
    assert found.distances.dtype == np.float32
    assert np.array_equal(found.indices, indices)
    assert np.array_equal(found.distances, distances)


@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 1023, 1025, 4097])
@pytest.mark.parametrize("k", [1, 2, 16, 37])
def test_neighbours_of_scattered_points_equal_the_twin(device, n, k):
    assert_neighbours_equal_twin(device, scattered_points(n), k=min(k, n))


@pytest.mark.every_device
@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("k", daily(1, [1, 16]))
def test_neighbours_of_awkward_clouds_equal_the_twin(device, cloud, k):
    assert_neighbours_equal_twin(device, CLOUDS[cloud], k=k)


def test_most_neighbours_allowed_equal_the_twin(device):
    assert_neighbours_equal_twin(device, scattered_points(900), k=neighbours.MOST_NEIGHBOURS)


@pytest.mark.parametrize("edge", [0.5, 2.0, 9.0, 50.0])
def test_neighbours_in_cells_of_0p5_to_50_mm_equal_the_twin(device, edge, monkeypatch):
    monkeypatch.setattr(neighbours, "choose_cell_edge", lambda points, k: edge)
    assert_neighbours_equal_twin(device, scattered_points(3000), k=16)


def points_of_two_parts(device):
    """A kernel takes a part of a large cloud at a time; devices without long work-items take larger parts."""
    return scattered_points(70_000 if device.has_long_items else 1_100_000)


def test_a_cloud_of_two_parts_has_the_neighbours_of_its_twin(device):
    assert_neighbours_equal_twin(device, points_of_two_parts(device), k=8)


def test_progress_of_neighbours_is_told_after_each_part(device):
    points, told = points_of_two_parts(device), []
    find_neighbours(points, k=8, device=device, progress=lambda *step: told.append(step))
    assert len(told) == 2
    assert told[-1] == ("neighbours", len(points), len(points))


@pytest.mark.oclgrind
def test_neighbours_of_a_small_cloud_with_equal_points_and_an_outlier_equal_the_twin(device):
    points = np.r_[scattered_points(150), np.zeros((30, 3)), [[300.0, 0.0, 0.0]]]
    assert_neighbours_equal_twin(device, points, k=7)


K = 16


@pytest.fixture(scope="module")
def neighbours_and_tree(device):
    """The K nearest of 8000 points, and by scipy's tree K + 1: distances and indices."""
    from scipy.spatial import cKDTree

    points = scattered_points(8000, size=(30.0, 30.0, 30.0))
    exact = points.astype(np.float64)
    return find_neighbours(PointCloud(points), K, device=device), *cKDTree(exact).query(exact, K + 1)


def test_distances_to_neighbours_are_those_of_scipy(neighbours_and_tree):
    found, distances, _ = neighbours_and_tree
    steps = np.spacing(distances[:, :K].astype(np.float32))
    assert np.all(np.abs(found.distances - distances[:, :K]) <= TREE_DISTANCE_STEPS * steps)


def test_neighbours_are_those_of_scipy_where_the_next_one_is_farther(neighbours_and_tree):
    found, distances, indices = neighbours_and_tree
    last, next_one = distances[:, K - 1], distances[:, K]
    clear = next_one - last > 1e-5
    assert clear.mean() > 0.9  # every twentieth point is there twice
    assert np.array_equal(np.sort(found.indices[clear], axis=1), np.sort(indices[clear, :K], axis=1))


@pytest.mark.parametrize("shift", [5000.0, 1e5])
def test_far_clouds_keep_their_neighbours_except_for_rounding(device, shift):
    points = np.round(scattered_points(3000).astype(np.float64), 3)
    near = find_neighbours(points - 2.0, k=16, device=device)
    far = find_neighbours(points + shift, k=16, device=device)
    assert np.mean(near.indices != far.indices) < 1e-3  # equal distances of whole micrometres, rounded otherwise
    assert np.abs(near.distances - far.distances).max() < 1e-4  # of some millimetres in float32


def test_permuted_points_give_permuted_neighbours(device):
    points = RNG.uniform(0, 20, (2000, 3)).astype(np.float32)  # no two distances of a point are equal
    order = RNG.permutation(len(points))
    straight = find_neighbours(points, k=12, device=device)
    permuted = find_neighbours(points[order], k=12, device=device)
    assert np.array_equal(order[permuted.indices], straight.indices[order])
    assert np.array_equal(permuted.distances, straight.distances[order])


def test_fewer_points_than_neighbours_are_each_others_neighbours_with_a_warning(device):
    found = find_neighbours(scattered_points(5), k=16, device=device)
    assert found.indices.shape == (5, 5)
    assert "the cloud has 5 points" in found.warnings[0]


def test_as_many_points_as_neighbours_are_not_warned_of(device):
    assert find_neighbours(scattered_points(5), k=5, device=device).warnings == ()


@pytest.mark.release
def test_a_hundred_thousand_equal_points_have_the_first_sixteen_as_neighbours(device):
    """Each of them would be compared with all: a minute, and a hundred for ten times as many."""
    found = find_neighbours(np.zeros((100_000, 3), np.float32), k=16, device=device)
    assert np.array_equal(found.indices, np.broadcast_to(np.arange(16), (100_000, 16)))
    assert not found.distances.any()


@pytest.fixture(scope="module")
def crowded_grid(device):
    """Five points at one place in one cell, four others in a second and three in a third; points of each cell."""
    apart = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    points = np.concatenate([np.zeros((5, 3)), apart + (10.0, 0.0, 0.0), apart[:3] + (20.0, 0.0, 0.0)])
    grid = fill_grid(device, plan_grid(points, edge=1.0))
    starts = download(device, np.empty(grid.cells + 1, np.uint32), grid.starts_d)
    assert sorted(np.diff(starts).tolist()) == [3, 4, 5]
    return grid, starts


PAIRS_OF_THE_CELL_OF_FOUR = 4 * 4  # equal points are no pairs, and a cell of three is not crowded


def test_pairs_of_a_crowded_cell_up_to_the_most_are_accepted(crowded_grid):
    grid, starts = crowded_grid
    check_pairs(grid, starts, crowded=3, most=PAIRS_OF_THE_CELL_OF_FOUR)


def test_pairs_of_a_crowded_cell_beyond_the_most_are_refused(crowded_grid):
    grid, starts = crowded_grid
    with refused(UsageError, 5, 12, 1):  # the fullest cell, the points, and the cell's edge in mm
        check_pairs(grid, starts, crowded=3, most=PAIRS_OF_THE_CELL_OF_FOUR - 1)


@pytest.mark.parametrize("k", [0, -1, neighbours.MOST_NEIGHBOURS + 1, 2.0, True, None])
def test_wrong_numbers_of_neighbours_are_refused(device, k):
    with refused(UsageError, 1, neighbours.MOST_NEIGHBOURS):
        find_neighbours(np.zeros((3, 3)), k, device=device)


def test_neighbours_in_an_empty_cloud_are_refused(device):
    with refused(UsageError, "cloud"):
        find_neighbours(np.zeros((0, 3)), device=device)


def test_neighbours_of_points_that_are_not_finite_are_refused_with_number_and_first(device):
    with refused(UsageError, 2, 4, 1):
        find_neighbours([[0, 0, 0], [0, np.nan, 0], [1, 1, 1], [np.inf, 0, 0]], device=device)


def test_neighbours_in_a_spot_of_a_million_points_among_far_ones_are_refused(device):
    """Cells for points 200 m apart hold the whole spot: a million times a million pairs."""
    crowded = np.r_[RNG.normal(0, 1e-3, (1_010_000, 3)), RNG.uniform(-1e5, 1e5, (50, 3))]
    with refused(UsageError, "points", "pairs", 1_010_000):
        find_neighbours(crowded, device=device)


def test_too_little_memory_for_a_search_for_neighbours_is_refused(device):
    with refused(DeviceMemoryError, 10_000, "points"):
        find_neighbours(scattered_points(10_000), k=16, device=device, memory=500_000)


def clouds_of_30_000_points(seed):
    """In a cube, and in a sheet of 0.05 mm; and the sheet with 2,000 more at the origin."""
    rng = np.random.default_rng(seed)
    box = rng.uniform(0, 60, (30_000, 3))
    sheet = np.c_[rng.uniform(0, 90, (30_000, 2)), rng.normal(0, 0.05, 30_000)]
    return {"box": box, "sheet": sheet, "sheet with a dense spot": np.r_[sheet, np.zeros((2000, 3))]}


@pytest.mark.parametrize("k", [4, 16, 40])
@pytest.mark.parametrize("cloud", ["box", "sheet", "sheet with a dense spot"])
def test_27_cells_around_a_point_hold_about_5p6_candidates_for_each_neighbour(cloud, k):
    points = clouds_of_30_000_points(k)[cloud]
    edge = choose_cell_edge(points, k)
    cells = np.floor(points / edge).astype(int)
    any_point = 15_000  # of the box or the sheet
    candidates = (np.abs(cells - cells[any_point]) <= 1).all(axis=1).sum()
    wanted = max(40, 5.6 * k)  # by which the edge is chosen: measured to be the quickest, and no fewer than 40
    assert 0.5 < candidates / wanted < 2.0  # of one point: measured 0.6 to 1.6
