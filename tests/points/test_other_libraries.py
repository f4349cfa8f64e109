"""Clouds of other libraries and back, parts of clouds, and what they say of themselves."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import UsageError


def make_cloud(count=7):
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return clrecon.PointCloud(
        rng.uniform(-50, 50, (count, 3)), normals, rng.integers(-900, 900, count), np.arange(count) - 1
    )


def assert_same(cloud, other):
    for name in ("points", "normals", "hu", "labels"):
        np.testing.assert_allclose(getattr(cloud, name), getattr(other, name), atol=1e-6)


def test_a_cloud_goes_to_pyvista_and_comes_back():
    cloud = make_cloud()
    assert_same(clrecon.PointCloud.from_pyvista(cloud.to_pyvista()), cloud)


def test_points_in_ras_are_turned():
    pyvista = pytest.importorskip("pyvista")
    cloud = clrecon.PointCloud.from_pyvista(pyvista.PolyData(np.array([[1.0, 2.0, 3.0]])), space="ras")
    assert cloud.points.tolist() == [[-1.0, -2.0, 3.0]] and cloud.normals is None and cloud.hu is None


@pytest.mark.release
def test_a_cloud_goes_to_open3d_and_comes_back():
    pytest.importorskip("open3d")
    cloud = make_cloud()
    there = cloud.to_open3d()
    assert_same(clrecon.PointCloud.from_open3d(there), cloud)
    legacy = clrecon.PointCloud.from_open3d(there.to_legacy(), space="ras")
    np.testing.assert_allclose(legacy.points, cloud.points * [-1.0, -1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(legacy.normals, cloud.normals * [-1.0, -1.0, 1.0], atol=1e-5)
    assert legacy.hu is None


@pytest.mark.parametrize("make", ["from_pyvista", "from_open3d"])
@pytest.mark.parametrize("given", ["a", None, np.zeros((3, 3))])
def test_objects_that_are_no_clouds_of_other_libraries_are_refused(make, given):
    with pytest.raises(UsageError, match="is no"):
        getattr(clrecon.PointCloud, make)(given)


def test_parts_are_ranges_masks_and_numbers():
    cloud = make_cloud()
    for key in (slice(2, 5), slice(None, None, -2), cloud.hu > 0, np.array([3, 1]), [0, 6]):
        np.testing.assert_array_equal(cloud[key].points, cloud.points[key])
        np.testing.assert_array_equal(cloud[key].labels, cloud.labels[key])
    assert len(cloud[7:]) == 0
    with refused(UsageError, "cloud.points", 3):
        cloud[3]
    with pytest.raises(TypeError):
        iter(cloud)


def test_bounds_of_a_cloud_are_its_extremes_and_nan_without_points():
    cloud = make_cloud()
    np.testing.assert_array_equal(cloud.bounds, [cloud.points.min(axis=0), cloud.points.max(axis=0)])
    assert np.isnan(cloud[:0].bounds).all()


def test_repr_of_a_step_is_short(device):
    cloud = clrecon.PointCloud(np.random.default_rng(6).uniform(0, 10, (1000, 3)))
    clusters = clrecon.cluster_points(cloud, 1.0, 3, device=device)
    assert repr(clusters) == "Clustering(PointCloud(1000 points, with labels, LPS mm) of 1,000)"
    thin = clrecon.thin_points(cloud, 2.0, device=device)
    removed = 1000 - len(thin.cloud)
    assert repr(thin) == f"PointStep({thin.cloud!r} of 1,000, {removed} as {thin.reasons[0]})"
