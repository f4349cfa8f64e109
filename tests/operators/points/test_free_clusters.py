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
from clrecon.operators.points.grid import MOST_CELLS_ALONG, fill_grid
from clrecon.points.cloud import PointCloud
from clrecon.proof.points import clusters as grid_twin
from clrecon.proof.points import clusters as twin


@pytest.fixture(params=["own form", "other form"])
def kernel_form(request, device, monkeypatch):
    """Both forms of the kernels on every device: for CPUs, and for GPUs."""
    if request.param == "other form":
        lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
        monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})


BOX = (30.0, 14.0, 11.0)  # mm


def assert_clusters_equal_twin(device, points, *, eps, min_samples):
    found = cluster_free_points(points, eps, min_samples, device=device)
    count, labels, cores = twin.cluster_points(points, eps, min_samples)
    assert found.labels.dtype == np.int32
    assert found.count == count
    np.testing.assert_array_equal(found.cores, cores)
    np.testing.assert_array_equal(found.labels, labels)
    return found


@pytest.mark.parametrize("n", [1, 2, 31, 32, 33, 1000, 9001])
@pytest.mark.parametrize("min_samples", [1, 2, 5])
@pytest.mark.parametrize("eps", daily(1, [0.8, 2.0]))
def test_clusters_of_scattered_points_equal_the_twin(device, kernel_form, n, min_samples, eps):
    assert_clusters_equal_twin(device, scattered_points(n, size=BOX), eps=eps, min_samples=min_samples)


def test_report_of_free_clusters_counts_clusters_and_noise(device):
    points = scattered_points(1000, size=BOX)
    facts = cluster_free_points(points, eps=0.8, min_samples=5, device=device).facts
    count, labels, _ = twin.cluster_points(points, eps=0.8, min_samples=5)
    assert facts["clusters"] == count > 0
    assert facts["noise_points"] == np.count_nonzero(labels < 0) > 0


def test_clustering_leaves_the_points_as_they_are(device):
    points = scattered_points(1000, size=BOX)
    before = points.copy()
    cluster_free_points(points, eps=0.8, min_samples=5, device=device)
    assert np.array_equal(points, before)


@pytest.mark.parametrize("per_chunk", [32, 64, 640])
def test_labels_of_clusters_found_in_chunks_of_32_64_or_640_cells_equal_the_twin(device, kernel_form, per_chunk):
    points = scattered_points(4000, size=BOX, seed=2)
    labels, *_ = find_clusters(device, plan_cells(points, eps=1.0), eps=1.0, min_samples=3, per_chunk=per_chunk)
    _, expected, _ = twin.cluster_points(points, eps=1.0, min_samples=3)
    assert np.array_equal(labels, expected)


@pytest.mark.oclgrind
def test_clusters_found_in_small_chunks_equal_the_twin(device):
    points = scattered_points(400, size=(12.0, 8.0, 6.0))
    labels, cores, count, _ = find_clusters(device, plan_cells(points, eps=1.1), eps=1.1, min_samples=4, per_chunk=32)
    expected_count, expected, expected_cores = twin.cluster_points(points, eps=1.1, min_samples=4)
    assert count == expected_count > 1
    assert np.array_equal(labels, expected)
    assert np.array_equal(cores, expected_cores)


@pytest.mark.parametrize("n", [0, 1, 4])
def test_points_fewer_than_min_samples_are_noise_with_a_warning(n):
    found = cluster_free_points(np.zeros((n, 3)), eps=2.0, min_samples=5)  # needs no device: nothing is compared
    assert (found.count, found.labels.tolist(), found.cores.tolist()) == (0, [-1] * n, [False] * n)
    assert found.facts == {"eps_mm": 2.0, "min_samples": 5, "clusters": 0, "core_points": 0, "noise_points": n}
    assert found.warnings == (f"{n} points are fewer than min_samples 5: all are noise",)


def test_cells_of_far_points_are_smaller_by_the_rounding_of_their_coordinates():
    """A cell's diagonal is eps, less a thousandth, and less what float32 may move points 10 m apart by."""
    eps, extent = 1.0, 1e4
    edge = eps / 3**0.5
    rounding = 4e-7 * extent  # mm that planning sets aside: some seven half steps of float32
    plan = plan_cells([[0.0, 0.0, 0.0], [extent, 0.0, 0.0]], eps)
    # Half a step of float32 is 6e-8; measured 2e-9.
    assert float(plan.edge) == pytest.approx(0.999 * edge - rounding, rel=1e-7)


