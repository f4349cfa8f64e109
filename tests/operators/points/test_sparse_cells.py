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
from clrecon.points.cloud import PointCloud
from clrecon.points.spacing import count_cells, find_cell_numbers
from clrecon.proof.points import clusters as twin


@pytest.mark.parametrize("n", [20, 64, 4097])
@pytest.mark.parametrize(("fewest", "threshold"), [(1, 1), (2, 2), (2, 5), (3, 2), (4, 9)])
@pytest.mark.parametrize("keep_largest", [False, True])
def test_sparse_cells_mark_each_point_as_the_twin_does(device, n, fewest, threshold, keep_largest):
    points = scattered_points(n, size=(30.0, 20.0, 10.0), seed=n)
    edge = 1.15 * (30.0 * 20.0 * 10.0 / n) ** (1 / 3)  # cells of some 1.5 points
    rules = {"fewest": fewest, "threshold": threshold, "largest": keep_largest}
    grown = grow_cells(device, plan_grid(points, edge), **rules)
    assert np.array_equal(grown.removed, twin.grow_cells(points, edge, **rules))


@pytest.mark.oclgrind
def test_sparse_cells_of_a_small_cloud_equal_the_twin(device):
    points = scattered_points(600, size=(20.0, 14.0, 9.0))
    rules = {"fewest": 2, "threshold": 3, "largest": True}
    grown = grow_cells(device, plan_grid(points, edge=1.5), **rules)
    assert set(np.unique(grown.removed)) == {0, *range(1, len(REASONS) + 1)}, "the cloud has no points of some reason"
    assert np.array_equal(grown.removed, twin.grow_cells(points, edge=1.5, **rules))


def blob(n: int, *, centre: tuple[float, float, float], seed: int) -> np.ndarray:
    """Points of a normal distribution of 2 mm along each axis, (n, 3) float32."""
    return np.random.default_rng(seed).normal(centre, 2.0, (n, 3)).astype(np.float32)


SPARSE_CELL, SMALLER_COMPONENT = REASONS.index("sparse cell") + 1, REASONS.index("smaller component") + 1


@pytest.fixture(scope="module")
def bone_in_noise(device):
    """How many points are of two pieces of bone that stand apart, before 1 % of far noise, and the step over all."""
    bone = np.concatenate([blob(9000, centre=(0, 0, 0), seed=1), blob(4000, centre=(30, 0, 0), seed=2)])
    noise = np.random.default_rng(3).uniform(-150, 150, (130, 3)).astype(np.float32)
    return len(bone), remove_sparse_cells(PointCloud(np.concatenate([bone, noise])), device=device)


def test_far_noise_is_removed_with_sparse_cells_and_bone_stays(bone_in_noise):
    of_bone, step = bone_in_noise
    assert (step.removed[of_bone:] == SPARSE_CELL).mean() >= 0.99  # measured all
    assert (step.removed[:of_bone] > 0).mean() < 0.06  # at the rims of both pieces; measured 0.031
    assert step.counts["sparse cell"] == np.count_nonzero(step.removed == SPARSE_CELL)


def test_pieces_that_stand_apart_stay_by_default_without_a_warning(bone_in_noise):
    _, step = bone_in_noise
    assert not (step.removed == SMALLER_COMPONENT).any()
    assert step.facts["edge_is_default"]
    assert step.warnings == ()


POINTS_OF_SMALLER, POINTS_OF_LARGEST = 3000, 9000


@pytest.fixture(scope="module")
def largest_piece(device):
    """The largest component of a cloud of two pieces, the smaller one first."""
    smaller = blob(POINTS_OF_SMALLER, centre=(30, 0, 0), seed=2)
    largest = blob(POINTS_OF_LARGEST, centre=(0, 0, 0), seed=1)
    cloud = PointCloud(np.concatenate([smaller, largest]))
    return remove_sparse_cells(cloud, edge=1.5, keep_largest=True, device=device)


def test_smaller_piece_is_removed_where_the_largest_is_asked_for(largest_piece):
    assert (largest_piece.removed[:POINTS_OF_SMALLER] > 0).all()
    in_sparse_cells = 0.05 * POINTS_OF_SMALLER  # at its rim; measured 96
    assert largest_piece.counts["smaller component"] >= POINTS_OF_SMALLER - in_sparse_cells
    assert largest_piece.facts["largest_component"]["points"] == len(largest_piece.cloud)


