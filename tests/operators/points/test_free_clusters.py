"""Clusters of free points equal those of scipy's tree and of exact arithmetic, whatever the cloud and the device."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from point_grids import scattered_points
from refusals import refused
from variants import daily

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.points import free_clusters as module
from clrecon.operators.points.clusters import cluster_points
from clrecon.operators.points.free_clusters import ClusterSearch, cluster_free_points, find_clusters, plan_cells
from clrecon.operators.points.grid import fill_grid
from clrecon.points import PointCloud
from clrecon.proof.points import clusters as grid_twin
from clrecon.proof.points import clusters as twin


@pytest.fixture(params=["own form", "other form"])
def form(request, device, monkeypatch):
    """Both forms of the kernels on every device."""
    if request.param == "other form":
        lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
        monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})


def check_equal(device, points, eps, min_samples):
    before = points.copy()
    found = cluster_free_points(points, eps, min_samples, device=device)
    count, labels, cores = twin.cluster_points(points, eps, min_samples)
    assert found.labels.dtype == np.int32
    assert found.count == count
    np.testing.assert_array_equal(found.cores, cores)
    np.testing.assert_array_equal(found.labels, labels)
    assert np.array_equal(points, before)
    assert found.facts["clusters"] == count
    assert found.facts["noise_points"] == (labels < 0).sum()
    return found


@pytest.mark.parametrize("n", [1, 2, 31, 32, 33, 1000, 9001])
@pytest.mark.parametrize("min_samples", [1, 2, 5])
@pytest.mark.parametrize("eps", daily(1, [0.8, 2.0]))
def test_clusters_of_scattered_points_equal_the_twin(device, form, n, min_samples, eps):
    check_equal(device, scattered_points(n, (30.0, 14.0, 11.0)), eps, min_samples)


@pytest.mark.parametrize("per_chunk", [32, 64, 640])
def test_clusters_are_the_same_in_chunks_of_any_size(device, form, per_chunk):
    points = scattered_points(4000, (30.0, 14.0, 11.0), seed=2)
    labels = find_clusters(device, plan_cells(points, 1.0), 1.0, 3, per_chunk=per_chunk)[0]
    assert np.array_equal(labels, twin.cluster_points(points, 1.0, 3)[1])


@pytest.mark.oclgrind
def test_clusters_found_in_small_chunks_equal_the_twin(device):
    points = scattered_points(400, (12.0, 8.0, 6.0))
    labels, cores, count, _ = find_clusters(device, plan_cells(points, 1.1), 1.1, 4, per_chunk=32)
    expected_count, expected, expected_cores = twin.cluster_points(points, 1.1, 4)
    assert count == expected_count > 1
    assert np.array_equal(labels, expected)
    assert np.array_equal(cores, expected_cores)


@pytest.mark.parametrize("n", [0, 1, 4])
def test_points_fewer_than_a_core_needs_are_noise_with_a_warning(n):
    """No device is needed: nothing is compared."""
    found = cluster_free_points(np.zeros((n, 3)), 2.0, 5)
    assert found.facts == {"eps_mm": 2.0, "min_samples": 5, "clusters": 0, "core_points": 0, "noise_points": n}
    assert found.warnings == (f"{n} points are fewer than min_samples 5: all are noise",)
    assert (found.count, found.labels.tolist(), found.cores.tolist()) == (0, [-1] * n, [False] * n)


def test_cells_of_far_points_are_smaller_by_a_tenth_at_most():
    """They are 1 / sqrt(3) mm, less 0.001 and what coordinates in float32 need, or a tenth: then there are too many."""
    with refused(UsageError, 0, "cells"):
        plan_cells([[0.0, 0.0, 0.0], [1e7, 0.0, 0.0]], 1.0)
    near = plan_cells([[0.0, 0.0, 0.0], [1e4, 0.0, 0.0]], 1.0)
    assert float(near.edge) == pytest.approx((0.999 - 4e-7 * 1e4 * 3**0.5) / 3**0.5, rel=1e-7)


def test_the_passes_equal_their_twins(device, form):
    points = scattered_points(5000, (30.0, 14.0, 11.0), seed=3)
    plan = plan_cells(points, 0.9)
    grid = grid_twin.make_grid(points, float(plan.edge))
    search = ClusterSearch(device, fill_grid(device, plan), 0.9, 3, 64)
    pairs = twin.count_pairs(grid, float(plan.edge), 3)
    assert np.array_equal(search.count_pairs(), pairs)
    search.find_cores()
    search.join_within()
    search.note_words()
    cores = twin.cluster_points(points, 0.9, 3)[2][grid.order]
    labels = twin.join_chunks(grid, cores, 0.9 * (1 + 1e-6), 64)
    found = module.ocl.download(device, np.empty(len(labels), np.uint32), search.labels_d)
    assert np.array_equal(found, labels)
    roots = twin.note_words(grid, labels)
    assert np.array_equal(module.ocl.download(device, np.empty(len(roots), np.uint32), search.roots_d), roots)
    assert (roots == twin.SEVERAL_ROOTS).any()


def test_clusters_of_a_lattice_at_its_own_spacing_equal_the_twin(device, form):
    """Distances equal eps, times what the rounding of the coordinates makes of them."""
    lattice = np.stack(np.meshgrid(*[np.arange(-7, 8)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    assert check_equal(device, lattice, 1.0, 7).count == 1
    assert check_equal(device, lattice, 0.999, 2).count == 0
    for eps in (0.7, 0.7 * np.sqrt(2.0), 0.7 * np.sqrt(3.0), 1.4):
        check_equal(device, lattice * np.float32(0.7), eps, 9)


@pytest.mark.every_device
def test_distances_at_the_limit_are_decided_as_in_exact_arithmetic(device, form):
    """Pairs of points about eps apart: float32 alone would take some of them wrongly."""
    rng, eps, n = np.random.default_rng(4), 1.25, 3000
    limit = eps * (1.0 + 1e-6)
    ways = rng.normal(size=(n, 3))
    ways *= limit * (1.0 + rng.uniform(-1e-7, 1e-7, (n, 1))) / np.linalg.norm(ways, axis=1, keepdims=True)
    places = 5.0 * np.stack(np.unravel_index(np.arange(n), (15, 15, 15)), axis=1) - 35.0 + rng.random((n, 3))
    points = np.concatenate([places, places + ways]).astype(np.float32)
    found = cluster_free_points(points, eps, 2, device=device)
    a, b = points[:n], points[n:]

    def is_near(first, second):
        parts = [Fraction(float(x)) - Fraction(float(y)) for x, y in zip(first, second, strict=True)]
        return sum(part * part for part in parts) <= Fraction(limit) ** 2

    exact = np.array([is_near(first, second) for first, second in zip(a, b, strict=True)])
    assert 0.2 < exact.mean() < 0.8
    in_float32 = ((b - a) ** 2).sum(axis=1) <= np.float32(limit) ** 2
    assert (in_float32 != exact).any()
    assert np.array_equal(found.cores[:n], exact)
    assert np.array_equal(found.cores[n:], exact)


def test_equal_points_are_one_cluster_at_once(device):
    found = cluster_free_points(np.full((200_000, 3), 7.25, np.float32), 0.5, 6, device=device)
    assert (found.labels == 0).all()
    assert found.cores.all()
    assert found.facts["cells"] == 1


@pytest.mark.parametrize(("gap", "clusters"), [(1.001, 2), (0.999, 1)])
def test_dense_spots_are_joined_up_to_the_distance(device, gap, clusters):
    """Their boxes are compared before their points."""
    spot = np.random.default_rng(5).random((4000, 3)) * 0.02
    spot[0], spot[1] = 0.0, 0.02
    points = np.concatenate([spot, spot + (gap + 0.02, 0, 0)]).astype(np.float32)
    points[4000, 1:] = points[1, 1:]
    found = cluster_free_points(points, 1.0, 6, device=device)
    assert found.count == clusters
    assert found.cores.all()


def test_permuted_points_have_the_same_clusters(device):
    points = scattered_points(5000, (30.0, 14.0, 11.0), seed=6)
    order = np.random.default_rng(7).permutation(len(points))
    one, other = (cluster_free_points(cloud, 0.9, 4, device=device) for cloud in (points, points[order]))
    assert np.array_equal(one.cores[order], other.cores)
    pairs = np.unique(np.stack([one.labels[order], other.labels])[:, other.cores], axis=1)
    assert pairs.shape[1] == one.count == other.count
    firsts = [np.flatnonzero(other.cores & (other.labels == number))[0] for number in range(other.count)]
    assert firsts == sorted(firsts)


def test_far_clouds_have_the_clusters_of_near_ones(device):
    """Coordinates are relative to whole millimetres, so these are the same numbers."""
    points = np.rint(scattered_points(3000, (30.0, 14.0, 11.0), seed=8) * 256.0) / 256.0
    near = cluster_free_points(points, 0.9, 3, device=device)
    far = cluster_free_points(PointCloud(points + (1e5, -2e5, 3e5)), 0.9, 3, device=device)
    assert near.count > 1
    assert np.array_equal(near.labels, far.labels)


@pytest.mark.parametrize("eps", [60.0, 1e6, 1e30])
def test_eps_beyond_the_box_gives_one_cluster(device, eps):
    found = cluster_free_points(scattered_points(500, (30.0, 14.0, 11.0)), eps, 500, device=device)
    assert (found.labels == 0).all()
    assert found.facts["cells"] == 1


@pytest.mark.parametrize("eps", [0, -1.0, np.nan, np.inf, 1e-10, "1"])
def test_eps_that_is_no_distance_is_refused(eps):
    with refused(UsageError, 1e-09, "distance"):
        cluster_free_points(scattered_points(10), eps)


@pytest.mark.parametrize("min_samples", [0, -3, 2.5, True])
def test_min_samples_that_are_no_count_are_refused(min_samples):
    with refused(UsageError, "min_samples", 1):
        cluster_free_points(scattered_points(10), 1.0, min_samples)


def test_points_that_cannot_be_clustered_are_refused(device):
    points = scattered_points(100)
    with pytest.raises(UsageError, match=r"points have shape \(n, 3\), these have \(100, 2\)"):
        cluster_free_points(points[:, :2], 1.0)
    points[7] = np.nan
    with pytest.raises(UsageError, match="1 of 100 points are not finite"):
        cluster_free_points(points, 1.0, device=device)
    with pytest.raises(UsageError, match="has 5,[0-9,]+ x 3,[0-9,]+ x 3,[0-9,]+ of them"):
        cluster_free_points(scattered_points(100), 0.0129, device=device)


def test_too_many_pairs_are_refused_before_they_are_compared(device):
    points = scattered_points(2_000_000, (3.0, 3.0, 3.0))
    with refused(UsageError, 2_000_000, 64, 1e12):
        cluster_free_points(points, 1.5, 6, device=device)
    assert cluster_free_points(points, 6.0, 6, device=device).count == 1  # one cell needs no pairs


def test_the_forecast_of_memory_is_refused_first(device):
    with refused(DeviceMemoryError, "clusters", "points"):
        cluster_free_points(scattered_points(50_000), 1.0, device=device, memory=2_000_000)


def test_progress_is_told_in_four_steps(device):
    told = []
    cluster_free_points(scattered_points(100), 1.0, 2, device=device, progress=lambda *step: told.append(step))
    assert told == [("clusters", done, 4) for done in range(1, 5)]


def test_clouds_without_voxels_are_clustered_as_free_points(device):
    points = scattered_points(2000, (30.0, 14.0, 11.0))
    cloud = PointCloud(points, hu=np.arange(2000))
    step = cluster_points(cloud, 1.1, 3, device=device)
    count, labels, cores = twin.cluster_points(points, 1.1, 3)
    assert np.array_equal(step.cloud.labels, labels)
    assert np.array_equal(step.cloud.hu, cloud.hu)
    assert np.array_equal(step.cores, cores)
    assert not step.removed.any()
    assert step.facts["clusters"] == count
    assert step.facts["largest_clusters"][0]["points"] == np.bincount(labels[labels >= 0]).max()


def test_free_points_need_a_distance_and_no_volume(device):
    cloud = PointCloud(scattered_points(100))
    with refused(UsageError, "lattice", "distance"):
        cluster_points(cloud, device=device)
    with refused(UsageError, 1, "planes"):
        cluster_points(cloud, 1.0, "plane+1", device=device)
    with pytest.raises(UsageError, match="a volume says nothing of them"):
        cluster_points(cloud, 1.0, volume=Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), device=device)


@pytest.mark.every_device
def test_clusters_of_a_large_cloud_are_right_where_work_items_end_early(device):
    """Shares of a core would be longer than llvmpipe's loops: nearly all labels were wrong, without a word."""
    if device.most_steps is None:
        pytest.skip("work-items of this device do not end early")
    check_equal(device, scattered_points(60_000, (60.0, 40.0, 30.0)), 1.2, 4)
    assert any("ends the loops of a work-item" in text for text in device.warnings)
