"""Smoothing: noise goes, shape and volume stay, nothing moves beyond the bound."""

from __future__ import annotations

from functools import partial

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
from clrecon.mesh.intersections import find_changed_intersections, find_self_intersections
from clrecon.mesh.refine import shifts
from clrecon.mesh.refine.decimation import default_deviation
from clrecon.mesh.refine.shifts import (
    _ROUNDS,
    _ROUNDS_OF_ITS_OWN,
    _SMALLEST_SHARE,
    _find_spoilt,
    as_stored,
    move_vertices,
)
from clrecon.mesh.refine.smoothing import Filter, Rings, sinc_terms, smooth_mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.operators.surface.decimation import follow_crossings

pytestmark = pytest.mark.unit

CENTRE = np.array([-150.25, 1071.5, -846.0])
RADIUS = 20.0


def noisy_sphere(noise: float, seed: int = 1) -> Mesh:
    """A sphere of 20 mm with noise of its radius, in mm."""
    vertices, triangles = samples.sphere((0, 0, 0), radius=1.0, rounds=5)
    lengths = RADIUS + np.random.default_rng(seed).normal(scale=noise, size=len(vertices))
    return Mesh(CENTRE + vertices * lengths[:, None], triangles, report={"iso_value_hu": 300.0})


def noisy_plane(noise: float, size: int = 30) -> Mesh:
    """A square of vertices 1 mm apart, with noise of their z."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(size), np.arange(size)))
    z = np.random.default_rng(2).normal(scale=noise, size=size * size)
    corner = (x + size * y)[(x < size - 1) & (y < size - 1)]
    lower = np.column_stack([corner, corner + 1, corner + size + 1])
    upper = np.column_stack([corner, corner + size + 1, corner + size])
    return Mesh(np.column_stack([x, y, z]), np.concatenate([lower, upper]))


def radial_error(mesh: Mesh) -> np.ndarray:
    """How far each vertex lies outside of the sphere, in mm."""
    return np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS


NOISE_MM = 0.1


@pytest.fixture(scope="module")
def rough_sphere() -> Mesh:
    """A sphere with noise of NOISE_MM of its radius."""
    return noisy_sphere(NOISE_MM)


@pytest.fixture(scope="module")
def smooth_sphere(rough_sphere) -> Mesh:
    return smooth_mesh(rough_sphere, max_deviation_mm=0.5)


def test_noise_on_a_sphere_is_halved_and_the_radius_stays(smooth_sphere):
    error = radial_error(smooth_sphere)
    assert np.std(error) < tolerances.SMOOTHED_NOISE_SHARE * NOISE_MM
    assert abs(error.mean()) < tolerances.SMOOTHED_RADIUS_MM


def test_a_smoothed_sphere_is_closed_and_manifold_with_its_volume_and_triangles(rough_sphere, smooth_sphere):
    quality = smooth_sphere.quality()
    assert (quality["closed"], quality["manifold"], quality["zero_area_faces"]) == (True, True, 0)
    volume_ml = 4 / 3 * np.pi * RADIUS**3 / 1000
    assert quality["volume_ml"] == pytest.approx(volume_ml, rel=tolerances.SMOOTHED_VOLUME)
    np.testing.assert_array_equal(smooth_sphere.triangles, rough_sphere.triangles)


def test_normals_of_a_smoothed_sphere_point_outward(smooth_sphere):
    outward = smooth_sphere.vertices - CENTRE
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.einsum("na,na->n", smooth_sphere.normals, outward).min() > 0.99  # cosine of 8 degrees


def test_report_of_a_smoothed_mesh_keeps_entries_and_has_the_default_number_of_iterations(smooth_sphere):
    assert smooth_sphere.report["iso_value_hu"] == 300.0
    assert smooth_sphere.report["refinement"]["smooth"]["iterations"] == 20


def test_more_iterations_smooth_more(rough_sphere):
    after_5, after_20 = (
        np.std(radial_error(smooth_mesh(rough_sphere, iterations=count, max_deviation_mm=1.0))) for count in (5, 20)
    )
    assert after_20 < after_5 < NOISE_MM


@pytest.fixture(scope="module", params=daily(1, [0.02, 0.1]), ids=lambda bound: f"{bound:g} mm")
def bounded(request):
    """The bound, a sphere with noise of 0.2 mm, and the same smoothed within the bound."""
    bound_mm, rough = request.param, noisy_sphere(0.2)
    return bound_mm, rough, smooth_mesh(rough, max_deviation_mm=bound_mm)


@pytest.mark.release
def test_a_noisy_sphere_that_is_smoothed_freely_moves_by_more_than_three_times_the_bound(bounded):
    bound, rough, _ = bounded
    free = smooth_mesh(rough, max_deviation_mm=10.0)
    assert free.report["refinement"]["smooth"]["vertices_held_back"] == 0
    moved_mm = SurfaceDistance(rough.vertices, rough.triangles)(free.vertices.astype(float)).max()
    assert moved_mm > 3 * bound  # measured 0.51


@pytest.mark.release
def test_no_vertex_is_moved_by_more_than_the_bound_and_those_held_back_are_counted(bounded):
    bound, rough, smooth = bounded
    step = smooth.vertices.astype(float) - rough.vertices
    assert np.linalg.norm(step, axis=1).max() <= bound
    assert smooth.report["refinement"]["smooth"]["vertices_held_back"] > 100  # of 4098; measured 2697


@pytest.mark.release
def test_no_point_of_either_surface_is_further_from_the_other_than_the_bound(bounded):
    """Vertices, and four random points of each triangle."""
    bound, rough, smooth = bounded
    shares = np.random.default_rng(3).dirichlet((1, 1, 1), 4)
    for mesh, other in ((rough, smooth), (smooth, rough)):
        on_triangles = np.einsum("wi,nia->nwa", shares, mesh.vertices[mesh.triangles].astype(float)).reshape(-1, 3)
        points = np.concatenate([mesh.vertices.astype(float), on_triangles])
        assert SurfaceDistance(other.vertices, other.triangles)(points).max() <= bound


@pytest.fixture(scope="module")
def sheets_that_nearly_touch() -> Mesh:
    """Two sheets 0.02 mm apart, the upper with a peak of 3 mm.

    The filter swings below zero beside a peak, as every steep low pass does: here through the sheet below.
    """
    lower, upper = noisy_plane(0.0), noisy_plane(0.0)
    peak = ((upper.vertices[:, :2] - 15) ** 2).sum(axis=1) < 5
    raised = upper.vertices + np.where(peak, 3.02, 0.02)[:, None] * [0, 0, 1] + [0.31, 0.17, 0]
    return Mesh(*samples.join((lower.vertices, lower.triangles), (raised, upper.triangles)))


def count_crossings(vertices: np.ndarray, mesh: Mesh) -> int:
    return len(find_self_intersections(vertices, mesh.triangles))


def test_the_filter_alone_moves_a_sheet_through_another(sheets_that_nearly_touch):
    mesh = sheets_that_nearly_touch
    # The steps of the filter as `smooth_mesh` finds them, in its 20 iterations, before any is taken back.
    low_pass = Filter(Rings.of(mesh.triangles, mesh.vertex_count))
    step = low_pass.find_steps(low_pass.measure_bends(mesh.vertices)[0], sinc_terms(20))
    assert count_crossings(mesh.vertices, mesh) == 0
    assert count_crossings(mesh.vertices + step, mesh) > 0


def test_vertices_are_taken_back_so_that_smoothed_sheets_do_not_cut_each_other(sheets_that_nearly_touch):
    smooth = smooth_mesh(sheets_that_nearly_touch, max_deviation_mm=1.0)
    taken_back = smooth.report["refinement"]["smooth"]["vertices_taken_back"]
    assert count_crossings(smooth.vertices, smooth) == 0
    assert 0 < taken_back < 0.2 * smooth.vertex_count  # those beside the peak


def test_a_thin_shell_keeps_its_volume():
    """A wall of 0.3 mm that the filter alone, which moves it by hundredths, would make thinner by a large share."""
    outer, inner = noisy_sphere(0.05), noisy_sphere(0.05, seed=2)
    shrunken = CENTRE + (inner.vertices - CENTRE) * ((RADIUS - 0.3) / RADIUS)
    mesh = Mesh(*samples.join((outer.vertices, outer.triangles), (shrunken, inner.triangles[:, ::-1])))
    smooth = smooth_mesh(mesh, max_deviation_mm=0.3)
    assert smooth.volume == pytest.approx(mesh.volume, rel=tolerances.SHELL_VOLUME)


def test_smoothing_joins_no_vertices_where_float32_is_coarse():
    """A sphere of 2 micrometres 1400 mm from the origin: STL would join vertices at one place, and be open."""
    mesh = Mesh(*samples.sphere((800.0, -790.0, 805.0), radius=2.0**-9, rounds=3))
    smooth = smooth_mesh(mesh, iterations=100, max_deviation_mm=1.0)
    assert len(find_coincident(smooth.vertices)) <= len(find_coincident(mesh.vertices))


def test_a_noisy_plane_is_flattened_and_its_border_stays():
    rough = noisy_plane(0.1)
    smooth = smooth_mesh(rough, iterations=40, max_deviation_mm=1.0)
    x_y = rough.vertices[:, :2]
    border = np.isin(x_y, (0.0, 29.0)).any(axis=1)  # of 30 x 30 vertices
    inner = ((x_y > 6) & (x_y < 23)).all(axis=1)
    np.testing.assert_array_equal(smooth.vertices[border], rough.vertices[border])
    assert np.std(smooth.vertices[inner, 2]) < tolerances.SMOOTHED_NOISE_SHARE * np.std(rough.vertices[inner, 2])


def test_a_flat_plane_stays_flat():
    flat = smooth_mesh(noisy_plane(0.0, size=30), max_deviation_mm=1.0)
    assert flat.vertices[:, 2].tolist() == [0.0] * 30**2


def test_a_torus_keeps_its_volume_and_its_handle():
    torus = Mesh(*samples.torus(rings=120, sides=48))
    quality = smooth_mesh(torus, max_deviation_mm=1.0).quality()
    assert quality["volume_ml"] == pytest.approx(torus.quality()["volume_ml"], rel=tolerances.SMOOTHED_VOLUME)
    assert quality["genus"] == 1


def test_no_face_of_a_tiny_box_loses_its_area():
    """Its edges are 4 steps of float32 at 1000 mm long."""
    edge = 2.0**-12
    box = Mesh(*samples.box((1000, 0, 0), size=(edge, edge, edge)))
    five_times_the_default = 100
    four_thousand_edges = 1.0  # mm: so wide a bound holds no vertex back
    smooth = smooth_mesh(box, iterations=five_times_the_default, max_deviation_mm=four_thousand_edges)
    assert smooth.quality()["zero_area_faces"] == 0


def test_the_default_bound_is_a_quarter_of_the_shortest_step_of_the_affine():
    rough = noisy_sphere(0.1)
    rough.report["affine_ijk_to_lps_mm"] = np.diag([0.5, 0.4, 2.0, 1.0]).tolist()
    bound = smooth_mesh(rough).report["refinement"]["smooth"]["max_deviation_mm"]
    assert bound == pytest.approx(0.4 / 4)


def test_smoothing_a_mesh_without_an_affine_needs_a_bound():
    with refused(UsageError, "max_deviation_mm"):
        smooth_mesh(noisy_sphere(0.1))


def test_the_default_bound_of_a_sheared_affine_is_a_quarter_of_its_shortest_column():
    """The columns are 0.5, 0.4 and 2 mm long, the rows 0.3, 0.57 and 2."""
    report = {"affine_ijk_to_lps_mm": [[0.3, 0, 0, 5], [0.4, 0.4, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]]}
    assert default_deviation(Mesh(*samples.box(), report=report)) == 0.4 / 4


def test_only_vertices_at_a_fault_are_taken_back_by_half_a_step_at_first():
    """Corner 0 of a box goes to the place of corner 1: two triangles lose their area, with four corners."""
    vertices, triangles = samples.box()
    step = np.zeros((8, 3))
    step[0] = (1.0, 0.0, 0.0)
    step[7] = 0.125  # the corner (1, 1, 1)
    moved, taken_back = move_vertices(vertices.astype(np.float32), triangles.astype(np.uint32), step)
    assert moved[0].tolist() == [0.5, 0.0, 0.0]
    assert moved[7].tolist() == [1.125, 1.125, 1.125]
    assert taken_back == 4


@pytest.mark.parametrize("iterations", [0, -1, 1001, 20.0])
def test_iterations_that_are_no_whole_number_from_1_to_1000_are_refused(iterations):
    with refused(UsageError, 1, 1000):
        smooth_mesh(noisy_sphere(0.1), iterations, max_deviation_mm=1.0)


@pytest.mark.parametrize("bound", [0.0, -1.0, float("nan"), float("inf")])
def test_bounds_that_are_no_finite_length_above_0_are_refused(bound):
    with refused(UsageError, "length", 0):
        smooth_mesh(noisy_sphere(0.1), max_deviation_mm=bound)


def test_smoothing_an_empty_mesh_is_refused():
    with refused(NoSurfaceError, "nothing", "refine"):
        smooth_mesh(Mesh([], []), max_deviation_mm=1.0)


def test_normals_at_corners_of_a_box_lie_along_its_diagonals_however_its_faces_are_cut():
    vertices, triangles = samples.box()
    normals = vertex_normals(vertices.astype(np.float32), triangles.astype(np.uint32))
    np.testing.assert_allclose(normals, (vertices * 2 - 1) / np.sqrt(3), atol=tolerances.MESH_UNIT_NORMAL)


def test_vertices_without_an_area_around_them_have_the_normal_0_0_1():
    """Three corners of a triangle without area, and a vertex of no triangle."""
    normals = vertex_normals(np.zeros((4, 3), np.float32), np.array([[0, 1, 2]], np.uint32))
    np.testing.assert_array_equal(normals, [[0, 0, 1]] * 4)


def test_vertices_that_stay_in_the_way_at_every_share_of_their_step_are_taken_back_wholly():
    """A corner that would go into a larger box by a whole, a half and a quarter step stays where it was."""
    vertices, triangles = samples.join(samples.box(), samples.box((1.25, -5, -5), size=(10, 10, 10)))
    step = np.zeros((16, 3))
    step[7] = (4.0, 0.0, 0.0)  # the corner (1, 1, 1), 0.25 mm from the larger box
    moved, taken_back = move_vertices(vertices.astype(np.float32), triangles.astype(np.uint32), step)
    np.testing.assert_array_equal(moved, vertices)
    assert taken_back > 0


def move_by_looking_at_all(vertices, triangles, step):
    """Move vertices as `move_vertices` does, with a look at each triangle that has a changed vertex in each round."""
    share = np.ones(len(vertices))
    moved = as_stored(vertices + step)
    changed: np.ndarray = np.ones(len(triangles), bool)
    for turn in range(_ROUNDS):
        spoilt = _find_spoilt(moved, triangles, changed)
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


@pytest.fixture(scope="module", params=range(4))
def shells_with_wild_steps(request):
    """Vertices, triangles and steps: two shells in each other and a sphere, a flat triangle, vertices at one place."""
    random = np.random.default_rng(request.param)
    shells = [samples.sphere((0, 0, 0), radius=radius, rounds=5) for radius in (10.0, 10.4)]
    vertices, triangles = samples.join(*shells, samples.sphere((25, 0, 0), radius=10.0, rounds=5))
    vertices, triangles = vertices.astype(np.float32), triangles.astype(np.uint32)
    vertices[triangles[50, 1]] = vertices[triangles[50, 0]]
    vertices[-1] = vertices[7]
    step = random.normal(0.0, 1.0, vertices.shape) * np.where(random.random((len(vertices), 1)) < 0.1, 0.5, 0.04)
    step[(random.random(len(vertices)) < 0.3) & (vertices[:, 0] > 12)] = 0.0
    return vertices, triangles, step


def test_steps_are_taken_back_as_if_all_triangles_were_looked_at_after_each_round(shells_with_wild_steps):
    vertices, triangles, step = shells_with_wild_steps
    moved, taken_back = move_vertices(vertices, triangles, step)
    expected, count = move_by_looking_at_all(vertices, triangles, step)
    np.testing.assert_array_equal(moved, expected)
    assert taken_back == count > 1000  # of 12,294 vertices; measured 2,700 and more


def test_steps_are_taken_back_alike_where_a_device_marks_what_is_looked_at(shells_with_wild_steps, device):
    vertices, triangles, step = shells_with_wild_steps
    follow = partial(follow_crossings, device, fewest=1)
    moved, taken_back = move_vertices(vertices, triangles, step, follow=follow)
    expected, count = move_vertices(vertices, triangles, step)
    np.testing.assert_array_equal(moved, expected)
    assert taken_back == count


def test_steps_of_a_surface_of_which_a_device_marks_nothing_are_made(device):
    vertices, triangles = samples.torus(rings=20, sides=10)
    vertices, triangles = vertices.astype(np.float32), np.asarray(triangles, np.uint32)
    follow = partial(follow_crossings, device, fewest=1)
    moved, taken_back = move_vertices(vertices, triangles, np.full(vertices.shape, 0.5), follow=follow)
    np.testing.assert_array_equal(moved, (vertices + 0.5).astype(np.float32))
    assert taken_back == 0


def test_rounds_after_the_second_look_at_less_than_half_and_the_last_at_a_twentieth_of_the_triangles(
    shells_with_wild_steps, monkeypatch
):
    vertices, triangles, step = shells_with_wild_steps
    looked_at = []

    def count_and_find_crossings(places, faces, changed):
        looked_at.append(len(faces))
        return find_changed_intersections(places, faces, changed)

    monkeypatch.setattr(shifts, "find_changed_intersections", count_and_find_crossings)
    move_vertices(vertices, triangles, step)
    assert len(looked_at) > 5  # rounds; measured 6 and 7
    assert looked_at[0] == len(triangles)
    assert max(looked_at[2:]) < 0.5 * len(triangles)  # measured 0.28 to 0.33, and 0.69 in the second round
    assert looked_at[-1] < 0.05 * len(triangles)  # measured 0.013 to 0.018


def test_vertices_that_would_stop_in_the_way_back_of_others_are_taken_back_again():
    """Boxes of 1 mm are to go 8 mm along x, where each would cut a wall, and half way another: they go a quarter.

    The wall half way cuts nothing at the end of the step.  Boxes and walls have blocks of 64 triangles of their own.
    """
    half_way, at_the_end = 4.4, 8.4  # x of walls 0.2 mm thick: within boxes from 4 to 5 mm and from 8 to 9 mm
    boxes = [samples.box((0.0, 1.5 * number, 0.0)) for number in range(16)]
    walls = [
        samples.box((x, 1.5 * number, -1.0), size=(0.2, 1.4, 3.0))
        for x in (half_way, at_the_end)
        for number in range(16)
    ]
    vertices, triangles = samples.join(*boxes, *walls)
    step = np.zeros((len(vertices), 3))
    step[: 16 * 8, 0] = 8.0
    moved, taken_back = move_vertices(vertices.astype(np.float32), triangles.astype(np.uint32), step)
    np.testing.assert_allclose(moved, vertices + 0.25 * step, atol=1e-6)  # mm, float32
    assert taken_back >= 16 * 8  # the corners of the boxes


def test_smoothing_tells_its_three_steps():
    steps = []
    smooth_mesh(Mesh(*samples.sphere()), iterations=5, max_deviation_mm=1.0, progress=lambda *step: steps.append(step))
    assert steps == [("smooth", done, 3) for done in range(4)]


SPECK_BOUND_MM = 0.25


@pytest.fixture(scope="module", params=[1, 20, 100, 1000], ids=lambda count: f"{count} iterations")
def speck(request):
    """An octahedron whose volume has no gradient after the filter, and the same beside a sphere: before and after."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * [0.11, 0.2, 0.3] + [50.0, 0.0, 0.0]
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    alone = Mesh(corners, faces)
    beside_a_sphere = Mesh(
        *samples.join((corners, np.array(faces)), samples.sphere((0, 0, 0), radius=RADIUS, rounds=3))
    )
    return [(mesh, smooth_mesh(mesh, request.param, SPECK_BOUND_MM)) for mesh in (alone, beside_a_sphere)]