def test_removal_of_a_smaller_piece_is_warned_of(largest_piece):
    (warning,) = largest_piece.warnings
    removed = largest_piece.counts["smaller component"]
    assert warning.startswith(f"the largest component keeps {len(largest_piece.cloud):,} points; {removed:,} in ")
    assert "bone that stands apart" in warning


def test_largest_of_equally_many_cells_has_more_points_and_of_those_it_is_the_first(device):
    """Three rods of three cells each, 10 mm apart, with two, three and three points in a cell."""
    rods = [
        np.array([(x + 0.5, y, 0.5) for x in range(3) for _ in range(points_a_cell)])
        for y, points_a_cell in ((0.5, 2), (10.5, 3), (20.5, 3))
    ]
    points = np.concatenate(rods).astype(np.float32)
    grown = grow_cells(device, plan_grid(points, edge=1.0), fewest=2, threshold=2, largest=True)
    assert grown.facts["components"] == 3
    assert (grown.removed == np.repeat([SMALLER_COMPONENT, 0, SMALLER_COMPONENT], [6, 9, 9])).all()


def test_the_default_edge_is_twice_the_median_distance_to_the_sixteenth_neighbour(device):
    points = scattered_points(3000)
    to_sixteenth = find_neighbours(points, k=16, device=device).distances[:, -1]
    expected = 2.0 * np.median(to_sixteenth)
    assert choose_edge(PointCloud(points), device=device) == pytest.approx(expected)
    assert remove_sparse_cells(points, device=device).facts["edge_mm"] == pytest.approx(expected)


def test_cells_of_the_default_edge_hold_some_sixteen_points(device):
    assert 5.0 < remove_sparse_cells(scattered_points(3000), device=device).facts["points_a_cell"] < 40.0  # measured 25


EDGE = 1.75  # mm


def test_cells_by_equations_1_and_2_of_paper_b_are_those_of_the_grid(device):
    points = scattered_points(4000)
    counts, numbers = count_cells(points, EDGE), find_cell_numbers(points, EDGE)
    grid = make_grid(device, points, EDGE)
    assert all(0 <= a - b <= 1 for a, b in zip(counts, grid.shape, strict=True))  # with a margin at both ends
    assert len(np.unique(numbers)) == grid.cells
    assert np.array_equal(np.argsort(numbers, kind="stable"), fetch_grid(grid)["order"])


def test_cell_of_a_point_by_equation_2_is_its_place_from_the_lowest_corner():
    points = scattered_points(4000)
    margin = 1e-3 * EDGE
    low = points.astype(np.float64).min(axis=0) - margin
    high = points.astype(np.float64).max(axis=0) + margin
    columns, rows, _ = counts = count_cells(points, EDGE)
    assert counts == tuple(int(value) + 1 for value in (high - low) / EDGE)
    i, j, k = np.floor((points - low) / EDGE).T
    assert np.array_equal(find_cell_numbers(points, EDGE), i + columns * (j + rows * k))


def test_cells_below_the_spacing_of_all_points_are_refused(device):
    lattice = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    words = "all 512 points would go: 512 of 512 cells of 0.6 mm have fewer than 2 points"
    with pytest.raises(UsageError, match=words):
        remove_sparse_cells(lattice, edge=0.6, device=device)


def test_cells_of_a_single_point_are_refused(device):
    with refused(UsageError, 1, "points"):
        remove_sparse_cells(np.zeros((1, 3), np.float32), edge=1.0, device=device)


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


def test_sparse_cells_of_an_empty_cloud_are_refused():
    with refused(UsageError, "cloud", "cells"):
        remove_sparse_cells(np.zeros((0, 3)), edge=1.0)


def test_default_edge_of_equal_points_is_refused(device):
    with refused(UsageError, 100, 16 - 1):  # points, and others at the place of each
        remove_sparse_cells(np.zeros((100, 3)), device=device)


def test_too_little_memory_for_sparse_cells_is_refused(device):
    with refused(DeviceMemoryError, "cells", 1_000_000):
        remove_sparse_cells(scattered_points(50_000), edge=1.0, device=device, memory=1_000_000)


def test_points_removed_for_each_reason_are_counted(device):
    points, rules = scattered_points(600, size=(20.0, 14.0, 9.0)), {"edge": 1.5, "fewest": 2, "threshold": 3}
    step = remove_sparse_cells(points, **rules, keep_largest=True, device=device)
    assert step.reasons == REASONS
    assert list(step.counts.values()) == [np.count_nonzero(step.removed == mark) for mark in (1, 2, 3)]
    assert len(step.cloud) == np.count_nonzero(step.removed == 0)
