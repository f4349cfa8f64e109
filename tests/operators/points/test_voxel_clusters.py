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
from clrecon.points import PointCloud
from clrecon.points.stencil import Lattice, make_stencil
from clrecon.proof.points import clusters as twin

FINE = np.diag((0.5, 0.5, 0.8, 1.0))


def noise(shape: tuple[int, int, int], density: float, seed: int = 5) -> np.ndarray:
    return (np.random.default_rng(seed).random(shape) < density).astype(np.int16)


def points_of(volume: Volume) -> np.ndarray:
    return volume.ijk_to_lps(np.argwhere(volume.voxels > 0)[:, ::-1])


def search(device, volume: Volume, eps: float, samples: int, **parts: int) -> ClusterSearch:
    stencil = make_stencil(Lattice.of(volume), eps)
    with DeviceVolume(volume, device=device) as resident:
        mask = mark_band(resident, (1.0, 1.0), pad=pad_for(stencil))
        return ClusterSearch(device, mask, stencil, samples, **parts)


def check_equal(device, volume: Volume, eps: float, samples: int) -> int:
    found = search(device, volume, eps, samples)
    labels, cores = found.label(), found.flag_cores()
    count, expected, expected_cores = twin.cluster_points(points_of(volume), eps, samples)
    assert found.count == count
    assert labels.dtype == np.int32 and cores.dtype == bool
    np.testing.assert_array_equal(cores, expected_cores)
    np.testing.assert_array_equal(labels, expected)
    return count


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 5, 8, 9, 17, 33])
@pytest.mark.parametrize("density", [0.05, 0.3, 0.7])
def test_noise_equals_the_twin(device, density, samples):
    check_equal(device, Volume(noise((6, 9, 70), density), FINE), 1.2, samples)


@pytest.mark.parametrize("ni", [1, 2, 31, 32, 33, 63, 64, 65, 255, 256, 257])
def test_clusters_of_rows_of_every_length_equal_the_twin(device, ni):
    check_equal(device, Volume(noise((3, 5, ni), 0.4), FINE), 0.9, 5)


@pytest.mark.parametrize("shape", [(1, 1, 90), (1, 40, 1), (40, 1, 1), (1, 40, 40)])
def test_clusters_of_flat_volumes_equal_the_twin(device, shape):
    check_equal(device, Volume(noise(shape, 0.5), OBLIQUE), 1.3, 3)


@pytest.mark.parametrize("eps", [0.6, 1.1, 2.3])
def test_clusters_of_uneven_and_oblique_stacks_equal_the_twin(device, eps):
    assert check_equal(device, uneven(noise((6, 20, 33), 0.35)), eps, 4) > 0
    assert check_equal(device, Volume(noise((8, 12, 40), 0.3), OBLIQUE), eps, 3) > 0


def test_clusters_of_a_stencil_beyond_several_words_equal_the_twin(device):
    """eps reaches 34 columns: 3 words on either side."""
    volume = Volume(noise((2, 6, 200), 0.02), np.diag((0.3, 2.0, 9.0, 1.0)))
    assert check_equal(device, volume, 10.3, 3) > 0


def test_clusters_of_rows_whose_columns_are_no_neighbours_equal_the_twin(device):
    """eps joins rows and slices, and not the voxels of a row: each is a node of its own."""
    volume = Volume(noise((6, 9, 70), 0.5), np.diag((2.0, 0.5, 0.8, 1.0)))
    assert check_equal(device, volume, 0.9, 2) > 0
    assert check_equal(device, volume, 0.4, 1) == int(volume.voxels.sum())


def test_a_run_is_met_by_two_widened_runs(device):
    """The trap of the sweep: both runs of the first row join the single voxel between them in the next one."""
    voxels = np.zeros((1, 2, 40), np.int16)
    voxels[0, 0, 2:5] = voxels[0, 0, 6:9] = voxels[0, 1, 5] = 1
    volume = Volume(voxels, np.eye(4))
    assert check_equal(device, volume, 1.5, 1) == 1
    voxels[0, 1, 5] = 0
    assert check_equal(device, volume, 1.5, 1) == 2


