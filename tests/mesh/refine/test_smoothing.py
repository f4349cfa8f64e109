"""Smoothing: noise goes, shape and volume stay, nothing moves beyond the bound."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused
from variants import daily

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.coordinates import find_coincident
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.refine.decimation import default_deviation
from clrecon.mesh.refine.shifts import (
    _ROUNDS,
    _ROUNDS_OF_ITS_OWN,
    _SMALLEST_SHARE,
    _find_spoilt,
    as_stored,
    move_vertices,
    shorten_steps,
)
from clrecon.mesh.refine.smoothing import Filter, Rings, sinc_terms, smooth_mesh
from clrecon.mesh.triangles import vertex_normals

pytestmark = pytest.mark.unit

CENTRE = np.array([-150.25, 1071.5, -846.0])
RADIUS = 20.0


def noisy_sphere(noise: float, seed: int = 1) -> Mesh:
    vertices, triangles = samples.sphere((0, 0, 0), 1.0, 5)
    lengths = RADIUS + np.random.default_rng(seed).normal(scale=noise, size=len(vertices))
    return Mesh(CENTRE + vertices * lengths[:, None], triangles, None, {"iso_value_hu": 300.0})


def plane(noise: float, size: int = 30) -> Mesh:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(size), np.arange(size)))
    z = np.random.default_rng(2).normal(scale=noise, size=size * size)
    corner = (x + size * y)[(x < size - 1) & (y < size - 1)]
    lower = np.column_stack([corner, corner + 1, corner + size + 1])
    upper = np.column_stack([corner, corner + size + 1, corner + size])
    return Mesh(np.column_stack([x, y, z]), np.concatenate([lower, upper]))


def radial_error(mesh: Mesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS


def test_noise_on_a_sphere_goes_and_the_radius_stays():
    rough = noisy_sphere(0.1)
    smooth = smooth_mesh(rough, max_deviation_mm=0.5)
    assert np.std(radial_error(smooth)) < tolerances.SMOOTHED_NOISE_SHARE * 0.1
    assert abs(radial_error(smooth).mean()) < tolerances.SMOOTHED_RADIUS_MM
    quality = smooth.quality()
    assert (quality["closed"], quality["manifold"], quality["zero_area_faces"]) == (True, True, 0)
    assert quality["volume_ml"] == pytest.approx(4 / 3 * np.pi * 8.0, rel=tolerances.SMOOTHED_VOLUME)
    np.testing.assert_array_equal(smooth.triangles, rough.triangles)
    outward = (smooth.vertices - CENTRE) / np.linalg.norm(smooth.vertices - CENTRE, axis=1, keepdims=True)
    assert np.einsum("na,na->n", smooth.normals, outward).min() > 0.99
    assert smooth.report["iso_value_hu"] == 300.0
    assert smooth.report["refinement"]["smooth"]["iterations"] == 20


def test_more_iterations_smooth_more():
    rough = noisy_sphere(0.1)
    few, many = (np.std(radial_error(smooth_mesh(rough, n, 1.0))) for n in (5, 20))
    assert many < few < 0.1


@pytest.mark.release
@pytest.mark.parametrize("bound", daily(1, [0.02, 0.1]))
def test_no_point_of_either_surface_is_further_than_the_bound(bound):
    rough = noisy_sphere(0.2)
    free, smooth = smooth_mesh(rough, 20, 10.0), smooth_mesh(rough, 20, bound)
    assert SurfaceDistance(rough.vertices, rough.triangles)(free.vertices.astype(float)).max() > 3 * bound
    assert free.report["refinement"]["smooth"]["vertices_held_back"] == 0
    assert smooth.report["refinement"]["smooth"]["vertices_held_back"] > 100
    step = smooth.vertices.astype(float) - rough.vertices
    assert np.linalg.norm(step, axis=1).max() <= bound
    shares = np.random.default_rng(3).dirichlet((1, 1, 1), 4)
    for one, other in ((rough, smooth), (smooth, rough)):
        within = np.einsum("wi,nia->nwa", shares, one.vertices[one.triangles].astype(float)).reshape(-1, 3)
        points = np.concatenate([one.vertices.astype(float), within])
        assert SurfaceDistance(other.vertices, other.triangles)(points).max() <= bound


def test_sheets_that_nearly_touch_do_not_cut_each_other():
    """The filter swings below zero beside a peak, as every steep low pass does: here through the sheet below."""
    lower, upper = plane(0.0), plane(0.0)
    peak = ((upper.vertices[:, :2] - 15) ** 2).sum(axis=1) < 5
    sheets = samples.join(
        (lower.vertices, lower.triangles),
        (upper.vertices + np.where(peak, 3.02, 0.02)[:, None] * [0, 0, 1] + [0.31, 0.17, 0], upper.triangles),
    )
    mesh = Mesh(*sheets)
    assert len(find_self_intersections(mesh.vertices, mesh.triangles)) == 0
    free = Filter(Rings.of(mesh.triangles, mesh.vertex_count))
    step = free.find_steps(free.measure_bends(mesh.vertices)[0], sinc_terms(20))
    assert len(find_self_intersections(mesh.vertices + step, mesh.triangles)) > 0
    smooth = smooth_mesh(mesh, 20, 1.0)
    assert len(find_self_intersections(smooth.vertices, smooth.triangles)) == 0
    assert 0 < smooth.report["refinement"]["smooth"]["vertices_taken_back"] < 0.2 * mesh.vertex_count


def test_a_thin_shell_keeps_its_volume():
    """Of a wall of 0.3 mm that the filter moves by hundredths, a large share of the volume would be gone."""
    outer, inner = noisy_sphere(0.05), noisy_sphere(0.05, 2)
    shell = samples.join(
        (outer.vertices, outer.triangles),
        (CENTRE + (inner.vertices - CENTRE) * (19.7 / 20.0), inner.triangles[:, ::-1]),
    )
    mesh = Mesh(*shell)
    before, after = mesh.quality(), smooth_mesh(mesh, 20, 0.3).quality()
    assert after["volume_ml"] == pytest.approx(before["volume_ml"], rel=1e-4)


def test_vertices_that_would_share_a_place_stay():
    """Far from the origin, where float32 is coarse: STL would join them, and be open."""
    vertices, triangles = samples.sphere((800.0, -790.0, 805.0), 2.0**-9, 3)
    mesh = Mesh(vertices, triangles)
    assert len(find_coincident(smooth_mesh(mesh, 100, 1.0).vertices)) <= len(find_coincident(mesh.vertices))


def test_a_plane_becomes_flat_and_keeps_its_border():
    rough = plane(0.1)
    smooth = smooth_mesh(rough, 40, 1.0)
    border = np.isin(rough.vertices[:, :2], (0.0, 29.0)).any(axis=1)
    np.testing.assert_array_equal(smooth.vertices[border], rough.vertices[border])
    inner = ((rough.vertices[:, :2] > 6) & (rough.vertices[:, :2] < 23)).all(axis=1)
    assert np.std(smooth.vertices[inner, 2]) < tolerances.SMOOTHED_NOISE_SHARE * np.std(rough.vertices[inner, 2])
    even = smooth_mesh(plane(0.0), 20, 1.0)
    assert np.abs(even.vertices[:, 2]).max() == 0.0


def test_a_torus_keeps_its_volume():
    torus = Mesh(*samples.torus(120, 48))
    before, after = torus.quality(), smooth_mesh(torus, 20, 1.0).quality()
    assert after["volume_ml"] == pytest.approx(before["volume_ml"], rel=tolerances.SMOOTHED_VOLUME)
    assert after["genus"] == 1


def test_faces_that_would_lose_their_area_stay():
    vertices, triangles = samples.box((1000, 0, 0), (2.0**-12, 2.0**-12, 2.0**-12))  # a few units of float32
    smooth = smooth_mesh(Mesh(vertices, triangles), 100, 1.0)
    assert smooth.quality()["zero_area_faces"] == 0


def test_the_default_bound_is_a_quarter_of_the_shortest_step():
    rough = noisy_sphere(0.1)
    with refused(UsageError, "max_deviation_mm"):
        smooth_mesh(rough)
    rough.report["affine_ijk_to_lps_mm"] = np.diag([0.5, 0.4, 2.0, 1.0]).tolist()
    assert smooth_mesh(rough).report["refinement"]["smooth"]["max_deviation_mm"] == pytest.approx(0.1)


def test_the_step_of_a_sheared_affine_is_the_length_of_a_column():
    report = {"affine_ijk_to_lps_mm": [[0.3, 0, 0, 5], [0.4, 0.4, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]]}
    assert default_deviation(Mesh(*samples.box(), None, report)) == 0.25 * 0.4  # the rows are 0.3, 0.57 and 2 long


def test_long_steps_are_shortened_and_keep_their_direction():
    step = np.array([[3.0, 4.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, -4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert shorten_steps(step, 1.0) == 2
    np.testing.assert_allclose(
        step, [[0.6, 0.8, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]], rtol=1e-15
    )


def test_only_vertices_at_a_fault_are_taken_back_at_first():
    vertices, triangles = samples.box()
    step = np.zeros((8, 3))
    step[0] = (1.0, 0.0, 0.0)  # to the place of corner 1: two triangles lose their area
    step[7] = 0.125
    moved, taken_back = move_vertices(vertices.astype(np.float32), triangles.astype(np.uint32), step)
    assert moved[0].tolist() == [0.5, 0.0, 0.0] and moved[7].tolist() == [1.125, 1.125, 1.125]
    assert taken_back == 4  # the corners of these two triangles


@pytest.mark.parametrize("iterations", [0, -1, 1001, 20.0])
def test_impossible_iterations_are_refused(iterations):
    with refused(UsageError, 1, 1000):
        smooth_mesh(noisy_sphere(0.1), iterations, 1.0)


@pytest.mark.parametrize("bound", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_bounds_are_refused(bound):
    with refused(UsageError, "length", 0):
        smooth_mesh(noisy_sphere(0.1), 20, bound)


def test_an_empty_surface_is_refused():
    with pytest.raises(NoSurfaceError, match="nothing to refine"):
        smooth_mesh(Mesh([], []), 20, 1.0)


def test_normals_do_not_depend_on_the_diagonals():
    vertices, triangles = samples.box()
    normals = vertex_normals(vertices.astype(np.float32), triangles.astype(np.uint32))
    np.testing.assert_allclose(normals, (vertices * 2 - 1) / np.sqrt(3), atol=tolerances.MESH_UNIT_NORMAL)


def test_a_vertex_without_faces_has_a_unit_normal():
    normals = vertex_normals(np.zeros((4, 3), np.float32), np.array([[0, 1, 2]], np.uint32))
    np.testing.assert_array_equal(normals, [[0, 0, 1]] * 4)


def test_vertices_that_stay_in_the_way_are_taken_back_wholly():
    """A corner that would go into a larger box by a whole, a half and a quarter step stays where it was."""
    vertices, triangles = samples.join(samples.box(), samples.box((1.25, -5, -5), (10, 10, 10)))
    step = np.zeros((16, 3))
    step[7] = (4.0, 0.0, 0.0)
    moved, taken_back = move_vertices(vertices.astype(np.float32), triangles.astype(np.uint32), step)
    np.testing.assert_array_equal(moved, vertices)
    assert taken_back > 0


def move_by_looking_at_all(vertices, triangles, step):
    """Move vertices as `move_vertices` does, with a look at each triangle that has a changed vertex in each round."""
    share = np.ones(len(vertices))
    moved = as_stored(vertices + step)
    changed = np.ones(len(triangles), bool)
    for turn in range(_ROUNDS):
        spoilt = _find_spoilt(moved, triangles, changed, find_self_intersections)
        if turn >= _ROUNDS_OF_ITS_OWN:
            spoilt = np.unique(triangles[np.isin(triangles, spoilt).any(axis=1)])
        spoilt = spoilt[share[spoilt] > 0.0]
        if len(spoilt) == 0:
            break
        share[spoilt] *= 0.5
        share[spoilt[share[spoilt] < _SMALLEST_SHARE]] = 0.0
        moved[spoilt] = vertices[spoilt] + share[spoilt, None] * step[spoilt]
        changed = np.isin(triangles, spoilt).any(axis=1)
    return moved, int(np.count_nonzero(share < 1.0))


@pytest.mark.parametrize("seed", range(4))
def test_steps_are_taken_back_as_if_all_triangles_were_looked_at_after_each_round(seed):
    """Shells in each other, with wild steps, a flat triangle and vertices at one place: later rounds look at few."""
    random = np.random.default_rng(seed)
    shells = [samples.sphere((0, 0, 0), radius, 5) for radius in (10.0, 10.4)]
    vertices, triangles = samples.join(*shells, samples.sphere((25, 0, 0), 10.0, 5))
    vertices, triangles = vertices.astype(np.float32), triangles.astype(np.uint32)
    vertices[triangles[50, 1]] = vertices[triangles[50, 0]]
    vertices[-1] = vertices[7]
    step = random.normal(0.0, 1.0, vertices.shape) * np.where(random.random((len(vertices), 1)) < 0.1, 0.5, 0.04)
    step[(random.random(len(vertices)) < 0.3) & (vertices[:, 0] > 12)] = 0.0
    looked_at = []

    def find_crossings(places, faces, *more):
        looked_at.append(len(faces))
        return find_self_intersections(places, faces, *more)

    moved, taken_back = move_vertices(vertices, triangles, step, find_crossings)
    expected, count = move_by_looking_at_all(vertices, triangles, step)
    np.testing.assert_array_equal(moved, expected)
    assert taken_back == count > 100
    assert looked_at[0] == len(triangles) and len(looked_at) > 5
    assert max(looked_at[2:]) < 0.5 * len(triangles) and looked_at[-1] < 0.05 * len(triangles)


def test_vertices_in_the_way_back_are_found():
    """Boxes that would go into a wall find another half way, of which nothing lies where they were to go.

    Boxes and walls have blocks of 64 triangles of their own.
    """
    boxes = [samples.box((0.0, 1.5 * number, 0.0)) for number in range(16)]
    walls = [samples.box((place, 1.5 * number, -1.0), (0.2, 1.4, 3.0)) for place in (4.4, 8.4) for number in range(16)]
    vertices, triangles = samples.join(*boxes, *walls)
    step = np.zeros((len(vertices), 3))
    step[: 16 * 8, 0] = 8.0
    moved, taken_back = move_vertices(vertices.astype(np.float32), triangles.astype(np.uint32), step)
    np.testing.assert_allclose(moved, vertices + 0.25 * step, atol=1e-6)
    assert taken_back >= 16 * 8


def test_smoothing_tells_its_three_steps():
    told = []
    smooth_mesh(Mesh(*samples.sphere()), 5, 1.0, progress=lambda *said: told.append(said))
    assert told == [("smooth", step, 3) for step in range(4)]


@pytest.mark.parametrize("iterations", [1, 20, 100, 1000])
def test_a_speck_that_the_filter_draws_into_a_point_keeps_its_volume(iterations):
    """An octahedron whose volume has no gradient after the filter: its steps are shorter, as in a larger mesh."""
    speck = np.concatenate([np.eye(3), -np.eye(3)]) * [0.11, 0.2, 0.3] + [50.0, 0.0, 0.0]
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    alone = Mesh(speck, faces)
    mesh = Mesh(*samples.join((speck, np.array(faces)), samples.sphere((0, 0, 0), RADIUS, 3)))
    smoothed = [smooth_mesh(each, iterations, 0.25) for each in (alone, mesh)]
    for each, smooth in zip((alone, mesh), smoothed, strict=True):
        assert np.isfinite(smooth.vertices).all()
        assert np.linalg.norm(smooth.vertices.astype(float) - each.vertices, axis=1).max() <= 0.25
        assert smooth.quality()["volume_ml"] == pytest.approx(each.quality()["volume_ml"], rel=1e-5)
        assert smooth.report["refinement"]["smooth"]["components_left"] == 0
    np.testing.assert_allclose(smoothed[0].vertices, smoothed[1].vertices[:6], atol=1e-5)
    assert not np.array_equal(smoothed[1].vertices[6:], mesh.vertices[6:])


def test_a_component_whose_volume_no_shift_restores_is_left():
    """A tetrahedron of a hundredth of the bound: half of it beyond the room that its sharp corners leave."""
    flat = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-4]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    smooth = smooth_mesh(flat, 20, 0.01)
    left = smooth.report["refinement"]["smooth"]["components_left"]
    assert left == int(np.array_equal(smooth.vertices, flat.vertices))
    assert smooth.quality()["volume_ml"] == pytest.approx(flat.quality()["volume_ml"], rel=2e-3)


@pytest.mark.parametrize("iterations", [1, 2, 3, 7, 20, 150, 1000])
def test_the_filter_keeps_what_is_constant_and_takes_away_what_is_rough(iterations):
    """A ring of vertices, whose waves are the eigenvectors of the mean of neighbours."""
    count = 64
    ring = np.arange(count)
    rings = Rings(
        2 * np.arange(count + 1, dtype=np.int32),
        np.column_stack([ring + 1, ring - 1]).reshape(-1).astype(np.uint32) % count,
        np.column_stack([ring - 1, ring + 1]).reshape(-1).astype(np.uint32) % count,
        np.full(count, 0.5, np.float32),
    )
    waves = (0, 1, 3, 32)
    low_pass, gains = Filter(rings), []
    for turns in waves:
        places = np.zeros((count, 3), np.float32)
        places[:, 0] = np.cos(2.0 * np.pi * turns * ring / count)
        step = low_pass.find_steps(low_pass.measure_bends(places)[0], sinc_terms(iterations))
        filtered = places[:, 0].astype(float) + step[:, 0]
        gains.append(float(filtered @ places[:, 0]) / float(places[:, 0] @ places[:, 0]))
        np.testing.assert_allclose(filtered, gains[-1] * places[:, 0], atol=2e-5 * iterations**0.5)
    assert gains[0] == 1.0 and gains[1] == pytest.approx(1.0, abs=2e-3) and gains[2] == pytest.approx(1.0, abs=3e-3)
    assert gains[3] < (1.0 if iterations < 20 else 0.01)


def test_vertices_at_borders_and_where_triangles_run_against_each_other_stay():
    vertices, triangles = samples.sphere((0, 0, 0), 1.0, 3)
    turned = triangles.astype(np.uint32).copy()
    turned[5] = turned[5, ::-1]
    still = np.flatnonzero(Rings.of(turned, len(vertices) + 1).weights == 0.0)
    assert still.tolist() == [*sorted(set(turned[5].tolist())), len(vertices)]
    opened = np.delete(triangles.astype(np.uint32), 5, axis=0)
    assert set(np.flatnonzero(Rings.of(opened, len(vertices)).weights == 0.0)) == set(triangles[5].tolist())


def test_a_component_that_loses_its_volume_where_steps_are_taken_back_is_left_as_it_was():
    """A small box beside a wall: one corner cannot move, the others would, and a tenth of the volume would be gone."""
    box, wall = samples.box(), samples.box((1.25, -5, -5), (10, 10, 10))
    vertices, triangles = (part.astype(kind) for part, kind in zip(samples.join(box, wall), "fI", strict=True))
    step = np.zeros((16, 3))
    step[:8] = (0.4, 0.0, 0.0)
    step[0] = 0.0

    def find_changed(now, share):
        return np.arange(8) if (share[:8] < 1.0).any() else np.zeros(0, np.int64)

    moved, taken_back = move_vertices(vertices, triangles, step, find_changed=find_changed)
    np.testing.assert_array_equal(moved[:8], vertices[:8])
    assert taken_back >= 8