def test_points_too_far_apart_for_cells_of_eps_are_refused():
    with refused(UsageError, MOST_CELLS_ALONG, "cells"):
        plan_cells([[0.0, 0.0, 0.0], [1e7, 0.0, 0.0]], eps=1.0)


POINTS_OF_PASSES = scattered_points(5000, size=BOX, seed=3)
EPS_OF_PASSES, MIN_SAMPLES_OF_PASSES, CHUNK = 0.9, 3, 64
WIDENED_EPS = 1.0 + 1e-6  # within it points are neighbours, so that those at eps are, however it is rounded


def start_search(device):
    """A search among `POINTS_OF_PASSES` in chunks, the twin's grid of it, and the edge of its cells."""
    plan = plan_cells(POINTS_OF_PASSES, EPS_OF_PASSES)
    search = ClusterSearch(device, fill_grid(device, plan), EPS_OF_PASSES, MIN_SAMPLES_OF_PASSES, per_chunk=CHUNK)
    return search, grid_twin.make_grid(POINTS_OF_PASSES, float(plan.edge)), float(plan.edge)


def test_pairs_of_a_search_are_counted_as_by_the_twin(device, kernel_form):
    search, grid, edge = start_search(device)
    assert np.array_equal(search.count_pairs(), twin.count_pairs(grid, edge, MIN_SAMPLES_OF_PASSES))


@pytest.fixture
def search_joined_in_chunks(device, kernel_form):
    """A search whose core points within chunks are joined, its grid, and the roots that the twin finds."""
    search, grid, _ = start_search(device)
    search.find_cores()
    search.join_within()
    _, _, cores = twin.cluster_points(POINTS_OF_PASSES, EPS_OF_PASSES, MIN_SAMPLES_OF_PASSES)
    roots = twin.join_chunks(grid, cores[grid.order], reach=EPS_OF_PASSES * WIDENED_EPS, per_chunk=CHUNK)
    return search, grid, roots


def test_core_points_joined_within_chunks_equal_the_twin(device, search_joined_in_chunks):
    search, _, expected = search_joined_in_chunks
    assert np.array_equal(module.ocl.download(device, np.empty(len(expected), np.uint32), search.labels_d), expected)


def test_roots_of_the_clusters_in_32_cells_of_a_word_are_those_of_the_twin_or_several(device, search_joined_in_chunks):
    """A union-find has a root for each cluster of core points; a word of the grid stands for 32 cells side by side."""
    search, grid, joined = search_joined_in_chunks
    expected = twin.note_words(grid, joined)
    assert (expected == twin.SEVERAL_ROOTS).any(), "no word has several roots"

    search.note_words()

    assert np.array_equal(module.ocl.download(device, np.empty(len(expected), np.uint32), search.roots_d), expected)


