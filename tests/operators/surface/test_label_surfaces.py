"""Surfaces of labels on every device: equal to the twin, closed, sharing borders, no worse than the plain surface."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
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

OBLIQUE = np.array([[0.7, 0.1, 0.05, -250.0], [-0.1, 0.5, 0.2, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])
MIRRORED = OBLIQUE @ np.diag((-1.0, 1.0, 1.0, 1.0))
SHAPES = [(5, 7, 9), (6, 5, 31), (5, 6, 33), (9, 4, 64), (4, 5, 100), (3, 4, 1030)]


def random_volume(shape, dtype="int16", affine=OBLIQUE, seed=0, high=6) -> Volume:
    return Volume(np.random.default_rng(seed).integers(0, high, shape).astype(dtype), affine)


def random_labels(shape, seed=1, numbers=(0, 0, 3, 7, 300)) -> np.ndarray:
    """Blocks of labels, and single voxels of others."""
    random = np.random.default_rng(seed)
    coarse = random.choice(np.array(numbers, np.uint16), [-(-n // 3) for n in shape])
    labels = coarse.repeat(3, 0).repeat(3, 1).repeat(3, 2)[: shape[0], : shape[1], : shape[2]]
    odd = random.random(shape) < 0.1
    return np.where(odd, random.choice(np.array(numbers, np.uint16), shape), labels)


def assert_equals_twin(mesh, volume, inside, number, iso_value, closed=True):
    vertices, normals, triangles = twin.extract_label(volume, inside, number, iso_value, closed=closed)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(volume.lps_to_ijk(mesh.vertices) - volume.lps_to_ijk(vertices)).max() <= tolerances.TWIN_VERTEX_VOXEL
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


def count_half_way(volume, inside, number, iso_value) -> int:
    """Crossed edges of a closed label that HU do not place."""
    inside = np.pad(inside, 1)
    dense = np.pad(volume.voxels >= iso_value, 1)
    half_way = 0
    for axis in range(3):
        (a, b), (da, db) = ((np.moveaxis(x, axis, 0)[:-1], np.moveaxis(x, axis, 0)[1:]) for x in (inside, dense))
        placed = ((a == number) & da & (b == 0) & ~db) | ((b == number) & db & (a == 0) & ~da)
        half_way += int(np.count_nonzero(((a == number) != (b == number)) & ~placed))
    return half_way


@pytest.mark.every_device
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_surfaces_of_labels_equal_their_twin(device, shape, solid, closed):
    volume, labels = random_volume(shape), random_labels(shape)
    numbers = (3, 7, 300)
    inside = twin.find_solid(volume, labels, 3, grow_mm=1.2, closed=closed, solid=numbers if solid else ())
    meshes = extract_labels(
        volume, LabelMap(labels, OBLIQUE), 3, device=device, grow_mm=1.2, closed=closed, solid=solid
    )
    assert tuple(meshes) == numbers
    for number, mesh in meshes.items():
        assert_equals_twin(mesh, volume, inside, number, 3, closed)
        if closed:
            by_hu = 1.0 - count_half_way(volume, inside, number, 3) / len(mesh.vertices)
            assert mesh.report["vertices_by_hu_share"] == pytest.approx(by_hu, abs=1e-12)


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
def test_surfaces_of_labels_equal_their_twin_for_every_voxel_type(device, dtype):
    shape = (6, 7, 37)
    volume, labels = random_volume(shape, dtype, MIRRORED, high=100), random_labels(shape)
    for iso_value in (40, 40.3):
        inside = twin.find_solid(volume, labels, iso_value)
        for number, mesh in extract_labels(volume, LabelMap(labels, MIRRORED), iso_value, device=device).items():
            assert_equals_twin(mesh, volume, inside, number, iso_value)


@pytest.mark.release
@pytest.mark.parametrize(("lanes", "words"), [("1", "1"), ("8", "3")])
@pytest.mark.parametrize("numbers", daily(1, [(0, 0, 3, 7), (0, 0, 3, 300)]), ids=["one-byte", "two-bytes"])
def test_every_variant_of_the_kernels_gives_the_same_meshes(device, lanes, words, numbers, monkeypatch):
    volume, labels = random_volume((6, 7, 75), affine=MIRRORED), random_labels((6, 7, 75), numbers=numbers)
    inside = twin.find_solid(volume, labels, 3)
    variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": words}
    monkeypatch.setattr(device, "kernel_variants", variants)
    label_map = LabelMap(labels.astype(np.uint8 if max(numbers) < 256 else np.uint16), MIRRORED)
    for number, mesh in extract_labels(volume, label_map, 3, device=device).items():
        assert_equals_twin(mesh, volume, inside, number, 3)


@pytest.mark.every_device
@pytest.mark.parametrize("grow_mm", [None, 0.0, 0.6, 2.7, 5.3])
def test_growth_is_that_of_the_twin_to_the_last_sample(device, grow_mm):
    """The buffer of the device is looked at itself: sizes on both sides of a work-group, ties of distance."""
    for shape in [(5, 7, 9), (4, 4, 4), (5, 5, 5), (1, 1, 63), (3, 1, 65)]:
        for affine in (OBLIQUE, np.eye(4)):
            volume, labels = random_volume(shape, affine=affine), random_labels(shape, numbers=(0, 0, 0, 0, 2, 9))
            growth = Growth.of(volume, grow_mm)
            rule = choose_iso_rule(volume, 3)
            taken = resample_labels(LabelMap(labels, affine), volume)
            run = operator.LabelExtraction(DeviceVolume(volume, device=device), taken, rule, growth, False, [])
            held = run.hold({1: (slice(0, shape[0]), slice(0, shape[1]), slice(0, shape[2]))})
            inside = operator.ocl.download(device, np.empty_like(taken.voxels), held.inside_d)
            assert np.array_equal(inside, twin.find_solid(volume, labels, 3, grow_mm=grow_mm))


def test_labels_are_closed_manifold_and_share_their_border(device):
    shape = (12, 13, 40)
    volume, labels = random_volume(shape, high=9), random_labels(shape)
    meshes = extract_labels(volume, LabelMap(labels, OBLIQUE), 2.3, device=device)
    points = {}
    for number, mesh in meshes.items():
        quality = mesh.quality()
        assert quality["closed"] and quality["manifold"] and quality["volume_ml"] > 0
        assert quality["zero_area_faces"] == 0 and quality["unused_vertices"] == 0
        points[number] = {row.tobytes() for row in mesh.vertices}
        assert len(points[number]) == len(mesh.vertices)
    inside = twin.find_solid(volume, labels, 2.3)
    for one, other in ((3, 7), (3, 300), (7, 300)):
        borders = 0
        for axis in range(3):
            a, b = np.moveaxis(inside, axis, 0)[1:], np.moveaxis(inside, axis, 0)[:-1]
            borders += int(((a == one) & (b == other) | (a == other) & (b == one)).sum())
        assert len(points[one] & points[other]) == borders > 0


def test_one_label_alone_is_the_same_as_among_others(device):
    shape = (20, 9, 40)
    volume, labels = random_volume(shape), np.zeros(shape, np.uint16)
    labels[2:6], labels[6:13, 2:], labels[15:] = 3, 7, 9
    together = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device)
    for number in (7, 9):
        alone = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, label=[number])[number]
        assert np.array_equal(alone.vertices, together[number].vertices)
        assert np.array_equal(alone.normals, together[number].normals)
        assert np.array_equal(alone.triangles, together[number].triangles)


@pytest.mark.every_device
def test_a_label_of_everything_is_the_plain_surface(device):
    for closed in (True, False):
        volume = random_volume((9, 8, 45))
        labels = LabelMap(np.ones(volume.voxels.shape, np.uint8), OBLIQUE)
        plain = extract_isosurface(volume, 3, device=device, closed=closed)
        mesh = extract_labels(volume, labels, 3, device=device, closed=closed)[1]
        assert np.array_equal(mesh.vertices, plain.vertices)
        assert np.array_equal(mesh.normals, plain.normals)
        assert np.array_equal(mesh.triangles, plain.triangles)
        assert mesh.report["vertices_by_hu_share"] == 1.0


def test_labels_that_do_not_fit_together_go_through_one_by_one(device, monkeypatch):
    shape = (60, 40, 40)
    volume, labels = random_volume(shape), np.zeros(shape, np.uint16)
    labels[:6], labels[28:31], labels[55:] = 3, 7, 9
    expected = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, solid=True)
    uploads, true_upload = [], device_volume.ocl.upload
    monkeypatch.setattr(device_volume.ocl, "upload", lambda d, a: uploads.append(a.shape) or true_upload(d, a))
    meshes = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, solid=True, memory=500_000)
    assert sum(len(shape) == 3 and shape[1:] == (40, 40) for shape in uploads) == 9  # three for each label
    for number, mesh in meshes.items():
        assert mesh.report["slabs"] == 3 and sum(mesh.report["device_bytes"].values()) <= 500_000
        assert expected[number].report["slabs"] == 1
        assert np.array_equal(mesh.vertices, expected[number].vertices)
        assert np.array_equal(mesh.normals, expected[number].normals)
        assert np.array_equal(mesh.triangles, expected[number].triangles)
    with refused(DeviceError, 50000):
        extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, memory=50_000)


@pytest.mark.every_device
def test_labels_on_another_grid_are_the_same_where_it_covers_the_volume(device):
    volume, labels = random_volume((6, 7, 33)), random_labels((6, 7, 33))
    turned = OBLIQUE @ np.array([[0, 0, 1, 0], [0, -1, 0, 6], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    expected = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device)
    meshes = extract_labels(volume, LabelMap(labels[:, ::-1].transpose(2, 1, 0), turned), 3, device=device)
    assert all(np.array_equal(meshes[n].vertices, expected[n].vertices) for n in expected)


def test_the_report_says_what_was_done(device):
    volume, labels = random_volume((5, 7, 9)), random_labels((5, 7, 9))
    label_map = LabelMap(labels, OBLIQUE, {3: "vertebrae_T12"}, warnings=["doubtful"])
    mesh = extract_labels(volume, label_map, 3, device=device, label=["T12"])[3]
    assert mesh.report["label"] == 3 and mesh.report["label_name"] == "vertebrae_T12"
    assert mesh.report["label_inside_share"] == 1.0 and mesh.report["solid"] is False
    assert mesh.report["grow_mm"] is None
    assert 0.1 < mesh.report["vertices_by_hu_share"] < 0.9
    assert "doubtful" in mesh.report["warnings"]
    assert set(mesh.report["seconds"]) == {"upload", "build", "kernels", "download"}


def test_a_label_that_leaves_the_volume_is_said(device):
    volume = random_volume((5, 7, 9))
    shifted = OBLIQUE.copy()
    shifted[:, 3] = OBLIQUE @ (0, 0, 3, 1)
    mesh = extract_labels(volume, LabelMap(np.full((5, 7, 9), 2), shifted), 3, device=device)[2]
    assert "60 % of label 2 lie outside the CT" in mesh.report["warnings"][-1]
    assert mesh.quality()["closed"]


def test_labels_without_a_surface_are_refused_or_left_out(device):
    volume, labels = random_volume((5, 7, 9)), np.zeros((5, 7, 9), np.uint8)
    labels[0], labels[3:] = 2, 5
    volume.voxels[:3] = 1
    label_map = LabelMap(labels, OBLIQUE, {2: "liver"})
    assert tuple(extract_labels(volume, label_map, 3, device=device)) == (5,)
    with refused(NoSurfaceError, 2, 3, 1):
        extract_labels(volume, label_map, 3, device=device, label=[5, 2])
    with refused(NoSurfaceError, 6, "label"):
        extract_labels(volume, label_map, 6, device=device)
    with refused(UsageError, "label_5", 9, 2, 5):
        extract_labels(volume, label_map, 3, device=device, label=[9])
    with refused(UsageError, "label"):
        extract_labels(volume, label_map, 3, device=device, label=[])
    far = OBLIQUE.copy()
    far[0, 3] += 1000
    with refused(RefusedInputError, 0, "labels"):
        extract_labels(volume, LabelMap(labels, far), 3, device=device)


@pytest.mark.parametrize("numbers", [None, [1]])
def test_a_label_that_is_the_whole_of_an_open_volume_has_no_surface(device, numbers):
    hu = np.zeros((5, 7, 9), np.int16)
    hu[2:4, 2:5, 2:6] = 300
    volume, label_map = Volume(hu, OBLIQUE), LabelMap(np.ones((5, 7, 9), np.uint8), OBLIQUE, {1: "all"})
    for closed, solid in ((True, False), (True, True), (False, False)):
        assert 1 in extract_labels(volume, label_map, 30, device=device, label=numbers, closed=closed, solid=solid)
    # Nothing leads to its dense voxels from outside: solid, all of it is inside.
    with refused(NoSurfaceError, "CT", 1, 30):
        extract_labels(volume, label_map, 30, device=device, label=numbers, closed=False, solid=True)
    full = Volume(np.full((5, 7, 9), 50, np.int16), OBLIQUE)
    with refused(NoSurfaceError, "CT", 1, 30):
        extract_labels(full, label_map, 30, device=device, label=numbers, closed=False)
    with refused(NoSurfaceError, 500):
        extract_labels(volume, label_map, 500, device=device, label=numbers, closed=False, solid=True)


def test_a_label_outside_the_volume_is_refused_when_asked_for(device):
    volume, labels = random_volume((5, 7, 9)), np.zeros((10, 7, 9), np.uint8)
    labels[:5], labels[8:] = 2, 4
    label_map = LabelMap(labels, OBLIQUE)
    assert tuple(extract_labels(volume, label_map, 3, device=device)) == (2,)
    with refused(NoSurfaceError, "label_4", "CT", 4):
        extract_labels(volume, label_map, 3, device=device, label=[4])


@pytest.mark.oclgrind
def test_every_pass_over_small_labels_equals_the_twin(device):
    volume, labels = random_volume((4, 4, 33)), random_labels((4, 4, 33))
    inside = twin.find_solid(volume, labels, 3, grow_mm=1.2)
    for number, mesh in extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, grow_mm=1.2).items():
        assert np.array_equal(mesh.triangles, twin.extract_label(volume, inside, number, 3)[2])


@pytest.mark.oclgrind
def test_label_without_growth_between_other_slices_equals_the_twin(device):
    """The slices that are held reach as far as those that are read."""
    volume, labels = random_volume((12, 4, 33)), np.zeros((12, 4, 33), np.uint16)
    labels[4:6] = 3
    inside = twin.find_solid(volume, labels, 3, grow_mm=0)
    mesh = extract_labels(volume, LabelMap(labels, OBLIQUE), 3, device=device, grow_mm=0)[3]
    assert np.array_equal(mesh.triangles, twin.extract_label(volume, inside, 3, 3)[2])


@pytest.mark.release
def test_a_real_vertebra_is_sound(device, real_data):
    from clrecon.labels import read_labels
    from clrecon.reading import read_volume

    folder = real_data / "thoracolumbar_labels"
    volume, labels = read_volume(folder / "ct_2mm_jpeg2000"), read_labels(folder / "ct_2mm_labels.nii.gz")
    hollow, full = (
        extract_labels(volume, labels, 200, device=device, label=["T12", "T11"], solid=solid) for solid in (False, True)
    )
    for mesh in (*hollow.values(), *full.values()):
        assert mesh.quality()["closed"] and mesh.quality()["manifold"]
    mask_ml = np.count_nonzero(resample_labels(labels, volume).voxels == 32) * np.prod(volume.spacing) / 1000
    assert full[32].quality()["volume_ml"] == pytest.approx(mask_ml, rel=tolerances.REAL_SOLID_VOLUME)
    assert hollow[32].quality()["volume_ml"] < 0.7 * mask_ml
    shared = {row.tobytes() for row in full[32].vertices} & {row.tobytes() for row in full[33].vertices}
    assert len(shared) > 100
    assert full[32].report["vertices_by_hu_share"] > 0.6


@pytest.mark.parametrize(("missing", "slices"), [(0, (0, 40)), (1, (16, 26))])
def test_a_volume_that_is_held_is_used_whole_where_a_mesh_of_half_the_bytes_fits(device, missing, slices):
    """Voxels of two bytes, labels and the samples inside of one each, and half of that: six bytes a voxel."""
    volume = random_volume((40, 5, 8), affine=np.eye(4))
    labels = np.zeros(volume.voxels.shape, np.uint8)
    labels[20:22, 1:4, 2:6] = 1
    with DeviceVolume(volume, device=device, memory=6 * volume.voxels.size - missing) as resident:
        resident.whole(Stopwatch())
        rule, growth = choose_iso_rule(volume, 3), Growth.of(volume, 1.0)
        taken = resample_labels(LabelMap(labels, np.eye(4)), volume)
        run = operator.LabelExtraction(resident, taken, rule, growth, False, [])
        assert run.slices_for({1: (slice(20, 22), slice(1, 4), slice(2, 6))}) == slices
        assert sum(run.needs(0, 40).values()) == 4 * volume.voxels.size
