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
BAND = (20, 60)  # HU, of random values from 0 to 99


def make_volume(
    shape: tuple[int, int, int], dtype: str = "int16", *, uneven: bool = False, far: bool = False
) -> Volume:
    """Random HU from 0 to 99 in an oblique volume, some 20 m from the origin where it is `far`."""
    chance = np.random.default_rng(8)
    affine = OBLIQUE.copy()
    if far:
        affine[:3, 3] += (9000.0, 0.0, -20000.0)
    voxels = chance.integers(0, 100, shape).astype(dtype)
    if not uneven:
        return Volume(voxels, affine)
    gaps = chance.uniform(0.4, 7.0, shape[0])
    return Volume(voxels, affine, slice_positions=np.cumsum(gaps)[:, None] * [0.05, 0.3, 0.9] + affine[:3, 3])


def assert_voxels_equal_twin(cloud, volume, **choice: Any) -> None:
    """The cloud has the voxels of `volume` within `BAND`, as the twin chooses and places them."""
    points, hu, ijk = extract_voxels(volume, *BAND, **choice)
    np.testing.assert_array_equal(cloud.ijk, ijk)
    np.testing.assert_array_equal(cloud.hu, hu)
    assert np.abs(cloud.points - points).max() <= tolerances.HALF_STEP * tolerances.float32_unit(points)


@pytest.mark.parametrize("columns", [1, 31, 32, 33, 63, 64, 65, 130])
@pytest.mark.parametrize("kind", ["voxels", "shell"])
def test_points_of_rows_around_whole_words_equal_the_twin(device, columns, kind):
    volume = make_volume((5, 7, columns))
    assert_voxels_equal_twin(extract_points(volume, hu=BAND, kind=kind, device=device), volume, shell=kind == "shell")


@pytest.mark.parametrize("lengths", [(4,), (3, 2), (0, 5), (2, 0, 1)])
def test_points_of_slabs_are_joined_in_their_order(lengths):
    """Slabs of so many points, each with its place, its HU and its number."""
    total = sum(lengths)
    places, numbers = np.arange(3.0 * total, dtype=np.float32).reshape(-1, 3), np.arange(total)
    hu = places[:, 0]
    ends = np.cumsum((0, *lengths))
    slabs = [(places[a:b], hu[a:b], numbers[a:b]) for a, b in zip(ends, ends[1:], strict=False)]

    joined = _join_points(slabs)

    for array, expected in zip(joined, (places, hu, numbers), strict=True):
        assert array.dtype == expected.dtype
        np.testing.assert_array_equal(array, expected)


def test_points_by_the_kernels_of_the_other_kind_of_device_equal_the_twin(device, monkeypatch):
    """An item takes a word on GPUs, a row of words on CPUs."""
    lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
    monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})
    volume = make_volume((5, 7, 130))
    assert_voxels_equal_twin(extract_points(volume, hu=BAND, device=device), volume)


@pytest.mark.parametrize("dtype", [kind for kind in VOXEL_TYPES if kind != "float32"])
def test_points_of_every_type_of_whole_numbers_equal_the_twin(device, dtype):
    volume = make_volume((6, 11, 70), dtype)
    assert_voxels_equal_twin(extract_points(volume, hu=BAND, device=device), volume)


@pytest.mark.release
def test_points_of_float_voxels_in_uneven_slices_equal_the_twin_and_lie_where_the_volume_says(device):
    volume = make_volume((9, 12, 40), "float32", uneven=True)
    cloud = extract_points(volume, hu=BAND, device=device)
    assert_voxels_equal_twin(cloud, volume)
    np.testing.assert_allclose(cloud.points, volume.ijk_to_lps(cloud.ijk), rtol=0, atol=tolerances.CLOUD_PLACE_MM)


@pytest.fixture(scope="module")
def labelled() -> tuple[Volume, LabelMap]:
    """A volume with the labels 0, 1 and 2 at random."""
    volume = make_volume((4, 6, 40))
    numbers = np.random.default_rng(3).integers(0, 3, volume.voxels.shape).astype(np.uint8)
    return volume, LabelMap(numbers, volume.affine)


