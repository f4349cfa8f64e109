"""Statistical outliers equal their twin and those of a definition by hand."""

from __future__ import annotations

import numpy as np
import pytest
from point_shapes import sphere
from refusals import refused
from tolerances import MEAN_DISTANCE_SHARE

from clrecon.errors import UsageError
from clrecon.operators.points.denoising import remove_outliers
from clrecon.points.cloud import PointCloud
from clrecon.proof.points.neighbours import find_neighbours, find_outliers, mean_distances


@pytest.mark.parametrize("deviations", [0.0, 1.0, 2.0, 3.5])
@pytest.mark.parametrize("k", [2, 16])
def test_outliers_and_their_mean_distance_equal_the_twin(device, deviations, k):
    points = sphere(radius=10.0).points
    step = remove_outliers(PointCloud(points), k=k, deviations=deviations, device=device)
    _, distances = find_neighbours(points, k)
    assert np.array_equal(step.removed, find_outliers(distances, deviations))
    assert step.facts["mean_distance_mm"] == pytest.approx(mean_distances(distances).mean(), rel=MEAN_DISTANCE_SHARE)


def test_points_that_are_no_outliers_stay_and_outliers_are_counted(device):
    points = sphere(radius=10.0).points
    step = remove_outliers(PointCloud(points), device=device)
    assert np.array_equal(step.cloud.points, points[step.removed == 0])
    assert step.counts == {"outlier": np.count_nonzero(step.removed)}


def test_far_points_are_outliers_and_all_points_of_a_sphere_stay_with_their_hu(device):
    shape, rng = sphere(radius=10.0).points, np.random.default_rng(5)
    far = rng.uniform(-60, 60, (30, 3))
    far = far[np.linalg.norm(far, axis=1) > 20]
    cloud = PointCloud(np.r_[shape, far], hu=np.arange(len(shape) + len(far)))
    step = remove_outliers(cloud, device=device)
    assert step.removed[len(shape) :].all()
    assert not step.removed[: len(shape)].any()
    assert np.array_equal(step.cloud.hu, np.flatnonzero(step.removed == 0))  # HU are numbers of points


def test_a_ring_of_equal_distances_has_no_outlier(device):
    angles = 2.0 * np.pi * np.arange(64) / 64
    ring = np.c_[np.cos(angles), np.sin(angles), np.zeros(64)]
    assert not remove_outliers(PointCloud(ring), k=3, deviations=2.0, device=device).removed.any()


def test_equal_points_have_no_outlier(device):
    assert not remove_outliers(PointCloud(np.zeros((50, 3))), device=device).removed.any()


@pytest.mark.oclgrind
def test_far_point_of_a_small_cloud_is_an_outlier(device):
    points = np.r_[sphere(radius=3.0).points, [[30.0, 0.0, 0.0]]]
    step = remove_outliers(PointCloud(points), k=6, device=device)
    assert step.removed[-1] == 1


@pytest.mark.parametrize("deviations", [-1.0, float("nan"), float("inf"), "2", True])
def test_wrong_deviations_are_refused(device, deviations):
    with refused(UsageError, "deviations", 0):
        remove_outliers(PointCloud(np.eye(3)), k=2, deviations=deviations, device=device)


def test_one_point_alone_stays_with_a_warning(device):
    step = remove_outliers(PointCloud(np.zeros((1, 3))), device=device)
    assert len(step.cloud) == 1
    assert "the cloud has 1 points" in step.warnings[0]
