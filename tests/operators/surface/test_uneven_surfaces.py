"""Surfaces of volumes whose slices are unevenly spaced: by analysis, and against the numpy twins."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from slab_surfaces import assert_same, extract_in_slabs
from variants import daily

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels import LabelMap
from clrecon.mesh.compare.iso_distance import distances_to_iso_surface
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.labels import extract_labels
from clrecon.proof.surface.extract import extract_isosurface as extract_twin

GAPS = (1.0,) * 9 + (0.4,) * 3 + (1.9,) * 8 + (1.0,) * 4
TURN = rotation((15.0, -25.0, 40.0))
IN_PLANE = TURN[:, :2] * (0.7, 0.5)


def make_volume(field, shape=(40, 50), gaps=GAPS, sideways=0.3, dtype=np.float32, noise=0.1) -> Volume:
    """`field` of points (n, 3) in mm around the centre of a stack that is sheared more where its gaps are larger."""
    heights = np.concatenate([[0.0], np.cumsum(gaps)])
    rng = np.random.default_rng(2)
    table = (
        heights[:, None] * TURN[:, 2]
        + (sideways * heights + rng.uniform(-noise, noise, len(heights)))[:, None] * TURN[:, 1]
    )
    table = table + np.array([40.0, -90.0, -600.0])
    affine = np.eye(4)
    affine[:3, :2], affine[:3, 2], affine[:3, 3] = IN_PLANE, (table[-1] - table[0]) / (len(table) - 1), table[0]
    nj, ni = shape
    volume = Volume(np.zeros((len(table), nj, ni), dtype), affine, slice_positions=table)
    k, j, i = np.mgrid[: len(table), :nj, :ni].reshape(3, -1)
    points = volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - centre_of(volume)
    return volume.with_voxels(field(points).reshape(len(table), nj, ni).astype(dtype))


def centre_of(volume: Volume) -> np.ndarray:
    return volume.ijk_to_lps([(np.array(volume.shape_ijk) - 1) / 2])[0]


RADIUS = 10.0


@pytest.fixture(scope="module")
def sphere_in_uneven_slices():
    """The distance field of a sphere of 10 mm."""
    return make_volume(lambda p: RADIUS - np.linalg.norm(p, axis=1), shape=(66, 50))


def off_sphere(mesh, volume) -> np.ndarray:
    return np.abs(np.linalg.norm(mesh.vertices - centre_of(volume), axis=1) - RADIUS)


def test_surface_of_a_sphere_in_uneven_slices_lies_on_it(device, sphere_in_uneven_slices):
    mesh = extract_isosurface(sphere_in_uneven_slices, 0.0, device=device)
    off = off_sphere(mesh, sphere_in_uneven_slices)
    assert off.max() <= tolerances.SPHERE_DISTANCE_FIELD_VOXEL * max(GAPS)


def test_surface_of_a_sphere_in_uneven_slices_is_closed_with_its_volume(device, sphere_in_uneven_slices):
    """Chords and facets lie inside a sphere."""
    quality = extract_isosurface(sphere_in_uneven_slices, 0.0, device=device).quality()
    assert (quality["closed"], quality["manifold"], quality["genus"]) == (True, True, 0)
    exact_ml = 4 / 3 * np.pi * RADIUS**3 / 1000
    assert 0.985 * exact_ml < quality["volume_ml"] < exact_ml  # measured 0.994 of it


def test_surface_of_the_same_slices_at_even_places_is_no_sphere(device, sphere_in_uneven_slices):
    """The tests above can fail."""
    nominal = Volume(sphere_in_uneven_slices.voxels, sphere_in_uneven_slices.affine)
    assert off_sphere(extract_isosurface(nominal, 0.0, device=device), nominal).max() > 0.5  # mm; measured 4.6


@pytest.mark.oclgrind
def test_trilinear_surface_of_a_few_uneven_slices_equals_the_twin(device):
    rng = np.random.default_rng(13)
    volume = make_volume(lambda p: rng.integers(-500, 500, len(p)), shape=(4, 9), gaps=GAPS[7:11], dtype=np.int16)
    mesh = extract_isosurface(volume, 25, device=device, topology="trilinear")
    vertices, _, triangles = extract_twin(volume, 25, topology="trilinear")
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.TWIN_VERTEX_VOXEL * min(volume.spacing)


@pytest.mark.parametrize("topology", ["separated", "trilinear"])
def test_surface_of_a_linear_field_in_uneven_slices_is_a_plane_with_its_normal(device, topology):
    slope = TURN @ np.array([0.35, -0.2, 0.9])
    slope /= np.linalg.norm(slope)
    volume = make_volume(lambda p: -(p @ slope))
    mesh = extract_isosurface(volume, 0.0, device=device, closed=False, topology=topology)
    assert np.abs((mesh.vertices - centre_of(volume)) @ slope).max() <= tolerances.LINEAR_FIELD_MM
    assert np.abs(mesh.normals - slope).max() <= tolerances.LINEAR_FIELD_NORMAL


@pytest.mark.every_device
@pytest.mark.parametrize("topology", ["separated", "trilinear"])
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_surfaces_of_uneven_slices_equal_the_twin(device, topology, closed, dtype):
    rng = np.random.default_rng(11)
    volume = make_volume(lambda p: rng.integers(-500, 500, len(p)), shape=(9, 11), gaps=GAPS[5:15], dtype=dtype)
    mesh = extract_isosurface(volume, 25, device=device, closed=closed, topology=topology)
    vertices, normals, triangles = extract_twin(volume, 25, closed=closed, topology=topology)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.TWIN_VERTEX_VOXEL * min(volume.spacing)
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_CELL_NORMAL


THIN = (*GAPS[:10], 0.002, *GAPS[10:18])
"""With two slices that are hardly apart: rounding takes a good share of that layer, and only of that one."""


@pytest.mark.parametrize("share", [0.01, 0.99], ids=["at its lower end", "at its upper end"])
def test_a_thin_layer_does_not_move_a_plane_in_another_layer(device, share):
    slope = TURN[:, 2]
    volume = make_volume(lambda p: -(p @ slope), gaps=THIN, noise=0.0)
    lower, upper = volume.slice_origins()[5:7]
    height = (lower * (1 - share) + upper * share) @ slope
    mesh = extract_isosurface(volume, float(centre_of(volume) @ slope - height), device=device, closed=False)
    assert np.abs(mesh.vertices @ slope - height).max() <= tolerances.LINEAR_FIELD_MM


@pytest.mark.parametrize("topology", ["separated", "trilinear"])
def test_surface_through_a_thin_layer_equals_the_twin(device, topology):
    rng = np.random.default_rng(12)
    volume = make_volume(lambda p: rng.integers(-500, 500, len(p)), shape=(9, 11), gaps=THIN[5:15], noise=0.0)
    mesh = extract_isosurface(volume, 25, device=device, topology=topology)
    vertices, _, triangles = extract_twin(volume, 25, topology=topology)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.TWIN_VERTEX_VOXEL * min(volume.spacing)


@pytest.mark.oclgrind
@pytest.mark.parametrize("slices", [1, 2, 3])
def test_slabs_of_uneven_slices_give_the_same_surface_bit_for_bit(device, slices):
    rng = np.random.default_rng(12)
    shape, gaps = ((4, 9), GAPS[7:11]) if device.is_simulator else ((9, 70), GAPS[5:15])
    volume = make_volume(lambda p: rng.integers(-500, 500, len(p)), shape=shape, gaps=gaps, dtype=np.int16)
    whole = extract_isosurface(volume, 10, device=device)
    mesh = extract_in_slabs(volume, 10, device, slices=slices)
    assert mesh.report["slabs"] > 1
    assert_same(mesh, whole)


def test_distances_to_a_plane_in_uneven_slices_are_those_of_analysis():
    slope = TURN @ np.array([0.3, 0.5, 0.8])
    slope /= np.linalg.norm(slope)
    volume = make_volume(lambda p: -(p @ slope))
    rule = choose_iso_rule(volume, 0.0)
    inner = np.random.default_rng(3).uniform((15, 12, 3), (35, 28, 20), (300, 3))
    points = volume.ijk_to_lps(inner)
    away = (points - centre_of(volume)) @ slope
    near = np.abs(away) < 0.4
    distances = distances_to_iso_surface(volume, rule, points[near])
    assert near.sum() >= 10  # measured 10
    assert np.abs(distances - np.abs(away[near])).max() <= tolerances.LINEAR_FIELD_MM


@pytest.fixture(scope="module")
def ball_with_fine_labels(device):
    """A ball of 7 mm in uneven slices, its surface, and that of its label on an even map of 0.4 mm."""
    radius, step = 7.0, 0.4
    volume = make_volume(lambda p: 40.0 * (radius - np.linalg.norm(p, axis=1)), shape=(60, 50), dtype=np.int16)
    affine = np.diag([step, step, step, 1.0])
    affine[:3, 3] = centre_of(volume) - step * 30
    k, j, i = np.mgrid[:61, :61, :61]
    inside = np.sqrt((k - 30) ** 2 + (j - 30) ** 2 + (i - 30) ** 2) * step < radius
    (of_label,) = extract_labels(volume, LabelMap(inside.astype(np.uint8), affine), 0, device=device).values()
    return extract_isosurface(volume, 0, device=device), of_label


@pytest.mark.seconds
def test_surface_of_a_label_of_an_even_map_is_that_of_the_uneven_slices(ball_with_fine_labels):
    """The map is finer than the gaps: it is brought to the slices by their own places."""
    plain, of_label = ball_with_fine_labels
    assert np.array_equal(of_label.triangles, plain.triangles)
    assert np.array_equal(of_label.vertices, plain.vertices)


@pytest.mark.seconds
def test_growth_of_labels_in_uneven_slices_is_warned_of(ball_with_fine_labels):
    _, of_label = ball_with_fine_labels
    assert any("growth of the labels" in text for text in of_label.report["warnings"])
