"""Thinned clouds have one point a cell, the one nearest to the mean, as the twin has."""

from __future__ import annotations

import numpy as np
import pytest
from point_grids import scattered_points
from refusals import refused

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.operators.points.grid import plan_grid
from clrecon.operators.points.thinning import choose_points, thin_points
from clrecon.points import PointCloud
from clrecon.proof.points import clusters as twin


@pytest.mark.parametrize("n", [1, 2, 63, 65, 9001])
@pytest.mark.parametrize("spacing", [0.9, 4.0, 100.0])
def test_chosen_points_equal_the_twin(device, n, spacing):
    points = scattered_points(n)
    assert np.array_equal(choose_points(device, plan_grid(points, spacing)), twin.choose_points(points, spacing))


@pytest.mark.oclgrind
def test_thinned_points_of_a_small_cloud_equal_the_twin(device):
    points = scattered_points(600)
    assert np.array_equal(choose_points(device, plan_grid(points, 3.0)), twin.choose_points(points, 3.0))


def test_the_point_nearest_to_the_mean_stays_and_of_several_the_first(device):
    cell = np.array([(0, 0.125, 0), (0.75, 0.125, 0), (0.5, 0.25, 0), (0.5, 0, 0)], np.float32)
    points = np.concatenate([cell[[0, 3, 1, 2]], cell + np.float32((7, 0, 0))])
    step = thin_points(points, 1.0, device=device)
    assert np.flatnonzero(step.removed == 0).tolist() == [1, 6]


def test_the_step_keeps_order_and_all_that_is_known(device):
    points = scattered_points(5000)
    hu = np.arange(5000, dtype=np.float32)
    cloud = PointCloud(points, hu=hu, labels=np.arange(5000), report={"iso_value_hu": 226.0})
    step = thin_points(cloud, 2.5, device=device)
    kept = step.removed == 0
    assert np.array_equal(step.cloud.points, points[kept])
    assert np.array_equal(step.cloud.hu, hu[kept])
    assert step.cloud.report == {"iso_value_hu": 226.0}
    assert step.counts == {"thinned": 5000 - len(step.cloud)}
    assert 0 < len(step.cloud) < 2500
    assert step.as_dict()["spacing_mm"] == 2.5


def test_every_occupied_cell_keeps_one_point(device):
    points = scattered_points(8000)
    step = thin_points(points, 1.7, device=device)
    plan = plan_grid(points, 1.7)

    def cells(places):
        return np.unique(np.floor((places.astype(np.float64) - plan.corner) / 1.7), axis=0)

    assert np.array_equal(cells(step.cloud.points), cells(points))
    assert len(step.cloud) == len(cells(points))


def test_thinning_keeps_far_points_exact_and_one_of_equal_ones(device):
    points = scattered_points(500).astype(np.float64) + (1e5, 2e5, -1e5)
    step = thin_points(PointCloud(points), 5.0, device=device)
    assert step.cloud.points.dtype == np.float64
    assert np.array_equal(step.cloud.points, points[step.removed == 0])
    assert len(thin_points(np.zeros((9000, 3), np.float32), 1.0, device=device).cloud) == 1


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan, np.inf, "2"])
def test_spacings_that_are_no_length_are_refused(spacing):
    with pytest.raises(UsageError, match="spacing=.*: a positive length in mm is needed"):
        thin_points(scattered_points(10), spacing)


def test_what_cannot_be_thinned_is_refused(device):
    with refused(UsageError, "cloud", "empty"):
        thin_points(np.zeros((0, 3)), 1.0)
    with refused(UsageError, "cells", 0.0001):
        thin_points(scattered_points(10), 1e-4, device=device)
    with refused(DeviceMemoryError, "cloud", 1000000):
        thin_points(scattered_points(50_000), 1.0, device=device, memory=1_000_000)
