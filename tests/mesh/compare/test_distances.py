"""Distances between surfaces whose distance is known."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import (
    NearDistance,
    SurfaceDistance,
    compare_meshes,
    sample_surface,
    sample_surface_points,
    summarise_distances,
    triangle_distances,
)

pytestmark = pytest.mark.unit

FAR = np.array([-1250.5, 3071.25, -846.25])
TRIANGLE = (np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]], np.uint32))


def rectangle(z: float, size: tuple[float, float] = (30.0, 20.0)) -> samples.Arrays:
    """Two triangles in a plane at z, from (0, 0) to `size` in x and y."""
    corners = np.array([[0, 0, z], [size[0], 0, z], [*size, z], [0, size[1], z]], dtype=float)
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def concentric_spheres():
    """The comparison of a sphere of 10.5 mm with one of 10 mm about the same centre, from 5000 samples of each."""
    inner, outer = (Mesh(*samples.sphere(FAR, radius=radius, rounds=5)) for radius in (10.0, 10.5))
    return compare_meshes(outer, inner, samples=5000)


PLANES_APART_MM = 1.25


@pytest.fixture(scope="module")
def parallel_planes():
    """The comparison of two planes PLANES_APART_MM apart."""
    (low, triangles), (high, _) = rectangle(0.0), rectangle(PLANES_APART_MM)
    below, above = Mesh(low + FAR, triangles), Mesh(high + FAR, triangles)
    return compare_meshes(below, above, samples=1000)


@pytest.mark.parametrize("side", ["to_reference_mm", "from_reference_mm"])
def test_every_figure_of_parallel_planes_is_their_distance_from_either_side(parallel_planes, side):
    assert parallel_planes[side] == pytest.approx(dict.fromkeys(("mean", "rms", "p95", "max"), PLANES_APART_MM))


def test_figures_of_both_sides_of_parallel_planes_are_their_distance(parallel_planes):
    figures = [parallel_planes[name] for name in ("hd95_mm", "assd_mm", "max_mm")]
    assert figures == pytest.approx([PLANES_APART_MM] * 3)


@pytest.mark.parametrize("figure", ["hd95_mm", "assd_mm", "max_mm"])
def test_concentric_spheres_are_apart_by_the_difference_of_their_radii(concentric_spheres, figure):
    assert concentric_spheres[figure] == pytest.approx(10.5 - 10.0, abs=tolerances.SPHERE_SAGITTA_MM)


def test_volume_change_of_concentric_spheres_is_that_of_the_cubes_of_their_radii(concentric_spheres):
    expected = 100 * ((10.5 / 10.0) ** 3 - 1)
    assert concentric_spheres["volume_change_percent"] == pytest.approx(expected, rel=tolerances.PEER_MEASURE)


def test_a_comparison_says_how_many_samples_it_took(concentric_spheres):
    assert concentric_spheres["samples"] == 5000


def test_hd95_is_that_of_the_worse_side_and_assd_the_mean_of_both():
    """Half of a plane lies on the plane, but the other half of the plane up to 15 mm from it.

    From x = 15 to 30 mm the distance grows evenly from 0 to 15 mm: 95 % of the whole plane ends at 28.5, that is
    13.5 mm.  Its mean is 7.5 mm over half of the plane and 0 over the rest, and 0 from the other side.
    """
    plane, half = Mesh(*rectangle(0.0, (30.0, 20.0))), Mesh(*rectangle(0.0, (15.0, 20.0)))
    measured = compare_meshes(half, plane, samples=20_000)
    assert measured["to_reference_mm"]["max"] == pytest.approx(0.0, abs=tolerances.NEAREST_MM)
    assert measured["hd95_mm"] == pytest.approx(13.5, abs=tolerances.SAMPLED_PLANE_MM)
    assert measured["assd_mm"] == pytest.approx((7.5 / 2 + 0.0) / 2, abs=tolerances.SAMPLED_PLANE_MM)


def test_a_plane_without_volume_has_no_change_of_volume():
    plane = Mesh(*rectangle(0.0))
    assert compare_meshes(plane, plane, samples=10)["volume_change_percent"] is None


points_around_a_triangle = pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((1.0, 1.0, 3.0), 3.0),
        ((2.0, -5.0, 0.0), 5.0),
        ((-3.0, -4.0, 0.0), 5.0),
        ((4.0, 4.0, 0.0), np.sqrt(8.0)),
        ((2.0, 2.0, 0.0), 0.0),
    ],
    ids=["over the face", "beside an edge", "beyond a corner", "beside the long edge", "on the long edge"],
)


@points_around_a_triangle
def test_surface_distance_to_one_triangle_is_that_to_its_face_edge_or_corner(point, distance):
    vertices, triangles = TRIANGLE
    measure = SurfaceDistance(vertices + FAR, triangles)
    assert measure(np.array([point]) + FAR) == pytest.approx([distance], abs=tolerances.FLOAT64_PLACE_MM)


@points_around_a_triangle
@pytest.mark.parametrize("vertex", range(3))
def test_distance_near_any_corner_of_one_triangle_is_that_to_its_face_edge_or_corner(point, distance, vertex):
    vertices, triangles = TRIANGLE
    measure = NearDistance(vertices + FAR, triangles)
    measured, _ = measure.find_around(np.array([point]) + FAR, np.array([[vertex]]))
    assert measured == pytest.approx([distance], abs=tolerances.FLOAT64_PLACE_MM)


DISTANCES_TO_LEGS_OF_3_AND_4 = {
    "over the face": ((1.0, 1.0, 2.0), 2.0),
    "in the plane beside an edge": ((1.0, -2.0, 0.0), 2.0),
    "above and beside an edge": ((1.0, -3.0, 4.0), 5.0),
    "beside the other leg": ((-2.0, 1.0, 0.0), 2.0),
    "above and beside the long edge": ((1.5 + 4.0, 2.0 + 3.0, 12.0), 13.0),
    "beyond the right angle": ((-3.0, -4.0, 0.0), 5.0),
    "beyond the second corner": ((5.0, -2.0, 1.0), 3.0),
    "beyond the third corner": ((-3.0, 8.0, 0.0), 5.0),
    "on the long edge": ((1.5, 2.0, 0.0), 0.0),
}


@pytest.mark.parametrize("scale", [0.125, 1.0, 32.0])
@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
@pytest.mark.parametrize(("point", "distance"), DISTANCES_TO_LEGS_OF_3_AND_4.values(), ids=DISTANCES_TO_LEGS_OF_3_AND_4)
def test_distance_is_exact_over_the_face_each_edge_and_each_corner(point, distance, order, scale):
    corners = scale * np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    columns = [corners[number][:, None] for number in (*order,)]
    measured = triangle_distances(scale * np.array(point)[:, None], *columns)
    assert measured == pytest.approx([scale * distance], rel=tolerances.FLOAT64_SHARE, abs=tolerances.NEAREST_MM)


@pytest.mark.parametrize("vertex", range(8))
def test_the_nearest_triangle_around_a_corner_is_the_one_that_the_point_lies_on(vertex):
    vertices, triangles = samples.box()
    around = np.flatnonzero((triangles == vertex).any(axis=1))
    centres = vertices[triangles[around]].mean(axis=1)
    near = NearDistance(vertices, triangles.astype(np.uint32))
    distances, nearest = near.find_around(centres, np.full((len(around), 1), vertex))
    assert nearest.tolist() == around.tolist()
    np.testing.assert_allclose(distances, 0.0, atol=tolerances.NEAREST_MM)


def test_distance_counts_only_the_triangles_around_the_vertex():
    """Around the corner (1, 1, 1) of a cube lie triangles of the faces x = 1, y = 1 and z = 1."""
    vertices, triangles = samples.box()
    corner = 7  # at (1, 1, 1)
    near = NearDistance(vertices, triangles.astype(np.uint32))
    on_the_face, beside_it, beyond_an_edge, above = [1, 0.75, 0.75], [1.25, 0.75, 0.75], [3, 2, 1], [3, 2, 3]
    points = np.array([on_the_face, beside_it, beyond_an_edge, above], float)
    distances, rows = near.find_around(points, np.full((4, 1), corner))
    expected = [0.0, 0.25, np.hypot(2, 1), np.sqrt(2**2 + 1**2 + 2**2)]
    np.testing.assert_allclose(distances, expected, rtol=tolerances.FLOAT64_SHARE)
    assert (triangles[rows] == corner).any(axis=1).all()


@pytest.fixture(scope="module")
def two_triangles_of_one_and_three_parts_of_the_area():
    """Right triangles with legs of 3 and 1 mm, and of 9 and 1 mm from x = 10 on; the last has no area."""
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [10, 0, 0], [19, 0, 0], [10, 1, 0], [0, 0, 0]])
    return vertices, np.array([[0, 1, 2], [3, 4, 5], [0, 6, 6]], np.uint32)


def test_triangles_have_samples_in_proportion_to_their_area(two_triangles_of_one_and_three_parts_of_the_area):
    vertices, triangles = two_triangles_of_one_and_three_parts_of_the_area
    points = sample_surface(vertices, triangles, 4000)
    on_the_larger = points[:, 0] >= 10.0
    assert on_the_larger.sum() == 3 / 4 * 4000


def test_samples_lie_within_their_triangle_and_evenly_about_its_centre(
    two_triangles_of_one_and_three_parts_of_the_area,
):
    """Of the larger: right-angled at (10, 0), with legs of 9 mm along x and 1 mm along y."""
    vertices, triangles = two_triangles_of_one_and_three_parts_of_the_area
    points = sample_surface(vertices, triangles, 4000)
    x, y, z = points[points[:, 0] >= 10.0].T
    assert (y <= 1 - (x - 10) / 9 + tolerances.NEAREST_MM).all()
    centre = [10 + 9 / 3, 1 / 3, 0.0]
    np.testing.assert_allclose([x.mean(), y.mean(), z.mean()], centre, atol=tolerances.SAMPLED_CENTRE_MM)


def test_sampling_twice_gives_the_same_points(two_triangles_of_one_and_three_parts_of_the_area):
    vertices, triangles = two_triangles_of_one_and_three_parts_of_the_area
    first, second = (sample_surface(vertices, triangles, 4000) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    "without_area",
    [Mesh([], []), Mesh([[0, 0, 0], [1, 1, 1]], [[0, 1, 1]])],
    ids=["empty", "one triangle of two vertices"],
)
def test_comparing_a_mesh_without_area_is_refused(without_area):
    with refused(NoSurfaceError, "area"):
        compare_meshes(Mesh(*rectangle(0.0)), without_area)
    with refused(NoSurfaceError, "area"):
        compare_meshes(without_area, Mesh(*rectangle(0.0)))


@pytest.mark.parametrize("heavy", ["all", "near", "far"])
def test_p95_of_weighted_distances_is_the_one_that_95_percent_of_the_weight_do_not_exceed(heavy):
    random = np.random.default_rng(8)
    distances, weights = random.permutation(np.arange(1000.0)), random.random(1000)
    weights[{"all": slice(0), "near": distances < 500.0, "far": distances >= 900.0}[heavy]] *= 100.0

    p95 = summarise_distances(distances, weights).p95

    assert weights[distances <= p95].sum() >= 0.95 * weights.sum()
    assert weights[distances < p95].sum() < 0.95 * weights.sum()


def test_comparing_without_samples_is_refused():
    with refused(UsageError, "sample", 1, 0):
        compare_meshes(Mesh(*rectangle(0.0)), Mesh(*rectangle(0.0)), samples=0)


def test_the_nearest_triangle_is_looked_for_around_each_of_several_vertices():
    """The point lies 2 mm from the corner 7 of a cube, (1, 1, 1), and 3 mm from the triangles around corner 0."""
    vertices, triangles = samples.box()
    unused = 8
    near = NearDistance(np.concatenate([vertices, [[5.0, 5.0, 5.0]]]), triangles)
    around = np.array([[0, 7], [7, 0], [unused, 7], [7, unused], [unused, unused]])
    distances, rows = near.find_around(np.array([[3.0, 1.0, 1.0]] * 5), around)
    assert distances.tolist() == [2.0, 2.0, 2.0, 2.0, np.inf]
    assert (triangles[rows[:4]] == 7).any(axis=1).all()
    assert rows[4] == -1


FOUR_EQUAL_TRIANGLES = np.array([[[3.0 * k, 0, 0], [3.0 * k + 2, 0, 0], [3.0 * k, 1, 0]] for k in range(4)]).reshape(
    -1, 3
)
ONE_WITHOUT_AREA_AND_FOUR = np.concatenate([[[0, 0, 1]], np.arange(12).reshape(-1, 3)]).astype(np.uint32)


def test_four_samples_of_four_equal_triangles_lie_one_in_each():
    points, rows = sample_surface_points(FOUR_EQUAL_TRIANGLES, ONE_WITHOUT_AREA_AND_FOUR, 4)
    assert rows.tolist() == [1, 2, 3, 4]  # 0 has no area
    assert (points[:, 0] // 3.0).tolist() == [0.0, 1.0, 2.0, 3.0]  # they begin 3 mm apart


def test_the_first_sample_is_the_first_corner_of_the_first_triangle_with_area():
    points, _ = sample_surface_points(FOUR_EQUAL_TRIANGLES, ONE_WITHOUT_AREA_AND_FOUR, 4)
    assert points[0].tolist() == [0.0, 0.0, 0.0]
