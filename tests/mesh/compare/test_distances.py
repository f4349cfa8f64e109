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
    triangle_distances,
)

pytestmark = pytest.mark.unit

FAR = np.array([-1250.5, 3071.25, -846.25])
TRIANGLE = (np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]], np.uint32))


def rectangle(height: float, size=(30.0, 20.0)) -> samples.Arrays:
    corners = np.array([[0, 0, height], [size[0], 0, height], [*size, height], [0, size[1], height]], dtype=float)
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def test_parallel_planes_lie_their_distance_apart():
    one, other = (Mesh(rectangle(height)[0] + FAR, rectangle(0)[1]) for height in (0.0, 1.25))
    found = compare_meshes(one, other, samples=1000)
    for side in ("to_reference_mm", "from_reference_mm"):
        assert found[side] == pytest.approx(dict.fromkeys(("mean", "rms", "p95", "max"), 1.25))
    assert (found["hd95_mm"], found["assd_mm"], found["max_mm"]) == pytest.approx((1.25, 1.25, 1.25))


def test_concentric_spheres_differ_by_their_radii_and_volumes():
    inner, outer = (Mesh(*samples.sphere(FAR, radius, 5)) for radius in (10.0, 10.5))
    found = compare_meshes(outer, inner, samples=5000)
    for name in ("hd95_mm", "assd_mm", "max_mm"):
        assert found[name] == pytest.approx(0.5, abs=tolerances.SPHERE_SAGITTA_MM)
    assert found["volume_change_percent"] == pytest.approx(100 * (1.05**3 - 1), rel=1e-5)
    assert found["samples"] == 5000


def test_hd95_takes_the_worse_side_and_assd_both():
    plane = Mesh(*rectangle(0.0))
    half = Mesh(*rectangle(0.0, (15.0, 20.0)))
    found = compare_meshes(half, plane, samples=20_000)
    assert found["to_reference_mm"]["max"] == pytest.approx(0.0, abs=1e-12)
    # Beyond the edge at x = 15 the distance grows to 15: 95 % of all points of 30 mm end at 13.5.
    assert found["hd95_mm"] == pytest.approx(13.5, abs=0.01)
    assert found["assd_mm"] == pytest.approx(0.5 * 15.0 / 4.0, abs=0.01)


def test_an_open_surface_without_volume_has_no_change():
    assert compare_meshes(Mesh(*rectangle(0.0)), Mesh(*rectangle(0.0)), 10)["volume_change_percent"] is None


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((1.0, 1.0, 3.0), 3.0),  # over the face
        ((2.0, -5.0, 0.0), 5.0),  # beside an edge
        ((-3.0, -4.0, 0.0), 5.0),  # at a corner
        ((4.0, 4.0, 0.0), np.sqrt(8.0)),  # beside the long edge
        ((2.0, 2.0, 0.0), 0.0),  # on it
    ],
)
def test_distance_to_one_triangle_is_that_of_its_face_edge_or_corner(point, distance):
    vertices, triangles = TRIANGLE
    points = np.array([point]) + FAR
    assert SurfaceDistance(vertices + FAR, triangles)(points) == pytest.approx([distance], abs=1e-9)
    for vertex in range(3):
        near = NearDistance(vertices + FAR, triangles)(points, np.array([vertex]), 0.5)
        assert near == pytest.approx([distance], abs=1e-9)


@pytest.mark.parametrize("scale", [0.125, 1.0, 32.0])
def test_distance_is_exact_over_the_face_each_edge_and_each_corner(scale):
    """A triangle with legs of 3 and 4: on its edges the foot lies at a third, a quarter and half of the way."""
    a, b, c = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    cases = [
        ((1.0, 1.0, 2.0), 2.0),  # over the face
        ((1.0, -2.0, 0.0), 2.0),  # beside each edge
        ((1.0, -3.0, 4.0), 5.0),
        ((-2.0, 1.0, 0.0), 2.0),
        ((1.5 + 4.0, 2.0 + 3.0, 12.0), 13.0),
        ((-3.0, -4.0, 0.0), 5.0),  # beyond each corner
        ((5.0, -2.0, 1.0), 3.0),
        ((-3.0, 8.0, 0.0), 5.0),
        ((1.5, 2.0, 0.0), 0.0),  # on an edge
    ]
    points = scale * np.array([point for point, _ in cases])
    for turned in ((a, b, c), (b, c, a), (c, b, a)):
        corners = [np.repeat(scale * corner[:, None], len(cases), axis=1) for corner in turned]
        found = triangle_distances(points.T, *corners)
        np.testing.assert_allclose(found, [scale * distance for _, distance in cases], rtol=1e-12, atol=1e-12)