def test_path_through_all_rows_is_one_cluster(device):
    """A path back and forth through every row and slice: labels pass through all parts of the rows."""
    voxels = np.zeros((9, 63, 65), np.int16)
    voxels[:, ::2] = 1
    voxels[:, 1::4, -1] = voxels[:, 3::4, 0] = 1
    voxels[1::2] = 0
    voxels[1::4, -1, -1] = voxels[3::4, 0, 0] = 1
    assert check_equal(device, Volume(voxels, np.eye(4)), 1.0, 1) == 1
    voxels[4] = 0
    assert check_equal(device, Volume(voxels, np.eye(4)), 1.0, 1) == 2


@pytest.mark.parametrize("value", [0, 1])
def test_empty_and_full_volumes_have_no_or_one_cluster(device, value):
    volume = Volume(np.full((4, 5, 70), value, np.int16), FINE)
    assert check_equal(device, volume, 1.2, 6) == value


def test_more_samples_than_a_stencil_has_is_all_noise(device):
    volume = Volume(np.ones((5, 9, 40), np.int16), FINE)
    assert check_equal(device, volume, 0.9, 255) == 0
    assert check_equal(device, volume, 2.6, 255) == 1


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("group", daily(1, [16, 1]))
def test_clusters_on_devices_with_small_work_groups_equal_the_twin(device, group, monkeypatch):
    monkeypatch.setattr(device, "max_work_group_size", group)
    check_equal(device, Volume(noise((6, 9, 70), 0.3), FINE), 1.2, 5)


def test_clusters_are_the_same_in_parts_of_any_size(device):
    volume = Volume(noise((6, 9, 70), 0.3), FINE)
    labels = [search(device, volume, 1.2, 5, parts_per_core=parts).label() for parts in (1, 7, 1000)]
    np.testing.assert_array_equal(labels, [search(device, volume, 1.2, 5).label()] * 3)


@pytest.mark.oclgrind
def test_clusters_under_a_simulator_equal_the_twin(device):
    check_equal(device, Volume(noise((3, 5, 70), 0.4), FINE), 1.0, 4)
    cloud = voxel_cloud(Volume(noise((3, 4, 40), 0.4), FINE))
    assert cluster_points(cloud.select(np.arange(len(cloud))[::-1]), 1.0, 4, device=device).facts["clusters"] > 0


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
def test_clusters_of_every_voxel_type_equal_the_twin(device, dtype):
    voxels = np.random.default_rng(1).integers(0, 100, (4, 6, 40)).astype(dtype)
    step = cluster_points(Volume(voxels, FINE), 0.8, 3, hu=(30.5, 60), device=device)
    inside = (voxels >= 30.5) & (voxels <= 60)
    count, expected, cores = twin.cluster_points(Volume(inside, FINE).ijk_to_lps(np.argwhere(inside)[:, ::-1]), 0.8, 3)
    np.testing.assert_array_equal(step.cloud.labels, expected)
    np.testing.assert_array_equal(step.cores, cores)
    assert step.facts["clusters"] == count and step.cloud.hu.tolist() == voxels[inside].tolist()


def voxel_cloud(volume: Volume) -> PointCloud:
    ijk = np.argwhere(volume.voxels > 0)[:, ::-1]
    report = {"affine_ijk_to_lps_mm": volume.affine.tolist()}
    return PointCloud(volume.ijk_to_lps(ijk), ijk=ijk, report=report)


@pytest.mark.release
@pytest.mark.parametrize(("eps", "samples"), daily_rows(1, [(1.2, 6), (0.85, 1), (1.6, 20)]))
def test_clusters_of_voxels_equal_scikit_learn(device, eps, samples):
    sklearn = pytest.importorskip("sklearn.cluster")
    volume = Volume(noise((10, 30, 40), 0.25), np.diag((0.644531, 0.644531, 0.8, 1.0)))
    expected = sklearn.DBSCAN(eps=eps * (1 + 1e-6), min_samples=samples).fit(points_of(volume))
    step = cluster_points(voxel_cloud(volume), eps, samples, device=device)
    np.testing.assert_array_equal(step.cloud.labels, expected.labels_)
    np.testing.assert_array_equal(np.flatnonzero(step.cores), expected.core_sample_indices_)
    assert step.facts["noise_points"] == int((expected.labels_ < 0).sum()) and not step.removed.any()


