"""Points inside of a closed surface: against closed forms, of surfaces whose vertices lie on the lines themselves."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

from clrecon.mesh.scanlines import cross_lines, fill_surface

SURFACE = 1e-3
"""Points of a lattice that lie on a surface may count on either side: only those farther from it are compared."""


def octahedron(radius: float, middle: float) -> tuple[np.ndarray, np.ndarray]:
    """Where |x| + |y| + |z| from the middle is the radius: vertices on lines of the lattice, triangles outwards."""
    vertices = middle + radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    triangles = [(a, b, c) if (a + b + c) % 2 else (b, a, c) for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    return vertices, np.array(triangles, np.uint32)


def octahedral_distance(shape: tuple[int, int, int], middle: float) -> np.ndarray:
    """Return |x| + |y| + |z| from the middle, for each point of a lattice."""
    return sum(np.abs(axis - middle) for axis in np.indices(shape))


@pytest.mark.parametrize(
    ("radius", "middle", "shape"),
    [(3.0, 7.0, (15, 14, 16)), (3.4, 7.0, (15, 14, 16)), (6.0, 7.0, (15, 14, 16)), (6.0, 1.0, (4, 3, 5))],
    ids=["corners on points", "corners between points", "large", "cut by the lattice"],
)
def test_filled_points_are_those_nearer_to_the_middle_than_the_octahedron(radius, middle, shape):
    inside = fill_surface(*octahedron(radius, middle), shape)
    distance = octahedral_distance(shape, middle)
    is_clear = np.abs(distance - radius) > SURFACE
    assert inside.any()
    assert np.array_equal(inside[is_clear], distance[is_clear] < radius)


RADIUS, MIDDLE, LENGTH = 5.5, 7.0, 15


@pytest.fixture
def crossings():
    """Numbers of lines, the place of each crossing along its line, and its triangle: an octahedron in a cube."""
    return cross_lines(*octahedron(RADIUS, MIDDLE), (LENGTH, LENGTH, LENGTH))


def test_crossings_lie_on_the_surface(crossings):
    lines, places, _ = crossings
    a, b = np.divmod(lines, LENGTH)
    distance = np.abs(a - MIDDLE) + np.abs(b - MIDDLE) + np.abs(places - MIDDLE)
    assert len(distance) > 0
    np.testing.assert_allclose(distance, RADIUS, atol=tolerances.CROSSING_STEP)


def test_every_line_crosses_a_closed_surface_an_even_number_of_times(crossings):
    lines, _, _ = crossings
    assert len(lines) > 0
    assert (np.bincount(lines) % 2 == 0).all()


def test_every_triangle_of_an_octahedron_is_crossed(crossings):
    _, _, triangles = crossings
    assert set(triangles.tolist()) == set(range(8))


def test_points_in_a_cavity_are_not_filled():
    outer_radius, inner_radius, middle = 6.3, 3.3, 7.0
    (outer, outer_faces), (inner, inner_faces) = octahedron(outer_radius, middle), octahedron(inner_radius, middle)
    triangles = np.concatenate([outer_faces, inner_faces[:, ::-1] + len(outer)]).astype(np.uint32)
    shape = (15, 15, 15)
    inside = fill_surface(np.concatenate([outer, inner]), triangles, shape)
    distance = octahedral_distance(shape, middle)
    assert np.array_equal(inside, (distance < outer_radius) & (distance > inner_radius))
