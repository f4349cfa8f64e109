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


def sphere_volume(radius, size, *, low=-1000, high=1000, hollow=None, core=0):
    """Partial volume of a sphere, of a shell where `hollow` is its inner radius; and the share of each voxel inside."""
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


def blocky(share, times):
    """The mask that a grid `times` as coarse gives."""
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
    "blocky": lambda share: blocky(share, 2),
}


def surface_error(vertices, radius):
    return np.linalg.norm(vertices - CENTER, axis=1) - radius


def quality(surface):
    vertices, normals, triangles = surface
    return Mesh(vertices.astype(np.float32), triangles, normals.astype(np.float32)).quality()


@pytest.mark.parametrize("mask", MASKS)
def test_hu_place_the_surface_whatever_the_mask_is_like(mask):
    radius = 6.4
    volume, share = sphere_volume(radius, 19)
    labels = MASKS[mask](share).astype(np.uint16)
    surface = extract_label(volume, find_solid(volume, labels, 0), 1, 0)
    error = surface_error(surface[0], radius)
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL
    assert np.abs(error).max() <= tolerances.SPHERE_PARTIAL_VOLUME_MAX_VOXEL
    plain = extract_isosurface(volume, 0)
    assert np.array_equal(surface[0], plain[0]) and np.array_equal(surface[1], plain[1])
    assert np.array_equal(surface[2], plain[2])


def test_without_growth_a_small_mask_would_be_the_surface():
    """Known bad: what the growth is for."""
    volume, share = sphere_volume(6.4, 19)
    labels = MASKS["blocky"](share).astype(np.uint16)
    error = surface_error(extract_label(volume, find_solid(volume, labels, 0, grow_mm=0), 1, 0)[0], 6.4)
    assert np.sqrt(np.mean(error**2)) > 4 * tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL


@pytest.mark.parametrize("affine", [OBLIQUE, np.diag((0.7, 0.7, 3.0, 1.0))], ids=["oblique", "thick"])
@pytest.mark.parametrize("grow_mm", [0.0, 0.6, 1.2, 3.1])
def test_growth_takes_the_nearest_label_in_mm(affine, grow_mm):
    """Against distances to every labelled sample, one by one."""
    random = np.random.default_rng(1)
    labels = random.choice([0, 0, 0, 0, 0, 0, 3, 4], (5, 7, 9)).astype(np.uint16)
    volume = Volume(np.zeros(labels.shape, np.int16), affine)
    grown = own_labels(labels, volume, grow_mm)
    k, j, i = np.nonzero(labels)
    points = volume.ijk_to_lps(np.stack([i, j, k], axis=1))
    for at in np.ndindex(labels.shape):
        away = np.linalg.norm(points - volume.ijk_to_lps([at[::-1]])[0], axis=1)
        near = away <= min(away.min(), grow_mm) + 1e-6
        assert grown[at] == (labels[at] or labels[k, j, i][near].min(initial=9) % 9)


def test_growth_in_a_cube_is_that_of_scipy():
    labels = np.zeros((9, 9, 9), np.uint16)
    labels[4, 4, 4] = 7
    grown = own_labels(labels, Volume(np.zeros(labels.shape, np.int16), np.eye(4)), 2.5)
    assert np.array_equal(grown == 7, distance_transform_edt(labels == 0) <= 2.5)


def test_the_default_growth_is_one_voxel_each_way_nearest_in_mm_first():
    volume = Volume(np.zeros((2, 2, 2), np.int16), np.diag((0.8, 0.8, 4.0, 1.0)))
    growth = Growth.of(volume, None)
    assert len(growth.offsets) == 26 and growth.reach == (1, 1, 1)
    lengths = np.linalg.norm(growth.offsets * (0.8, 0.8, 4.0), axis=1)
    assert (np.diff(lengths) >= -1e-9).all()
    assert growth.shells.tolist() == [0] * 4 + [1] * 4 + [2] * 2 + [3] * 8 + [4] * 8