def test_clouds_in_another_order_are_numbered_in_that_order(device):
    sklearn = pytest.importorskip("sklearn.cluster")
    cloud = voxel_cloud(Volume(noise((8, 16, 33), 0.12), FINE))
    shuffled = cloud.select(np.random.default_rng(8).permutation(len(cloud)))
    expected = sklearn.DBSCAN(eps=0.9, min_samples=3).fit(shuffled.points.astype(np.float64))
    assert expected.labels_.max() > 20
    step = cluster_points(shuffled, 0.9, 3, device=device)
    np.testing.assert_array_equal(step.cloud.labels, expected.labels_)
    np.testing.assert_array_equal(np.flatnonzero(step.cores), expected.core_sample_indices_)


def test_one_sample_gives_connected_components(device):
    from scipy import ndimage

    voxels = noise((9, 21, 40), 0.15)
    volume = Volume(voxels, np.eye(4))
    for eps, rank in ((1.0, 1), (1.5, 2), (1.8, 3)):
        parts, count = ndimage.label(voxels, ndimage.generate_binary_structure(3, rank))
        step = cluster_points(volume, eps, 1, hu=(1, 1), device=device)
        np.testing.assert_array_equal(step.cloud.labels, parts[voxels > 0] - 1)
        assert step.facts["clusters"] == count and step.facts["noise_points"] == 0


def test_a_cloud_of_a_part_of_the_volume_needs_no_volume(device):
    voxels = noise((8, 20, 64), 0.3)
    voxels[:3] = voxels[:, :7] = voxels[..., :33] = 0
    volume = Volume(voxels, OBLIQUE)
    expected = cluster_points(volume, 1.1, 4, hu=(1, 1), device=device)
    for step in (
        cluster_points(voxel_cloud(volume), 1.1, 4, device=device),
        cluster_points(voxel_cloud(volume), 1.1, 4, volume=volume, device=device),
    ):
        np.testing.assert_array_equal(step.cloud.labels, expected.cloud.labels)


@pytest.mark.parametrize("make", [lambda voxels: Volume(voxels, OBLIQUE), uneven], ids=["oblique", "uneven"])
def test_voxels_by_number_are_clustered_as_those_by_index(device, make):
    volume = make(noise((6, 19, 67), 0.3))
    listed = voxel_cloud(volume)
    for chosen in (slice(None), slice(40, None, 3), np.arange(900)[::-1]):
        cloud = clrecon.extract_points(volume, hu=(1, 1), device=device).select(np.arange(len(listed))[chosen])
        numbered = cluster_points(cloud, 1.1, 4, volume=volume, device=device)
        assert cloud.voxel_numbers is not None or not isinstance(chosen, slice)  # indices are made for other orders
        by_index = cluster_points(listed.select(np.arange(len(listed))[chosen]), 1.1, 4, volume=volume, device=device)
        np.testing.assert_array_equal(numbered.cloud.labels, by_index.cloud.labels)
        np.testing.assert_array_equal(numbered.cores, by_index.cores)
        np.testing.assert_array_equal(numbered.cloud.ijk, by_index.cloud.ijk)


def test_voxels_by_number_of_another_volume_are_refused(device):
    volume = Volume(noise((6, 19, 67), 0.3), OBLIQUE)
    cloud = clrecon.extract_points(volume, hu=(1, 1), device=device)
    affine = OBLIQUE.copy()
    affine[0, 3] += 0.02
    moved = Volume(volume.voxels, affine)
    with refused(UsageError, "voxels", "volume", 0.02):
        cluster_points(cloud, 1.1, 4, volume=moved, device=device)
    smaller = Volume(volume.voxels[:3], OBLIQUE)
    with refused(UsageError, "volume", 67, 19):
        cluster_points(cloud, 1.1, 4, volume=smaller, device=device)


def test_an_uneven_cloud_needs_its_volume(device):
    volume = uneven(noise((6, 10, 20), 0.4))
    with refused(UsageError, "voxels", "volume"):
        cluster_points(voxel_cloud(volume), 1.1, 4, device=device)
    step = cluster_points(voxel_cloud(volume), 1.1, 4, volume=volume, device=device)
    np.testing.assert_array_equal(
        step.cloud.labels, cluster_points(volume, 1.1, 4, hu=(1, 1), device=device).cloud.labels
    )


