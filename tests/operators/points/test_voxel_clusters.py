"""Clusters of voxels found on the device equal the twin's, scikit-learn's and scipy's components, label for label."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused
from surface_volumes import OBLIQUE
from uneven_volume import uneven
from variants import VOXEL_TYPES, daily, daily_rows

import clrecon
from clrecon import opencl
from clrecon.errors import DeviceError, DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.masks.voxel_mask import checked_band, mark_band
from clrecon.operators.points import voxel_clusters
from clrecon.operators.points.clusters import cluster_points
from clrecon.operators.points.voxel_clusters import ClusterSearch, pad_for
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points.cloud import PointCloud
from clrecon.points.stencil import Lattice, make_stencil
from clrecon.proof.points import clusters as twin

FINE = np.diag((0.5, 0.5, 0.8, 1.0))  # voxels of 0.5 x 0.5 x 0.8 mm
ONES = (1, 1)  # the band of HU that holds the voxels of value 1 alone


def random_voxels(shape: tuple[int, int, int], *, density: float) -> np.ndarray:
    """Voxels of 1 at random places, `density` of all, among zeros."""
    return (np.random.default_rng(5).random(shape) < density).astype(np.int16)


def points_of_ones(volume: Volume) -> np.ndarray:
    """Places of the voxels of 1 in LPS mm, in their order in memory."""
    return volume.ijk_to_lps(np.argwhere(volume.voxels > 0)[:, ::-1])  # k, j, i to i, j, k


def search(device, volume: Volume, *, eps: float, samples: int, **parts: int) -> ClusterSearch:
    """The search for clusters of the voxels of 1, as `cluster_points` begins it."""
    stencil = make_stencil(Lattice.of(volume), eps)
    with DeviceVolume(volume, device=device) as resident:
        mask = mark_band(resident, (1.0, 1.0), pad=pad_for(stencil))
        return ClusterSearch(device, mask, stencil, samples, **parts)


def count_clusters(device, volume: Volume, *, eps: float, samples: int) -> int:
    """The number of clusters of the voxels of 1, whose labels and core points equal those of the twin."""
    found = search(device, volume, eps=eps, samples=samples)
    labels, cores = found.label(), found.flag_cores()
    count, expected, expected_cores = twin.cluster_points(points_of_ones(volume), eps=eps, min_samples=samples)
    assert found.count == count
    assert labels.dtype == np.int32 and cores.dtype == bool
    np.testing.assert_array_equal(cores, expected_cores)
    np.testing.assert_array_equal(labels, expected)
    return count


assert_clusters_equal_twin = count_clusters


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 5, 8, 9, 17, 33])
@pytest.mark.parametrize("density", [0.05, 0.3, 0.7])
def test_clusters_of_random_voxels_equal_the_twin(device, density, samples):
    volume = Volume(random_voxels((6, 9, 70), density=density), FINE)
    assert_clusters_equal_twin(device, volume, eps=1.2, samples=samples)


@pytest.mark.parametrize("columns", [1, 31, 32, 33, 63, 64, 65, 255, 256, 257])
def test_clusters_of_rows_around_whole_words_equal_the_twin(device, columns):
    """The mask holds 32 columns in a word."""
    assert_clusters_equal_twin(device, Volume(random_voxels((3, 5, columns), density=0.4), FINE), eps=0.9, samples=5)


@pytest.mark.parametrize("shape", [(1, 1, 90), (1, 40, 1), (40, 1, 1), (1, 40, 40)])
def test_clusters_of_flat_volumes_equal_the_twin(device, shape):
    """eps joins neighbours along each axis: slices, the farthest, are 2.5 mm apart."""
    volume = Volume(random_voxels(shape, density=0.5), OBLIQUE)
    assert count_clusters(device, volume, eps=2.6, samples=3) > 0


@pytest.mark.parametrize("eps", [0.6, 1.1, 2.3])
@pytest.mark.parametrize("stack", ["uneven", "oblique"])
def test_clusters_of_uneven_and_oblique_stacks_equal_the_twin(device, stack, eps):
    voxels = random_voxels((6, 20, 33), density=0.35)
    volume = uneven(voxels) if stack == "uneven" else Volume(voxels, OBLIQUE)
    assert count_clusters(device, volume, eps=eps, samples=3) > 0  # some: measured 123 to 2, fewer with a larger eps


def test_clusters_of_a_stencil_beyond_several_words_equal_the_twin(device):
    """eps reaches 34 columns: the mask holds 32 in a word, so the search looks into 3 words on either side."""
    volume = Volume(random_voxels((2, 6, 200), density=0.02), np.diag((0.3, 2.0, 9.0, 1.0)))
    assert count_clusters(device, volume, eps=10.3, samples=3) > 0


def test_clusters_of_rows_whose_columns_are_no_neighbours_equal_the_twin(device):
    """eps is below the 2 mm between columns, and joins rows (0.5 mm) and slices (0.8 mm)."""
    volume = Volume(random_voxels((6, 9, 70), density=0.5), np.diag((2.0, 0.5, 0.8, 1.0)))
    assert count_clusters(device, volume, eps=0.9, samples=2) > 0


def test_every_voxel_is_a_cluster_of_its_own_where_eps_is_below_all_steps(device):
    volume = Volume(random_voxels((6, 9, 70), density=0.5), np.diag((2.0, 0.5, 0.8, 1.0)))
    assert count_clusters(device, volume, eps=0.4, samples=1) == np.count_nonzero(volume.voxels)


@pytest.mark.parametrize(("voxel_between", "clusters"), [(1, 1), (0, 2)], ids=["joined", "apart"])
def test_two_runs_of_a_row_are_joined_by_a_voxel_between_them_in_the_next_row(device, voxel_between, clusters):
    """Voxels of 1 mm, and eps 1.5 mm reaches the diagonal neighbour: the sweep must not stop at the first run."""
    voxels = np.zeros((1, 2, 40), np.int16)
    voxels[0, 0, 2:5] = voxels[0, 0, 6:9] = 1
    voxels[0, 1, 5] = voxel_between
    assert count_clusters(device, Volume(voxels, np.eye(4)), eps=1.5, samples=1) == clusters


@pytest.mark.parametrize(("middle", "clusters"), [("whole", 1), ("cut", 2)])
def test_path_back_and_forth_through_rows_and_slices_is_one_cluster_and_two_where_it_is_cut(device, middle, clusters):
    """A path back and forth through every second row of every second slice, joined at the ends of rows and slices."""
    voxels = np.zeros((9, 63, 65), np.int16)
    voxels[:, ::2] = 1
    voxels[:, 1::4, -1] = voxels[:, 3::4, 0] = 1  # steps from row to row, right and left in turn
    voxels[1::2] = 0
    voxels[1::4, -1, -1] = voxels[3::4, 0, 0] = 1  # steps from slice to slice, at either end of the path in turn
    if middle == "cut":
        voxels[4] = 0
    assert count_clusters(device, Volume(voxels, np.eye(4)), eps=1.0, samples=1) == clusters


@pytest.mark.parametrize(("value", "clusters"), [(0, 0), (1, 1)], ids=["empty", "full"])
def test_empty_volume_has_no_cluster_and_a_full_one_has_one(device, value, clusters):
    volume = Volume(np.full((4, 5, 70), value, np.int16), FINE)
    assert count_clusters(device, volume, eps=1.2, samples=6) == clusters


@pytest.mark.parametrize(("eps", "clusters"), [(0.9, 0), (2.6, 1)], ids=["11 voxels within", "over 255 within"])
def test_full_volume_is_noise_where_fewer_than_min_samples_lie_within_eps(device, eps, clusters):
    """Within 0.9 mm lie 9 voxels of 0.5 mm in the slice and 2 in its neighbours, 0.8 mm away."""
    volume = Volume(np.ones((5, 9, 40), np.int16), FINE)
    assert count_clusters(device, volume, eps=eps, samples=255) == clusters


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("group", daily(1, [16, 1]))
def test_clusters_on_devices_with_small_work_groups_equal_the_twin(device, group, monkeypatch):
    monkeypatch.setattr(device, "max_work_group_size", group)
    assert_clusters_equal_twin(device, Volume(random_voxels((6, 9, 70), density=0.3), FINE), eps=1.2, samples=5)


@pytest.mark.parametrize("parts_per_core", [1, 7, 1000])
def test_labels_of_clusters_found_in_1_7_or_1000_parts_a_core_are_those_of_the_default(device, parts_per_core):
    volume = Volume(random_voxels((6, 9, 70), density=0.3), FINE)
    labels = search(device, volume, eps=1.2, samples=5, parts_per_core=parts_per_core).label()
    np.testing.assert_array_equal(labels, search(device, volume, eps=1.2, samples=5).label())


@pytest.mark.oclgrind
def test_clusters_of_a_small_volume_equal_the_twin(device):
    assert_clusters_equal_twin(device, Volume(random_voxels((3, 5, 70), density=0.4), FINE), eps=1.0, samples=4)


@pytest.mark.oclgrind
def test_clusters_are_found_in_a_small_cloud_in_reversed_order(device):
    cloud = voxel_cloud(Volume(random_voxels((3, 4, 40), density=0.4), FINE))
    reversed_cloud = cloud.select(np.arange(len(cloud))[::-1])
    step = cluster_points(reversed_cloud, eps=1.0, min_samples=4, device=device)
    assert step.facts["clusters"] == 1  # so dense that all join


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
def test_clusters_of_every_voxel_type_equal_the_twin(device, dtype):
    low, high = 30.5, 60
    voxels = np.random.default_rng(1).integers(0, 100, (4, 6, 40)).astype(dtype)
    inside = (voxels >= low) & (voxels <= high)
    points = Volume(inside, FINE).ijk_to_lps(np.argwhere(inside)[:, ::-1])  # k, j, i to i, j, k

    step = cluster_points(Volume(voxels, FINE), eps=0.8, min_samples=3, hu=(low, high), device=device)

    _, expected, cores = twin.cluster_points(points, eps=0.8, min_samples=3)
    np.testing.assert_array_equal(step.cloud.labels, expected)
    np.testing.assert_array_equal(step.cores, cores)
    np.testing.assert_array_equal(step.cloud.hu, voxels[inside])


def voxel_cloud(volume: Volume) -> PointCloud:
    ijk = np.argwhere(volume.voxels > 0)[:, ::-1]
    report = {"affine_ijk_to_lps_mm": volume.affine.tolist()}
    return PointCloud(volume.ijk_to_lps(ijk), ijk=ijk, report=report)


@pytest.mark.release
@pytest.mark.parametrize(("eps", "samples"), daily_rows(1, [(1.2, 6), (0.85, 1), (1.6, 20)]))
def test_clusters_of_voxels_equal_scikit_learn(device, eps, samples):
    sklearn = pytest.importorskip("sklearn.cluster")
    volume = Volume(random_voxels((10, 30, 40), density=0.25), np.diag((0.644531, 0.644531, 0.8, 1.0)))
    # Distances up to eps * (1 + 1e-6) are within, see `cluster_points`.
    expected = sklearn.DBSCAN(eps=eps * (1 + 1e-6), min_samples=samples).fit(points_of_ones(volume))

    step = cluster_points(voxel_cloud(volume), eps=eps, min_samples=samples, device=device)

    np.testing.assert_array_equal(step.cloud.labels, expected.labels_)
    np.testing.assert_array_equal(np.flatnonzero(step.cores), expected.core_sample_indices_)
    assert step.facts["noise_points"] == np.count_nonzero(expected.labels_ < 0)


def test_clusters_of_a_shuffled_cloud_are_numbered_in_its_order_as_by_scikit_learn(device):
    sklearn = pytest.importorskip("sklearn.cluster")
    cloud = voxel_cloud(Volume(random_voxels((8, 16, 33), density=0.12), FINE))
    shuffled = cloud.select(np.random.default_rng(8).permutation(len(cloud)))
    expected = sklearn.DBSCAN(eps=0.9, min_samples=3).fit(shuffled.points.astype(np.float64))
    assert expected.labels_.max() > 20, "too few clusters for an order"  # measured 62

    step = cluster_points(shuffled, eps=0.9, min_samples=3, device=device)

    np.testing.assert_array_equal(step.cloud.labels, expected.labels_)
    np.testing.assert_array_equal(np.flatnonzero(step.cores), expected.core_sample_indices_)


@pytest.mark.parametrize(
    ("eps", "rank"), [(1.0, 1), (1.5, 2), (1.8, 3)], ids=["6 neighbours", "18 neighbours", "26 neighbours"]
)
def test_clusters_of_min_samples_one_are_the_connected_components_of_scipy(device, eps, rank):
    """Voxels of 1 mm: eps reaches faces (1), edges (1.41) and corners (1.73)."""
    from scipy import ndimage

    voxels = random_voxels((9, 21, 40), density=0.15)
    components, _ = ndimage.label(voxels, ndimage.generate_binary_structure(3, rank))
    step = cluster_points(Volume(voxels, np.eye(4)), eps=eps, min_samples=1, hu=ONES, device=device)
    np.testing.assert_array_equal(step.cloud.labels, components[voxels > 0] - 1)


@pytest.mark.parametrize("volume_is_given", [False, True])
def test_cloud_of_a_part_of_a_volume_has_its_clusters_with_and_without_the_volume(device, volume_is_given):
    voxels = random_voxels((8, 20, 64), density=0.3)
    voxels[:3] = voxels[:, :7] = voxels[..., :33] = 0
    volume = Volume(voxels, OBLIQUE)
    how = {"eps": 1.1, "min_samples": 4, "device": device}
    step = cluster_points(voxel_cloud(volume), **how, volume=volume if volume_is_given else None)
    expected = cluster_points(volume, **how, hu=ONES)
    np.testing.assert_array_equal(step.cloud.labels, expected.cloud.labels)


@pytest.mark.parametrize("stack", ["oblique", "uneven"])
@pytest.mark.parametrize(
    "chosen", [slice(None), slice(40, None, 3), np.arange(900)[::-1]], ids=["all", "every third", "reversed"]
)
def test_cloud_that_keeps_voxel_numbers_has_the_clusters_of_one_that_keeps_indices(device, stack, chosen):
    """Points of a volume keep one number each for their voxel, other clouds three indices."""
    voxels = random_voxels((6, 19, 67), density=0.3)
    volume = uneven(voxels) if stack == "uneven" else Volume(voxels, OBLIQUE)
    listed = voxel_cloud(volume)
    places = np.arange(len(listed))[chosen]
    cloud = clrecon.extract_points(volume, hu=ONES, device=device).select(places)

    numbered = cluster_points(cloud, eps=1.1, min_samples=4, volume=volume, device=device)

    by_index = cluster_points(listed.select(places), eps=1.1, min_samples=4, volume=volume, device=device)
    np.testing.assert_array_equal(numbered.cloud.labels, by_index.cloud.labels)
    np.testing.assert_array_equal(numbered.cores, by_index.cores)
    np.testing.assert_array_equal(numbered.cloud.ijk, by_index.cloud.ijk)


@pytest.mark.parametrize("step", [1, 3])
def test_points_of_a_volume_keep_voxel_numbers_when_chosen_in_ascending_order(device, step):
    volume = Volume(random_voxels((6, 19, 67), density=0.3), OBLIQUE)
    cloud = clrecon.extract_points(volume, hu=ONES, device=device)
    assert cloud.select(np.arange(0, len(cloud), step)).voxel_numbers is not None


def test_points_of_a_volume_are_refused_beside_the_same_volume_moved(device):
    volume = Volume(random_voxels((6, 19, 67), density=0.3), OBLIQUE)
    cloud = clrecon.extract_points(volume, hu=ONES, device=device)
    moved = OBLIQUE.copy()
    moved[0, 3] += 0.02  # mm
    with refused(UsageError, "voxels", "volume", 0.02):
        cluster_points(cloud, eps=1.1, min_samples=4, volume=Volume(volume.voxels, moved), device=device)


def test_points_of_a_volume_are_refused_beside_a_volume_of_fewer_slices(device):
    volume = Volume(random_voxels((6, 19, 67), density=0.3), OBLIQUE)
    cloud = clrecon.extract_points(volume, hu=ONES, device=device)
    with refused(UsageError, "volume", 67, 19):  # columns and rows
        cluster_points(cloud, eps=1.1, min_samples=4, volume=Volume(volume.voxels[:3], OBLIQUE), device=device)


def test_cloud_of_uneven_slices_is_refused_without_its_volume(device):
    volume = uneven(random_voxels((6, 10, 20), density=0.4))
    with refused(UsageError, "voxels", "volume"):
        cluster_points(voxel_cloud(volume), eps=1.1, min_samples=4, device=device)


def test_cloud_of_uneven_slices_has_the_clusters_of_its_volume(device):
    volume = uneven(random_voxels((6, 10, 20), density=0.4))
    step = cluster_points(voxel_cloud(volume), eps=1.1, min_samples=4, volume=volume, device=device)
    expected = cluster_points(volume, eps=1.1, min_samples=4, hu=ONES, device=device)
    np.testing.assert_array_equal(step.cloud.labels, expected.cloud.labels)


@pytest.fixture(scope="module")
def box_and_sheet(device):
    """Clusters, with all defaults, of a box of 4 x 6 x 6 voxels and of a sheet of 10 x 20 in slice 4."""
    voxels = np.zeros((8, 30, 40), np.int16)
    voxels[2:6, 3:9, 3:9] = voxels[4, 20:, 20:] = 300
    return cluster_points(Volume(voxels, FINE), hu=(200, np.inf), device=device)


def test_eps_is_by_default_half_more_than_the_largest_step_and_min_samples_six(box_and_sheet):
    assert box_and_sheet.facts["eps_mm"] == pytest.approx(1.5 * 0.8)
    assert box_and_sheet.facts["min_samples"] == 6


def test_facts_of_clusters_count_the_voxels_within_eps(box_and_sheet):
    """Within 1.2 mm lie 21 voxels of 0.5 mm in the slice, and 9 in each of the two slices 0.8 mm away."""
    assert box_and_sheet.facts["stencil_members_in_plane"] == 21
    assert box_and_sheet.facts["stencil_members"] == [21 + 2 * 9] * 2  # fewest and most of all slices


def test_facts_of_clusters_count_clusters_and_noise(box_and_sheet):
    assert box_and_sheet.facts["clusters"] == 2
    assert box_and_sheet.facts["noise_points"] == 0
    assert box_and_sheet.as_dict()["points_after"] == 4 * 6 * 6 + 10 * 20
    assert box_and_sheet.warnings == ()


def test_facts_of_clusters_tell_number_size_place_and_thickness_of_the_largest(box_and_sheet):
    largest, *_ = box_and_sheet.facts["largest_clusters"]
    assert (largest["cluster"], largest["points"]) == (1, 10 * 20)
    assert largest["box_lps_mm"] == [[20 * 0.5, 20 * 0.5, 4 * 0.8], [39 * 0.5, 29 * 0.5, 4 * 0.8]]
    assert min(largest["principal_sd_mm"]) == 0.0  # one slice has no thickness


def test_a_lone_slice_is_noise_and_a_box_a_cluster_with_min_samples_plane_plus_one(device):
    """One more than the 9 voxels of 0.6 mm within eps in a plane: a slice alone has no core point."""
    voxels = np.zeros((9, 20, 20), np.int16)
    voxels[1:5, 4:12, 4:12] = voxels[7] = 1
    volume = Volume(voxels, np.diag((0.6, 0.6, 0.8, 1.0)))

    found = cluster_points(volume, eps=0.9, min_samples="plane+1", hu=ONES, device=device)

    assert found.facts["min_samples"] == 9 + 1
    slices = found.cloud.ijk[:, 2]
    assert set(found.cloud.labels[slices == 7].tolist()) == {-1}
    assert (found.cloud.labels[slices < 5] == 0).mean() > 0.9  # but the box's corners
    assert not found.warnings


def test_plane_plus_one_is_warned_of_where_slices_lie_two_pixels_apart(device):
    volume = Volume(np.ones((5, 8, 8), np.int16), np.diag((0.5, 0.5, 1.0, 1.0)))
    found = cluster_points(volume, eps=1.5, min_samples="plane+1", hu=ONES, device=device)
    assert "takes much bone where slices are 2.0 pixels apart" in found.warnings[0]


def test_an_eps_below_every_step_of_the_voxels_is_warned_of(device):
    volume = Volume(random_voxels((5, 6, 40), density=0.3), FINE)
    step = cluster_points(volume, eps=0.4, min_samples=2, hu=ONES, device=device)
    assert "is below every step of the voxels (the smallest is 0.5 mm)" in step.warnings[0]
    assert step.facts["clusters"] == 0


def test_an_eps_below_the_slice_gap_is_warned_of(device):
    volume = Volume(random_voxels((5, 6, 40), density=0.3), FINE)
    step = cluster_points(volume, eps=0.6, min_samples=2, hu=ONES, device=device)
    assert "below the largest slice gap of 0.8 mm" in step.warnings[0]


def test_an_eps_larger_than_the_volume_gives_one_cluster(device):
    volume = Volume(random_voxels((4, 6, 40), density=0.1), FINE)
    step = cluster_points(volume, eps=1e6, min_samples=6, hu=ONES, device=device)
    assert (step.cloud.labels == 0).all()
    assert step.facts["clusters"] == 1


def test_fewer_voxels_than_min_samples_are_noise_with_a_warning(device):
    volume = Volume(np.pad(np.ones((1, 1, 3), np.int16), 2), FINE)
    step = cluster_points(volume, eps=1e6, min_samples=6, hu=ONES, device=device)
    assert step.facts["noise_points"] == 3
    assert "3 points are fewer than min_samples 6: all are noise" in step.warnings


def nine_far_voxels() -> Volume:
    """Nine voxels, 100 mm from each other, in a volume of one column."""
    voxels = np.zeros((450, 450, 1), np.int16)
    voxels[::200, ::200] = 1
    return Volume(voxels, FINE)


def test_an_eps_whose_search_would_take_too_long_is_refused(device):
    with refused(UsageError, "eps", 1e11):  # the most visits of rows
        cluster_points(nine_far_voxels(), eps=300.0, min_samples=6, hu=ONES, device=device)


@pytest.mark.parametrize(("samples", "label"), [(6, 0), (255, -1)], ids=["one cluster", "all noise"])
def test_an_eps_larger_than_the_volume_needs_no_search(device, samples, label):
    step = cluster_points(nine_far_voxels(), eps=1e6, min_samples=samples, hu=ONES, device=device)
    assert step.cloud.labels.tolist() == [label] * 9
    assert step.cores.tolist() == [label == 0] * 9


@pytest.mark.parametrize("origins", [None, [[0.0, 0, 0], [0, 0, 1], [0, 0, 2.5]]], ids=["even", "uneven"])
@pytest.mark.parametrize(
    ("beyond_diagonal", "holds"), [(-1e-3, False), (0.0, True), (1e6, True)], ids=["shorter", "equal", "longer"]
)
def test_a_stencil_holds_a_volume_whose_diagonal_is_no_longer_than_eps(origins, beyond_diagonal, holds):
    shape, affine = (5, 4, 3), np.diag([1.0, 2.0, 1.25, 1.0])
    lattice = Lattice(shape, affine, None if origins is None else np.array(origins))
    diagonal = math.sqrt((4 * 1.0) ** 2 + (3 * 2.0) ** 2 + (2 * 1.25) ** 2)
    assert make_stencil(lattice, diagonal + beyond_diagonal).holds(shape) == holds


def sparse_values() -> Volume:
    """Whole HU from 0 to 99 in 40 slices; 3 % of the voxels have 97 and more."""
    return Volume(np.random.default_rng(2).integers(0, 100, (40, 30, 64)).astype(np.float32), FINE)


def test_clusters_of_a_volume_beyond_the_memory_are_those_of_the_whole(device):
    volume = sparse_values()
    slice_bytes = volume.voxels[0].nbytes
    how = {"eps": 1.2, "min_samples": 3, "hu": (97, 100), "device": device}
    expected = cluster_points(volume, **how)
    memory = expected.facts["device_bytes"] + 4 * slice_bytes
    assert memory < volume.voxels.nbytes

    heard: list[tuple[str, int, int]] = []
    step = cluster_points(volume, **how, memory=memory, progress=lambda *told: heard.append(told))

    np.testing.assert_array_equal(step.cloud.labels, expected.cloud.labels)
    assert len(heard) > 2 and heard[-1] == ("mask", 40, 40)  # slab by slab, of 40 slices


@pytest.mark.parametrize(
    ("band", "memory", "facts"),
    [((97, 100), 20_000, ("mask", "voxels", 20_000)), ((0, 100), 100_000, ("clusters", "voxels"))],
    ids=["no room for a mask", "no room for the clusters of all voxels"],
)
def test_clusters_without_room_on_the_device_are_refused(device, band, memory, facts):
    with refused(DeviceError, *facts):
        cluster_points(sparse_values(), eps=1.2, min_samples=3, hu=band, device=device, memory=memory)


def test_too_little_memory_is_refused_before_any_is_taken(device, monkeypatch):
    no_memory = {**vars(opencl), "allocate": lambda *_: pytest.fail("memory was taken")}
    monkeypatch.setattr(voxel_clusters, "ocl", SimpleNamespace(**no_memory))
    with refused(DeviceMemoryError, "mask", "core", 2000):
        cluster_points(voxel_cloud(Volume(random_voxels((6, 9, 70), density=0.3), FINE)), device=device, memory=2000)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"eps": 0.0, "hu": ONES}, "eps is 0.0: a distance above 0 mm"),
        ({"eps": -1.2, "hu": ONES}, "eps is -1.2: a distance above 0 mm"),
        ({"eps": float("nan"), "hu": ONES}, "eps is nan: a distance above 0 mm"),
        ({"min_samples": 0, "hu": ONES}, "min_samples is 0: a core point has from 1 to 255 points within eps"),
        ({"min_samples": 256, "hu": ONES}, "min_samples is 256: a core point has from 1 to 255"),
        ({"min_samples": 2.5, "hu": ONES}, "min_samples is 2.5: a core point has from 1 to 255"),
        ({"min_samples": "plane", "hu": ONES}, "a whole number, or plane\\+1, is needed"),
        ({}, "clusters of a volume need hu=LO,HI"),
        ({"hu": (300, 200)}, "a band is two numbers in HU, the lower one first, not \\(300, 200\\)"),
        ({"hu": (np.nan, 200)}, "a band is two numbers"),
        ({"hu": 200}, "a band is two numbers"),
        ({"hu": (7, 9)}, "no voxel lies from 7 to 9 HU: there is nothing to cluster"),
    ],
)
def test_parameters_that_cannot_cluster_a_volume_are_refused(device, arguments, words):
    with pytest.raises(UsageError, match=words):
        cluster_points(Volume(random_voxels((3, 4, 40), density=0.4), FINE), device=device, **arguments)


@pytest.mark.parametrize("band", [(0.2, 0.8), (40_000, 50_000)], ids=["between whole numbers", "beyond int16"])
def test_bands_that_no_voxel_can_have_are_refused(device, band):
    with refused(NoSurfaceError, "voxel"):
        cluster_points(Volume(random_voxels((3, 4, 40), density=0.4), FINE), hu=band, device=device)


@pytest.fixture(scope="module")
def small_cloud() -> PointCloud:
    """The voxels of 1 of a volume of 3 x 4 x 40."""
    return voxel_cloud(Volume(random_voxels((3, 4, 40), density=0.4), FINE))


def test_empty_cloud_is_refused(device, small_cloud):
    with refused(UsageError, "cloud", "empty"):
        cluster_points(small_cloud.select([]), device=device)


def test_cloud_with_a_voxel_twice_is_refused(device, small_cloud):
    with refused(UsageError, 1, 3):  # one of three points
        cluster_points(small_cloud.select([0, 1, 1]), device=device)


def test_cloud_of_voxels_without_their_affine_is_refused(device, small_cloud):
    with refused(UsageError, "voxels"):
        cluster_points(small_cloud.changed(report={}), device=device)


def test_cloud_beside_a_band_of_values_is_refused(device, small_cloud):
    with refused(UsageError, "voxels", "volume"):
        cluster_points(small_cloud, hu=(1, 2), device=device)


def test_cloud_beside_a_volume_too_small_for_its_voxels_is_refused(device, small_cloud):
    with refused(UsageError, "volume", 39, 2):  # columns: the highest of a voxel, and those that the volume has
        cluster_points(small_cloud, volume=Volume(random_voxels((2, 2, 2), density=1.0), FINE), device=device)


def test_cloud_beside_a_volume_that_places_its_voxels_elsewhere_is_refused(device, small_cloud):
    with refused(UsageError, "points", "voxels"):
        cluster_points(small_cloud, volume=Volume(random_voxels((3, 4, 40), density=1.0), OBLIQUE), device=device)


def test_cloud_of_one_voxel_is_one_cluster_with_min_samples_one(device, small_cloud):
    one = cluster_points(small_cloud.select([0]), min_samples=1, eps=0.6, device=device)
    assert one.cloud.labels.tolist() == [0]


def test_an_eps_of_a_thousand_pixels_is_refused(device):
    """Each of 6.6 million voxels has some 3 million others within eps: hours of work."""
    volume = Volume(np.ones((200, 1000, 33), np.int8), np.diag((1.0, 0.01, 0.01, 1.0)))
    with refused(UsageError, "eps", 1e11):  # the most visits of rows
        cluster_points(volume, eps=10.0, hu=ONES, device=device)


@pytest.mark.release
@pytest.mark.first_device
def test_clusters_of_bone_in_a_real_scan_equal_scikit_learn(device, real_data):
    sklearn = pytest.importorskip("sklearn.cluster")
    volume = clrecon.read_volume(real_data / "thoracic_0p8mm")
    part = Volume(volume.voxels[40:60], volume.affine)
    step = cluster_points(part, eps=1.2, min_samples=6, hu=(300, np.inf), device=device)
    points = part.ijk_to_lps(step.cloud.ijk)
    expected = sklearn.DBSCAN(eps=1.2 * (1 + 1e-6), min_samples=6).fit_predict(points)
    np.testing.assert_array_equal(step.cloud.labels, expected)
    assert step.facts["clusters"] > 20, "too few clusters to compare"


@pytest.mark.release  # every day: those of random voxels equal the twin, and scikit-learn's in even stacks
@pytest.mark.parametrize("eps", [1.2, 4.1])
def test_clusters_of_a_real_tilted_scan_with_gaps_equal_scikit_learn(device, real_data, eps):
    sklearn = pytest.importorskip("sklearn.cluster")
    volume = clrecon.read_volume(real_data / "head_tilt_gaps", allow_gaps=True)
    assert volume.uneven
    step = cluster_points(volume, eps=eps, min_samples=6, hu=(700, np.inf), device=device)
    expected = sklearn.DBSCAN(eps=eps * (1 + 1e-6), min_samples=6).fit_predict(volume.ijk_to_lps(step.cloud.ijk))
    np.testing.assert_array_equal(step.cloud.labels, expected)
    assert step.facts["clusters"] > 3, "too few clusters to compare"


@pytest.mark.parametrize(
    ("hu", "voxels"), [((1, None), "ones"), ((None, 0), "zeros"), ((None, None), "all")], ids=["from 1", "to 0", "open"]
)
def test_clusters_of_a_band_without_an_end_hold_the_voxels_that_point_extraction_takes(device, hu, voxels):
    volume = Volume(random_voxels((5, 6, 40), density=0.3), FINE)
    ones = np.count_nonzero(volume.voxels)
    expected = {"ones": ones, "zeros": volume.voxels.size - ones, "all": volume.voxels.size}[voxels]
    step = cluster_points(volume, eps=0.6, min_samples=2, hu=hu, device=device)
    assert len(step.cloud) == len(clrecon.extract_points(volume, hu=hu, device=device)) == expected


@pytest.mark.parametrize(
    ("hu", "closed"),
    [((1, None), (1, math.inf)), ((None, 0), (-math.inf, 0)), ((None, None), (-math.inf, math.inf)),
     ([-np.inf, np.inf], (-math.inf, math.inf))],
)  # fmt: skip
def test_a_band_without_an_end_ends_at_infinity(hu, closed):
    assert checked_band(hu) == closed


@pytest.mark.parametrize("wrong", [(1,), (None, None, None), (2, 1), (None, "x"), (math.nan, None)])
def test_bands_that_are_no_two_ascending_numbers_are_refused(device, wrong):
    with refused(UsageError, "band"):
        cluster_points(
            Volume(random_voxels((5, 6, 40), density=0.3), FINE), eps=0.6, min_samples=2, hu=wrong, device=device
        )


@pytest.mark.parametrize("report_is_kept", [True, False])
@pytest.mark.parametrize(("eps", "clusters", "warned"), [(2.0, 20, True), (3.0, 1, False)])
def test_an_eps_below_the_slice_step_is_warned_of_for_free_points(device, report_is_kept, eps, clusters, warned):
    """A long bone through 20 slices 3 mm apart: its surface has no points between the slices."""
    _, j, i = np.indices((20, 24, 24))
    bone = np.where(np.hypot(j - 12, i - 12) < 7.0, 600, -800).astype(np.int16)
    volume = Volume(bone, np.diag((0.7, 0.7, 3.0, 1.0)))
    surface = clrecon.extract_points(volume, 200, kind="surface", device=device)
    free = PointCloud(surface.points, report=surface.report if report_is_kept else {})

    found = cluster_points(free, eps=eps, min_samples=3, device=device)

    assert found.facts["clusters"] == clusters
    text = "is below the 3 mm between the slices that the points come from"
    assert [text in warning for warning in found.warnings] == [True] * warned


def test_points_that_lie_in_no_slices_are_not_warned_of(device):
    points = np.random.default_rng(2).normal(0.0, 20.0, (500, 3))
    assert cluster_points(PointCloud(points), eps=2.0, min_samples=3, device=device).warnings == ()
