"""Distance to the trilinear iso surface, where analysis knows it."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from scipy.ndimage import map_coordinates

from clrecon.geometry import Volume, compose_affine
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.compare import iso_distance
from clrecon.mesh.compare.iso_distance import (
    distances_to_iso_surface,
    rule_of_report,
    smallest_voxel_mm,
    trilinear_field,
)
from clrecon.mesh.compare.mesh_gates import DEVIATION_MEAN_VOXEL, judge_mesh
from clrecon.proof.surface.extract import extract_isosurface

pytestmark = pytest.mark.unit

SHEARED = compose_affine((0.0, 0.7, 0.1), (0.5, 0.0, -0.05), (0.3, 0.2, 2.5), (-250.0, 130.5, -846.25))
SHAPE_IJK = (11, 9, 7)


def measure_iso_distance(mesh, volume, rule, **options) -> iso_distance.IsoDistance:
    return iso_distance.measure_iso_distances([mesh], volume, rule, **options)[0]


def centres(shape_ijk=SHAPE_IJK) -> np.ndarray:
    k, j, i = np.meshgrid(*(np.arange(n) for n in shape_ijk[::-1]), indexing="ij")
    return np.column_stack([i.ravel(), j.ravel(), k.ravel()])


def volume_of(field, affine=SHEARED, shape_ijk=SHAPE_IJK, dtype=np.float32) -> Volume:
    empty = Volume(np.zeros(shape_ijk[::-1], dtype), affine)
    return Volume(field(empty.ijk_to_lps(centres(shape_ijk))).reshape(shape_ijk[::-1]).astype(dtype), affine)


def noise_volume(dtype=np.int16) -> Volume:
    return Volume(np.random.default_rng(4).integers(-900, 900, SHAPE_IJK[::-1]).astype(dtype), SHEARED)


def test_field_and_gradient_equal_scipy_and_differences():
    volume = noise_volume()
    rule = choose_iso_rule(volume, 100, closed=True)
    ijk = np.random.default_rng(5).uniform(-1, SHAPE_IJK, (400, 3))
    padded = np.pad(volume.voxels.astype(float), 1, constant_values=rule.outside)
    value, gradient = trilinear_field(volume, rule, ijk)
    expected = map_coordinates(padded, ijk.T[::-1] + 1, order=1)
    np.testing.assert_allclose(value, expected, rtol=0, atol=tolerances.TRILINEAR * 1000)
    inner = ijk[(np.abs(ijk - np.round(ijk)) > 1e-3).all(axis=1)]
    for axis in range(3):
        step = 1e-4 * np.eye(3)[axis]
        change = trilinear_field(volume, rule, inner + step)[0] - trilinear_field(volume, rule, inner - step)[0]
        found = trilinear_field(volume, rule, inner)[1][:, axis]
        np.testing.assert_allclose(found, change / 2e-4, rtol=0, atol=1e-4)


def test_an_open_volume_ends_at_its_border():
    volume = noise_volume()
    rule = choose_iso_rule(volume, 100, closed=False)
    beyond, border = np.array([[-0.5, 3.0, 9.0], [4.2, 8.9, 2.0]]), np.array([[0.0, 3.0, 6.0], [4.2, 8.0, 2.0]])
    np.testing.assert_array_equal(trilinear_field(volume, rule, beyond)[0], trilinear_field(volume, rule, border)[0])


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.3, -0.5, 0.8), (-0.2, 0.9, 0.1)])
def test_distance_to_a_plane_through_sheared_voxels_is_exact(normal):
    """A linear field is trilinear itself: distances are exact, along the normal in mm and not in index space."""
    normal = np.array(normal) / np.linalg.norm(normal)
    middle = (SHEARED @ [5, 4, 3, 1])[:3]
    volume = volume_of(lambda points: 40.0 * (points - middle) @ normal)
    rule = choose_iso_rule(volume, 0.0, closed=False)
    rng = np.random.default_rng(6)
    across = rng.uniform(-0.6, 0.6, (50, 3)) @ (np.eye(3) - np.outer(normal, normal))
    offset = rng.uniform(-0.3, 0.3, 50)
    found = distances_to_iso_surface(volume, rule, middle + across + offset[:, None] * normal)
    np.testing.assert_allclose(found, np.abs(offset), atol=1e-4)  # voxels are float32


def test_points_off_a_sphere_have_their_offset_as_distance():
    affine = np.diag([0.7, 0.5, 0.9, 1.0])
    shape, radius = (40, 55, 32), 8.0
    centre = (affine @ [19.3, 27.4, 15.6, 1])[:3]
    volume = volume_of(lambda points: radius - np.linalg.norm(points - centre, axis=1), affine, shape)
    directions = np.random.default_rng(7).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offset = np.linspace(-0.5, 0.5, 300)
    points = centre + directions * (radius + offset)[:, None]
    found = distances_to_iso_surface(volume, choose_iso_rule(volume, 0.0), points)
    np.testing.assert_allclose(found, np.abs(offset), atol=tolerances.ISO_SPHERE_SAGITTA_MM)


def test_surface_in_the_border_cell_of_a_closed_volume_is_found():
    volume = Volume(np.full((4, 4, 4), 1000, np.int16), np.diag([2.0, 1.0, 1.0, 1.0]))
    rule = choose_iso_rule(volume, 0, closed=True)
    surface = -2.0 * (1000 + 0.5) / (1000 - rule.outside)  # in x, half a unit below the integer
    points = np.array([[surface + 0.1, 1.5, 1.5], [surface, 1.2, 2.0]])
    np.testing.assert_allclose(distances_to_iso_surface(volume, rule, points), [0.1, 0.0], atol=1e-9)


def test_a_flat_field_has_no_surface_nearby():
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    rule = choose_iso_rule(volume, 500, closed=False)
    assert np.isnan(distances_to_iso_surface(volume, rule, np.array([[1.5, 1.5, 1.5]]))).all()
    mesh = Mesh([[1, 1, 1], [2, 1, 1], [1, 2, 1]], [[0, 1, 2]])
    found = measure_iso_distance(mesh, volume, rule)
    assert (found["not_found"], found["vertices_mm"], found["centres_voxel"]) == (4, None, None)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("iso_value", [100, 33.25])
def test_vertices_of_an_extracted_surface_lie_on_it(iso_value, closed):
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, iso_value, closed=closed)
    found = measure_iso_distance(Mesh(vertices, triangles), volume, choose_iso_rule(volume, iso_value, closed=closed))
    assert found["vertices_voxel"]["max"] < tolerances.ISO_VERTEX_VOXEL
    assert found["centres_voxel"]["p95"] > 0.01  # flat triangles on noise
    assert found["vertices_mm"]["max"] == pytest.approx(found["vertices_voxel"]["max"] * smallest_voxel_mm(volume))
    assert smallest_voxel_mm(volume) == pytest.approx(np.hypot(0.5, 0.05))


def test_a_level_half_a_unit_off_is_found():
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, 100)
    mesh = Mesh(vertices, triangles)
    assert measure_iso_distance(mesh, volume, choose_iso_rule(volume, 101))["vertices_voxel"]["mean"] > 1e-4


def test_iso_distance_takes_no_more_samples_than_asked():
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, 100)
    found = measure_iso_distance(Mesh(vertices, triangles), volume, choose_iso_rule(volume, 100), samples=100)
    assert 50 < found["samples"]["vertices"] <= 100
    assert 50 < found["samples"]["centres"] <= 100


def test_the_rule_is_read_from_the_report_of_a_mesh():
    closed = {"iso_value_hu": 226.0, "iso_level_hu": 225.5, "closed_at_border": True, "outside_hu": -1024.0}
    rule = rule_of_report(closed)
    assert rule is not None
    assert (rule.iso_level, rule.outside, rule.border) == (225.5, -1024.0, 1)
    opened = rule_of_report({**closed, "closed_at_border": False, "outside_hu": None})
    assert opened is not None
    assert (opened.closed, opened.border) == (False, 0)
    assert rule_of_report({}) is None
    assert rule_of_report({**closed, "outside_hu": None}) is None


def test_a_mesh_where_no_surface_is_counts_all_its_points():
    volume = volume_of(lambda lps: np.where(lps[:, 0] > lps[:, 0].mean(), 900.0, -900.0))
    rule = choose_iso_rule(volume, 100, closed=False)
    far = volume.ijk_to_lps(np.array([[0.2, 1, 1], [0.3, 2, 1], [0.1, 1, 2]], float))
    flat = volume_of(lambda lps: np.full(len(lps), -900.0))
    found = measure_iso_distance(Mesh(far, [[0, 1, 2]]), flat, rule)
    assert (found["not_found"], found["vertices_voxel"], found["centres_voxel"]) == (4, None, None)


def test_rays_find_the_surface_where_the_gradient_leads_nowhere():
    """In a flat plateau beside a step the gradient is zero; the surface lies within two voxels."""
    volume = volume_of(lambda lps: np.zeros(len(lps)))
    volume.voxels[:, :, 5:] = 900.0  # i from 5 on; between 4 and 5 the field rises
    rule = choose_iso_rule(volume, 450, closed=False)
    point = volume.ijk_to_lps(np.array([[3.8, 4.0, 3.0], [4.2, 4.0, 3.0], [0.5, 4.0, 3.0]]))
    distances = distances_to_iso_surface(volume, rule, point)
    normal = np.linalg.inv(volume.affine[:3, :3])[0]
    across = 1.0 / np.linalg.norm(normal)  # of one step along i, straight to the plane
    assert 0.7 * across <= distances[0] <= 1.4 * 0.7 * across  # the rays follow the sheared grid
    assert distances[1] == pytest.approx(0.3 * across, abs=1e-3)
    assert np.isnan(distances[2])


def layers(axis: int, first: int, low: float = 0.0, high: float = 900.0, count: int = 12) -> Volume:
    """Voxels of 1 mm: `low` below a number along an axis, `high` from it on."""
    shape = [4, 4, 4]
    shape[axis] = count
    along = np.indices(shape)[axis]
    return Volume(np.where(along >= first, high, low).astype(np.float32).transpose(2, 1, 0), np.eye(4))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("at", "first", "distance"), [(1.5, 3, 1.0), (1.5, 4, None), (4.5, 4, 1.0), (4.5, 3, None)])
def test_lines_reach_the_voxels_of_the_cell_and_of_its_neighbours(axis, at, first, distance):
    """In a flat cell the gradient is zero; the level lies half way to the voxels that differ."""
    volume = layers(axis, first)
    point = np.full((1, 3), 2.0)
    point[0, axis] = at
    found = distances_to_iso_surface(volume, choose_iso_rule(volume, 450.0, closed=False), point)
    np.testing.assert_allclose(found, [np.nan if distance is None else distance], atol=1e-9)


def test_lines_find_a_level_between_values_less_than_1_apart():
    """Half way between two voxels, and just before the end of the lines."""
    volume = layers(0, 3, 0.0, 0.5)
    for level, distance in ((0.25, 1.0), (0.485, 1.47)):
        rule = choose_iso_rule(volume, level, closed=False)
        assert distances_to_iso_surface(volume, rule, np.array([[1.5, 2.0, 2.0]])) == pytest.approx([distance])


def test_a_surface_is_looked_for_within_eleven_half_voxels_along_the_gradient():
    """Of twelve steps of half a voxel at most, the last shows that the surface is reached."""
    volume = Volume(np.tile(100.0 * np.arange(24.0), (4, 4, 1)).astype(np.float32), np.eye(4))
    rule = choose_iso_rule(volume, 1000.0, closed=False)
    found = distances_to_iso_surface(volume, rule, np.array([[4.55, 2, 2], [4.45, 2, 2], [15.45, 2, 2], [15.55, 2, 2]]))
    np.testing.assert_allclose(found, [5.45, np.nan, 5.45, np.nan], atol=1e-4)


def test_point_beyond_a_closed_volume_has_its_distance_to_the_border_surface():
    """The surface lies just before the border, where a step from the border is short."""
    volume = Volume(np.full((4, 4, 4), 1000, np.int16), np.eye(4))
    rule = choose_iso_rule(volume, 0, closed=True)
    surface = 3.0 + (1000 + 0.5) / (1000 - rule.outside)
    found = distances_to_iso_surface(volume, rule, np.array([[1.5, 1.5, 5.25], [1.5, 5.25, 1.5], [1.5, 1.5, -2.25]]))
    np.testing.assert_allclose(found, 5.25 - surface, atol=1e-9)


def test_flat_fields_divide_by_no_zero():
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    with np.errstate(all="raise"):
        assert np.isnan(distances_to_iso_surface(volume, choose_iso_rule(volume, 500, closed=False), np.ones((1, 3))))


def test_of_more_points_than_100_000_every_second_is_measured(monkeypatch):
    monkeypatch.setattr(iso_distance, "distances_to_iso_surface", lambda volume, rule, points: np.zeros(len(points)))
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    for count, measured in ((100_000, 100_000), (100_001, 50_001), (250_000, 83_334)):
        mesh = Mesh(np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint32))
        found = measure_iso_distance(mesh, volume, choose_iso_rule(volume, 500, closed=False))
        assert found["samples"] == {"vertices": measured, "centres": measured}
        assert found == found.as_dict()  # a record is equal to its entries


def test_a_mesh_that_does_not_say_whether_it_is_closed_is_open():
    rule = rule_of_report({"iso_level_hu": 225.5})
    assert rule is not None
    assert (rule.closed, rule.iso_level) == (False, 225.5)


def metal_volume(level: float, count: int) -> tuple[Volume, Mesh]:
    """Bone below i = 5 and one voxel of the level at (8, 3, 3); `count` of six vertices lie within two voxels of it."""
    voxels = np.zeros((7, 7, 14), np.int16)
    voxels[:, :, :5] = 900
    voxels[3, 3, 8] = level
    places: list[tuple[float, float, float]] = (
        [(6, 3, 3), (8, 1, 5), (10, 5, 1), (11, 3, 3)] if count == 3 else [(8, 3, 3)] * count
    )
    places += [(4.5, 1, 1)] * (6 - len(places))
    return Volume(voxels, np.eye(4)), Mesh(np.array(places, float), [[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize(("level", "iso_value", "near"), [(2001, 200, 3), (2000, 200, 0), (3071, 2500, 0)])
def test_vertices_near_metal_are_counted_and_left_out(level, iso_value, near):
    volume, mesh = metal_volume(level, 3)
    rule = choose_iso_rule(volume, iso_value, closed=False)
    found = measure_iso_distance(mesh, volume, rule)
    assert found["near_metal"] == near
    if not near:
        assert found["away_from_metal_voxel"] is None
        return
    away = distances_to_iso_surface(volume, rule, mesh.vertices[3:].astype(np.float64))
    assert np.isfinite(away).sum() >= 2
    assert found["away_from_metal_voxel"]["max"] == np.nanmax(away)  # the centre of the second triangle is near


def test_mesh_mostly_of_metal_is_judged_whole():
    volume, mesh = metal_volume(3071, 4)
    found = measure_iso_distance(mesh, volume, choose_iso_rule(volume, 200, closed=False))
    assert (found["near_metal"], found["away_from_metal_voxel"]) == (4, None)


def test_few_triangles_of_a_ball_are_judged_by_their_surface_not_by_their_corners():
    """Corners lie outside of what is round where the volume is right: their mean alone is past the bound."""
    far = np.linalg.norm(np.indices((15, 15, 15)).reshape(3, -1).T - 7.0, axis=1).reshape(15, 15, 15)
    volume = Volume(np.rint(1000.0 - 150.0 * (far - 4.5)).astype(np.int16), np.eye(4))
    rule = choose_iso_rule(volume, 1000.0)
    ball = Mesh(*samples.sphere(radius=4.5, rounds=2))
    right = (4.0 / 3.0 * np.pi * 4.5**3 / (1000.0 * ball.quality()["volume_ml"])) ** (1.0 / 3.0)
    measured = {
        larger: measure_iso_distance(Mesh(7.0 + larger * right * ball.vertices, ball.triangles), volume, rule)
        for larger in (1.0, 1.03, 0.9)
    }
    of_vertices = {larger: one["vertices_voxel"]["mean"] for larger, one in measured.items()}
    assert of_vertices[1.0] > DEVIATION_MEAN_VOXEL
    gates = {larger: judge_mesh(iso_distance=one)[2] for larger, one in measured.items()}
    assert {larger: gate["ok"] for larger, gate in gates.items()} == {1.0: True, 1.03: False, 0.9: False}
    assert {gate["name"] for gate in gates.values()} == {"iso_distance_mean"}


def test_meshes_are_measured_together_as_each_alone(monkeypatch):
    volume = noise_volume()
    rule = choose_iso_rule(volume, 100)
    vertices, _, triangles = extract_isosurface(volume, 100)
    meshes = [Mesh(vertices, triangles[start::7]) for start in range(7)]
    alone = [measure_iso_distance(mesh, volume, rule) for mesh in meshes]
    calls = []
    measure = iso_distance.distances_to_iso_surface
    monkeypatch.setattr(
        iso_distance, "distances_to_iso_surface", lambda *given: calls.append(len(given[2])) or measure(*given)
    )
    for one, other in zip(iso_distance.measure_iso_distances(meshes, volume, rule), alone, strict=True):
        assert one["samples"] == other["samples"], "samples of a mesh among others"
        for of in ("vertices_mm", "centres_mm", "centres_voxel"):
            assert dict(one[of]) == pytest.approx(other[of], rel=1e-9), of
    assert len(calls) == 1, calls