def test_facts_say_what_was_done(device):
    voxels = np.zeros((8, 30, 40), np.int16)
    voxels[2:6, 3:9, 3:9] = voxels[4, 20:, 20:] = 300
    step = cluster_points(Volume(voxels, FINE), hu=(200, np.inf), device=device)
    facts = step.facts
    assert facts["eps_mm"] == pytest.approx(1.2) and facts["min_samples"] == 6
    assert facts["stencil_members_in_plane"] == 21 and facts["stencil_members"] == [39, 39]
    assert facts["clusters"] == 2 and facts["noise_points"] == 0 and facts["sheets"] == 0
    largest = facts["largest_clusters"][0]
    assert largest["cluster"] == 1 and largest["points"] == 200 and largest["principal_sd_mm"][0] == 0.0
    assert largest["box_lps_mm"] == [[10.0, 10.0, 3.2], [19.5, 14.5, 3.2]]
    assert step.warnings == () and step.as_dict()["points_after"] == 344


def test_a_lone_slice_is_noise_with_plane_plus_one(device):
    voxels = np.zeros((9, 20, 20), np.int16)
    voxels[1:5, 4:12, 4:12] = voxels[7] = 1
    lone = cluster_points(Volume(voxels, np.diag((0.6, 0.6, 0.8, 1.0))), 0.9, "plane+1", hu=(1, 1), device=device)
    assert lone.facts["min_samples"] == lone.facts["stencil_members_in_plane"] + 1 == 10
    assert not lone.warnings
    assert set(lone.cloud.labels[lone.cloud.ijk[:, 2] == 7].tolist()) == {-1}
    assert (lone.cloud.labels[lone.cloud.ijk[:, 2] < 6] == 0).mean() > 0.9
    wide = cluster_points(Volume(voxels, np.diag((0.5, 0.5, 1.0, 1.0))), 1.5, "plane+1", hu=(1, 1), device=device)
    assert "takes much bone where slices are 2.0 pixels apart" in wide.warnings[0]


def test_an_eps_below_the_steps_is_warned_of(device):
    volume = Volume(noise((5, 6, 40), 0.3), FINE)
    step = cluster_points(volume, 0.4, 2, hu=(1, 1), device=device)
    assert "is below every step of the voxels (the smallest is 0.5 mm)" in step.warnings[0]
    assert step.facts["clusters"] == 0 and step.facts["stencil_members"] == [1, 1]
    step = cluster_points(volume, 0.6, 2, hu=(1, 1), device=device)
    assert "below the largest slice gap of 0.8 mm" in step.warnings[0]


def test_an_eps_larger_than_the_volume_gives_one_cluster(device):
    volume = Volume(noise((4, 6, 40), 0.1), FINE)
    step = cluster_points(volume, 1e6, 6, hu=(1, 1), device=device)
    assert step.facts["clusters"] == 1 and step.facts["noise_points"] == 0
    few = Volume(np.pad(np.ones((1, 1, 3), np.int16), 2), FINE)
    step = cluster_points(few, 1e6, 6, hu=(1, 1), device=device)
    assert step.facts["noise_points"] == 3 and "3 points are fewer than min_samples 6: all are noise" in step.warnings


def test_an_eps_larger_than_the_volume_needs_no_search(device):
    voxels = np.zeros((450, 450, 1), np.int16)
    voxels[::200, ::200] = 1
    volume = Volume(voxels, FINE)
    with refused(UsageError, "volume"):
        cluster_points(volume, 300.0, 6, hu=(1, 1), device=device)
    for samples, labels in ((6, 0), (255, -1)):
        step = cluster_points(volume, 1e6, samples, hu=(1, 1), device=device)
        assert len(step.cloud) == 9 and (step.cloud.labels == labels).all()
        assert (step.cores == (labels == 0)).all() and step.facts["clusters"] == labels + 1


@pytest.mark.parametrize("origins", [None, [[0.0, 0, 0], [0, 0, 1], [0, 0, 2.5]]], ids=["even", "uneven"])
def test_a_stencil_holds_a_volume_from_its_diagonal_on(origins):
    shape, affine = (5, 4, 3), np.diag([1.0, 2.0, 1.25, 1.0])
    lattice = Lattice(shape, affine, None if origins is None else np.array(origins))
    diagonal = math.sqrt(4.0**2 + 6.0**2 + 2.5**2)
    assert not make_stencil(lattice, diagonal - 1e-3).holds(shape)
    assert make_stencil(lattice, diagonal).holds(shape) and make_stencil(lattice, 1e6).holds(shape)


