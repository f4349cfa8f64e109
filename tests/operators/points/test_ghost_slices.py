"""Ghost slices: counts equal the twin's; planted slices are found, and the made case shows what each means is for."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_once import make_once
from pydicom import dcmread
from refusals import refused
from variants import daily

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.operators.masks.voxel_mask import mark_band
from clrecon.operators.points.slice_overlap import count_overlaps, find_ghost_slices
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points import PointCloud, drop_ghost_slices, fill_ghost_slices, keep_clusters
from clrecon.points.ghost_slices import judge_slices
from clrecon.proof.phantom import PhantomSettings, make_phantom, write_phantom
from clrecon.proof.points import clusters as twin

BONE = (200, np.inf)


def rods(slices: int = 20, step: float = 0.3) -> np.ndarray:
    """Two rods that lean: neighbouring slices are much alike."""
    k, j, i = np.indices((slices, 40, 50))
    lean = step * k
    inside = (np.hypot(j - 12 - lean, i - 15) < 6) | (np.hypot(j - 25, i - 30 - lean) < 5)
    return np.where(inside, 500, -100).astype(np.int16)


def other(kind: str) -> np.ndarray:
    page = np.full((40, 50), -100, np.int16)
    if kind == "capture":
        page[2:4], page[-4:-2], page[8:30:4, 5:45:2] = 500, 500, 500
    elif kind == "turned":
        page[:40, :40] = np.rot90(rods()[10][:40, :40])
    else:
        page[:, 20:24] = 500
    return page


@pytest.mark.parametrize("shape", [(1, 3, 40), (2, 3, 31), (3, 5, 32), (7, 9, 70), (12, 1, 33)])
def test_counts_equal_the_twin(device, shape):
    voxels = np.random.default_rng(4).integers(0, 3, shape).astype(np.int16)
    with DeviceVolume(Volume(voxels, np.eye(4)), device=device) as resident:
        found = count_overlaps(device, mark_band(resident, (1.0, 1.0)))
    np.testing.assert_array_equal(found, twin.count_overlaps(voxels == 1))


@pytest.mark.oclgrind
def test_ghost_counts_hold_every_point_under_a_simulator(device):
    voxels = np.random.default_rng(4).integers(0, 2, (5, 3, 40)).astype(np.int16)
    assert find_ghost_slices(Volume(voxels, np.eye(4)), (1, 1), device=device).points.sum() == voxels.sum()


@pytest.mark.parametrize("kind", ["capture", "turned", "line"])
@pytest.mark.parametrize("at", [1, 9, 18])
def test_a_planted_slice_is_found(device, kind, at):
    voxels = rods()
    assert find_ghost_slices(Volume(voxels, np.eye(4)), BONE, device=device).slices == ()
    voxels[at] = other(kind)
    found = find_ghost_slices(Volume(voxels, np.eye(4)), BONE, device=device)
    assert found.slices == (at,)
    entry = found.as_dict()["ghost_slices"][0]
    assert entry["slice"] == at and entry["points"] == int((voxels[at] >= 200).sum())
    assert entry["dice_with_neighbour"] < 0.75 * entry["dice_of_neighbours"]
    assert found.as_dict()["least_share_of_others"] > 0.75


@pytest.mark.parametrize(
    ("places", "found"), [((0,), ()), ((19,), ()), ((9, 10), ()), ((5, 8), (5, 8)), ((5, 12), (5, 12))]
)
def test_ghosts_are_found_but_for_those_at_the_ends_or_side_by_side(device, places, found):
    """The ends have one neighbour; two ghosts side by side look like each other."""
    voxels = rods()
    for place in places:
        voxels[place] = other("capture")
    test = find_ghost_slices(Volume(voxels, np.eye(4)), BONE, device=device)
    assert test.slices == found and test.tested == 18
    assert np.isnan(test.around[[0, -1]]).all() and not np.isnan(test.around[1:-1]).any()


def thick_slices(kind: str = "spine", slices: int = 30) -> np.ndarray:
    settings = PhantomSettings(kind=kind, size=(120, 120), slices=slices, spacing=(1.5, 1.5, 5.0))
    return make_phantom(settings)[0]


def find_in(voxels: np.ndarray):
    return judge_slices(twin.count_overlaps(voxels >= 200), 120 * 120, (200.0, np.inf))


@pytest.mark.release
@pytest.mark.parametrize("slices", daily(1, [24, 30, 40]))
def test_discs_between_vertebrae_are_no_ghosts(slices):
    """They are unlike both neighbours, which are alike, but lie within one of them."""
    found = find_in(thick_slices(slices=slices))
    unlike = found.nearest < 0.75 * found.around
    assert unlike.sum() == 3 and found.within[unlike].min() > 0.42
    assert found.slices == () and found.as_dict()["within_share"] == 0.42


def test_bone_that_closes_in_one_slice_is_no_ghost():
    """The base of a skull, 5 mm apart: unlike both neighbours, but most of one lies within it."""
    voxels = make_phantom(PhantomSettings(kind="skull", size=(192, 192), slices=30, spacing=(0.9, 0.9, 5.0)))[0]
    found = judge_slices(twin.count_overlaps(voxels >= 200), 192 * 192, (200.0, np.inf))
    unlike = np.flatnonzero(found.nearest < 0.75 * found.around)
    assert unlike.tolist() == [8] and found.within[8] > 0.55 and found.slices == ()


@pytest.mark.parametrize("at", daily(1, [1, 4, 12, 17, 28]))
def test_a_slice_of_another_scan_is_found_among_thick_slices(at):
    voxels = thick_slices()
    voxels[at] = thick_slices("skull")[15]
    found = find_in(voxels)
    assert found.slices == (at,)
    assert found.as_dict()["ghost_slices"][0]["share_within_neighbour"] < 0.42


def test_the_share_within_a_neighbour_is_corrected_for_chance():
    """Of 4 voxels 3 lie within the slice before, which takes 5 of 20; of 4 voxels 1 within the one behind, 10 of 20."""
    counts = np.array([[5, 4, 10], [3, 1, 0], [5, 0, 0]])
    found = judge_slices(counts, 20, (0.0, 1.0))
    assert found.within[1] == pytest.approx((3 / 4 - 5 / 20) / (1 - 5 / 20))
    assert np.isnan(found.within[[0, 2]]).all()


@pytest.mark.parametrize("slices", [1, 2])
def test_stacks_without_an_inner_slice_are_not_tested(device, slices):
    found = find_ghost_slices(Volume(rods(slices), np.eye(4)), BONE, device=device)
    assert (found.slices, found.tested, found.as_dict()["least_share_of_others"]) == ((), 0, None)


def test_a_slice_without_points_is_no_ghost(device):
    voxels = rods()
    voxels[7], voxels[12:15] = -100, -100
    found = find_ghost_slices(Volume(voxels, np.eye(4)), BONE, device=device)
    assert found.slices == () and found.points[7] == 0


def test_ghost_slices_found_in_slabs_are_the_same(device):
    voxels = rods()
    voxels[6] = other("capture")
    volume = Volume(voxels, np.eye(4))
    heard: list[tuple[str, int, int]] = []
    small = find_ghost_slices(volume, BONE, device=device, memory=30_000, progress=lambda *told: heard.append(told))
    whole = find_ghost_slices(volume, BONE, device=device)
    assert small.slices == whole.slices == (6,) and len(heard) > 1
    np.testing.assert_array_equal(small.nearest, whole.nearest)


def test_points_of_ghosts_are_dropped():
    counts = twin.count_overlaps(np.concatenate([rods()[:6], other("line")[None], rods()[7:]]) >= 200)
    found = judge_slices(counts, 40 * 50, (200.0, np.inf))
    assert found.slices == (6,)
    volume = Volume(rods(), np.diag((0.5, 0.5, 2.0, 1.0)))
    ijk = np.argwhere(volume.voxels >= 200)[:, ::-1]
    cloud = PointCloud(volume.ijk_to_lps(ijk), ijk=ijk)
    step = drop_ghost_slices(cloud, found)
    assert step.counts == {"ghost slice": int((ijk[:, 2] == 6).sum())} and 6 not in step.cloud.ijk[:, 2]
    free = PointCloud([[1.0, 1.0, z] for z in (9.9, 10.1, 12.0, 13.9, 14.0)])
    assert drop_ghost_slices(free, found, volume=volume).removed.tolist() == [0, 1, 1, 1, 0]
    with pytest.raises(UsageError, match="do not say in which slice they lie"):
        drop_ghost_slices(free, found)
    with pytest.raises(UsageError, match="20 were tested: another volume"):
        drop_ghost_slices(PointCloud([[0.0, 0.0, 0.0]], ijk=[[0, 0, 30]]), found)
    filled = fill_ghost_slices(volume, found)
    assert np.array_equal(filled.voxels[6], volume.voxels[5]) and np.array_equal(filled.voxels[7:], volume.voxels[7:])
    with pytest.raises(UsageError, match="20 slices were tested, the volume has 3"):
        fill_ghost_slices(Volume(rods(3), np.eye(4)), found)


@pytest.mark.release
@pytest.mark.first_device
@pytest.mark.parametrize("hu", [200, -300])
def test_real_scans_have_no_false_ghost_slices(device, real_data, hu):
    for name in ("thoracic_0p8mm", "lumbar_4p25mm", "head_tilt_gaps"):
        volume = clrecon.read_volume(real_data / name, allow_gaps=True)
        found = find_ghost_slices(volume, (hu, np.inf), device=device)
        assert found.slices == () and found.tested >= volume.shape_ijk[2] - 4


SETTINGS = PhantomSettings(
    size=(64, 72), slices=230, spacing=(2.5, 2.5, 2.5), table_gap_mm=4.0, table="curved", ghosts=True
)


def make_case(folder: Path) -> None:
    folder.mkdir()
    truth = write_phantom(folder / "series", SETTINGS)
    clean, _, _ = make_phantom(dataclasses.replace(SETTINGS, ghosts=False, table="none", table_gap_mm=0.0))
    np.savez(folder / "truth.npz", slices=[one["slice"] for one in truth["ghosts"]["slices"]], bone=clean >= BONE[0])


@pytest.fixture(scope="module")
def made(shared_folder):
    """The made case: its folder, its truth, and the bone of the same phantom without ghosts and table."""
    folder = make_once(shared_folder, "ghosts", make_case)
    with np.load(folder / "truth.npz") as truth:
        return folder / "series", truth["slices"].tolist(), truth["bone"]


def score(cloud: PointCloud, bone: np.ndarray) -> tuple[float, float]:
    """Recall and precision of the points of bone."""
    points = np.zeros_like(bone)
    points[tuple(cloud.ijk.T[::-1])] = True
    both = np.count_nonzero(points & bone)
    return both / np.count_nonzero(bone), both / np.count_nonzero(points)


def voxels_of(volume: Volume) -> PointCloud:
    ijk = np.argwhere(volume.voxels >= BONE[0])[:, ::-1]
    return PointCloud(volume.ijk_to_lps(ijk), ijk=ijk, report={"affine_ijk_to_lps_mm": volume.affine.tolist()})


@pytest.mark.release  # every day: planted slices are found, and each step's own tests
def test_each_means_against_ghosts_is_needed(device, made):
    """All means together leave bone; each of them switched off leaves its ghost."""
    folder, slices, bone = made
    volume = clrecon.read_volume(folder)
    assert volume.shape_ijk[2] == SETTINGS.slices
    found = find_ghost_slices(volume, BONE, device=device)
    assert list(found.slices) == slices
    without_table = clrecon.remove_table(fill_ghost_slices(volume, found))
    recall, precision = score(drop_ghost_slices(voxels_of(without_table), found).cloud, bone)
    assert recall >= 0.99 and precision >= 0.99
    # The slices stay without the slice test, and the table without its removal.
    untested = without_table.voxels.copy()
    untested[slices] = volume.voxels[slices]
    assert score(voxels_of(volume.with_voxels(untested)), bone)[1] < 0.97
    assert score(drop_ghost_slices(voxels_of(volume), found).cloud, bone)[1] < 0.97


@pytest.mark.release
def test_clusters_tell_the_table_of_the_made_case(device, made):
    _, slices, bone = made
    folder = made[0]
    volume = clrecon.read_volume(folder)
    found = find_ghost_slices(volume, BONE, device=device)
    step = clrecon.cluster_points(drop_ghost_slices(voxels_of(volume), found).cloud, volume=volume, device=device)
    i, j, k = step.cloud.ijk.T
    is_bone, labels = bone[k, j, i], step.cloud.labels
    of_bone, of_table = set(labels[is_bone].tolist()) - {-1}, set(labels[~is_bone].tolist()) - {-1}
    assert of_bone and of_table and not of_bone & of_table
    largest = keep_clusters(step.cloud, "largest:3", cores=step.cores)
    assert score(largest.cloud, bone)[1] == 1.0


@pytest.mark.release
def test_the_gate_drops_the_localizer(made):
    """Without it a stack of all images of the folder has one of another orientation in it."""
    folder, _, bone = made
    images = [dcmread(path, stop_before_pixels=True) for path in sorted(Path(folder).glob("*.dcm"))]
    directions = {tuple(map(float, image.ImageOrientationPatient)) for image in images}
    assert len(images) == len(bone) + 1 and len(directions) == 2
    assert len({image.SeriesInstanceUID for image in images}) == 1
    series = clrecon.list_series(folder).series
    assert [(one.kind, one.slices) for one in series] == [("stack", len(bone)), ("localizer", 1)]
    sagittal = images[-1]
    assert (sagittal.Rows, sagittal.Columns) == (SETTINGS.slices, SETTINGS.size[1])
    volume = clrecon.read_volume(folder)
    view = dcmread(sorted(Path(folder).glob("*.dcm"))[-1])
    np.testing.assert_array_equal(view.pixel_array - 1024, volume.voxels.max(axis=2)[::-1])
    corner = np.array(sagittal.ImagePositionPatient, float)
    down = np.array(sagittal.ImageOrientationPatient[3:], float) * float(sagittal.PixelSpacing[0])
    ijk = volume.lps_to_ijk([corner, corner + (SETTINGS.slices - 1) * down])
    np.testing.assert_allclose(ijk[:, 1:], [[0, SETTINGS.slices - 1], [0, 0]], atol=1e-3)


def test_ghosts_are_for_spines_with_room():
    with refused(UsageError, "ghosts"):
        PhantomSettings(kind="skull", ghosts=True)
    with refused(UsageError, 11, 12):
        PhantomSettings(slices=11, ghosts=True)
    assert PhantomSettings(ghosts=True).table_used == "curved" and PhantomSettings().table_used == "own"
    assert "ghosts" not in PhantomSettings().as_dict() and PhantomSettings(ghosts=True).as_dict()["ghosts"]