LATTICE = np.stack(np.meshgrid(*[np.arange(-7, 8)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
"""15 x 15 x 15 points 1 mm apart."""


@pytest.mark.parametrize(("eps", "min_samples", "clusters"), [(1.0, 7, 1), (0.999, 2, 0)], ids=["equal", "below"])
def test_points_of_a_lattice_are_one_cluster_at_eps_of_its_spacing_and_noise_below(
    device, kernel_form, eps, min_samples, clusters
):
    """Seven points are within 1 mm of an inner one, itself included."""
    found = assert_clusters_equal_twin(device, LATTICE, eps=eps, min_samples=min_samples)
    assert found.count == clusters


@pytest.mark.parametrize("eps", [0.7, 0.7 * np.sqrt(2.0), 0.7 * np.sqrt(3.0), 1.4])
def test_clusters_of_a_lattice_whose_distances_round_to_eps_equal_the_twin(device, kernel_form, eps):
    """0.7 is no number of float32: distances are eps times what rounding makes of them."""
    assert_clusters_equal_twin(device, LATTICE * np.float32(0.7), eps=eps, min_samples=9)


@pytest.mark.every_device
def test_distances_at_the_limit_are_decided_as_in_exact_arithmetic(device, kernel_form):
    """3000 pairs of points within 1e-7 of eps of being eps apart, each pair 5 mm from the next."""
    rng, eps, n = np.random.default_rng(4), 1.25, 3000
    limit = eps * WIDENED_EPS
    ways = rng.normal(size=(n, 3))
    ways *= limit * (1.0 + rng.uniform(-1e-7, 1e-7, (n, 1))) / np.linalg.norm(ways, axis=1, keepdims=True)
    places = 5.0 * np.stack(np.unravel_index(np.arange(n), (15, 15, 15)), axis=1) - 35.0 + rng.random((n, 3))
    points = np.concatenate([places, places + ways]).astype(np.float32)

    found = cluster_free_points(points, eps, min_samples=2, device=device)

    def is_near(first, second):
        parts = [Fraction(float(x)) - Fraction(float(y)) for x, y in zip(first, second, strict=True)]
        return sum(part * part for part in parts) <= Fraction(limit) ** 2

    firsts, seconds = points[:n], points[n:]
    exact = np.array([is_near(first, second) for first, second in zip(firsts, seconds, strict=True)])
    in_float32 = ((seconds - firsts) ** 2).sum(axis=1) <= np.float32(limit) ** 2
    assert (in_float32 != exact).any(), "float32 alone would be right"
    assert np.array_equal(found.cores, np.concatenate([exact, exact]))


def test_equal_points_are_one_cluster_in_one_cell(device):
    found = cluster_free_points(np.full((200_000, 3), 7.25, np.float32), eps=0.5, min_samples=6, device=device)
    assert found.facts["cells"] == 1
    assert (found.labels == 0).all()
    assert found.cores.all()


@pytest.mark.parametrize(("gap", "clusters"), [(1.001, 2), (0.999, 1)], ids=["beyond eps", "within eps"])
def test_dense_spots_are_joined_where_their_gap_is_within_eps(device, gap, clusters):
    """4000 points in a cube of 0.02 mm, and the same again: their boxes are compared before their points."""
    side = 0.02
    spot = np.random.default_rng(5).random((4000, 3)) * side
    spot[0], spot[1] = 0.0, side
    points = np.concatenate([spot, spot + (gap + side, 0, 0)]).astype(np.float32)
    points[4000, 1:] = points[1, 1:]  # the nearest points of both, `gap` apart along x
    found = cluster_free_points(points, eps=1.0, min_samples=6, device=device)
    assert found.count == clusters
    assert found.cores.all()


@pytest.fixture(scope="module")
def clusters_in_two_orders(device):
    """Clusters of points, and those of the points permuted; the permutation."""
    points = scattered_points(5000, size=BOX, seed=6)
    order = np.random.default_rng(7).permutation(len(points))
    how = {"eps": 0.9, "min_samples": 4, "device": device}
    return cluster_free_points(points, **how), cluster_free_points(points[order], **how), order


def test_permuted_points_have_the_same_cores_in_the_same_clusters(clusters_in_two_orders):
    straight, permuted, order = clusters_in_two_orders
    assert np.array_equal(straight.cores[order], permuted.cores)
    pairs_of_numbers = np.unique(np.stack([straight.labels[order], permuted.labels])[:, permuted.cores], axis=1)
    assert pairs_of_numbers.shape[1] == straight.count == permuted.count


def test_clusters_are_numbered_by_their_first_core_point(clusters_in_two_orders):
    _, permuted, _ = clusters_in_two_orders
    firsts = [np.flatnonzero(permuted.cores & (permuted.labels == number))[0] for number in range(permuted.count)]
    assert len(firsts) > 1
    assert firsts == sorted(firsts)


def test_far_clouds_have_the_clusters_of_near_ones(device):
    """Coordinates are relative to whole millimetres, so these are the same numbers."""
    points = np.rint(scattered_points(3000, size=BOX, seed=8) * 256.0) / 256.0
    near = cluster_free_points(points, eps=0.9, min_samples=3, device=device)
    far = cluster_free_points(PointCloud(points + (1e5, -2e5, 3e5)), eps=0.9, min_samples=3, device=device)
    assert near.count > 1
    assert np.array_equal(near.labels, far.labels)


@pytest.mark.parametrize("eps", [60.0, 1e6, 1e30])
def test_eps_beyond_the_box_gives_one_cluster_in_one_cell(device, eps):
    found = cluster_free_points(scattered_points(500, size=BOX), eps, min_samples=500, device=device)
    assert found.facts["cells"] == 1
    assert (found.labels == 0).all()


@pytest.mark.parametrize("eps", [0, -1.0, np.nan, np.inf, 1e-10, "1"])
def test_eps_that_is_no_distance_is_refused(eps):
    with refused(UsageError, 1e-09, "distance"):
        cluster_free_points(scattered_points(10), eps)


@pytest.mark.parametrize("min_samples", [0, -3, 2.5, True])
def test_min_samples_that_are_no_count_are_refused(min_samples):
    with refused(UsageError, "min_samples", 1):
        cluster_free_points(scattered_points(10), eps=1.0, min_samples=min_samples)


def test_points_of_two_coordinates_are_refused(device):
    with refused(UsageError, 100, 2):
        cluster_free_points(scattered_points(100)[:, :2], 1.0)


def test_points_that_are_not_finite_are_refused_with_their_number(device):
    points = scattered_points(100)
    points[7] = np.nan
    with refused(UsageError, 1, 100):  # one of a hundred points
        cluster_free_points(points, 1.0, device=device)


def test_eps_that_needs_too_many_cells_is_refused_with_their_numbers(device):
    with pytest.raises(UsageError, match="has 5,[0-9,]+ x 3,[0-9,]+ x 3,[0-9,]+ of them"):  # 40 mm / (eps / sqrt(3))
        cluster_free_points(scattered_points(100, size=(40.0, 25.0, 30.0)), eps=0.0129, device=device)


@pytest.fixture(scope="module")
def two_million_points():
    """In a cube of 3 mm."""
    return scattered_points(2_000_000, size=(3.0, 3.0, 3.0))


def test_too_many_pairs_are_refused_before_they_are_compared(device, two_million_points):
    with refused(UsageError, 2_000_000, 64, 1e12):  # points, cells, and the most pairs
        cluster_free_points(two_million_points, eps=1.5, min_samples=6, device=device)


def test_points_of_one_cell_are_one_cluster_however_many_pairs_they_have(device, two_million_points):
    assert cluster_free_points(two_million_points, eps=6.0, min_samples=6, device=device).count == 1


def test_too_little_memory_for_free_clusters_is_refused(device):
    with refused(DeviceMemoryError, "clusters", "points"):
        cluster_free_points(scattered_points(50_000), eps=1.0, device=device, memory=2_000_000)


def test_progress_is_told_in_four_steps(device):
    told, points = [], scattered_points(100)
    cluster_free_points(points, eps=1.0, min_samples=2, device=device, progress=lambda *step: told.append(step))
    assert told == [("clusters", done, 4) for done in range(1, 5)]


CLUSTERING = {"eps": 1.1, "min_samples": 3}


@pytest.fixture(scope="module")
def clustered_cloud(device):
    """A cloud without voxels, and what `cluster_points` makes of it."""
    cloud = PointCloud(scattered_points(2000, size=BOX), hu=np.arange(2000))
    return cloud, cluster_points(cloud, **CLUSTERING, device=device)


def test_clouds_without_voxels_are_clustered_as_free_points(clustered_cloud):
    cloud, step = clustered_cloud
    count, labels, cores = twin.cluster_points(cloud.points, **CLUSTERING)
    assert np.array_equal(step.cloud.labels, labels)
    assert np.array_equal(step.cores, cores)
    assert step.facts["clusters"] == count
    largest, *_ = step.facts["largest_clusters"]
    assert largest["points"] == np.bincount(labels[labels >= 0]).max()


def test_clustering_of_a_cloud_keeps_all_points_and_their_hu(clustered_cloud):
    cloud, step = clustered_cloud
    assert not step.removed.any()
    assert np.array_equal(step.cloud.hu, cloud.hu)


def test_free_points_without_eps_are_refused(device):
    with refused(UsageError, "lattice", "distance"):
        cluster_points(PointCloud(scattered_points(100)), device=device)


def test_free_points_with_min_samples_of_a_plane_are_refused(device):
    with refused(UsageError, "min_samples", "planes"):
        cluster_points(PointCloud(scattered_points(100)), eps=1.0, min_samples="plane+1", device=device)


def test_free_points_beside_a_volume_are_refused(device):
    volume = Volume(np.zeros((2, 2, 2), np.int16), np.eye(4))
    with refused(UsageError, "volume"):
        cluster_points(PointCloud(scattered_points(100)), eps=1.0, volume=volume, device=device)


@pytest.mark.every_device
def test_clusters_of_a_large_cloud_equal_the_twin_with_a_warning_where_work_items_end_early(device):
    """Shares of a core would be longer than llvmpipe's loops: nearly all labels were wrong, without a word."""
    if device.most_steps is None:
        pytest.skip("work-items of this device do not end early")
    assert_clusters_equal_twin(device, scattered_points(60_000, size=(60.0, 40.0, 30.0)), eps=1.2, min_samples=4)
    assert any("ends the loops of a work-item" in text for text in device.warnings)
