"""Sparse cells, growth and the largest component equal the twin's, and paper B's equations are those of the grid."""

from __future__ import annotations

import numpy as np
import pytest
from point_grids import fetch_grid, scattered_points
from refusals import refused

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.operators.points.grid import make_grid, plan_grid
from clrecon.operators.points.neighbours import find_neighbours
from clrecon.operators.points.thinning import REASONS, choose_edge, grow_cells, remove_sparse_cells
from clrecon.points import PointCloud
from clrecon.points.spacing import count_cells, find_cell_numbers
from clrecon.proof.points import clusters as twin


@pytest.mark.parametrize("n", [20, 64, 4097])
@pytest.mark.parametrize(("fewest", "threshold"), [(1, 1), (2, 2), (2, 5), (3, 2), (4, 9)])
@pytest.mark.parametrize("largest", [False, True])
def test_sparse_cells_mark_each_point_as_the_twin_does(device, n, fewest, threshold, largest):
    points = scattered_points(n, (30.0, 20.0, 10.0), seed=n)
    edge = 1.15 * (6000.0 / n) ** (1 / 3)
    grown = grow_cells(device, plan_grid(points, edge), fewest, threshold, largest)
    assert np.array_equal(grown.removed, twin.grow_cells(points, edge, fewest, threshold, largest))


@pytest.mark.oclgrind
def test_sparse_cells_of_a_small_cloud_equal_the_twin(device):
    points = scattered_points(600, (20.0, 14.0, 9.0))
    grown = grow_cells(device, plan_grid(points, 1.5), 2, 3, True)
    assert set(np.unique(grown.removed)) == {0, 1, 2, 3}
    assert np.array_equal(grown.removed, twin.grow_cells(points, 1.5, 2, 3, True))


def blob(n: int, centre: tuple[float, float, float], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(centre, 2.0, (n, 3)).astype(np.float32)


def test_far_noise_goes_and_bone_stays(device):
    """1 % of far outliers, and two pieces of bone that stand apart."""
    bone = np.concatenate([blob(9000, (0, 0, 0), 1), blob(4000, (30, 0, 0), 2)])
    noise = np.random.default_rng(3).uniform(-150, 150, (130, 3)).astype(np.float32)
    cloud = PointCloud(np.concatenate([bone, noise]))
    step = remove_sparse_cells(cloud, device=device)
    assert (step.removed[len(bone) :] == 1).mean() >= 0.99
    assert (step.removed[: len(bone)] > 0).mean() < 0.06
    assert step.facts["edge_is_default"]
    assert step.warnings == ()
    assert not (step.removed == 3).any()
    assert step.counts["sparse cell"] == (step.removed == 1).sum()


def test_the_largest_is_kept_on_request_alone_and_says_what_went(device):
    cloud = PointCloud(np.concatenate([blob(3000, (30, 0, 0), 2), blob(9000, (0, 0, 0), 1)]))
    step = remove_sparse_cells(cloud, 1.5, keep_largest=True, device=device)
    taken = step.counts["smaller component"]
    assert taken >= 2500
    assert (step.removed[:3000] > 0).all()
    assert step.facts["largest_component"]["points"] == len(step.cloud)
    (warning,) = step.warnings
    assert warning.startswith(f"the largest component keeps {len(step.cloud):,} points; {taken:,} in ")
    assert "bone that stands apart" in warning


def test_ties_go_to_more_points_and_then_to_the_first(device):
    rods = [np.array([(x + 0.5, y, 0.5) for x in (0, 1, 2) for _ in range(count)]) for y, count in
            ((0.5, 2), (10.5, 3), (20.5, 3))]  # fmt: skip
    points = np.concatenate(rods).astype(np.float32)
    grown = grow_cells(device, plan_grid(points, 1.0), 2, 2, True)
    assert (grown.removed == np.repeat([3, 0, 3], [6, 9, 9])).all()
    assert grown.facts["components"] == 3


def test_the_default_edge_is_twice_the_median_distance_to_the_sixteenth(device):
    points = scattered_points(3000)
    farthest = find_neighbours(points, 16, device=device).distances[:, 15]
    edge = choose_edge(PointCloud(points), device=device)
    assert edge == pytest.approx(2.0 * np.median(farthest))
    step = remove_sparse_cells(points, device=device)
    assert step.facts["edge_mm"] == pytest.approx(edge)
    assert 5.0 < step.facts["points_a_cell"] < 40.0


def test_the_equations_give_the_cells_of_the_grid(device):
    """Equations 1 and 2 of paper B, with one origin in both."""
    points, edge = scattered_points(4000), 1.75
    counts, numbers = count_cells(points, edge), find_cell_numbers(points, edge)
    grid = make_grid(device, points, edge)
    assert all(0 <= a - b <= 1 for a, b in zip(counts, grid.shape, strict=True))
    assert len(np.unique(numbers)) == grid.cells
    order = np.argsort(numbers, kind="stable")
    found = fetch_grid(grid)
    assert np.array_equal(order, found["order"])
    margin = 1e-3 * edge
    low, high = points.astype(np.float64).min(axis=0) - margin, points.astype(np.float64).max(axis=0) + margin
    assert counts == tuple(int(value) + 1 for value in (high - low) / edge)
    a, b, c = np.floor((points[17] - low) / edge)
    assert numbers[17] == a + counts[0] * (b + counts[1] * c)


def test_cells_below_the_spacing_are_refused(device):
    lattice = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    words = "all 512 points would go: 512 of 512 cells of 0.6 mm have fewer than 2 points"
    with pytest.raises(UsageError, match=words):
        remove_sparse_cells(lattice, 0.6, device=device)
    with pytest.raises(UsageError, match="all 1 points would go"):
        remove_sparse_cells(lattice[:1], 1.0, device=device)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"edge": 0.0}, "an edge of .*: a positive length in mm is needed"),
        ({"edge": -1.0}, "an edge of -1.0: a positive length in mm is needed"),
        ({"edge": -1}, "an edge of -1: a positive length in mm is needed"),
        ({"edge": np.nan}, "an edge of .*: a positive length in mm is needed"),
        ({"edge": 1.0, "fewest": 0}, "fewest=.*: a whole number of points from 1 on is needed"),
        ({"edge": 1.0, "threshold": 1.5}, "threshold=.*: a whole number of points from 1 on is needed"),
        ({"edge": 1e-5}, "take larger cells"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(device, given, words):
    with pytest.raises(UsageError, match=words):
        remove_sparse_cells(scattered_points(100), device=device, **given)


def test_clouds_that_cannot_be_used_are_refused(device):
    with refused(UsageError, "cloud", "cells"):
        remove_sparse_cells(np.zeros((0, 3)), 1.0)
    with refused(UsageError, 100, 15):
        remove_sparse_cells(np.zeros((100, 3)), device=device)
    with refused(DeviceMemoryError, "cells", 3, 50000):
        remove_sparse_cells(scattered_points(50_000), 1.0, device=device, memory=1_000_000)


def test_reasons_are_those_of_the_marks(device):
    step = remove_sparse_cells(scattered_points(600, (20.0, 14.0, 9.0)), 1.5, 2, 3, keep_largest=True, device=device)
    assert step.reasons == REASONS
    assert list(step.counts.values()) == [int((step.removed == number).sum()) for number in (1, 2, 3)]
    assert len(step.cloud) == (step.removed == 0).sum()
