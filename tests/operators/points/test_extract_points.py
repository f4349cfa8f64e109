"""Points of a volume: voxels equal their twin, surfaces the vertices of the mesh, slabs give the same bits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused
from surface_volumes import MIDDLE, hollow_ball
from variants import VOXEL_TYPES

from clrecon import LabelMap, Volume, extract_isosurface, extract_labels, fit_cortex
from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.operators.points.point_extraction import Selection, VoxelEmission, _join_points, extract_points
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.points.clusters import extract_voxels, mark_shell

pytestmark = pytest.mark.opencl

OBLIQUE = np.array([[0.7, 0.1, 0.05, -150.0], [-0.1, 0.5, 0.3, -30.0], [0.0, 0.05, 0.9, -400.0], [0.0, 0.0, 0.0, 1.0]])
BAND = (20, 60)


def make_volume(shape: tuple[int, int, int], dtype: str = "int16", uneven: bool = False, far: bool = False) -> Volume:
    chance = np.random.default_rng(8)
    affine = OBLIQUE.copy()
    if far:
        affine[:3, 3] += (9000.0, 0.0, -20000.0)
    voxels = chance.integers(0, 100, shape).astype(dtype)
    if not uneven:
        return Volume(voxels, affine)
    gaps = chance.uniform(0.4, 7.0, shape[0])
    return Volume(voxels, affine, slice_positions=np.cumsum(gaps)[:, None] * [0.05, 0.3, 0.9] + affine[:3, 3])


def check_voxels(cloud, volume, **choice: Any) -> None:
    points, hu, ijk = extract_voxels(volume, *BAND, **choice)
    np.testing.assert_array_equal(cloud.ijk, ijk)
    np.testing.assert_array_equal(cloud.hu, hu)
    assert np.abs(cloud.points - points).max() <= tolerances.HALF_STEP * tolerances.float32_unit(points)


@pytest.mark.parametrize("columns", [1, 31, 32, 33, 63, 64, 65, 130])
@pytest.mark.parametrize("kind", ["voxels", "shell"])
def test_points_of_rows_of_every_length_equal_the_twin(device, columns, kind):
    volume = make_volume((5, 7, columns))
    check_voxels(extract_points(volume, hu=BAND, kind=kind, device=device), volume, shell=kind == "shell")


@pytest.mark.parametrize("lengths", [(4,), (3, 2), (0, 5), (2, 0, 1)])
def test_slabs_are_joined_in_their_order(lengths):
    places, numbers = np.arange(3.0 * sum(lengths), dtype=np.float32).reshape(-1, 3), np.arange(sum(lengths))
    ends = np.cumsum((0, *lengths))
    parts = [(places[a:b], places[a:b, 0], numbers[a:b]) for a, b in zip(ends, ends[1:], strict=False)]
    found = _join_points(parts)
    for array, expected in zip(found, (places, places[:, 0], numbers), strict=True):
        assert array.dtype == expected.dtype
        np.testing.assert_array_equal(array, expected)


def test_points_by_the_kernels_of_the_other_kind_of_device_equal_the_twin(device, monkeypatch):
    """An item takes a word on GPUs, a row of words on CPUs."""
    lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
    monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})
    volume = make_volume((5, 7, 130))
    check_voxels(extract_points(volume, hu=BAND, device=device), volume)


@pytest.mark.parametrize("dtype", [kind for kind in VOXEL_TYPES if kind != "float32"])
def test_points_of_every_voxel_type_equal_the_twin(device, dtype):
    volume = make_volume((6, 11, 70), dtype)
    check_voxels(extract_points(volume, hu=BAND, device=device), volume)


@pytest.mark.release
def test_points_of_float_voxels_in_uneven_slices_lie_at_their_places(device):
    volume = make_volume((9, 12, 40), "float32", uneven=True)
    cloud = extract_points(volume, hu=(20.0, 60.0), device=device)
    check_voxels(cloud, volume)
    np.testing.assert_allclose(cloud.points, volume.ijk_to_lps(cloud.ijk), rtol=0, atol=tolerances.CLOUD_PLACE_MM)


@pytest.mark.oclgrind
def test_points_of_a_label_are_its_voxels_or_their_shell(device):
    volume = make_volume((4, 6, 40))
    numbers = np.random.default_rng(3).integers(0, 3, volume.voxels.shape).astype(np.uint8)
    labels = LabelMap(numbers, volume.affine)
    for kind in ("voxels", "shell"):
        one = extract_points(volume, hu=BAND, kind=kind, labels=labels, label=2, device=device)
        check_voxels(one, volume, shell=kind == "shell", labels=numbers, label=2)
        assert set(one.labels.tolist()) == {2} and one.report["label"] == 2
    every = extract_points(volume, hu=BAND, labels=labels, device=device)
    check_voxels(every, volume, labels=numbers)
    i, j, k = every.ijk.T
    np.testing.assert_array_equal(every.labels, numbers[k, j, i])
    marked = (volume.voxels >= BAND[0]) & (volume.voxels <= BAND[1])
    assert every.report["voxels_in_band"] == int(marked.sum()) > len(every)


@pytest.mark.first_device
def test_points_of_a_label_above_255_are_its_voxels(device):
    volume = make_volume((4, 6, 40))
    numbers = 300 * np.random.default_rng(3).integers(0, 3, volume.voxels.shape).astype(np.uint16)
    cloud = extract_points(volume, hu=BAND, labels=LabelMap(numbers, volume.affine), label=600, device=device)
    check_voxels(cloud, volume, labels=numbers, label=600)


@pytest.mark.parametrize("kind", ["voxels", "shell"])
def test_slabs_give_the_same_points_bit_for_bit(device, kind):
    volume = make_volume((23, 20, 50), uneven=True)
    labels = LabelMap(np.random.default_rng(3).integers(0, 2, (23, 20, 50)).astype(np.uint8), volume.affine)
    for choice in ({}, {"labels": labels}):
        if choice and volume.uneven:
            volume = make_volume((23, 20, 50))
        whole = extract_points(volume, hu=BAND, kind=kind, device=device, **choice)
        parts = extract_points(volume, hu=BAND, kind=kind, device=device, memory=45_000, **choice)
        assert whole.report["slabs"] == 1 and parts.report["slabs"] > 2
        for name in ("points", "hu", "ijk"):
            np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
        for entry in ("voxels", "points", "voxels_in_band", "share"):
            assert parts.report[entry] == whole.report[entry]


def test_too_little_memory_for_one_slice_is_said(device):
    with refused(DeviceError, "slice", "points", "bytes"):
        extract_points(make_volume((5, 20, 50)), hu=BAND, device=device, memory=1500)


def test_far_from_the_origin_points_are_float64(device):
    volume = make_volume((5, 8, 40), far=True)
    cloud = extract_points(volume, hu=BAND, device=device)
    assert cloud.points.dtype == np.float64
    np.testing.assert_allclose(cloud.points, volume.ijk_to_lps(cloud.ijk), rtol=0, atol=tolerances.CLOUD_PLACE_MM)
    assert any("float64" in text for text in cloud.report["warnings"])


def test_report_of_points_of_the_whole_volume_counts_all_voxels(device):
    volume = make_volume((3, 5, 33))
    cloud = extract_points(volume, hu=(0, None), device=device)
    assert len(cloud) == volume.voxels.size and cloud.report["share"] == 1.0
    report = cloud.report
    assert (report["kind"], report["band_hu"], report["iso_value_hu"]) == ("voxels", [0.0, None], 0.0)
    assert report["voxels"] == report["points"] == report["voxels_in_band"] == 495
    assert report["affine_ijk_to_lps_mm"] == volume.affine.tolist() and report["device"] == device.label
    assert extract_points(volume, hu=(0, 40), device=device).report["iso_value_hu"] is None
    low = extract_points(volume, hu=(None, 40), device=device)
    assert len(low) == np.count_nonzero(volume.voxels <= 40) and low.report["band_hu"] == [None, 40.0]
    shell = extract_points(volume, 0, kind="shell", device=device)
    assert len(shell) == 495 - 1 * 3 * 31 and shell.report["voxels_in_band"] == 495


@pytest.mark.parametrize(("high", "points"), [(-1, 0), (99, 495)])
def test_bytes_of_point_extraction_are_those_of_its_buffers(device, high, points):
    """3 x 5 x 33 voxels of two bytes; a mask of two words a row, its ends, and counts of each row; 20 bytes a point."""
    volume = Volume(np.zeros((3, 5, 33), np.int16), np.eye(4))
    emission = VoxelEmission(DeviceVolume(volume, device=device), Selection(np.int16(-5), np.int16(high)))
    assert len(emission.run()[1]) == points
    assert emission.largest == {"volume": 2 * 495, "output": 20 * points, "scratch": 15 * (4 * 2 + 4 + 9)}


@pytest.mark.release
def test_surface_points_are_the_vertices_of_the_mesh(device):
    volume = make_volume((9, 10, 40), uneven=True)
    mesh = extract_isosurface(volume, 50, device=device)
    cloud = extract_points(volume, 50, device=device)
    np.testing.assert_array_equal(cloud.points, mesh.vertices)
    np.testing.assert_array_equal(cloud.normals, mesh.normals)
    assert set(cloud.hu.tolist()) == {50.0} and cloud.ijk is None
    assert cloud.report["kind"] == "surface" and cloud.report["points"] == mesh.vertex_count
    assert cloud.report["device_bytes"]["output"] == 24 * mesh.vertex_count
    parts = extract_points(volume, 50, device=device, memory=60_000)
    assert parts.report["slabs"] > 1
    np.testing.assert_array_equal(parts.points, mesh.vertices)
    band = extract_points(volume, kind="surface", hu=(30, 60), device=device)
    np.testing.assert_array_equal(band.points, extract_isosurface(volume, (30, 60), device=device).vertices)
    assert band.hu is None


def test_surface_points_of_labels_are_the_vertices_of_their_meshes(device):
    volume = make_volume((8, 12, 40))
    labels = LabelMap((np.indices(volume.voxels.shape)[2] // 14).astype(np.uint8), volume.affine, {1: "bone"})
    cloud = extract_points(volume, 50, labels=labels, label="bone", device=device)
    mesh = extract_labels(volume, labels, 50, label=["bone"], device=device)[1]
    np.testing.assert_array_equal(cloud.points, mesh.vertices)
    assert set(cloud.labels.tolist()) == {1} and cloud.report["label_name"] == "bone"
    both = extract_points(volume, 50, labels=labels, device=device)
    assert set(both.labels.tolist()) == {1, 2} and both.report["label"] is None


def test_points_of_a_ball_fill_it_or_lie_on_its_surface(device):
    """Voxels fill the ball, the shell lies within a voxel's diagonal of its surface, surface points lie on it."""
    spacing, radius = np.array([0.64, 0.64, 0.8]), 20.0
    k, j, i = np.indices((56, 68, 68))
    away = np.linalg.norm((np.stack([i, j, k], -1) - [33.5, 33.5, 27.5]) * spacing, axis=-1)
    volume = Volume(np.rint(np.clip(200 + 300 * (radius - away), -1000, 1000)).astype(np.int16), np.diag([*spacing, 1]))
    centre = np.array([33.5, 33.5, 27.5]) * spacing
    solid, shell, surface = (
        extract_points(volume, **choice, device=device)
        for choice in ({"hu": (200, None)}, {"iso_value": 200, "kind": "shell"}, {"iso_value": 200})
    )
    assert len(solid) * spacing.prod() == pytest.approx(4 / 3 * np.pi * radius**3, rel=tolerances.BALL_OF_VOXELS)
    depth = radius - np.linalg.norm(shell.points - centre, axis=1)
    assert 0.0 <= depth.min() + tolerances.CLOUD_BALL_MM and depth.max() < np.linalg.norm(spacing)
    assert np.abs(np.linalg.norm(surface.points - centre, axis=1) - radius).max() < tolerances.CLOUD_BALL_MM
    assert set(map(tuple, shell.ijk.tolist())) <= set(map(tuple, solid.ijk.tolist()))