@pytest.mark.parametrize("which", [0, 1], ids=["alone", "beside a sphere"])
def test_a_speck_that_the_filter_draws_into_a_point_keeps_its_volume_within_the_bound(speck, which):
    rough, smooth = speck[which]
    step = smooth.vertices.astype(float) - rough.vertices
    assert np.linalg.norm(step, axis=1).max() <= SPECK_BOUND_MM  # which no NaN is
    assert smooth.volume == pytest.approx(rough.volume, rel=tolerances.PEER_MEASURE)
    assert smooth.report["refinement"]["smooth"]["components_left"] == 0


def test_a_speck_is_smoothed_alone_as_beside_a_sphere(speck):
    (_, alone), (_, beside_a_sphere) = speck
    np.testing.assert_allclose(alone.vertices, beside_a_sphere.vertices[:6], atol=tolerances.MOVED_VERTEX_MM)


def test_a_sphere_beside_a_speck_is_smoothed(speck):
    _, (rough, smooth) = speck
    first_of_the_sphere = 6  # behind the corners of the octahedron
    assert not np.array_equal(smooth.vertices[first_of_the_sphere:], rough.vertices[first_of_the_sphere:])


def test_a_component_is_left_as_it_was_or_keeps_its_volume_where_the_bound_leaves_little_room():
    """A tetrahedron of a hundredth of the bound: half of it beyond the room that its sharp corners leave."""
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    flat = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-4]], faces)
    smooth = smooth_mesh(flat, max_deviation_mm=0.01)
    left = smooth.report["refinement"]["smooth"]["components_left"]
    assert left == np.array_equal(smooth.vertices, flat.vertices)
    assert smooth.volume == pytest.approx(flat.volume, rel=tolerances.SMOOTHED_VOLUME)


