"""What is inside of a label, as the twin says it: growth, the accuracy of the surface, borders, solid labels."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from label_files import OBLIQUE
from refusals import refused
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from clrecon.errors import UsageError
from clrecon.geometry import Volume, compose_affine
from clrecon.labels.label_levels import Growth, _checked
from clrecon.mesh import Mesh
from clrecon.proof.surface.extract import extract_isosurface
from clrecon.proof.surface.labels import extract_label, find_solid, own_labels

CENTER = np.array((0.31, -0.17, 0.23))


def sphere_volume(radius, *, size, low=-1000, high=1000, hollow=None, core=0):
    """Partial volume of a sphere from `low` to `high` HU in `size` voxels a side, of a shell where `hollow` is its
    inner radius; and the share of each voxel inside."""
    fine = 6
    axis = (np.arange(size * fine) + 0.5) / fine - 0.5 - (size - 1) / 2
    z, y, x = np.meshgrid(*(axis - c for c in CENTER[::-1]), indexing="ij")
    squared = x * x + y * y + z * z

    def share(r):
        return (squared < r * r).reshape(size, fine, size, fine, size, fine).mean(axis=(1, 3, 5))

    hu = low + (high - low) * share(radius)
    if hollow is not None:
        hu += (core - high) * share(hollow)
    affine = compose_affine((1, 0, 0), (0, 1, 0), (0, 0, 1), np.full(3, -(size - 1) / 2))
    return Volume(np.rint(hu).astype(np.int16), affine), share(radius)


def as_blocks(share, times):
    """The mask of a grid `times` as coarse: blocks of which at least half is inside."""
    size = share.shape[0] // times * times
    coarse = share[:size, :size, :size].reshape([size // times, times] * 3).mean(axis=(1, 3, 5)) >= 0.5
    mask = np.zeros(share.shape, bool)
    mask[:size, :size, :size] = coarse.repeat(times, 0).repeat(times, 1).repeat(times, 2)
    return mask


MASKS = {
    "half": lambda share: share >= 0.5,
    "all that it touches": lambda share: share > 0,
    "eroded": lambda share: binary_erosion(share >= 0.5),
    "dilated": lambda share: binary_dilation(share >= 0.5, iterations=2),
    "blocky": lambda share: as_blocks(share, 2),
}


def surface_error(vertices, radius):
    """How far each vertex lies outside of the sphere, in voxels."""
    return np.linalg.norm(vertices - CENTER, axis=1) - radius


def measure_quality(surface):
    vertices, normals, triangles = surface
    return Mesh(vertices.astype(np.float32), triangles, normals.astype(np.float32)).quality()


HALF_WAY = 0
"""The level between the -1000 and 1000 HU of `sphere_volume`."""


def extract_label_1(volume, labels, level, **options):
    """Vertices, normals and triangles of label 1, grown and solid as the options of `find_solid` say."""
    return extract_label(volume, find_solid(volume, labels.astype(np.uint16), level, **options), 1, level)


@pytest.mark.parametrize("mask", MASKS)
def test_surface_of_a_grown_label_lies_on_the_sphere_of_the_hu_whatever_its_mask(mask):
    radius = 6.4
    volume, share = sphere_volume(radius, size=19)
    vertices, _, _ = extract_label_1(volume, MASKS[mask](share), HALF_WAY)
    error = surface_error(vertices, radius)
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL
    assert np.abs(error).max() <= tolerances.SPHERE_PARTIAL_VOLUME_MAX_VOXEL


@pytest.mark.parametrize("mask", MASKS)
def test_surface_of_a_grown_label_is_the_isosurface_of_the_volume_whatever_its_mask(mask):
    volume, share = sphere_volume(radius=6.4, size=19)
    label_surface = extract_label_1(volume, MASKS[mask](share), HALF_WAY)
    for of_label, of_volume in zip(label_surface, extract_isosurface(volume, HALF_WAY), strict=True):
        assert np.array_equal(of_label, of_volume)


def test_surface_without_growth_lies_off_the_sphere_where_the_mask_is_too_small():
    """Known bad: what the growth is for."""
    radius = 6.4
    volume, share = sphere_volume(radius, size=19)
    vertices, _, _ = extract_label_1(volume, MASKS["blocky"](share), HALF_WAY, grow_mm=0)
    error = surface_error(vertices, radius)
    # far more than a grown one may: measured 0.41 voxels, of blocks of 2
    assert np.sqrt(np.mean(error**2)) > 4 * tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL


@pytest.mark.parametrize("affine", [OBLIQUE, np.diag((0.7, 0.7, 3.0, 1.0))], ids=["oblique", "thick"])
@pytest.mark.parametrize("grow_mm", [0.0, 0.6, 1.2, 3.1])
def test_grown_samples_get_the_nearest_label_in_mm_and_the_lowest_of_equally_near_ones(affine, grow_mm):
    """Against distances to every labelled sample, one by one."""
    random = np.random.default_rng(1)
    labels = random.choice([0, 0, 0, 0, 0, 0, 3, 4], (5, 7, 9)).astype(np.uint16)
    volume = Volume(np.zeros(labels.shape, np.int16), affine)

    grown = own_labels(labels, volume, grow_mm)

    k, j, i = np.nonzero(labels)
    labelled_points, numbers = volume.ijk_to_lps(np.stack([i, j, k], axis=1)), labels[k, j, i]
    for at in np.ndindex(labels.shape):
        point = volume.ijk_to_lps([at[::-1]])[0]  # of k, j, i
        distances = np.linalg.norm(labelled_points - point, axis=1)
        equally_near = distances <= distances.min() + tolerances.EQUAL_DISTANCE_MM
        nearest = numbers[equally_near].min() if distances.min() <= grow_mm else 0
        assert grown[at] == (labels[at] or nearest)


def test_voxel_grows_to_the_ball_of_scipys_distances():
    labels = np.zeros((9, 9, 9), np.uint16)
    labels[4, 4, 4] = 7
    grow_mm = 2.5  # of voxels of 1 mm
    grown = own_labels(labels, Volume(np.zeros(labels.shape, np.int16), np.eye(4)), grow_mm)
    assert np.array_equal(grown == 7, distance_transform_edt(labels == 0) <= grow_mm)


def test_default_growth_reaches_the_26_neighbours_nearest_in_mm_first():
    spacing = (0.8, 0.8, 4.0)
    growth = Growth.of(Volume(np.zeros((2, 2, 2), np.int16), np.diag((*spacing, 1.0))), None)
    assert growth.reach == (1, 1, 1)
    assert len(growth.offsets) == 26
    # 4 neighbours at 0.8 mm, 4 at 1.13, 2 at 4, 8 at 4.08 and 8 at 4.16 mm
    assert growth.shells.tolist() == [0] * 4 + [1] * 4 + [2] * 2 + [3] * 8 + [4] * 8
    lengths = np.linalg.norm(growth.offsets * spacing, axis=1)
    assert (np.diff(lengths) >= -tolerances.EQUAL_DISTANCE_MM).all()


@pytest.mark.parametrize("grow", [-1, float("nan"), float("inf"), 50, 1e200, "much"])
def test_growth_that_is_no_number_of_mm_from_0_to_a_few_is_refused(grow):
    with refused(UsageError, "labels", "grow"):
        Growth.of(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), grow)


def block_of_labels_4_and_9():
    """A dense block of noise, two labels that touch in it, air around, and a part without a label."""
    random = np.random.default_rng(5)
    hu = np.full((9, 12, 14), -1000, np.int16)
    hu[2:7, 2:10, 2:12] = random.integers(100, 900, (5, 8, 10))
    labels = np.zeros(hu.shape, np.uint16)
    labels[1:8, 1:11, 1:6], labels[1:8, 1:11, 6:10] = 4, 9
    labels[3, 4:7, 4:8] = 4  # a border that is not flat
    return Volume(hu, OBLIQUE), labels


def count_faces_between_4_and_9(inside):
    return sum(
        np.count_nonzero((np.minimum(one, other) == 4) & (np.maximum(one, other) == 9))
        for one, other in (
            (inside[1:], inside[:-1]),
            (inside[:, 1:], inside[:, :-1]),
            (inside[..., 1:], inside[..., :-1]),
        )
    )


@pytest.mark.parametrize("solid", [(), (4, 9)], ids=["plain", "solid"])
def test_surfaces_of_touching_labels_are_closed_and_manifold(solid):
    volume, labels = block_of_labels_4_and_9()
    inside = find_solid(volume, labels, iso_value=300, solid=solid)
    for number in (4, 9):
        quality = measure_quality(extract_label(volume, inside, number, iso_value=300))
        assert quality["closed"]
        assert quality["manifold"]


@pytest.mark.parametrize("solid", [(), (4, 9)], ids=["plain", "solid"])
def test_surfaces_of_touching_labels_share_a_vertex_for_each_face_between_their_samples(solid):
    volume, labels = block_of_labels_4_and_9()
    inside = find_solid(volume, labels, iso_value=300, solid=solid)
    (of_4, *_), (of_9, *_) = (extract_label(volume, inside, number, iso_value=300) for number in (4, 9))
    of_4, of_9 = ({tuple(vertex) for vertex in vertices.tolist()} for vertices in (of_4, of_9))
    assert len(of_4 & of_9) == count_faces_between_4_and_9(inside)
    assert count_faces_between_4_and_9(inside) > 20  # the labels touch over some 5 x 8 samples


def test_surface_towards_dense_bone_of_no_label_lies_half_way_between_the_samples():
    volume, labels = block_of_labels_4_and_9()
    hu = np.where(volume.voxels > 0, 500, volume.voxels).astype(np.int16)
    even_bone = Volume(hu, np.eye(4))

    inside = find_solid(even_bone, labels, iso_value=300)
    vertices, normals, _ = extract_label(even_bone, inside, number=9, iso_value=300)

    last_sample = 9 + 1  # of label 9 along x, and its growth; the bone goes on to sample 11
    half_way = np.abs(vertices[:, 0] - (last_sample + 0.5)) < tolerances.EQUAL_DISTANCE_MM
    assert half_way.sum() == 5 * 8  # all samples of that side of the block
    assert np.allclose(normals[half_way][:, 0].max(), 1.0)


SHELL_RADIUS = 9.4
SHELL_LEVEL = 275
"""Half way from the outside, -50 HU, to the wall of 600 HU."""


def shell_volume():
    """A shell of bone around marrow of 0 HU, its wall 2.5 voxels thick; and the share of each voxel inside of it."""
    return sphere_volume(SHELL_RADIUS, size=25, low=-50, high=600, hollow=SHELL_RADIUS - 2.5, core=0)


MIDDLE = (12, 12, 12)
"""Of the 25 x 25 x 25 voxels, in the marrow."""


def test_surface_of_a_solid_label_is_the_outer_one_of_a_shell():
    volume, share = shell_volume()
    vertices, _, _ = surface = extract_label_1(volume, share >= 0.5, SHELL_LEVEL, solid=(1,))
    quality = measure_quality(surface)
    assert quality["components"] == 1
    ball_ml = 4 / 3 * np.pi * SHELL_RADIUS**3 / 1000
    assert quality["volume_ml"] == pytest.approx(ball_ml, rel=tolerances.LABEL_SPHERE_VOLUME)
    error = surface_error(vertices, SHELL_RADIUS)
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL


def test_surface_of_a_label_that_is_not_solid_has_the_inner_side_of_a_shell_too():
    volume, share = shell_volume()
    outer_and_inner = 2
    assert measure_quality(extract_label_1(volume, share >= 0.5, SHELL_LEVEL))["components"] == outer_and_inner


@pytest.mark.parametrize("mask", ["half", "all that it touches", "eroded", "blocky", "a voxel too large"])
def test_surface_of_a_solid_label_lies_on_the_shell_of_the_hu_whatever_its_mask(mask):
    volume, share = shell_volume()
    a_voxel_too_large = binary_dilation(share >= 0.5, np.ones((3, 3, 3)))
    labels = a_voxel_too_large if mask == "a voxel too large" else MASKS[mask](share)
    vertices, _, _ = extract_label_1(volume, labels, SHELL_LEVEL, solid=(1,))
    error = surface_error(vertices, SHELL_RADIUS)
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL


def shell_with_a_pore(across):
    """The shell with a channel `across` voxels wide from the outside to its marrow, along x."""
    volume, share = shell_volume()
    hu = volume.voxels.copy()
    pore = slice(MIDDLE[0] - across // 2, MIDDLE[0] - across // 2 + across)
    hu[pore, pore, 16:] = 0
    return Volume(hu, volume.affine), (share >= 0.5).astype(np.uint16)


@pytest.mark.parametrize("across", [1, 2])
def test_solid_label_of_a_shell_with_a_narrow_pore_is_that_of_the_whole_shell(across):
    """The mask closes a hole of one or two voxels."""
    whole, _ = shell_volume()
    holed, labels = shell_with_a_pore(across)
    solid = find_solid(holed, labels, SHELL_LEVEL, solid=(1,))
    assert np.array_equal(solid > 0, find_solid(whole, labels, SHELL_LEVEL, solid=(1,)) > 0)


def test_solid_label_of_a_shell_with_a_wide_pore_is_dented_but_keeps_its_marrow():
    whole, _ = shell_volume()
    holed, labels = shell_with_a_pore(across=9)
    of_whole = np.count_nonzero(find_solid(whole, labels, SHELL_LEVEL, solid=(1,)))
    of_holed = np.count_nonzero(find_solid(holed, labels, SHELL_LEVEL, solid=(1,)))
    assert 0.95 * of_whole <= of_holed <= 0.985 * of_whole  # measured 0.961
    not_solid = np.count_nonzero(find_solid(holed, labels, SHELL_LEVEL))
    assert not_solid < 0.65 * of_whole  # the marrow is 40 % of the ball


@pytest.mark.parametrize("across", [1, 2, 9])
def test_solid_label_of_a_shell_with_a_pore_has_one_surface(across):
    holed, labels = shell_with_a_pore(across)
    assert measure_quality(extract_label_1(holed, labels, SHELL_LEVEL, solid=(1,)))["components"] == 1


def test_hole_in_the_mask_of_a_solid_label_is_filled_around_another_label_in_it():
    volume, share = shell_volume()
    labels = (share >= 0.5).astype(np.uint16)
    labels[10:15, 10:15, 10:15] = 0
    labels[MIDDLE] = 2  # not solid, and its marrow is below the level
    inside = find_solid(volume, labels, SHELL_LEVEL, solid=(1,))
    assert (inside[10:15, 10:15, 10:15] == 1).sum() == 5**3 - 1
    assert inside[MIDDLE] == 0  # of neither label


@pytest.mark.parametrize("closed", [True, False])
def test_solid_label_that_leaves_the_volume_is_solid_up_to_its_end(closed):
    volume, share = shell_volume()
    lower_half = Volume(volume.voxels[:13], volume.affine)
    labels = (share[:13] >= 0.5).astype(np.uint16)
    inside = find_solid(lower_half, labels, SHELL_LEVEL, closed=closed, solid=(1,))
    assert inside[MIDDLE] == 1  # in the last slice
    assert np.count_nonzero(inside) == np.count_nonzero(labels)


@pytest.mark.parametrize(("closed", "filled"), [(True, 0), (False, 5**3)], ids=["closed", "open"])
def test_hole_at_the_end_of_the_volume_is_filled_unless_surfaces_are_closed_there(closed, filled):
    volume, share = shell_volume()
    lower_half = Volume(volume.voxels[:13], volume.affine)
    labels = (share[:13] >= 0.5).astype(np.uint16)
    labels[8:13, 10:15, 10:15] = 0  # up to the last slice
    inside = find_solid(lower_half, labels, SHELL_LEVEL, closed=closed, solid=(1,))
    assert np.count_nonzero(inside[8:13, 10:15, 10:15]) == filled


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.5, 1.0, 2.0)], ids=["cubes", "anisotropic"])
def test_growth_over_5000_voxels_is_accepted_and_over_more_refused(spacing):
    volume_of_mm3_voxels = Volume(np.zeros((2, 2, 2), np.int16), np.diag((*spacing, 1.0)))
    most_mm = (5000.0 * 3.0 / (4.0 * np.pi)) ** (1.0 / 3.0)  # radius of a ball of 5000 mm3
    assert _checked(0.999 * most_mm, volume_of_mm3_voxels) == 0.999 * most_mm
    with refused(UsageError, round(1.001 * most_mm, 4), "labels"):
        _checked(1.001 * most_mm, volume_of_mm3_voxels)


@pytest.mark.parametrize("turned", [False, True])
def test_neighbours_at_one_distance_form_one_shell_in_the_order_of_their_voxels(turned):
    affine = np.diag((0.1, 0.1, 0.1, 1.0))
    if turned:  # distances of neighbours differ by their rounding
        affine[:3, :3] = rotation((10.0, 20.0, 30.0)) * 0.1

    growth = Growth.of(Volume(np.zeros((2, 2, 2), np.int16), affine), None)

    faces_edges_corners = (6, 12, 8)  # neighbours at a distance of 1, sqrt(2) and sqrt(3) voxels
    assert growth.shells.tolist() == np.repeat([0, 1, 2], faces_edges_corners).tolist()
    assert (growth.offsets**2).sum(axis=1).tolist() == np.repeat([1, 2, 3], faces_edges_corners).tolist()
    for shell in range(3):
        offsets_kji = growth.offsets[growth.shells == shell][:, ::-1].tolist()
        assert offsets_kji == sorted(offsets_kji)