def test_paper_mode_puts_all_slices_into_one_plane_and_says_the_error(device):
    volume = make_volume((9, 12, 40), uneven=True)
    cloud = extract_points(volume, hu=BAND, paper=True, device=device)
    check_voxels(cloud, volume, paper=True)
    away = np.linalg.norm(cloud.points - volume.ijk_to_lps(cloud.ijk), axis=1)
    facts = cloud.report["paper"]
    assert facts["error_max_mm"] == pytest.approx(away.max(), abs=tolerances.CLOUD_PLACE_MM)
    assert facts["error_rms_mm"] == pytest.approx(np.sqrt((away**2).mean()), abs=tolerances.CLOUD_PLACE_MM)
    assert facts["nonzero_voxels"] == np.count_nonzero(volume.voxels) and facts["error_max_mm"] > 10
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    assert np.ptp(cloud.points @ (normal / np.linalg.norm(normal))) < tolerances.CLOUD_PLACE_MM * 10


def test_a_resident_volume_is_uploaded_once(device):
    volume = make_volume((9, 12, 40))
    with DeviceVolume(volume, device=device) as resident:
        extract_points(resident, hu=BAND)
        extract_points(resident, 50)
        assert resident.uploaded_bytes == volume.voxels.nbytes


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"hu": (2000, 3000)}, "no voxel of 2000 to 3000 HU: the volume runs from 0 to 99 HU"),
        ({"hu": (40000, None)}, "no voxel can have 40000 HU and more: voxels are int16"),
        ({"hu": (50.2, 50.8)}, "no voxel can have 50.2 to 50.8 HU"),
        ({"iso_value": 2000}, "no surface at 2000 HU"),
    ],
)
def test_extraction_that_finds_no_point_is_an_error(device, choice, words):
    with pytest.raises(NoSurfaceError, match=words):
        extract_points(make_volume((3, 5, 33)), device=device, **choice)


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"iso_value": 1, "hu": (1, 2)}, "give an iso value or hu=.*, not both"),
        ({"kind": "dots", "hu": (1, 2)}, "no points of the kind 'dots': use one of surface, cortex, shell, voxels"),
        ({"hu": (5,)}, "a band is two numbers in HU"),
        ({"hu": (5, 1)}, "a band is two numbers in HU, the lower one first"),
        ({"hu": (float("nan"), 1)}, "a band is two numbers in HU"),
        ({"hu": (1, 5), "label": 3}, "label needs labels"),
        ({"iso_value": 5, "paper": True}, "paper=True places voxels"),
    ],
)
def test_wrong_arguments_are_refused(choice, words):
    with pytest.raises(UsageError, match=words):
        extract_points(make_volume((3, 5, 33)), **choice)