def test_volumes_over_the_memory_give_the_same_labels(device):
    voxels = np.random.default_rng(2).integers(0, 100, (40, 30, 64)).astype(np.float32)
    volume = Volume(voxels, FINE)
    expected = cluster_points(volume, 1.2, 3, hu=(97, 100), device=device)
    heard: list[tuple[str, int, int]] = []
    memory = expected.facts["device_bytes"] + 4 * voxels[0].nbytes
    assert memory < voxels.nbytes
    step = cluster_points(
        volume, 1.2, 3, hu=(97, 100), device=device, memory=memory, progress=lambda *told: heard.append(told)
    )
    np.testing.assert_array_equal(step.cloud.labels, expected.cloud.labels)
    assert len(heard) > 2 and heard[-1] == ("mask", 40, 40)
    with refused(DeviceError, "mask", "voxels", 20000):
        cluster_points(volume, 1.2, 3, hu=(97, 100), device=device, memory=20_000)
    with refused(DeviceMemoryError, "clusters", "voxels"):
        cluster_points(volume, 1.2, 3, hu=(0, 100), device=device, memory=memory)


def test_memory_is_refused_before_it_is_taken(device, monkeypatch):
    no_memory = {**vars(opencl), "allocate": lambda *_: pytest.fail("memory was taken")}
    monkeypatch.setattr(voxel_clusters, "ocl", SimpleNamespace(**no_memory))
    with refused(DeviceMemoryError, "mask", "core", 2000):
        cluster_points(voxel_cloud(Volume(noise((6, 9, 70), 0.3), FINE)), device=device, memory=2000)


BAND = {"hu": (1, 1)}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"eps": 0.0, **BAND}, "eps is 0.0: a distance above 0 mm"),
        ({"eps": -1.2, **BAND}, "eps is -1.2: a distance above 0 mm"),
        ({"eps": float("nan"), **BAND}, "eps is nan: a distance above 0 mm"),
        ({"min_samples": 0, **BAND}, "min_samples is 0: a core point has from 1 to 255 points within eps"),
        ({"min_samples": 256, **BAND}, "min_samples is 256: a core point has from 1 to 255"),
        ({"min_samples": 2.5, **BAND}, "min_samples is 2.5: a core point has from 1 to 255"),
        ({"min_samples": "plane", **BAND}, "a whole number, or plane\\+1, is needed"),
        ({}, "clusters of a volume need hu=LO,HI"),
        ({"hu": (300, 200)}, "a band is two numbers in HU, the lower one first, not \\(300, 200\\)"),
        ({"hu": (np.nan, 200)}, "a band is two numbers"),
        ({"hu": 200}, "a band is two numbers"),
        ({"hu": (7, 9)}, "no voxel lies from 7 to 9 HU: there is nothing to cluster"),
    ],
)
def test_bad_input_is_refused(device, arguments, words):
    with pytest.raises(UsageError, match=words):
        cluster_points(Volume(noise((3, 4, 40), 0.4), FINE), device=device, **arguments)


def test_bands_that_no_voxel_can_have_are_refused(device):
    volume = Volume(noise((3, 4, 40), 0.4), FINE)
    for band in ((0.2, 0.8), (40_000, 50_000)):
        with refused(NoSurfaceError, "voxel"):
            cluster_points(volume, hu=band, device=device)
    assert checked_band([-np.inf, np.inf]) == (-np.inf, np.inf)


