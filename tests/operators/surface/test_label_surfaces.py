"""Surfaces of labels on every device: equal to the twin, closed, sharing borders, no worse than the plain surface."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from slab_surfaces import assert_same
from surface_volumes import MIRRORED, OBLIQUE, random_labels, random_volume
from variants import VOXEL_TYPES, daily

from clrecon.errors import DeviceError, NoSurfaceError, RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.label_levels import Growth
from clrecon.opencl import Stopwatch
from clrecon.operators.resident import device_volume
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import labels as operator
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.labels import extract_labels
from clrecon.proof.surface import labels as twin

SHAPES = [(5, 7, 9), (6, 5, 31), (5, 6, 33), (9, 4, 64), (4, 5, 100), (3, 4, 1030)]


def assert_equals_twin(mesh, volume, inside, *, number, iso_value, closed=True):
    vertices, normals, triangles = twin.extract_label(volume, inside, number, iso_value, closed=closed)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(volume.lps_to_ijk(mesh.vertices) - volume.lps_to_ijk(vertices)).max() <= tolerances.TWIN_VERTEX_VOXEL
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


def share_placed_by_hu(volume, inside, *, number, iso_value, vertices) -> float:
    """The share of crossed edges of a closed label that HU place; others carry their vertex half way."""
    inside = np.pad(inside, 1)
    dense = np.pad(volume.voxels >= iso_value, 1)
    half_way = 0
    for axis in range(3):
        (a, b), (da, db) = ((np.moveaxis(x, axis, 0)[:-1], np.moveaxis(x, axis, 0)[1:]) for x in (inside, dense))
        placed = ((a == number) & da & (b == 0) & ~db) | ((b == number) & db & (a == 0) & ~da)
        half_way += int(np.count_nonzero(((a == number) != (b == number)) & ~placed))
    return 1.0 - half_way / vertices


@pytest.mark.every_device
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_surfaces_of_labels_and_their_share_placed_by_hu_equal_the_twin(device, shape, solid, closed):
    volume, labels = random_volume(shape), random_labels(shape)
    numbers = (3, 7, 300)
    inside = twin.find_solid(volume, labels, 3, grow_mm=1.2, closed=closed, solid=numbers if solid else ())
    meshes = extract_labels(
        volume, LabelMap(labels, OBLIQUE), 3, device=device, grow_mm=1.2, closed=closed, solid=solid
    )
    assert tuple(meshes) == numbers
    for number, mesh in meshes.items():
        assert_equals_twin(mesh, volume, inside, number=number, iso_value=3, closed=closed)
        if closed:
            by_hu = share_placed_by_hu(volume, inside, number=number, iso_value=3, vertices=len(mesh.vertices))
            assert mesh.report["vertices_by_hu_share"] == pytest.approx(by_hu, abs=tolerances.FLOAT64_SHARE)


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize("iso_value", [40, 40.3])
def test_surfaces_of_labels_equal_their_twin_for_every_voxel_type(device, dtype, iso_value):
    shape = (6, 7, 37)
    volume, labels = random_volume(shape, dtype=dtype, high=100, affine=MIRRORED), random_labels(shape)
    inside = twin.find_solid(volume, labels, iso_value)
    meshes = extract_labels(volume, LabelMap(labels, MIRRORED), iso_value, device=device)
    assert tuple(meshes) == (3, 7, 300)
    for number, mesh in meshes.items():
        assert_equals_twin(mesh, volume, inside, number=number, iso_value=iso_value)


@pytest.mark.release
@pytest.mark.parametrize(("lanes", "words"), [("1", "1"), ("8", "3")])
@pytest.mark.parametrize("numbers", daily(1, [(0, 0, 3, 7), (0, 0, 3, 300)]), ids=["one-byte", "two-bytes"])
def test_kernels_of_gpus_and_those_of_three_words_an_item_give_the_same_meshes(
    device, lanes, words, numbers, monkeypatch
):
    volume, labels = random_volume((6, 7, 75), affine=MIRRORED), random_labels((6, 7, 75), numbers=numbers)
    inside = twin.find_solid(volume, labels, 3)
    variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": words}
    monkeypatch.setattr(device, "kernel_variants", variants)
    label_map = LabelMap(labels.astype(np.uint8 if max(numbers) < 256 else np.uint16), MIRRORED)
    meshes = extract_labels(volume, label_map, 3, device=device)
    assert sorted(meshes) == sorted({*numbers} - {0})
    for number, mesh in meshes.items():
        assert_equals_twin(mesh, volume, inside, number=number, iso_value=3)


@pytest.mark.every_device
@pytest.mark.parametrize("grow_mm", [None, 0.0, 0.6, 2.7, 5.3])
@pytest.mark.parametrize("affine", [OBLIQUE, np.eye(4)], ids=["oblique", "straight"])
@pytest.mark.parametrize("shape", [(5, 7, 9), (4, 4, 4), (5, 5, 5), (1, 1, 63), (3, 1, 65)])
def test_samples_that_labels_grow_to_equal_the_twin(device, shape, affine, grow_mm):
    """Sizes on both sides of a work-group of 64; in a straight grid distances tie."""
    volume, labels = random_volume(shape, affine=affine), random_labels(shape, numbers=(0, 0, 0, 0, 2, 9))
    growth = Growth.of(volume, grow_mm)
    taken = resample_labels(LabelMap(labels, affine), volume)
    resident = DeviceVolume(volume, device=device)
    run = operator.LabelExtraction(resident, taken, choose_iso_rule(volume, 3), growth, solid=False, warnings=[])

    held = run.hold({1: (slice(0, shape[0]), slice(0, shape[1]), slice(0, shape[2]))})

    inside = operator.ocl.download(device, np.empty_like(taken.voxels), held.inside_d)
    assert np.array_equal(inside, twin.find_solid(volume, labels, 3, grow_mm=grow_mm))


@pytest.fixture(scope="module")
def random_label_meshes(device):
    """A volume, its labels 3, 7 and 300, and their surfaces at 2.3 HU."""
    shape = (12, 13, 40)
    volume, labels = random_volume(shape, high=9), random_labels(shape)
    return volume, labels, extract_labels(volume, LabelMap(labels, OBLIQUE), 2.3, device=device)


@pytest.mark.parametrize("number", [3, 7, 300])
def test_surface_of_a_label_is_closed_and_manifold_with_no_vertex_twice(random_label_meshes, number):
    _, _, meshes = random_label_meshes
    quality = meshes[number].quality()
    assert (quality["closed"], quality["manifold"]) == (True, True)
    assert quality["volume_ml"] > 0
    assert (quality["zero_area_faces"], quality["unused_vertices"]) == (0, 0)
    assert len(np.unique(meshes[number].vertices, axis=0)) == len(meshes[number].vertices)


@pytest.mark.parametrize(("one", "other"), [(3, 7), (3, 300), (7, 300)])
def test_labels_share_a_vertex_for_each_face_between_their_voxels(random_label_meshes, one, other):
    volume, labels, meshes = random_label_meshes
    inside = twin.find_solid(volume, labels, 2.3)
    faces = 0
    for axis in range(3):
        a, b = np.moveaxis(inside, axis, 0)[1:], np.moveaxis(inside, axis, 0)[:-1]
        faces += int(((a == one) & (b == other) | (a == other) & (b == one)).sum())
    shared = {row.tobytes() for row in meshes[one].vertices} & {row.tobytes() for row in meshes[other].vertices}
    assert len(shared) == faces > 0


@pytest.mark.parametrize("number", [7, 9])
def test_surface_of_a_label_alone_is_the_same_as_among_others(device, number):
    shape = (20, 9, 40)
    volume, labels = random_volume(shape), np.zeros(shape, np.uint16)
    labels[2:6], labels[6:13, 2:], labels[15:] = 3, 7, 9
    label_map = LabelMap(labels, OBLIQUE)
    together = extract_labels(volume, label_map, 3, device=device)[number]
    assert_same(extract_labels(volume, label_map, 3, device=device, label=[number])[number], together)


@pytest.mark.every_device
@pytest.mark.parametrize("closed", [True, False])
def test_surface_of_a_label_of_all_voxels_is_that_of_the_volume(device, closed):
    volume = random_volume((9, 8, 45))
    labels = LabelMap(np.ones(volume.voxels.shape, np.uint8), OBLIQUE)
    mesh = extract_labels(volume, labels, 3, device=device, closed=closed)[1]
    assert_same(mesh, extract_isosurface(volume, 3, device=device, closed=closed))
    assert mesh.report["vertices_by_hu_share"] == 1.0


@pytest.fixture(scope="module")
def three_layers() -> tuple[Volume, LabelMap]:
    """Labels 3, 7 and 9 at the bottom, in the middle and at the top of 60 slices."""
    labels = np.zeros((60, 40, 40), np.uint16)
    labels[:6], labels[28:31], labels[55:] = 3, 7, 9
    return random_volume(labels.shape), LabelMap(labels, OBLIQUE)


@pytest.mark.parametrize("number", [3, 7, 9])
def test_labels_that_do_not_fit_together_have_the_same_surfaces_one_by_one(device, three_layers, number):
    volume, labels = three_layers
    memory = 500_000
    together = extract_labels(volume, labels, 3, device=device, solid=True)[number]
    alone = extract_labels(volume, labels, 3, device=device, solid=True, memory=memory)[number]
    assert (together.report["slabs"], alone.report["slabs"]) == (1, 3)
    assert sum(alone.report["device_bytes"].values()) <= memory
    assert_same(alone, together)


def test_labels_that_do_not_fit_together_upload_three_slabs_each(device, three_layers, monkeypatch):
    volume, labels = three_layers
    uploads, true_upload = [], device_volume.ocl.upload

    def upload(device, array, **named):
        uploads.append(array.shape)
        return true_upload(device, array, **named)

    monkeypatch.setattr(device_volume.ocl, "upload", upload)
    extract_labels(volume, labels, 3, device=device, solid=True, memory=500_000)
    slabs = [shape for shape in uploads if len(shape) == 3 and shape[1:] == (40, 40)]
    assert len(slabs) == 3 * 3


def test_labels_that_do_not_fit_alone_are_refused(device, three_layers):
    volume, labels = three_layers
    with refused(DeviceError, 50_000):
        extract_labels(volume, labels, 3, device=device, memory=50_000)


@pytest.mark.every_device
@pytest.mark.parametrize("number", [3, 7, 300])
def test_labels_on_a_turned_grid_of_the_same_voxels_have_the_same_surfaces(device, number):
    volume, labels = random_volume((6, 7, 33)), random_labels((6, 7, 33))
    turned = OBLIQUE @ np.array([[0, 0, 1, 0], [0, -1, 0, 6], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    turned_labels = LabelMap(labels[:, ::-1].transpose(2, 1, 0), turned)
    expected = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device)[number]
    assert np.array_equal(extract_labels(volume, turned_labels, 3, device=device)[number].vertices, expected.vertices)


@pytest.fixture(scope="module")
def report_of_t12(device):
    """The report of the surface of a label named after its vertebra, in a doubtful map."""
    volume, labels = random_volume((5, 7, 9)), random_labels((5, 7, 9))
    label_map = LabelMap(labels, OBLIQUE, names={3: "vertebrae_T12"}, warnings=["doubtful"])
    return extract_labels(volume, label_map, 3, device=device, label=["T12"])[3].report


def test_report_of_a_label_names_it_and_has_the_warnings_of_its_map(report_of_t12):
    assert (report_of_t12["label"], report_of_t12["label_name"]) == (3, "vertebrae_T12")
    assert "doubtful" in report_of_t12["warnings"]


def test_report_of_a_label_has_its_shares_and_settings(report_of_t12):
    assert report_of_t12["label_inside_share"] == 1.0
    assert 0.1 < report_of_t12["vertices_by_hu_share"] < 0.9  # some, not all; measured 0.83
    assert (report_of_t12["solid"], report_of_t12["grow_mm"]) == (False, None)


def test_report_of_a_label_has_the_seconds_of_its_steps(report_of_t12):
    assert set(report_of_t12["seconds"]) == {"upload", "build", "kernels", "download"}


def test_a_label_that_leaves_the_volume_is_closed_at_its_end_with_a_warning(device):
    """Shifted by 3 of 5 slices."""
    shifted = OBLIQUE.copy()
    shifted[:, 3] = OBLIQUE @ (0, 0, 3, 1)
    mesh = extract_labels(random_volume((5, 7, 9)), LabelMap(np.full((5, 7, 9), 2), shifted), 3, device=device)[2]
    assert mesh.quality()["closed"]
    assert "60 % of label 2 lie outside the CT" in mesh.report["warnings"][-1]


@pytest.fixture(scope="module")
def liver_and_bone() -> tuple[Volume, LabelMap]:
    """Label 2, the liver, of 1 HU in the first slice, and label 5 with 0 to 5 HU in the last two."""
    volume, labels = random_volume((5, 7, 9), high=6), np.zeros((5, 7, 9), np.uint8)
    labels[0], labels[3:] = 2, 5
    volume.voxels[:3] = 1
    return volume, LabelMap(labels, OBLIQUE, names={2: "liver"})


def test_a_label_without_a_surface_is_left_out_where_all_are_asked_for(device, liver_and_bone):
    volume, labels = liver_and_bone
    assert tuple(extract_labels(volume, labels, 3, device=device)) == (5,)


def test_a_label_without_a_surface_is_refused_where_it_is_asked_for(device, liver_and_bone):
    volume, labels = liver_and_bone
    with refused(NoSurfaceError, 2, 3, 1):  # the label, the level, and its highest HU
        extract_labels(volume, labels, 3, device=device, label=[5, 2])


def test_labels_of_which_none_has_a_surface_are_refused(device, liver_and_bone):
    volume, labels = liver_and_bone
    with refused(NoSurfaceError, 6, "label"):
        extract_labels(volume, labels, 6, device=device)


def test_an_unknown_label_is_refused_with_those_there_are(device, liver_and_bone):
    volume, labels = liver_and_bone
    with refused(UsageError, "label_5", 9, 2, 5):
        extract_labels(volume, labels, 3, device=device, label=[9])


def test_an_empty_choice_of_labels_is_refused(device, liver_and_bone):
    volume, labels = liver_and_bone
    with refused(UsageError, "label"):
        extract_labels(volume, labels, 3, device=device, label=[])


def test_labels_a_metre_beside_the_volume_are_refused(device, liver_and_bone):
    volume, labels = liver_and_bone
    beside = OBLIQUE.copy()
    beside[0, 3] += 1000
    with refused(RefusedInputError, 0, "labels"):
        extract_labels(volume, LabelMap(labels.voxels, beside), 3, device=device)


@pytest.fixture(scope="module")
def block_in_a_label_of_all() -> tuple[Volume, LabelMap]:
    """A block of 300 HU in 0 HU, and a label of all voxels."""
    hu = np.zeros((5, 7, 9), np.int16)
    hu[2:4, 2:5, 2:6] = 300
    return Volume(hu, OBLIQUE), LabelMap(np.ones((5, 7, 9), np.uint8), OBLIQUE, names={1: "all"})


@pytest.mark.parametrize("chosen", [None, [1]])
@pytest.mark.parametrize(("closed", "solid"), [(True, False), (True, True), (False, False)])
def test_a_block_within_a_label_of_all_voxels_has_a_surface(device, block_in_a_label_of_all, chosen, closed, solid):
    volume, labels = block_in_a_label_of_all
    meshes = extract_labels(volume, labels, 30, device=device, label=chosen, closed=closed, solid=solid)
    assert tuple(meshes) == (1,)


@pytest.mark.parametrize("chosen", [None, [1]])
def test_an_open_solid_surface_of_a_label_of_all_voxels_is_refused(device, block_in_a_label_of_all, chosen):
    """Nothing leads to its dense voxels from outside: solid, all of it is inside."""
    volume, labels = block_in_a_label_of_all
    with refused(NoSurfaceError, "CT", 1, 30):
        extract_labels(volume, labels, 30, device=device, label=chosen, closed=False, solid=True)


@pytest.mark.parametrize("chosen", [None, [1]])
def test_an_open_surface_of_a_label_of_all_voxels_that_are_dense_is_refused(device, block_in_a_label_of_all, chosen):
    _, labels = block_in_a_label_of_all
    dense = Volume(np.full((5, 7, 9), 50, np.int16), OBLIQUE)
    with refused(NoSurfaceError, "CT", 1, 30):
        extract_labels(dense, labels, 30, device=device, label=chosen, closed=False)


@pytest.mark.parametrize("chosen", [None, [1]])
def test_a_surface_of_labels_above_all_their_hu_is_refused(device, block_in_a_label_of_all, chosen):
    volume, labels = block_in_a_label_of_all
    with refused(NoSurfaceError, 500):
        extract_labels(volume, labels, 500, device=device, label=chosen, closed=False, solid=True)


@pytest.fixture(scope="module")
def label_beyond_the_volume() -> tuple[Volume, LabelMap]:
    """Label 2 in the five slices of the volume, and label 4 in slices 8 and 9 of the map."""
    labels = np.zeros((10, 7, 9), np.uint8)
    labels[:5], labels[8:] = 2, 4
    return random_volume((5, 7, 9)), LabelMap(labels, OBLIQUE)


def test_a_label_outside_the_volume_is_left_out_where_all_are_asked_for(device, label_beyond_the_volume):
    volume, labels = label_beyond_the_volume
    assert tuple(extract_labels(volume, labels, 3, device=device)) == (2,)


def test_a_label_outside_the_volume_is_refused_where_it_is_asked_for(device, label_beyond_the_volume):
    volume, labels = label_beyond_the_volume
    with refused(NoSurfaceError, "label_4", "CT", 4):
        extract_labels(volume, labels, 3, device=device, label=[4])


@pytest.mark.oclgrind
@pytest.mark.parametrize("number", [3, 7, 300])
def test_triangles_of_a_label_of_a_small_volume_equal_the_twin(device, number):
    volume, labels = random_volume((4, 4, 33)), random_labels((4, 4, 33))
    inside = twin.find_solid(volume, labels, 3, grow_mm=1.2)
    mesh = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, grow_mm=1.2)[number]
    _, _, triangles = twin.extract_label(volume, inside, number, iso_value=3)
    assert np.array_equal(mesh.triangles, triangles)


@pytest.mark.oclgrind
def test_triangles_of_a_label_without_growth_between_other_slices_equal_the_twin(device):
    """The slices that are held reach as far as those that are read."""
    volume, labels = random_volume((12, 4, 33)), np.zeros((12, 4, 33), np.uint16)
    labels[4:6] = 3
    inside = twin.find_solid(volume, labels, 3, grow_mm=0)
    mesh = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, grow_mm=0)[3]
    _, _, triangles = twin.extract_label(volume, inside, number=3, iso_value=3)
    assert np.array_equal(mesh.triangles, triangles)


T12, T11 = 32, 33


@pytest.fixture(scope="module")
def real_vertebrae(device, real_data):
    """Hollow and solid surfaces of T12 and T11 in a real scan at 200 HU, and the volume of T12's mask in ml."""
    from clrecon.labels import read_labels
    from clrecon.reading import read_volume

    folder = real_data / "thoracolumbar_labels"
    volume, labels = read_volume(folder / "ct_2mm_jpeg2000"), read_labels(folder / "ct_2mm_labels.nii.gz")
    hollow, solid = (
        extract_labels(volume, labels, 200, device=device, label=["T12", "T11"], solid=solid) for solid in (False, True)
    )
    mask_ml = np.count_nonzero(resample_labels(labels, volume).voxels == T12) * np.prod(volume.spacing) / 1000
    return hollow, solid, mask_ml


