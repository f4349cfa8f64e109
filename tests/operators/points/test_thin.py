"""Thinned clouds have one point a cell, the one nearest to the mean, as the twin has."""

from __future__ import annotations

import numpy as np
import pytest
from point_grids import scattered_points
from refusals import refused

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.operators.points.grid import MOST_CELLS, MOST_CELLS_ALONG, plan_grid
from clrecon.operators.points.thinning import choose_points, thin_points
from clrecon.points.cloud import PointCloud
from clrecon.proof.points import clusters as twin


@pytest.mark.parametrize("n", [1, 2, 63, 65, 9001])
@pytest.mark.parametrize("spacing", [0.9, 4.0, 100.0])
def test_chosen_points_equal_the_twin(device, n, spacing):
    points = scattered_points(n)
    assert np.array_equal(choose_points(device, plan_grid(points, spacing)), twin.choose_points(points, spacing))


@pytest.mark.oclgrind
def test_thinned_points_of_a_small_cloud_equal_the_twin(device):
    points = scattered_points(600)
    assert np.array_equal(choose_points(device, plan_grid(points, edge=3.0)), twin.choose_points(points, spacing=3.0))


def test_the_point_nearest_to_the_mean_of_its_cell_stays_and_of_equally_near_ones_the_first(device):
    """The mean of the four is (0.4375, 0.125, 0): the third and fourth are equally near, the others farther away."""
    cell = np.array([(0, 0.125, 0), (0.75, 0.125, 0), (0.5, 0.25, 0), (0.5, 0, 0)], np.float32)
    fourth_before_third, as_listed = cell[[0, 3, 1, 2]], cell + np.float32((7, 0, 0))
    step = thin_points(np.concatenate([fourth_before_third, as_listed]), spacing=1.0, device=device)
    assert np.flatnonzero(step.removed == 0).tolist() == [1, 4 + 2]


SPACING_MM = 2.5


@pytest.fixture(scope="module")
def thinned_cloud(device):
    """A cloud of 5000 points with HU, labels and a report, and what thinning leaves of it."""
    hu = np.arange(5000, dtype=np.float32)
    cloud = PointCloud(scattered_points(5000), hu=hu, labels=np.arange(5000), report={"iso_value_hu": 226.0})
    return cloud, thin_points(cloud, SPACING_MM, device=device)


def test_thinned_cloud_keeps_the_order_of_its_points_with_their_hu_and_labels(thinned_cloud):
    cloud, step = thinned_cloud
    kept = step.removed == 0
    assert 0 < np.count_nonzero(kept) < len(cloud) / 2
    assert np.array_equal(step.cloud.points, cloud.points[kept])
    assert np.array_equal(step.cloud.hu, cloud.hu[kept])
    assert np.array_equal(step.cloud.labels, cloud.labels[kept])


def test_thinned_cloud_keeps_its_report(thinned_cloud):
    cloud, step = thinned_cloud
    assert step.cloud.report == cloud.report


def test_points_removed_by_thinning_are_counted_with_the_spacing(thinned_cloud):
    cloud, step = thinned_cloud
    assert step.counts == {"thinned": len(cloud) - len(step.cloud)}
    assert step.as_dict()["spacing_mm"] == SPACING_MM


def test_every_occupied_cell_keeps_one_point(device):
    points, spacing = scattered_points(8000), 1.7
    step = thin_points(points, spacing, device=device)
    corner = plan_grid(points, spacing).corner

    def occupied_cells(places):
        return np.unique(np.floor((places.astype(np.float64) - corner) / spacing), axis=0)

    assert np.array_equal(occupied_cells(step.cloud.points), occupied_cells(points))
    assert len(step.cloud) == len(occupied_cells(points))


def test_thinning_keeps_points_far_from_the_origin_exact(device):
    points = scattered_points(500).astype(np.float64) + (1e5, 2e5, -1e5)
    step = thin_points(PointCloud(points), spacing=5.0, device=device)
    assert step.cloud.points.dtype == np.float64
    assert np.array_equal(step.cloud.points, points[step.removed == 0])


def test_thinning_keeps_one_of_equal_points(device):
    assert len(thin_points(np.zeros((9000, 3), np.float32), spacing=1.0, device=device).cloud) == 1


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan, np.inf, "2"])
def test_spacings_that_are_no_length_are_refused(spacing):
    with pytest.raises(UsageError, match="spacing=.*: a positive length in mm is needed"):
        thin_points(scattered_points(10), spacing)


def test_thinning_of_an_empty_cloud_is_refused():
    with refused(UsageError, "cloud", "empty"):
        thin_points(np.zeros((0, 3)), spacing=1.0)


def test_spacing_that_needs_too_many_cells_is_refused(device):
    with refused(UsageError, 0.0001, MOST_CELLS, MOST_CELLS_ALONG):
        thin_points(scattered_points(10), spacing=1e-4, device=device)


def test_too_little_memory_for_thinning_is_refused(device):
    with refused(DeviceMemoryError, "cloud", 1_000_000):
        thin_points(scattered_points(50_000), spacing=1.0, device=device, memory=1_000_000)