def test_twin_marks_the_shell_of_a_cube():
    cube = np.zeros((5, 5, 5), bool)
    cube[1:4, 1:4, 1:4] = True
    assert mark_shell(cube).sum() == 26 and not mark_shell(cube)[2, 2, 2]
    assert mark_shell(np.ones((3, 4, 5), bool)).sum() == 60 - 1 * 2 * 3


def test_points_of_the_cortex_lie_on_the_bone(device):
    volume = hollow_ball(thickness=3.0)
    level, cloud = (extract_points(volume, 200.0, kind=kind, device=device) for kind in ("surface", "cortex"))
    outer = np.linalg.norm(level.points - MIDDLE, axis=1) > 12.5
    off, away = (np.linalg.norm(each.points[outer] - MIDDLE, axis=1) - 13.0 for each in (level, cloud))
    assert off.mean() == pytest.approx(0.76, abs=0.01) and np.abs(away).mean() < 0.025
    outward = np.einsum("na,na->n", cloud.normals[outer], cloud.points[outer] - MIDDLE)
    assert (outward > 0.0).all() and cloud.hu is None and cloud.labels is None
    assert cloud.report["kind"] == "cortex" and cloud.report["cortex"]["fitted"] > 0.9 * outer.sum()


def test_points_of_the_cortex_of_labels_are_those_of_their_meshes(device):
    volume = hollow_ball(thickness=3.0)
    numbers = np.ones(volume.voxels.shape, np.uint8)
    numbers[:18] = 2
    labels = LabelMap(numbers, volume.affine)
    cloud = extract_points(volume, 200.0, kind="cortex", labels=labels, device=device)
    meshes = extract_labels(volume, labels, 200.0, device=device)
    assert np.array_equal(np.bincount(cloud.labels)[1:], [meshes[1].vertex_count, meshes[2].vertex_count])
    known = np.concatenate([fit_cortex(mesh, volume, device=device).vertices for mesh in meshes.values()])
    assert np.percentile(np.linalg.norm(cloud.points - known, axis=1), 95) < 0.05  # constants of each


@pytest.mark.parametrize("what", [{}, {"iso_value": "auto"}, {"hu": (200, 900)}])
def test_the_cortex_needs_a_low_level(device, what):
    with refused(UsageError, 200):
        extract_points(hollow_ball(), kind="cortex", device=device, **what)
