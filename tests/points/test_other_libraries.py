"""Clouds of other libraries and back, parts of clouds, and what they say of themselves."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused

import clrecon
from clrecon.errors import UsageError


def make_cloud():
    """Seven points with normals, HU and labels."""
    count = 7
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, hu = rng.uniform(-50, 50, (count, 3)), rng.integers(-900, 900, count)
    return clrecon.PointCloud(points, normals=normals, hu=hu, labels=np.arange(count) - 1)


def assert_same(cloud, other):
    for name in ("points", "normals", "hu", "labels"):
        np.testing.assert_allclose(getattr(cloud, name), getattr(other, name), atol=1e-6)


def test_arrays_of_a_cloud_return_unchanged_from_pyvista():
    cloud = make_cloud()
    assert_same(clrecon.PointCloud.from_pyvista(cloud.to_pyvista()), cloud)


def test_points_of_pyvista_in_ras_become_a_cloud_in_lps_without_normals_and_hu():
    pyvista = pytest.importorskip("pyvista")
    cloud = clrecon.PointCloud.from_pyvista(pyvista.PolyData(np.array([[1.0, 2.0, 3.0]])), space="ras")
    assert cloud.points.tolist() == [[-1.0, -2.0, 3.0]]
    assert cloud.normals is None
    assert cloud.hu is None


@pytest.mark.release
def test_arrays_of_a_cloud_return_unchanged_from_open3d():
    pytest.importorskip("open3d")
    cloud = make_cloud()
    assert_same(clrecon.PointCloud.from_open3d(cloud.to_open3d()), cloud)


@pytest.mark.release
def test_points_and_normals_of_a_legacy_cloud_of_open3d_in_ras_become_a_cloud_in_lps():
    pytest.importorskip("open3d")
    cloud = make_cloud()
    legacy = clrecon.PointCloud.from_open3d(cloud.to_open3d().to_legacy(), space="ras")
    np.testing.assert_allclose(legacy.points, cloud.points * [-1.0, -1.0, 1.0], atol=tolerances.MOVED_VERTEX_MM)
    np.testing.assert_allclose(legacy.normals, cloud.normals * [-1.0, -1.0, 1.0], atol=tolerances.MESH_UNIT_NORMAL)
    assert legacy.hu is None


@pytest.mark.parametrize("make", ["from_pyvista", "from_open3d"])
@pytest.mark.parametrize("given", ["a", None, np.zeros((3, 3))])
def test_objects_that_are_no_clouds_of_other_libraries_are_refused(make, given):
    with pytest.raises(UsageError, match="is no"):
        getattr(clrecon.PointCloud, make)(given)


KEYS = {
    "range": slice(2, 5),
    "every second backwards": slice(None, None, -2),
    "mask": np.array([True, False, True, False, False, True, False]),
    "numbers": np.array([3, 1]),
    "list": [0, 6],
    "nothing": slice(7, None),
}


@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_a_part_of_a_cloud_has_the_points_and_labels_that_numpy_takes(key):
    cloud = make_cloud()
    np.testing.assert_array_equal(cloud[key].points, cloud.points[key])
    np.testing.assert_array_equal(cloud[key].labels, cloud.labels[key])


def test_a_single_number_for_a_part_of_a_cloud_is_refused():
    with refused(UsageError, "cloud.points", 3):
        make_cloud()[3]


def test_going_through_a_cloud_as_a_sequence_is_refused():
    with refused(TypeError, "PointCloud"):
        iter(make_cloud())


def test_bounds_of_a_cloud_are_the_extremes_of_its_points():
    cloud = make_cloud()
    np.testing.assert_array_equal(cloud.bounds, [cloud.points.min(axis=0), cloud.points.max(axis=0)])


def test_bounds_of_no_points_are_nan():
    assert np.isnan(make_cloud()[:0].bounds).all()


@pytest.fixture(scope="module")
def thousand_points():
    """Random points in a cube of 10 mm."""
    return clrecon.PointCloud(np.random.default_rng(6).uniform(0, 10, (1000, 3)))


def test_repr_of_a_clustering_has_its_cloud_and_the_points_before(device, thousand_points):
    clusters = clrecon.cluster_points(thousand_points, eps=1.0, min_samples=3, device=device)
    assert repr(clusters) == "Clustering(PointCloud(1000 points, with labels, LPS mm) of 1,000)"


def test_repr_of_a_step_has_its_cloud_the_points_before_and_those_removed_by_reason(device, thousand_points):
    thinned = clrecon.thin_points(thousand_points, spacing=2.0, device=device)
    removed = 1000 - len(thinned.cloud)
    assert repr(thinned) == f"PointStep({thinned.cloud!r} of 1,000, {removed} as {thinned.reasons[0]})"
