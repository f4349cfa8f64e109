"""The triangle nearest to a point: faces, edges, corners, and against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances

from clrecon.mesh import triangles as searching
from clrecon.mesh.triangles import find_nearest_triangle

pytestmark = pytest.mark.unit

TRIANGLE = (np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0]], np.float32), np.array([[0, 1, 2]], np.uint32))


def nearest(mesh, point):
    vertices, triangles = mesh
    return find_nearest_triangle(vertices.astype(np.float32), triangles.astype(np.uint32), np.array(point, float))


POINTS_AND_DISTANCES = {
    "above the face": ((1, 1, 2), 2.0),
    "below the face": ((1, 1, -2), 2.0),
    "in the face": ((1, 1, 0), 0.0),
    "at a corner": ((4, 0, 0), 0.0),
    "beside an edge": ((1, -3, 4), 5.0),
    "beyond one corner": ((-2, -1, 2), 3.0),
    "beyond another corner": ((7, 0, 4), 5.0),
    "beside the long edge": ((2 + 3, 1.5 + 4, 0), 5.0),
    "beside the long edge and above": ((2 + 3, 1.5 + 4, 12), 13.0),
}


@pytest.mark.parametrize(("point", "distance"), POINTS_AND_DISTANCES.values(), ids=POINTS_AND_DISTANCES)
def test_nearest_distance_is_exact_over_faces_edges_and_corners(point, distance):
    assert nearest(TRIANGLE, point) == (0, pytest.approx(distance, abs=tolerances.NEAREST_MM))


@pytest.mark.parametrize(
    ("vertices", "triangle", "point", "distance"),
    [([[0, 0, 0], [2, 0, 0], [6, 0, 0]], [0, 1, 2], (4, 3, 0), 3.0), ([[1.0, 2, 3]], [0, 0, 0], (1, 2, 7), 4.0)],
    ids=["line", "point"],
)
def test_distance_to_a_triangle_without_area_is_that_to_its_edges(vertices, triangle, point, distance):
    assert nearest((np.array(vertices), np.array([triangle])), point) == (0, pytest.approx(distance))


@pytest.mark.parametrize(
    ("point", "triangle", "distance"),
    [((0, 0, 2), 1, 2.0), ((0, 0, 5), 0, 1.0)],
    ids=["near the large face", "near the small triangle"],
)
def test_the_nearest_face_is_found_where_the_nearest_corner_belongs_to_another_triangle(point, triangle, distance):
    """The small triangle lies 6 mm over the middle of the large one, whose corners are 70 mm away."""
    small = (np.array([[0, 0, 6], [1, 0, 6], [0, 1, 6]]), np.array([[0, 1, 2]]))
    large = (np.array([[-50, -50, 0], [50, -50, 0], [0, 80, 0]]), np.array([[0, 1, 2]]))
    assert nearest(samples.join(small, large), point) == (triangle, pytest.approx(distance))


def test_of_triangles_at_equal_distance_the_first_is_found():
    """The origin lies 2 mm from a box of 12 triangles on the right, and from one on the left."""
    mesh = samples.join(samples.box((2, 0, 0)), samples.box((-3, 0, 0)))
    triangle, distance = nearest(mesh, (0, 0.5, 0.5))
    assert distance == pytest.approx(2.0)
    assert triangle < 12


@pytest.mark.parametrize("from_centre_mm", [0.0, 3.0, 9.9, 14.0])
def test_distance_to_a_sphere_is_that_to_the_nearest_of_many_points_on_its_triangles(from_centre_mm):
    centre = np.array([1000.0, -2000.0, 500.0])
    vertices, triangles = samples.sphere(centre, radius=10.0, rounds=4)
    point = centre + from_centre_mm * np.array([0.36, -0.48, 0.8])  # a direction of length 1

    _, distance = nearest((vertices, triangles), point)

    a, b, c = (vertices.astype(np.float32).astype(float)[triangles[:, corner]] for corner in range(3))
    share = np.random.default_rng(4).dirichlet((1, 1, 1), 400)  # 400 points on each triangle
    points_on_triangles = share[:, :1, None] * a + share[:, 1:2, None] * b + share[:, 2:, None] * c
    least = np.linalg.norm(points_on_triangles - point, axis=2).min()
    assert distance <= least
    assert distance == pytest.approx(least, abs=tolerances.NEAREST_SAMPLED_MM)


@pytest.mark.parametrize("seed", range(40))
def test_of_triangles_at_equal_distance_the_first_is_found_wherever_they_lie(seed):
    """A point half way between two boxes, whose coordinates are rounded differently at each place."""
    place = np.random.default_rng(seed).uniform(-900, 900, 3)
    first, second = samples.box((2.1, 0, 0)), samples.box((-3.1, 0, 0))  # 1 mm wide: both 2.1 mm away
    vertices, triangles = samples.join(first, second)
    triangle, distance = nearest((vertices + place, triangles), place + (0, 0.5, 0.5))
    assert distance == pytest.approx(2.1, abs=tolerances.FLOAT32_POINT_MM)
    assert triangle < len(first[1])  # of its 12 triangles


@pytest.mark.parametrize("scale", [0.125, 32.0])
@pytest.mark.parametrize(
    ("point", "distance"),
    [((1, -3, 4), 5.0), ((7, 0, 4), 5.0), ((-2, 1.5, 0), 2.0), ((5, 5.5, 12), 13.0)],
    ids=["beside an edge", "beyond a corner", "beside another edge", "beside the long edge"],
)
def test_distance_to_a_larger_or_smaller_triangle_is_larger_or_smaller_alike(point, distance, scale):
    vertices, triangles = TRIANGLE
    scaled = nearest((scale * vertices, triangles), scale * np.array(point))
    assert scaled == (0, pytest.approx(scale * distance, rel=tolerances.FLOAT64_SHARE))


def test_only_triangles_whose_box_is_near_are_measured_exactly(monkeypatch):
    """A row of 100 cubes, and a point 1 mm over one of them."""
    measured = []
    measure = searching._distances_from_origin

    def count_and_measure(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        measured.append(len(a))
        return measure(a, b, c)

    monkeypatch.setattr(searching, "_distances_from_origin", count_and_measure)
    cubes = samples.join(*(samples.box((3 * k, 0, 0)) for k in range(100)))
    _, distance = nearest(cubes, (30.5, 0.5, 2.0))

    assert distance == pytest.approx(1.0)
    on_top, on_the_sides = 2, 4 * 2  # triangles of one cube: the boxes of those on its sides reach up to the top
    assert measured == [on_top + on_the_sides]
