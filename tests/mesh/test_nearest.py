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


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((1, 1, 2), 2.0),
        ((1, 1, -2), 2.0),
        ((1, 1, 0), 0.0),
        ((4, 0, 0), 0.0),
        ((1, -3, 4), 5.0),
        ((-2, -1, 2), 3.0),
        ((7, 0, 4), 5.0),
        ((2 + 3, 1.5 + 4, 0), 5.0),
        ((2 + 3, 1.5 + 4, 12), 13.0),
    ],
)
def test_nearest_distance_is_exact_over_faces_edges_and_corners(point, distance):
    assert nearest(TRIANGLE, point) == (0, pytest.approx(distance, abs=tolerances.NEAREST_MM))


def test_a_triangle_without_area_is_its_edges():
    line = (np.array([[0, 0, 0], [2, 0, 0], [6, 0, 0]]), np.array([[0, 1, 2]]))
    assert nearest(line, (4, 3, 0))[1] == pytest.approx(3.0)
    spot = (np.array([[1.0, 2, 3]]), np.array([[0, 0, 0]]))
    assert nearest(spot, (1, 2, 7))[1] == pytest.approx(4.0)


def test_a_large_face_beats_a_near_corner():
    """The nearest corner of all belongs to another triangle than the nearest face."""
    large = (np.array([[-50, -50, 0], [50, -50, 0], [0, 80, 0]]), np.array([[0, 1, 2]]))
    small = (np.array([[0, 0, 6], [1, 0, 6], [0, 1, 6]]), np.array([[0, 1, 2]]))
    assert nearest(samples.join(small, large), (0, 0, 2)) == (1, pytest.approx(2.0))
    assert nearest(samples.join(small, large), (0, 0, 5)) == (0, pytest.approx(1.0))


def test_nearest_of_two_equal_triangles_is_the_first():
    mesh = samples.join(samples.box((2, 0, 0)), samples.box((-3, 0, 0)))
    triangle, distance = nearest(mesh, (0, 0.5, 0.5))
    assert distance == pytest.approx(2.0)
    assert triangle < 12


@pytest.mark.parametrize("radius", [0.0, 3.0, 9.9, 14.0])
def test_distance_from_a_sphere_equals_brute_force(radius):
    vertices, triangles = samples.sphere((1000.0, -2000.0, 500.0), 10.0, 4)
    direction = np.array([0.36, -0.48, 0.8])
    point = np.array([1000.0, -2000.0, 500.0]) + radius * direction
    _, distance = nearest((vertices, triangles), point)
    a, b, c = (vertices.astype(np.float32).astype(float)[triangles[:, corner]] for corner in range(3))
    share = np.random.default_rng(4).dirichlet((1, 1, 1), 400)
    sampled = share[:, :1, None] * a + share[:, 1:2, None] * b + share[:, 2:, None] * c
    least = np.linalg.norm(sampled - point, axis=2).min()
    assert distance <= least
    assert distance == pytest.approx(least, abs=tolerances.NEAREST_SAMPLED_MM)


def test_nearest_of_equal_triangles_is_the_first_wherever_they_lie():
    """A point half way between two boxes, whose coordinates are rounded differently at each place."""
    for place in np.random.default_rng(6).uniform(-900, 900, (40, 3)):
        boxes = samples.join(samples.box((2.1, 0, 0)), samples.box((-3.1, 0, 0)))
        triangle, distance = nearest((boxes[0] + place, boxes[1]), place + (0, 0.5, 0.5))
        assert distance == pytest.approx(2.1, abs=1e-3)
        assert triangle < 12


@pytest.mark.parametrize("scale", [0.125, 32.0])
def test_short_and_long_edges_have_the_distance_of_their_scale(scale):
    vertices, triangles = TRIANGLE
    for point, distance in (((1, -3, 4), 5.0), ((7, 0, 4), 5.0), ((-2, 1.5, 0), 2.0), ((5, 5.5, 12), 13.0)):
        found = nearest((scale * vertices, triangles), scale * np.array(point))
        assert found == (0, pytest.approx(scale * distance, rel=1e-12))


def test_only_triangles_whose_box_is_near_are_measured_exactly(monkeypatch):
    measured = []
    exactly = searching._distances_from_origin

    def watch(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        measured.append(len(a))
        return exactly(a, b, c)

    monkeypatch.setattr(searching, "_distances_from_origin", watch)
    squares = samples.join(*(samples.box((3 * k, 0, 0)) for k in range(100)))
    assert nearest(squares, (30.5, 0.5, 2.0))[1] == pytest.approx(1.0)
    assert measured == [2 + 2 * 4]  # of one box: the two faces on top, and two on each side, whose boxes reach up to it