def test_bad_clouds_are_refused(device):
    cloud = voxel_cloud(Volume(noise((3, 4, 40), 0.4), FINE))
    with refused(UsageError, "cloud", "empty"):
        cluster_points(cloud.select([]), device=device)
    with refused(UsageError, 1, 3):
        cluster_points(cloud.select([0, 1, 1]), device=device)
    with pytest.raises(UsageError, match="does not say where its voxels lie"):
        cluster_points(cloud.changed(report={}), device=device)
    with refused(UsageError, "voxels", "volume"):
        cluster_points(cloud, hu=(1, 2), device=device)
    with refused(UsageError, "volume", 3):
        cluster_points(cloud, volume=Volume(noise((2, 2, 2), 1.0), FINE), device=device)
    with refused(UsageError, "points", "voxels"):
        cluster_points(cloud, volume=Volume(noise((3, 4, 40), 1.0), OBLIQUE), device=device)
    one = cluster_points(cloud.select([0]), min_samples=1, eps=0.6, device=device)
    assert one.cloud.labels.tolist() == [0]


def test_work_of_hours_is_refused(device):
    volume = Volume(np.ones((200, 1000, 33), np.int8), np.diag((1.0, 0.01, 0.01, 1.0)))
    with refused(UsageError, "volume"):
        cluster_points(volume, 10.0, hu=(1, 1), device=device)


@pytest.mark.release
@pytest.mark.first_device
def test_real_ct_equals_scikit_learn(device, real_data):
    sklearn = pytest.importorskip("sklearn.cluster")
    volume = clrecon.read_volume(real_data / "thoracic_0p8mm")
    part = Volume(volume.voxels[40:60], volume.affine)
    step = cluster_points(part, 1.2, 6, hu=(300, np.inf), device=device)
    points = part.ijk_to_lps(step.cloud.ijk)
    expected = sklearn.DBSCAN(eps=1.2 * (1 + 1e-6), min_samples=6).fit_predict(points)
    np.testing.assert_array_equal(step.cloud.labels, expected)
    assert step.facts["clusters"] > 20


@pytest.mark.release  # every day: noise in tilted and uneven stacks equals the twin, and scikit-learn's in even ones
def test_a_real_tilted_stack_with_gaps_equals_scikit_learn(device, real_data):
    sklearn = pytest.importorskip("sklearn.cluster")
    volume = clrecon.read_volume(real_data / "head_tilt_gaps", allow_gaps=True)
    assert volume.uneven
    for eps in (1.2, 4.1):
        step = cluster_points(volume, eps, 6, hu=(700, np.inf), device=device)
        expected = sklearn.DBSCAN(eps=eps * (1 + 1e-6), min_samples=6).fit_predict(volume.ijk_to_lps(step.cloud.ijk))
        np.testing.assert_array_equal(step.cloud.labels, expected)
        assert step.facts["clusters"] > 3


def test_a_band_without_an_end_is_one_everywhere(device):
    volume = Volume(noise((5, 6, 40), 0.3), FINE)
    for hu, closed in (((1, None), (1, math.inf)), ((None, 0), (-math.inf, 0)), ((None, None), (-math.inf, math.inf))):
        assert checked_band(hu) == closed
        step = cluster_points(volume, 0.6, 2, hu=hu, device=device)
        assert len(step.cloud) == len(clrecon.extract_points(volume, hu=hu, device=device)) > 0
    for wrong in ((1,), (None, None, None), (2, 1), (None, "x"), (math.nan, None)):
        with refused(UsageError, "band"):
            cluster_points(volume, 0.6, 2, hu=wrong, device=device)


@pytest.mark.parametrize("known", [True, False])
def test_an_eps_below_the_slice_step_is_warned_of_for_free_points(device, known):
    """A long bone along the slices' axis: its surface has no points between the slices."""
    _, j, i = np.indices((20, 24, 24))
    bone = np.where(np.hypot(j - 12, i - 12) < 7.0, 600, -800).astype(np.int16)
    volume = Volume(bone, np.diag((0.7, 0.7, 3.0, 1.0)))
    cloud = clrecon.extract_points(volume, 200, kind="surface", device=device)
    cloud = PointCloud(cloud.points, report=cloud.report if known else {})
    broken = cluster_points(cloud, 2.0, 3, device=device)
    assert broken.facts["clusters"] == 20
    assert "eps 2 mm is below the 3 mm between the slices that the points come from" in broken.warnings[-1]
    assert cluster_points(cloud, 3.0, 3, device=device).warnings == ()


def test_points_that_lie_in_no_slices_are_not_warned_of(device):
    points = np.random.default_rng(2).normal(0.0, 20.0, (500, 3))
    assert cluster_points(PointCloud(points), 2.0, 3, device=device).warnings == ()