@pytest.mark.oclgrind
@pytest.mark.parametrize("kind", ["voxels", "shell"])
def test_points_of_a_label_are_its_voxels_or_their_shell(device, labelled, kind):
    volume, labels = labelled
    cloud = extract_points(volume, hu=BAND, kind=kind, labels=labels, label=2, device=device)
    assert_voxels_equal_twin(cloud, volume, shell=kind == "shell", labels=labels.voxels, label=2)
    assert set(cloud.labels.tolist()) == {2}
    assert cloud.report["label"] == 2


@pytest.mark.oclgrind
def test_points_of_all_labels_have_the_label_of_their_voxel(device, labelled):
    volume, labels = labelled
    cloud = extract_points(volume, hu=BAND, labels=labels, device=device)
    assert_voxels_equal_twin(cloud, volume, labels=labels.voxels)
    i, j, k = cloud.ijk.T
    np.testing.assert_array_equal(cloud.labels, labels.voxels[k, j, i])


def test_report_of_points_of_labels_counts_the_voxels_in_the_band_outside_of_labels_too(device, labelled):
    volume, labels = labelled
    cloud = extract_points(volume, hu=BAND, labels=labels, device=device)
    in_band = np.count_nonzero((volume.voxels >= BAND[0]) & (volume.voxels <= BAND[1]))
    assert cloud.report["voxels_in_band"] == in_band > len(cloud)


@pytest.mark.first_device
def test_points_of_a_label_above_255_are_its_voxels(device):
    volume = make_volume((4, 6, 40))
    numbers = 300 * np.random.default_rng(3).integers(0, 3, volume.voxels.shape).astype(np.uint16)
    cloud = extract_points(volume, hu=BAND, labels=LabelMap(numbers, volume.affine), label=600, device=device)
    assert_voxels_equal_twin(cloud, volume, labels=numbers, label=600)