RING = 64
"""Vertices of a ring, whose waves are the eigenvectors of the mean of neighbours."""


def filter_wave(turns: int, iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """A cosine with so many turns around the ring, before and after the filter."""
    ring = np.arange(RING)
    after_before, before_after = (
        np.column_stack(pair).reshape(-1).astype(np.uint32) % RING
        for pair in ([ring + 1, ring - 1], [ring - 1, ring + 1])
    )
    begin = 2 * np.arange(RING + 1, dtype=np.int32)
    rings = Rings(begin, after_before, before_after, np.full(RING, 0.5, np.float32))
    places = np.zeros((RING, 3), np.float32)
    places[:, 0] = np.cos(2.0 * np.pi * turns * ring / RING)
    low_pass = Filter(rings)
    step = low_pass.find_steps(low_pass.measure_bends(places)[0], sinc_terms(iterations))
    return places[:, 0], places[:, 0].astype(float) + step[:, 0]


def measure_gain(turns: int, iterations: int) -> float:
    """The amplitude of such a wave after the filter, as a share of that before."""
    wave, filtered = filter_wave(turns, iterations)
    return float(filtered @ wave) / float(wave @ wave)


for_few_and_many_iterations = pytest.mark.parametrize("iterations", [1, 2, 3, 7, 20, 150, 1000])


@for_few_and_many_iterations
@pytest.mark.parametrize("turns", [0, 1, 3, 32])
def test_a_wave_around_a_ring_stays_a_wave(turns, iterations):
    wave, filtered = filter_wave(turns, iterations)
    rounding = 2e-5 * iterations**0.5  # of float32, in each iteration
    np.testing.assert_allclose(filtered, measure_gain(turns, iterations) * wave, atol=rounding)


@for_few_and_many_iterations
def test_the_filter_keeps_a_constant_exactly_and_long_waves_within_3_per_mille(iterations):
    assert measure_gain(0, iterations) == 1.0
    assert measure_gain(1, iterations) == pytest.approx(1.0, abs=2e-3)
    assert measure_gain(3, iterations) == pytest.approx(1.0, abs=3e-3)


@for_few_and_many_iterations
def test_the_filter_damps_the_shortest_wave_and_removes_it_from_20_iterations_on(iterations):
    """Neighbours with opposite signs.

    Measured: 0.999 of the wave after 1 iteration, 0.47 after 7, and less than 1e-6, of float32, from 20 on.
    """
    assert measure_gain(RING // 2, iterations) < (1.0 if iterations < 20 else 0.01)


@pytest.fixture
def sphere_triangles():
    """The number of vertices of a sphere, and its triangles."""
    vertices, triangles = samples.sphere((0, 0, 0), radius=1.0, rounds=3)
    return len(vertices), triangles.astype(np.uint32)


def list_still(triangles: np.ndarray, count: int) -> set[int]:
    """Vertices that the filter does not move."""
    return set(np.flatnonzero(Rings.of(triangles, count).weights == 0.0).tolist())


def test_vertices_of_a_flipped_triangle_and_of_none_stay(sphere_triangles):
    count, triangles = sphere_triangles
    corners = triangles[5].tolist()  # any
    triangles[5] = corners[::-1]
    assert list_still(triangles, count + 1) == {*corners, count}


def test_vertices_at_a_border_stay(sphere_triangles):
    count, triangles = sphere_triangles
    any_of_them = 5
    assert list_still(np.delete(triangles, any_of_them, axis=0), count) == set(triangles[any_of_them].tolist())


def test_a_component_that_loses_its_volume_where_steps_are_taken_back_is_left_as_it_was():
    """A small box beside a wall: one corner cannot move, the others would, and a tenth of the volume would be gone."""
    box, wall = samples.box(), samples.box((1.25, -5, -5), size=(10, 10, 10))
    vertices, triangles = samples.join(box, wall)
    step = np.zeros((16, 3))
    step[:8] = (0.4, 0.0, 0.0)
    step[0] = 0.0

    def find_changed(now, share):  # the whole box, once a step of one of its corners is taken back
        return np.arange(8) if (share[:8] < 1.0).any() else np.zeros(0, np.int64)

    moved, taken_back = move_vertices(
        vertices.astype(np.float32), triangles.astype(np.uint32), step, find_changed=find_changed
    )
    np.testing.assert_array_equal(moved[:8], vertices[:8])
    assert taken_back >= 8  # the corners of the box; measured 12, with those of the wall that it cut
