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
from clrecon.points import PointCloud
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


def check_equal(device, points, k):
    found = find_neighbours(points, k, device=device)
    indices, distances = twin.find_neighbours(np.asarray(points, np.float32), k)
    assert found.indices.dtype == np.int32
    assert found.distances.dtype == np.float32
    assert np.array_equal(found.indices, indices)
    assert np.array_equal(found.distances, distances)
    return found


@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 1023, 1025, 4097])
@pytest.mark.parametrize("k", [1, 2, 16, 37])
def test_neighbours_of_scattered_points_equal_the_twin(device, n, k):
    check_equal(device, scattered_points(n), min(k, n))


@pytest.mark.every_device
@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("k", daily(1, [1, 16]))
def test_neighbours_of_awkward_clouds_equal_the_twin(device, cloud, k):
    check_equal(device, CLOUDS[cloud], k)


def test_most_neighbours_allowed_equal_the_twin(device):
    check_equal(device, scattered_points(900), neighbours.MOST_NEIGHBOURS)


@pytest.mark.parametrize("edge", [0.5, 2.0, 9.0, 50.0])
def test_neighbours_are_the_same_in_cells_of_any_size(device, edge, monkeypatch):
    monkeypatch.setattr(neighbours, "choose_cell_edge", lambda points, k: edge)
    check_equal(device, scattered_points(3000), 16)


def test_a_cloud_of_several_parts_has_the_neighbours_of_its_twin_and_tells_each_part(device):
    count = 70_000 if device.has_long_items else 1_100_000
    told = []
    find_neighbours(scattered_points(count), 8, device=device, progress=lambda *step: told.append(step))
    assert len(told) == 2 and told[-1] == ("neighbours", count, count)
    check_equal(device, scattered_points(count), 8)


@pytest.mark.oclgrind
def test_neighbours_of_a_small_cloud_equal_the_twin_on_every_way(device):
    points = np.r_[scattered_points(150), np.zeros((30, 3)), [[300.0, 0.0, 0.0]]]
    check_equal(device, points, 7)


def test_distances_are_those_of_a_tree(device):
    from scipy.spatial import cKDTree

    points = scattered_points(8000, (30.0, 30.0, 30.0))
    found = find_neighbours(PointCloud(points), 16, device=device)
    exact, numbers = cKDTree(points.astype(np.float64)).query(points.astype(np.float64), 17)
    steps = np.spacing(exact[:, :16].astype(np.float32))
    assert np.all(np.abs(found.distances - exact[:, :16]) <= TREE_DISTANCE_STEPS * steps)
    clear = exact[:, 16] - exact[:, 15] > 1e-5
    assert clear.mean() > 0.9  # every twentieth point is there twice
    assert np.array_equal(np.sort(found.indices[clear], axis=1), np.sort(numbers[clear, :16], axis=1))


@pytest.mark.parametrize("shift", [5000.0, 1e5])
def test_far_clouds_keep_their_neighbours(device, shift):
    points = np.round(scattered_points(3000).astype(np.float64), 3)
    near = find_neighbours(points - 2.0, 16, device=device)
    far = find_neighbours(points + shift, 16, device=device)
    assert np.mean(near.indices != far.indices) < 1e-3
    assert np.abs(near.distances - far.distances).max() < 1e-4
    assert near.distances.max() > 1.0


def test_permuted_points_give_permuted_neighbours(device):
    points = RNG.uniform(0, 20, (2000, 3)).astype(np.float32)  # no two distances of a point are equal
    order = RNG.permutation(len(points))
    straight, permuted = find_neighbours(points, 12, device=device), find_neighbours(points[order], 12, device=device)
    assert np.array_equal(order[permuted.indices], straight.indices[order])
    assert np.array_equal(permuted.distances, straight.distances[order])


def test_fewer_points_than_neighbours_are_said(device):
    found = find_neighbours(scattered_points(5), 16, device=device)
    assert found.indices.shape == (5, 5)
    assert "the cloud has 5 points" in found.warnings[0]
    assert find_neighbours(scattered_points(5), 5, device=device).warnings == ()


@pytest.mark.release
def test_a_million_equal_points_do_not_take_the_square(device):
    """Each of them would be compared with all: a minute."""
    found = find_neighbours(np.zeros((100_000, 3), np.float32), 16, device=device)
    assert np.array_equal(found.indices, np.broadcast_to(np.arange(16), (100_000, 16)))
    assert not found.distances.any()


def test_equal_points_in_a_crowded_cell_are_no_pairs(device):
    """Five points at one place, four others in one cell, three in a third, which is not crowded: 16 pairs."""
    apart = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    points = np.concatenate([np.zeros((5, 3)), apart + (10.0, 0.0, 0.0), apart[:3] + (20.0, 0.0, 0.0)])
    grid = fill_grid(device, plan_grid(points, 1.0))
    starts = download(device, np.empty(grid.cells + 1, np.uint32), grid.starts_d)
    assert sorted(np.diff(starts).tolist()) == [3, 4, 5]
    check_pairs(grid, starts, crowded=3, most=16)
    with refused(UsageError, 5, 12, 1):
        check_pairs(grid, starts, crowded=3, most=15)


@pytest.mark.parametrize("k", [0, -1, 129, 2.0, True, None])
def test_wrong_numbers_of_neighbours_are_refused(device, k):
    with refused(UsageError, 1, 128):
        find_neighbours(np.zeros((3, 3)), k, device=device)


def test_clouds_that_cannot_be_searched_are_refused(device):
    with refused(UsageError, "cloud"):
        find_neighbours(np.zeros((0, 3)), device=device)
    with refused(UsageError, 2, 4, 1):
        find_neighbours([[0, 0, 0], [0, np.nan, 0], [1, 1, 1], [np.inf, 0, 0]], device=device)
    crowded = np.r_[RNG.normal(0, 1e-3, (1_010_000, 3)), RNG.uniform(-1e5, 1e5, (50, 3))]
    with refused(UsageError, "points", "pairs", 1_010_000):
        find_neighbours(crowded, device=device)


def test_memory_of_a_search_for_neighbours_is_forecast(device):
    with refused(DeviceMemoryError, 10000, "points"):
        find_neighbours(scattered_points(10_000), 16, device=device, memory=500_000)


@pytest.mark.parametrize("k", [4, 16, 40])
def test_cells_hold_about_as_many_candidates_as_they_should(k):
    rng = np.random.default_rng(k)
    flat = np.c_[rng.uniform(0, 90, (30_000, 2)), rng.normal(0, 0.05, 30_000)]
    for points in (rng.uniform(0, 60, (30_000, 3)), flat, np.r_[flat, np.zeros((2000, 3))]):
        edge = choose_cell_edge(points, k)
        cells = np.floor(points / edge).astype(int)
        middle = (cells == cells[15_000]).all(axis=1)
        around = (np.abs(cells - cells[15_000]) <= 1).all(axis=1)
        assert middle.any()
        assert 0.5 < around.sum() / max(40, 5.6 * k) < 2.0
