"""Distance to the trilinear iso surface, where analysis knows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from scipy.ndimage import map_coordinates

from clrecon.geometry import Volume, compose_affine
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
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


def measure_iso_distance(mesh: Mesh, volume: Volume, rule: IsoRule, **options: Any) -> iso_distance.IsoDistance:
    (distance,) = iso_distance.measure_iso_distances([mesh], volume, rule, **options)
    return distance


def voxel_indices(shape_ijk=SHAPE_IJK) -> np.ndarray:
    """Indices i, j, k of all voxels, shape (n, 3)."""
    k, j, i = np.meshgrid(*(np.arange(n) for n in shape_ijk[::-1]), indexing="ij")
    return np.column_stack([i.ravel(), j.ravel(), k.ravel()])


def volume_of(field, affine=SHEARED, shape_ijk=SHAPE_IJK, dtype=np.float32) -> Volume:
    """Voxels with the values of a function of LPS points."""
    empty = Volume(np.zeros(shape_ijk[::-1], dtype), affine)
    return Volume(field(empty.ijk_to_lps(voxel_indices(shape_ijk))).reshape(shape_ijk[::-1]).astype(dtype), affine)


def noise_volume(dtype=np.int16) -> Volume:
    """Sheared voxels of -900 to 900 HU."""
    return Volume(np.random.default_rng(4).integers(-900, 900, SHAPE_IJK[::-1]).astype(dtype), SHEARED)


def test_trilinear_values_are_those_of_scipy():
    volume = noise_volume()
    rule = choose_iso_rule(volume, 100, closed=True)
    ijk = np.random.default_rng(5).uniform(-1, SHAPE_IJK, (400, 3))
    values, _ = trilinear_field(volume, rule, ijk)
    padded = np.pad(volume.voxels.astype(float), 1, constant_values=rule.outside)
    in_padded_kji = ijk.T[::-1] + 1
    expected = map_coordinates(padded, in_padded_kji, order=1)
    np.testing.assert_allclose(values, expected, rtol=0, atol=tolerances.TRILINEAR * 1000)  # values up to 1000 HU


@pytest.mark.parametrize("axis", range(3))
def test_trilinear_gradient_is_the_difference_of_values_over_a_short_step(axis):
    volume = noise_volume()
    rule = choose_iso_rule(volume, 100, closed=True)
    ijk = np.random.default_rng(5).uniform(-1, SHAPE_IJK, (400, 3))
    within_cells = ijk[(np.abs(ijk - np.round(ijk)) > 1e-3).all(axis=1)]
    step = 1e-4 * np.eye(3)[axis]
    after, before = (trilinear_field(volume, rule, within_cells + side * step)[0] for side in (1, -1))
    _, gradient = trilinear_field(volume, rule, within_cells)
    np.testing.assert_allclose(gradient[:, axis], (after - before) / 2e-4, rtol=0, atol=tolerances.DIFFERENCE_HU)


def test_points_beyond_an_open_volume_have_the_value_of_its_border():
    volume = noise_volume()  # indices up to (10, 8, 6)
    rule = choose_iso_rule(volume, 100, closed=False)
    beyond = np.array([[-0.5, 3.0, 9.0], [4.2, 8.9, 2.0]])
    at_the_border = np.array([[0.0, 3.0, 6.0], [4.2, 8.0, 2.0]])
    expected, _ = trilinear_field(volume, rule, at_the_border)
    np.testing.assert_array_equal(trilinear_field(volume, rule, beyond)[0], expected)


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.3, -0.5, 0.8), (-0.2, 0.9, 0.1)])
def test_distance_to_a_plane_through_sheared_voxels_is_exact(normal):
    """A linear field is trilinear itself: distances are exact, along the normal in mm and not in index space."""
    normal = np.array(normal) / np.linalg.norm(normal)
    middle = (SHEARED @ [5, 4, 3, 1])[:3]
    volume = volume_of(lambda points: 40.0 * (points - middle) @ normal)
    rule = choose_iso_rule(volume, 0.0, closed=False)
    rng = np.random.default_rng(6)
    within_plane = rng.uniform(-0.6, 0.6, (50, 3)) @ (np.eye(3) - np.outer(normal, normal))
    offset = rng.uniform(-0.3, 0.3, 50)
    distances = distances_to_iso_surface(volume, rule, middle + within_plane + offset[:, None] * normal)
    np.testing.assert_allclose(distances, np.abs(offset), atol=tolerances.FLOAT32_PLANE_MM)


def test_points_off_a_sphere_have_their_offset_as_distance():
    affine, shape, radius = np.diag([0.7, 0.5, 0.9, 1.0]), (40, 55, 32), 8.0
    centre = (affine @ [19.3, 27.4, 15.6, 1])[:3]  # near the middle, between voxels
    volume = volume_of(lambda points: radius - np.linalg.norm(points - centre, axis=1), affine, shape)
    directions = np.random.default_rng(7).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offset = np.linspace(-0.5, 0.5, 300)

    points = centre + directions * (radius + offset)[:, None]
    distances = distances_to_iso_surface(volume, choose_iso_rule(volume, 0.0), points)

    np.testing.assert_allclose(distances, np.abs(offset), atol=tolerances.ISO_SPHERE_SAGITTA_MM)


def test_surface_in_the_border_cell_of_a_closed_volume_is_found():
    volume = Volume(np.full((4, 4, 4), 1000, np.int16), np.diag([2.0, 1.0, 1.0, 1.0]))
    rule = choose_iso_rule(volume, 0, closed=True)
    # Between the first voxel and one outside, 2 mm before it, to the level of 0 HU: half a unit below the integer.
    surface_x = -2.0 * (1000 + 0.5) / (1000 - rule.outside)
    points = np.array([[surface_x + 0.1, 1.5, 1.5], [surface_x, 1.2, 2.0]])
    distances = distances_to_iso_surface(volume, rule, points)
    np.testing.assert_allclose(distances, [0.1, 0.0], atol=tolerances.FLOAT64_PLACE_MM)


def test_a_point_in_a_flat_field_has_no_distance():
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    rule = choose_iso_rule(volume, 500, closed=False)
    assert np.isnan(distances_to_iso_surface(volume, rule, np.array([[1.5, 1.5, 1.5]]))).all()


def test_vertices_and_centres_in_a_flat_field_are_counted_and_have_no_figures():
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    triangle = Mesh([[1, 1, 1], [2, 1, 1], [1, 2, 1]], [[0, 1, 2]])
    measured = measure_iso_distance(triangle, volume, choose_iso_rule(volume, 500, closed=False))
    assert measured["not_found"] == 3 + 1
    assert (measured["vertices_mm"], measured["centres_voxel"]) == (None, None)


@pytest.mark.parametrize("closed", [True, False], ids=["closed", "open"])
@pytest.mark.parametrize("iso_value", [100, 33.25])
def test_vertices_of_an_extracted_surface_lie_on_it_and_centres_of_its_flat_triangles_beside_it(iso_value, closed):
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, iso_value, closed=closed)
    rule = choose_iso_rule(volume, iso_value, closed=closed)
    measured = measure_iso_distance(Mesh(vertices, triangles), volume, rule)
    assert measured["vertices_voxel"]["max"] < tolerances.ISO_VERTEX_VOXEL
    assert measured["centres_voxel"]["p95"] > 100 * tolerances.ISO_VERTEX_VOXEL  # measured 0.47 to 0.59


def test_distances_in_mm_are_those_in_voxels_times_the_shortest_step():
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, 100)
    measured = measure_iso_distance(Mesh(vertices, triangles), volume, choose_iso_rule(volume, 100))
    in_mm, in_voxels = measured["vertices_mm"]["max"], measured["vertices_voxel"]["max"]
    assert in_mm == pytest.approx(in_voxels * smallest_voxel_mm(volume))


def test_the_shortest_step_of_sheared_voxels_is_the_length_of_a_column():
    steps_mm = [np.hypot(0.7, 0.1), np.hypot(0.5, 0.05), np.linalg.norm((0.3, 0.2, 2.5))]  # of `SHEARED`
    assert smallest_voxel_mm(noise_volume()) == pytest.approx(min(steps_mm))


def test_vertices_at_a_level_1_hu_off_are_measured_off_the_surface():
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, 100)
    measured = measure_iso_distance(Mesh(vertices, triangles), volume, choose_iso_rule(volume, 101))
    assert measured["vertices_voxel"]["mean"] > tolerances.ISO_VERTEX_VOXEL


@pytest.mark.parametrize("of", ["vertices", "centres"])
def test_iso_distance_takes_more_than_half_of_the_samples_asked_for_and_not_more(of):
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, 100)
    measured = measure_iso_distance(Mesh(vertices, triangles), volume, choose_iso_rule(volume, 100), samples=100)
    assert 50 < measured["samples"][of] <= 100  # every n-th, n rounded up


CLOSED_REPORT = {"iso_value_hu": 226.0, "iso_level_hu": 225.5, "closed_at_border": True, "outside_hu": -1024.0}


def test_the_rule_of_a_closed_mesh_is_read_from_its_report():
    rule = rule_of_report(CLOSED_REPORT)
    assert rule is not None
    assert (rule.iso_level, rule.outside, rule.border) == (225.5, -1024.0, 1)


def test_the_rule_of_an_open_mesh_has_no_border():
    rule = rule_of_report({**CLOSED_REPORT, "closed_at_border": False, "outside_hu": None})
    assert rule is not None
    assert (rule.closed, rule.border) == (False, 0)


@pytest.mark.parametrize("report", [{}, {**CLOSED_REPORT, "outside_hu": None}], ids=["empty", "no outside value"])
def test_a_report_without_the_level_or_the_outside_of_a_closed_mesh_has_no_rule(report):
    assert rule_of_report(report) is None


def test_a_surface_within_two_voxels_is_found_along_lines_where_the_gradient_is_zero():
    """On a flat plateau beside a step, between i = 4 and 5 from 0 to 900 HU: the level of 450 lies at i = 4.5.

    One step along i is `step_mm` straight to the plane, but longer along the sheared grid.
    """
    volume = volume_of(lambda lps: np.zeros(len(lps)))
    volume.voxels[:, :, 5:] = 900.0
    rule = choose_iso_rule(volume, 450, closed=False)
    step_mm = 1.0 / np.linalg.norm(np.linalg.inv(volume.affine[:3, :3])[0])

    on_the_plateau, in_the_step, far_away = [3.8, 4.0, 3.0], [4.2, 4.0, 3.0], [0.5, 4.0, 3.0]
    points = volume.ijk_to_lps(np.array([on_the_plateau, in_the_step, far_away]))
    of_plateau, of_step, of_far_point = distances_to_iso_surface(volume, rule, points)

    # The plane lies at i = 4.5, 0.7 steps from the plateau; 1.4: the lines follow the sheared grid.
    assert 0.7 * step_mm <= of_plateau <= 1.4 * 0.7 * step_mm
    assert of_step == pytest.approx(0.3 * step_mm, abs=tolerances.ISO_VERTEX_VOXEL)
    assert np.isnan(of_far_point)


def two_layers(axis: int, *, first: int, low: float = 0.0, high: float = 900.0, count: int = 12) -> Volume:
    """Voxels of 1 mm: `low` below the index `first` of an axis, `high` from it on."""
    shape = [4, 4, 4]
    shape[axis] = count
    along = np.indices(shape)[axis]
    return Volume(np.where(along >= first, high, low).astype(np.float32).transpose(2, 1, 0), np.eye(4))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("along_axis", "first", "distance"),
    [(1.5, 3, 1.0), (1.5, 4, np.nan), (4.5, 4, 1.0), (4.5, 3, np.nan)],
    ids=["rises in the next cell", "a cell further", "rose in the cell before", "a cell before that"],
)
def test_search_for_the_iso_surface_reaches_the_voxels_of_the_cell_and_of_its_neighbours(
    axis, along_axis, first, distance
):
    """In a flat cell the gradient is zero; the level lies half way to the voxels that differ."""
    volume = two_layers(axis, first=first, low=0.0, high=900.0)
    point = np.full((1, 3), 2.0)
    point[0, axis] = along_axis
    distances = distances_to_iso_surface(volume, choose_iso_rule(volume, 450.0, closed=False), point)
    np.testing.assert_allclose(distances, [distance], atol=tolerances.FLOAT64_PLACE_MM)


@pytest.mark.parametrize(("level", "at_i"), [(0.25, 2.5), (0.485, 2.97)], ids=["half way", "at the end of the lines"])
def test_lines_find_a_level_between_values_less_than_1_apart(level, at_i):
    """The values rise from 0 at i = 2 to 0.5 at i = 3; the point lies at i = 1.5."""
    volume = two_layers(axis=0, first=3, low=0.0, high=0.5)
    rule = choose_iso_rule(volume, level, closed=False)
    assert distances_to_iso_surface(volume, rule, np.array([[1.5, 2.0, 2.0]])) == pytest.approx([at_i - 1.5])


def test_a_surface_is_looked_for_within_eleven_half_voxels_along_the_gradient():
    """A ramp that reaches its level at i = 10; of twelve steps of half a voxel the last shows that it is reached."""
    volume = Volume(np.tile(100.0 * np.arange(24.0), (4, 4, 1)).astype(np.float32), np.eye(4))
    rule = choose_iso_rule(volume, 1000.0, closed=False)
    within, beyond = [10 - 5.45, 10 + 5.45], [10 - 5.55, 10 + 5.55]
    points = np.array([[i, 2.0, 2.0] for i in within + beyond])
    distances = distances_to_iso_surface(volume, rule, points)
    np.testing.assert_allclose(distances, [5.45, 5.45, np.nan, np.nan], atol=tolerances.ISO_VERTEX_VOXEL)


@pytest.mark.parametrize("point", [[1.5, 1.5, 5.25], [1.5, 5.25, 1.5], [1.5, 1.5, -2.25]], ids=["k", "j", "below k"])
def test_point_beyond_a_closed_volume_has_its_distance_to_the_border_surface(point):
    """The surface lies just before the border, where a step from the border is short; each point 2.25 mm beyond."""
    volume = Volume(np.full((4, 4, 4), 1000, np.int16), np.eye(4))
    rule = choose_iso_rule(volume, 0, closed=True)
    from_last_voxel_mm = (1000 + 0.5) / (1000 - rule.outside)
    distances = distances_to_iso_surface(volume, rule, np.array([point]))
    np.testing.assert_allclose(distances, 2.25 - from_last_voxel_mm, atol=tolerances.FLOAT64_PLACE_MM)


def test_a_point_in_a_flat_field_is_measured_without_a_division_by_zero():
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    with np.errstate(all="raise"):
        assert np.isnan(distances_to_iso_surface(volume, choose_iso_rule(volume, 500, closed=False), np.ones((1, 3))))


@pytest.mark.parametrize(("count", "measured"), [(100_000, 100_000), (100_001, 50_001), (250_000, 83_334)])
def test_of_more_than_100_000_points_every_second_or_third_is_measured(count, measured, monkeypatch):
    monkeypatch.setattr(iso_distance, "distances_to_iso_surface", lambda volume, rule, points: np.zeros(len(points)))
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    mesh = Mesh(np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint32))
    distance = measure_iso_distance(mesh, volume, choose_iso_rule(volume, 500, closed=False))
    assert distance["samples"] == {"vertices": measured, "centres": measured}


def test_an_iso_distance_is_equal_to_the_dictionary_of_its_entries():
    volume = Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    triangle = Mesh([[1, 1, 1], [2, 1, 1], [1, 2, 1]], [[0, 1, 2]])
    distance = measure_iso_distance(triangle, volume, choose_iso_rule(volume, 500, closed=False))
    assert distance == distance.as_dict()


def test_a_mesh_that_does_not_say_whether_it_is_closed_is_open():
    rule = rule_of_report({"iso_level_hu": 225.5})
    assert rule is not None
    assert (rule.closed, rule.iso_level) == (False, 225.5)


BONE_EDGE = (4.5, 1, 1)
WITHIN_TWO_VOXELS_OF_METAL = [(6, 3, 3), (8, 1, 5), (10, 5, 1)]
JUST_BEYOND = (11, 3, 3)


def bone_beside_a_dense_voxel(level: float) -> Volume:
    """900 HU below i = 5, and one voxel of the level at (8, 3, 3); voxels of 1 mm."""
    voxels = np.zeros((7, 7, 14), np.int16)
    voxels[:, :, :5] = 900
    voxels[3, 3, 8] = level
    return Volume(voxels, np.eye(4))


TWO_TRIANGLES = [[0, 1, 2], [3, 4, 5]]
METAL_HU, DENSE_BONE_HU = 2001, 2000


def test_vertices_within_two_voxels_of_metal_are_left_out():
    volume = bone_beside_a_dense_voxel(METAL_HU)
    rule = choose_iso_rule(volume, 200, closed=False)
    others = [JUST_BEYOND, (11, 2.9, 3), BONE_EDGE, (4.5, 0, 0), (4.5, 6, 0), (4.5, 0, 6)]
    vertices = np.array([*WITHIN_TWO_VOXELS_OF_METAL, *others], float)
    measured = measure_iso_distance(Mesh(vertices, [*TWO_TRIANGLES, [6, 7, 8]]), volume, rule)
    of_others = distances_to_iso_surface(volume, rule, np.array(others, float))
    assert np.isfinite(of_others).sum() == 4  # those at the edge of the bone
    assert measured["away_from_metal_voxel"]["max"] == np.nanmax(of_others)


@pytest.mark.parametrize(
    ("level", "iso_value"), [(DENSE_BONE_HU, 200), (3071, 2500)], ids=["dense bone", "metal is what is looked for"]
)
def test_vertices_near_dense_bone_and_on_a_surface_of_metal_are_not_left_out(level, iso_value):
    volume = bone_beside_a_dense_voxel(level)
    vertices = np.array([*WITHIN_TWO_VOXELS_OF_METAL, JUST_BEYOND, BONE_EDGE, BONE_EDGE], float)
    rule = choose_iso_rule(volume, iso_value, closed=False)
    measured = measure_iso_distance(Mesh(vertices, TWO_TRIANGLES), volume, rule)
    assert (measured["near_metal_share"], measured["away_from_metal_voxel"]) == (0.0, None)


SQUARE_NEAR_METAL = [(8, 3, 3), (9, 3, 3), (8, 4, 3)]  # 0.5 mm2


@pytest.mark.parametrize(
    ("edge_mm", "near_metal_share", "is_left_out"),
    [(2, 0.2, True), (0.5, 0.8, False)],  # triangles of 2 and 0.125 mm2 beside that of 0.5 mm2
    ids=["less than half of the area", "most of it"],
)
def test_what_is_near_metal_is_left_out_up_to_half_of_the_area(edge_mm, near_metal_share, is_left_out):
    volume = bone_beside_a_dense_voxel(METAL_HU)
    far = np.array([(4, 1, 1), (4, 1 + edge_mm, 1), (4, 1, 1 + edge_mm)], float)
    mesh = Mesh(np.concatenate([SQUARE_NEAR_METAL, far]), TWO_TRIANGLES)
    measured = measure_iso_distance(mesh, volume, choose_iso_rule(volume, 200, closed=False))
    assert measured["near_metal_share"] == pytest.approx(near_metal_share)
    assert (measured["away_from_metal_voxel"] is not None) == is_left_out


@pytest.mark.parametrize("at", ["vertices_mm", "centres_mm", "surface_mm"])
def test_distances_are_of_the_area_and_not_of_the_number_of_points(at):
    """One triangle of 2 mm2 at the level and four of 0.125 mm2 each at 0.4 mm from it: a fifth of the area."""
    volume = volume_of(lambda points: 1000.0 * points[:, 2], np.eye(4))
    large = np.array([(1, 1, 3), (3, 1, 3), (1, 3, 3)], float)
    small = np.array([(5, 5, 3.4), (5.5, 5, 3.4), (5, 5.5, 3.4)], float)
    vertices = np.concatenate([large, *[small] * 4])
    mesh = Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    measured = measure_iso_distance(mesh, volume, choose_iso_rule(volume, 3000.0, closed=False))
    of_surface = measured["surface_voxel"] if at == "surface_mm" else measured[at]  # voxels of 1 mm
    assert of_surface["mean"] == pytest.approx(0.2 * 0.4, abs=1e-6)  # float32 vertices at 3.4 mm: measured 2e-8
    assert of_surface["p95"] == pytest.approx(0.4, abs=1e-6)  # measured 1e-7


BALL_RADIUS = 4.5


def measure_coarse_ball(*, larger: float) -> iso_distance.IsoDistance:
    """128 triangles with the volume of the ball that 15 voxels an edge show, `larger` times as large."""
    from_centre = np.linalg.norm(np.indices((15, 15, 15)) - 7.0, axis=0)
    volume = Volume(np.rint(1000.0 - 150.0 * (from_centre - BALL_RADIUS)).astype(np.int16), np.eye(4))
    inscribed = Mesh(*samples.sphere(radius=BALL_RADIUS, rounds=2))
    of_its_volume = (4.0 / 3.0 * np.pi * BALL_RADIUS**3 / inscribed.volume) ** (1.0 / 3.0)
    ball = Mesh(7.0 + larger * of_its_volume * inscribed.vertices, inscribed.triangles)
    return measure_iso_distance(ball, volume, choose_iso_rule(volume, 1000.0))


@pytest.mark.parametrize(
    ("larger", "ok"), [(1.0, True), (1.03, False), (0.9, False)], ids=["right", "0.14 mm larger", "0.45 mm smaller"]
)
def test_few_triangles_of_a_ball_are_judged_by_their_surface_of_the_right_size(larger, ok):
    _, _, mean_gate = judge_mesh(iso_distance=measure_coarse_ball(larger=larger))
    assert (mean_gate["name"], mean_gate["ok"]) == ("iso_distance_mean", ok)


def test_corners_of_few_triangles_with_the_volume_of_a_ball_lie_outside_of_it_beyond_the_bound():
    assert measure_coarse_ball(larger=1.0)["vertices_voxel"]["mean"] > DEVIATION_MEAN_VOXEL


@pytest.fixture(scope="module")
def seven_meshes():
    """Seven meshes, each of every seventh triangle of a surface through noise, with the volume and its rule."""
    volume = noise_volume()
    vertices, _, triangles = extract_isosurface(volume, 100)
    return [Mesh(vertices, triangles[start::7]) for start in range(7)], volume, choose_iso_rule(volume, 100)


def test_meshes_that_are_measured_together_have_the_figures_of_each_alone(seven_meshes):
    meshes, volume, rule = seven_meshes
    together = iso_distance.measure_iso_distances(meshes, volume, rule)
    for mesh, among_others in zip(meshes, together, strict=True):
        alone = measure_iso_distance(mesh, volume, rule)
        assert among_others["samples"] == alone["samples"]
        for figures in ("vertices_mm", "centres_mm", "centres_voxel"):
            assert dict(among_others[figures]) == pytest.approx(alone[figures], rel=tolerances.FLOAT64_SHARE), figures


def test_points_of_several_meshes_are_measured_in_one_call(seven_meshes, monkeypatch):
    calls = []

    def count_calls(volume, rule, points):
        calls.append(len(points))
        return np.zeros(len(points))

    monkeypatch.setattr(iso_distance, "distances_to_iso_surface", count_calls)
    iso_distance.measure_iso_distances(*seven_meshes)
    assert len(calls) == 1