def test_each_triangle_around_each_vertex_is_found():
    vertices, triangles = samples.box()
    near = NearDistance(vertices, triangles.astype(np.uint32))
    for vertex in range(8):
        rows = np.flatnonzero((triangles == vertex).any(axis=1))
        centres = vertices[triangles[rows]].mean(axis=1)
        found, nearest = near.find_around(centres, np.full((len(rows), 1), vertex))
        assert nearest.tolist() == rows.tolist()
        np.testing.assert_allclose(found, 0.0, atol=1e-15)


def test_distance_counts_only_the_triangles_around_the_vertex():
    vertices, triangles = samples.box()
    near = NearDistance(vertices, triangles.astype(np.uint32))
    points = np.array([[1.0, 0.75, 0.75], [1.25, 0.75, 0.75], [3.0, 2.0, 1.0], [3.0, 2.0, 3.0]])
    found, rows = near.find_within(points, np.full(4, 7), 0.5)
    np.testing.assert_allclose(found, [0.0, 0.25, np.sqrt(5.0), 3.0], rtol=1e-15)
    assert all(7 in triangles[row] for row in rows)


def test_distances_near_a_vertex_are_exact_or_within_the_limit():
    vertices, triangles = samples.torus(40, 24)
    triangles = triangles.astype(np.uint32)
    rng = np.random.default_rng(3)
    near = rng.integers(0, len(vertices), 500)
    points = vertices[near] + rng.normal(scale=1.5, size=(500, 3))
    exact = SurfaceDistance(vertices, triangles)(points)
    found = NearDistance(vertices, triangles)(points, near, 0.8)
    assert (found >= exact - 1e-9).all()
    assert ((found <= 0.8) | (np.abs(found - exact) < 1e-9)).all()
    assert (found > 0.8).sum() > 50 < (found < 0.8).sum()


def test_samples_cover_the_area_evenly():
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [10, 0, 0], [19, 0, 0], [10, 1, 0], [0, 0, 0]])
    triangles = np.array([[0, 1, 2], [3, 4, 5], [0, 6, 6]], np.uint32)
    points = sample_surface(vertices, triangles, 4000)
    on_second = points[:, 0] >= 10.0
    assert on_second.sum() == 3000  # areas 1.5 and 4.5
    np.testing.assert_allclose(points[on_second].mean(axis=0), [13.0, 1 / 3, 0.0], atol=0.02)
    assert (points[on_second][:, 1] <= 1 - (points[on_second][:, 0] - 10) / 9 + 1e-12).all()
    np.testing.assert_array_equal(points, sample_surface(vertices, triangles, 4000))


@pytest.mark.seconds
def test_nothing_to_measure_is_refused():
    plane = Mesh(*rectangle(0.0))
    with refused(NoSurfaceError, "area"):
        compare_meshes(plane, Mesh([], []))
    with refused(NoSurfaceError, "area"):
        compare_meshes(Mesh([[0, 0, 0], [1, 1, 1]], [[0, 1, 1]]), plane)
    with refused(UsageError, "sample", 1, 0):
        compare_meshes(plane, plane, samples=0)


def test_the_triangles_around_each_of_several_vertices_count():
    vertices, triangles = samples.box()
    near = NearDistance(np.concatenate([vertices, [[5.0, 5.0, 5.0]]]), triangles)  # no triangle uses vertex 8
    points = np.array([[3.0, 1.0, 1.0]] * 5)  # 2 mm from corner 7 and 3 mm from the face around corner 0
    found, rows = near.find_around(points, np.array([[0, 7], [7, 0], [8, 7], [8, 8], [7, 8]]))
    assert found.tolist() == [2.0, 2.0, 2.0, np.inf, 2.0]
    assert (rows == -1).tolist() == [False, False, False, True, False]
    assert all(7 in triangles[row] for row in rows[found == 2.0])


def test_each_sample_lies_in_the_triangle_that_its_share_of_the_area_names():
    """Four triangles of one area after one without: a sample of each, from the second on."""
    corners = np.array([[[3.0 * k, 0, 0], [3.0 * k + 2, 0, 0], [3.0 * k, 1, 0]] for k in range(4)]).reshape(-1, 3)
    triangles = np.concatenate([[[0, 0, 1]], np.arange(12).reshape(-1, 3)]).astype(np.uint32)
    points, rows = sample_surface_points(corners, triangles, 4)
    assert rows.tolist() == [1, 2, 3, 4]
    assert (points[:, 0] // 3.0).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert points[0].tolist() == [0.0, 0.0, 0.0]  # the sequence begins in the first corner