@pytest.mark.parametrize("grow", [-1, float("nan"), float("inf"), 50, 1e200, "much"])
def test_impossible_growth_is_refused(grow):
    with refused(UsageError, "labels", "grow"):
        Growth.of(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), grow)


def two_labels():
    """A dense block of noise, two labels that touch in it, air around, and a part without a label."""
    random = np.random.default_rng(5)
    hu = np.full((9, 12, 14), -1000, np.int16)
    hu[2:7, 2:10, 2:12] = random.integers(100, 900, (5, 8, 10))
    labels = np.zeros(hu.shape, np.uint16)
    labels[1:8, 1:11, 1:6], labels[1:8, 1:11, 6:10] = 4, 9
    labels[3, 4:7, 4:8] = 4  # a border that is not flat
    return Volume(hu, OBLIQUE), labels


@pytest.mark.parametrize("solid", [(), (4, 9)], ids=["plain", "solid"])
def test_labels_are_closed_and_share_their_border(solid):
    volume, labels = two_labels()
    inside = find_solid(volume, labels, 300, solid=solid)
    surfaces = {number: extract_label(volume, inside, number, 300) for number in (4, 9)}
    for surface in surfaces.values():
        assert quality(surface)["closed"] and quality(surface)["manifold"]
    shared = {tuple(p) for p in surfaces[4][0].tolist()} & {tuple(p) for p in surfaces[9][0].tolist()}
    borders = sum(
        int(((a == 4) & (b == 9) | (a == 9) & (b == 4)).sum())
        for a, b in ((inside[1:], inside[:-1]), (inside[:, 1:], inside[:, :-1]), (inside[..., 1:], inside[..., :-1]))
    )
    assert len(shared) == borders > 20


def test_vertices_on_a_border_of_labels_lie_half_way():
    volume, labels = two_labels()
    hu = volume.voxels.copy()
    hu[hu > 0] = 500
    inside = find_solid(Volume(hu, np.eye(4)), labels, 300)
    vertices, normals, _ = extract_label(Volume(hu, np.eye(4)), inside, 9, 300)
    far = np.abs(vertices[:, 0] - 9.5 - 1) < 1e-9  # beyond label 9 and its growth there is dense bone of no label
    assert far.sum() == 5 * 8
    assert np.allclose(normals[far][:, 0].max(), 1.0)


def test_a_solid_shell_is_full():
    radius = 9.4
    volume, share = sphere_volume(radius, 25, low=-50, high=600, hollow=radius - 2.5, core=0)
    labels = (share >= 0.5).astype(np.uint16)
    surface = extract_label(volume, find_solid(volume, labels, 275, solid=(1,)), 1, 275)
    exact = 4 / 3 * np.pi * radius**3 / 1000
    hollow = extract_label(volume, find_solid(volume, labels, 275), 1, 275)
    assert quality(surface)["components"] == 1 and quality(hollow)["components"] == 2
    assert quality(surface)["volume_ml"] == pytest.approx(exact, rel=tolerances.LABEL_SPHERE_VOLUME)
    error = surface_error(surface[0], radius)
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL


@pytest.mark.parametrize("mask", ["half", "all that it touches", "eroded", "blocky", "a voxel too large"])
def test_hu_place_the_surface_of_a_solid_label_whatever_the_mask_is_like(mask):
    radius = 9.4
    volume, share = sphere_volume(radius, 25, low=-50, high=600, hollow=radius - 2.5, core=0)
    grown = binary_dilation(share >= 0.5, np.ones((3, 3, 3)))
    labels = (grown if mask == "a voxel too large" else MASKS[mask](share)).astype(np.uint16)
    surface = extract_label(volume, find_solid(volume, labels, 275, solid=(1,)), 1, 275)
    error = surface_error(surface[0], radius)
    assert np.sqrt(np.mean(error**2)) <= tolerances.SPHERE_PARTIAL_VOLUME_RMS_VOXEL