@pytest.mark.parametrize("kind", ["voxels", "shell"])
@pytest.mark.parametrize("volume_is", ["uneven", "labelled"])
def test_points_found_in_slabs_are_those_of_the_whole_volume_bit_for_bit(device, volume_is, kind):
    shape = (23, 20, 50)
    volume = make_volume(shape, uneven=volume_is == "uneven")
    numbers = np.random.default_rng(3).integers(0, 2, shape).astype(np.uint8)
    labels = LabelMap(numbers, volume.affine) if volume_is == "labelled" else None

    whole = extract_points(volume, hu=BAND, kind=kind, labels=labels, device=device)
    parts = extract_points(volume, hu=BAND, kind=kind, labels=labels, device=device, memory=45_000)

    assert whole.report["slabs"] == 1
    assert parts.report["slabs"] > 2
    for name in ("points", "hu", "ijk"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    counts = ("voxels", "points", "voxels_in_band", "share")
    assert [parts.report[name] for name in counts] == [whole.report[name] for name in counts]


def test_too_little_memory_for_one_slice_is_refused(device):
    slice_bytes = 20 * 50 * 2
    with refused(DeviceError, "slice", "points", "bytes"):
        extract_points(make_volume((5, 20, 50)), hu=BAND, device=device, memory=slice_bytes - 500)


def test_points_20_m_from_the_origin_are_float64_with_a_warning(device):
    volume = make_volume((5, 8, 40), far=True)
    cloud = extract_points(volume, hu=BAND, device=device)
    assert cloud.points.dtype == np.float64
    np.testing.assert_allclose(cloud.points, volume.ijk_to_lps(cloud.ijk), rtol=0, atol=tolerances.CLOUD_PLACE_MM)
    assert any("float64" in text for text in cloud.report["warnings"])


@pytest.fixture(scope="module")
def small_volume() -> Volume:
    """Of 3 slices, 5 rows and 33 columns."""
    return make_volume((3, 5, 33))


def test_report_of_points_of_the_whole_volume_counts_all_voxels(device, small_volume):
    cloud = extract_points(small_volume, hu=(0, None), device=device)
    report, voxels = cloud.report, small_volume.voxels.size
    assert len(cloud) == voxels
    assert (report["voxels"], report["points"], report["voxels_in_band"]) == (voxels, voxels, voxels)
    assert report["share"] == 1.0


def test_report_of_points_names_kind_band_affine_and_device(device, small_volume):
    report = extract_points(small_volume, hu=(0, None), device=device).report
    assert (report["kind"], report["band_hu"]) == ("voxels", [0.0, None])
    assert report["affine_ijk_to_lps_mm"] == small_volume.affine.tolist()
    assert report["device"] == device.label


@pytest.mark.parametrize(("band", "iso_value"), [((0, None), 0.0), ((0, 40), None)], ids=["open", "closed"])
def test_report_of_points_has_an_iso_value_where_the_band_has_no_upper_end(device, small_volume, band, iso_value):
    assert extract_points(small_volume, hu=band, device=device).report["iso_value_hu"] == iso_value


def test_band_without_a_lower_end_holds_all_voxels_up_to_its_upper_end(device, small_volume):
    cloud = extract_points(small_volume, hu=(None, 40), device=device)
    assert len(cloud) == np.count_nonzero(small_volume.voxels <= 40)
    assert cloud.report["band_hu"] == [None, 40.0]


def test_shell_of_the_whole_volume_is_what_its_inner_voxels_leave(device, small_volume):
    inner = (3 - 2) * (5 - 2) * (33 - 2)
    shell = extract_points(small_volume, 0, kind="shell", device=device)
    assert len(shell) == small_volume.voxels.size - inner
    assert shell.report["voxels_in_band"] == small_volume.voxels.size


@pytest.mark.parametrize(("high", "points"), [(-1, 0), (99, 3 * 5 * 33)], ids=["no point", "all voxels"])
def test_bytes_of_point_extraction_are_those_of_its_buffers(device, high, points):
    volume = Volume(np.zeros((3, 5, 33), np.int16), np.eye(4))
    selection = Selection(low=np.int16(-5), high=np.int16(high))
    emission = VoxelEmission(DeviceVolume(volume, device=device), selection)
    _, hu, _ = emission.run()
    assert len(hu) == points

    rows, point_bytes = 3 * 5, 3 * 4 + 4 + 4  # place, HU and number of a point
    mask, end, counts = 2 * 4, 4, 9  # of each row: two words for 33 columns, where its points begin, and counts
    assert emission.largest == {
        "volume": volume.voxels.nbytes, "output": point_bytes * points, "scratch": rows * (mask + end + counts)
    }  # fmt: skip


@pytest.fixture(scope="module")
def uneven_volume() -> Volume:
    """Random HU from 0 to 99 in 9 slices with gaps of 0.4 to 7 mm."""
    return make_volume((9, 10, 40), uneven=True)


@pytest.fixture(scope="module")
def uneven_mesh(device, uneven_volume):
    """The surface of `uneven_volume` at 50 HU."""
    return extract_isosurface(uneven_volume, 50, device=device)


@pytest.mark.release
def test_surface_points_are_the_vertices_of_the_mesh_with_its_normals(device, uneven_volume, uneven_mesh):
    cloud = extract_points(uneven_volume, 50, device=device)
    np.testing.assert_array_equal(cloud.points, uneven_mesh.vertices)
    np.testing.assert_array_equal(cloud.normals, uneven_mesh.normals)


@pytest.mark.release
def test_surface_points_have_the_hu_of_the_level_and_no_voxels(device, uneven_volume):
    cloud = extract_points(uneven_volume, 50, device=device)
    assert set(cloud.hu.tolist()) == {50.0}
    assert cloud.ijk is None


@pytest.mark.release
def test_report_of_surface_points_tells_kind_number_and_bytes(device, uneven_volume, uneven_mesh):
    report = extract_points(uneven_volume, 50, device=device).report
    assert (report["kind"], report["points"]) == ("surface", uneven_mesh.vertex_count)
    assert report["device_bytes"]["output"] == 6 * 4 * uneven_mesh.vertex_count  # place and normal


@pytest.mark.release
def test_surface_points_of_slabs_are_the_vertices_of_the_mesh(device, uneven_volume, uneven_mesh):
    cloud = extract_points(uneven_volume, 50, device=device, memory=60_000)
    assert cloud.report["slabs"] > 1
    np.testing.assert_array_equal(cloud.points, uneven_mesh.vertices)


@pytest.mark.release
def test_surface_points_of_a_band_are_the_vertices_of_its_mesh_without_hu(device, uneven_volume):
    cloud = extract_points(uneven_volume, kind="surface", hu=(30, 60), device=device)
    np.testing.assert_array_equal(cloud.points, extract_isosurface(uneven_volume, (30, 60), device=device).vertices)
    assert cloud.hu is None


def three_bones(volume: Volume) -> LabelMap:
    """Labels 0, 1 and 2 side by side, 14 columns each; 1 is named bone."""
    return LabelMap((np.indices(volume.voxels.shape)[2] // 14).astype(np.uint8), volume.affine, {1: "bone"})


def test_surface_points_of_a_named_label_are_the_vertices_of_its_mesh(device):
    volume = make_volume((8, 12, 40))
    labels = three_bones(volume)
    cloud = extract_points(volume, 50, labels=labels, label="bone", device=device)
    (mesh,) = extract_labels(volume, labels, 50, label=["bone"], device=device).values()
    np.testing.assert_array_equal(cloud.points, mesh.vertices)
    assert set(cloud.labels.tolist()) == {1}
    assert cloud.report["label_name"] == "bone"


def test_surface_points_of_all_labels_have_each_label(device):
    volume = make_volume((8, 12, 40))
    cloud = extract_points(volume, 50, labels=three_bones(volume), device=device)
    assert set(cloud.labels.tolist()) == {1, 2}
    assert cloud.report["label"] is None


SPACING, RADIUS = np.array([0.64, 0.64, 0.8]), 20.0  # mm
CENTRE = np.array([33.5, 33.5, 27.5]) * SPACING


@pytest.fixture(scope="module")
def ball() -> Volume:
    """A ball of 20 mm whose HU fall by 300 a mm from 200 at its surface, in 56 slices of 68 x 68 voxels."""
    k, j, i = np.indices((56, 68, 68))
    from_centre = np.linalg.norm(np.stack([i, j, k], -1) * SPACING - CENTRE, axis=-1)
    return Volume(
        np.rint(np.clip(200 + 300 * (RADIUS - from_centre), -1000, 1000)).astype(np.int16), np.diag([*SPACING, 1])
    )


def test_points_of_the_voxels_of_a_ball_fill_it(device, ball):
    solid = extract_points(ball, hu=(200, None), device=device)
    assert len(solid) * SPACING.prod() == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=tolerances.BALL_OF_VOXELS)


def test_points_of_the_shell_of_a_ball_are_voxels_within_a_diagonal_of_its_surface(device, ball):
    shell = extract_points(ball, 200, kind="shell", device=device)
    depth = RADIUS - np.linalg.norm(shell.points - CENTRE, axis=1)
    assert depth.min() > -tolerances.CLOUD_BALL_MM
    assert depth.max() < np.linalg.norm(SPACING)


def test_points_of_the_surface_of_a_ball_lie_on_it(device, ball):
    surface = extract_points(ball, 200, device=device)
    assert np.abs(np.linalg.norm(surface.points - CENTRE, axis=1) - RADIUS).max() < tolerances.CLOUD_BALL_MM


@pytest.fixture(scope="module")
def paper_points(device):
    """An uneven volume, and its points placed as the paper does: without the third coordinate."""
    volume = make_volume((9, 12, 40), uneven=True)
    return volume, extract_points(volume, hu=BAND, paper=True, device=device)


def test_paper_mode_puts_all_slices_into_one_plane(paper_points):
    volume, cloud = paper_points
    assert_voxels_equal_twin(cloud, volume, paper=True)
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    normal /= np.linalg.norm(normal)
    assert np.ptp(cloud.points @ normal) < tolerances.CLOUD_PLACE_MM * 10  # sums of three rounded coordinates


def test_paper_mode_reports_how_far_its_points_lie_from_their_voxels(paper_points):
    volume, cloud = paper_points
    away = np.linalg.norm(cloud.points - volume.ijk_to_lps(cloud.ijk), axis=1)
    facts = cloud.report["paper"]
    assert facts["error_max_mm"] == pytest.approx(away.max(), abs=tolerances.CLOUD_PLACE_MM)
    assert facts["error_rms_mm"] == pytest.approx(np.sqrt((away**2).mean()), abs=tolerances.CLOUD_PLACE_MM)
    assert away.max() > 10.0, "the slices lie side by side"  # mm; measured 26


def test_paper_mode_counts_the_voxels_that_are_not_zero(paper_points):
    volume, cloud = paper_points
    assert cloud.report["paper"]["nonzero_voxels"] == np.count_nonzero(volume.voxels)


def test_a_resident_volume_is_uploaded_once_for_voxels_and_surface(device):
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
def test_choices_of_points_that_contradict_themselves_are_refused(choice, words):
    with pytest.raises(UsageError, match=words):
        extract_points(make_volume((3, 5, 33)), **choice)


def test_twin_marks_the_shell_of_a_cube_of_three_voxels():
    cube = np.zeros((5, 5, 5), bool)
    cube[1:4, 1:4, 1:4] = True
    shell = cube.copy()
    shell[2, 2, 2] = False
    np.testing.assert_array_equal(mark_shell(cube), shell)


def test_twin_marks_the_border_of_a_full_volume_as_its_shell():
    assert mark_shell(np.ones((3, 4, 5), bool)).sum() == 3 * 4 * 5 - 1 * 2 * 3


OUTER_MM = 13.0


@pytest.fixture(scope="module")
def hollow_bone() -> Volume:
    """A blurred shell of bone whose inner radius is 10 mm."""
    return hollow_ball(radius=OUTER_MM, thickness=3.0)


def outer_points(cloud) -> np.ndarray:
    """Which points lie on the outer wall of `hollow_bone`."""
    return np.linalg.norm(cloud.points - MIDDLE, axis=1) > OUTER_MM - 0.5


def test_points_of_the_cortex_lie_on_the_bone_and_those_of_a_level_outside(device, hollow_bone):
    level, cortex = (extract_points(hollow_bone, 200.0, kind=kind, device=device) for kind in ("surface", "cortex"))
    away_of_level, away_of_cortex = (
        np.linalg.norm(cloud.points[outer_points(level)] - MIDDLE, axis=1) - OUTER_MM for cloud in (level, cortex)
    )
    assert away_of_level.mean() == pytest.approx(0.76, abs=0.01)  # measured: 200 HU is reached far out in the blur
    assert np.abs(away_of_cortex).mean() < 0.025  # measured 0.016


def test_normals_of_points_of_the_cortex_point_outward(device, hollow_bone):
    cloud = extract_points(hollow_bone, 200.0, kind="cortex", device=device)
    outer = outer_points(cloud)
    assert outer.any()
    assert (np.einsum("na,na->n", cloud.normals[outer], cloud.points[outer] - MIDDLE) > 0.0).all()


def test_points_of_the_cortex_have_no_hu_and_report_how_many_are_fitted(device, hollow_bone):
    cloud = extract_points(hollow_bone, 200.0, kind="cortex", device=device)
    assert cloud.hu is None and cloud.labels is None
    assert cloud.report["kind"] == "cortex"
    assert cloud.report["cortex"]["fitted"] > 0.9 * outer_points(cloud).sum()  # measured all


def test_points_of_the_cortex_have_thickness_and_error_of_the_fitted_mesh(device, hollow_bone):
    cloud = extract_points(hollow_bone, 200.0, kind="cortex", device=device)
    mesh = fit_cortex(extract_isosurface(hollow_bone, 200.0, device=device), hollow_bone, device=device)
    assert set(cloud.values) == {"thickness_mm", "error_mm"}
    for name, values in cloud.values.items():
        assert np.array_equal(values, mesh.values[name], equal_nan=True)


def test_points_of_the_cortex_of_labels_are_those_of_their_fitted_meshes(device, hollow_bone):
    """A label for the lower half, and one for the upper."""
    numbers = np.ones(hollow_bone.voxels.shape, np.uint8)
    numbers[:18] = 2
    labels = LabelMap(numbers, hollow_bone.affine)
    cloud = extract_points(hollow_bone, 200.0, kind="cortex", labels=labels, device=device)

    meshes = extract_labels(hollow_bone, labels, 200.0, device=device)
    assert np.array_equal(np.bincount(cloud.labels)[1:], [meshes[1].vertex_count, meshes[2].vertex_count])
    fitted = np.concatenate([fit_cortex(mesh, hollow_bone, device=device).vertices for mesh in meshes.values()])
    # The cloud takes the HU of bone from its largest mesh, `fit_cortex` from each.
    assert np.percentile(np.linalg.norm(cloud.points - fitted, axis=1), 95) < 0.05  # mm; measured 0.017


@pytest.mark.parametrize("level", [{}, {"iso_value": "auto"}, {"hu": (150, 900)}], ids=["none", "auto", "a band"])
def test_points_of_the_cortex_without_one_level_are_refused_with_a_level_to_give(device, level):
    with refused(UsageError, 200):
        extract_points(hollow_ball(), kind="cortex", device=device, **level)