@pytest.mark.release
@pytest.mark.parametrize("number", [T12, T11], ids=["T12", "T11"])
def test_hollow_and_solid_surfaces_of_a_real_vertebra_are_closed_and_manifold(real_vertebrae, number):
    hollow, solid, _ = real_vertebrae
    for quality in (hollow[number].quality(), solid[number].quality()):
        assert (quality["closed"], quality["manifold"]) == (True, True)


@pytest.mark.release
def test_a_solid_real_vertebra_has_the_volume_of_its_mask_and_a_hollow_one_less(real_vertebrae):
    hollow, solid, mask_ml = real_vertebrae
    assert solid[T12].quality()["volume_ml"] == pytest.approx(mask_ml, rel=tolerances.REAL_SOLID_VOLUME)
    assert hollow[T12].quality()["volume_ml"] < 0.7 * mask_ml  # measured 0.64


@pytest.mark.release
def test_two_real_vertebrae_share_vertices_where_they_touch(real_vertebrae):
    _, solid, _ = real_vertebrae
    shared = {row.tobytes() for row in solid[T12].vertices} & {row.tobytes() for row in solid[T11].vertices}
    assert len(shared) > 100  # of 15,668 of T12; measured 1723


@pytest.mark.release
def test_most_vertices_of_a_real_vertebra_are_placed_by_hu(real_vertebrae):
    _, solid, _ = real_vertebrae
    assert solid[T12].report["vertices_by_hu_share"] > 0.6  # measured 0.68


@pytest.mark.parametrize(("missing", "slices"), [(0, (0, 40)), (1, (16, 26))], ids=["room", "a byte too few"])
def test_a_volume_that_is_held_is_used_whole_where_a_mesh_of_half_the_bytes_fits(device, missing, slices):
    """Voxels of two bytes, labels and the samples inside of one each, and half of that: six bytes a voxel."""
    volume = random_volume((40, 5, 8), affine=np.eye(4))
    labels = np.zeros(volume.voxels.shape, np.uint8)
    labels[20:22, 1:4, 2:6] = 1
    with DeviceVolume(volume, device=device, memory=6 * volume.voxels.size - missing) as resident:
        resident.whole(Stopwatch())
        rule, growth = choose_iso_rule(volume, 3), Growth.of(volume, 1.0)
        taken = resample_labels(LabelMap(labels, np.eye(4)), volume)
        run = operator.LabelExtraction(resident, taken, rule, growth, solid=False, warnings=[])
        assert sum(run.needs(first=0, end=40).values()) == 4 * volume.voxels.size
        assert run.slices_for({1: (slice(20, 22), slice(1, 4), slice(2, 6))}) == slices