@pytest.mark.parametrize(("across", "lost"), [(1, 0.0), (2, 0.0), (9, 0.05)])
def test_pores_of_the_shell_do_not_let_the_outside_in(across, lost):
    """Narrow holes are closed over by the mask; a wide one dents it, but the marrow stays full."""
    radius = 9.4
    volume, share = sphere_volume(radius, 25, low=-50, high=600, hollow=radius - 2.5, core=0)
    hu = volume.voxels.copy()
    hole = slice(12 - across // 2, 12 - across // 2 + across)
    hu[hole, hole, 16:] = 0  # a channel from the outside to the marrow
    holed = Volume(hu, volume.affine)
    labels = (share >= 0.5).astype(np.uint16)
    solid, whole = (find_solid(v, labels, 275, solid=(1,)) for v in (holed, volume))
    missing = np.count_nonzero(whole) - np.count_nonzero(solid)
    assert 0.3 * lost <= missing / np.count_nonzero(whole) <= lost
    assert np.count_nonzero(find_solid(holed, labels, 275)) < 0.65 * np.count_nonzero(whole)
    assert quality(extract_label(holed, solid, 1, 275))["components"] == 1


def test_a_hole_in_the_mask_is_filled_and_another_label_in_it_is_not():
    volume, share = sphere_volume(9.4, 25, low=-50, high=600, hollow=6.9, core=0)
    labels = (share >= 0.5).astype(np.uint16)
    labels[10:15, 10:15, 10:15] = 0
    labels[12, 12, 12] = 2
    inside = find_solid(volume, labels, 275, solid=(1,))
    assert (inside[10:15, 10:15, 10:15] == 1).sum() == 124 and inside[12, 12, 12] == 0


@pytest.mark.parametrize("closed", [True, False])
def test_a_solid_label_that_leaves_the_volume_is_solid_up_to_its_end(closed):
    volume, share = sphere_volume(9.4, 25, low=-50, high=600, hollow=6.9, core=0)
    half = Volume(volume.voxels[:13], volume.affine)
    labels = (share[:13] >= 0.5).astype(np.uint16)
    inside = find_solid(half, labels, 275, closed=closed, solid=(1,))
    assert inside[12, 12, 12] == 1
    assert np.count_nonzero(inside) >= 0.99 * np.count_nonzero(labels)


@pytest.mark.parametrize(("closed", "filled"), [(True, 0), (False, 125)])
def test_a_hole_at_the_end_of_the_volume_is_open_where_outside_is_beyond(closed, filled):
    volume, share = sphere_volume(9.4, 25, low=-50, high=600, hollow=6.9, core=0)
    labels = (share[:13] >= 0.5).astype(np.uint16)
    labels[8:13, 10:15, 10:15] = 0
    inside = find_solid(Volume(volume.voxels[:13], volume.affine), labels, 275, closed=closed, solid=(1,))
    assert np.count_nonzero(inside[8:13, 10:15, 10:15]) == filled


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.5, 1.0, 2.0)])
def test_growth_reaches_five_thousand_voxels(spacing):
    volume = Volume(np.zeros((2, 2, 2), np.int16), np.diag((*spacing, 1.0)))
    most = (5000.0 * 3.0 / (4.0 * np.pi)) ** (1.0 / 3.0)  # radius in mm of a ball of 5000 mm3
    assert _checked(0.999 * most, volume) == 0.999 * most
    with refused(UsageError, 10.6185, "labels"):
        _checked(1.001 * most, volume)


@pytest.mark.parametrize("turned", [False, True])
def test_neighbours_at_one_distance_form_one_shell_whatever_the_rounding(turned):
    affine = np.diag((0.1, 0.1, 0.1, 1.0))
    if turned:
        affine[:3, :3] = rotation((10.0, 20.0, 30.0)) * 0.1
    growth = Growth.of(Volume(np.zeros((2, 2, 2), np.int16), affine), None)
    assert growth.shells.tolist() == [0] * 6 + [1] * 12 + [2] * 8
    assert (growth.offsets**2).sum(axis=1).tolist() == [1] * 6 + [2] * 12 + [3] * 8
    for shell in range(3):  # within a shell in the order of k, j, i
        places = growth.offsets[growth.shells == shell][:, ::-1].tolist()
        assert places == sorted(places)
    assert growth.reach == (1, 1, 1)
