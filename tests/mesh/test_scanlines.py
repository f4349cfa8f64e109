"""Points inside of a closed surface: against the ball, and surfaces whose vertices lie on the lines themselves."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.mesh.scanlines import cross_lines, fill_surface


def octahedron(radius: float, middle: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices on lines of the lattice, triangles outwards."""
    vertices = middle + radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    triangles = [(a, b, c) if (a + b + c) % 2 else (b, a, c) for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    return vertices, np.array(triangles, np.uint32)


@pytest.mark.parametrize("radius", [3.0, 3.4, 6.0])
def test_points_inside_are_those_of_the_closed_form(radius):
    vertices, triangles = octahedron(radius, 7.0)
    inside = fill_surface(vertices, triangles, (15, 14, 16))
    far = sum(np.abs(axis - 7.0) for axis in np.indices((15, 14, 16)))
    sure = np.abs(far - radius) > 1e-3  # points of the surface itself are on either side
    assert np.array_equal(inside[sure], far[sure] < radius)


def test_lines_are_crossed_at_their_places():
    vertices, triangles = octahedron(5.5, 7.0)
    lines, places, rows = cross_lines(vertices, triangles, (15, 15, 15))
    a, b = lines // 15, lines % 15
    assert np.allclose(np.abs(a - 7) + np.abs(b - 7) + np.abs(places - 7.0), 5.5, atol=1e-4)
    assert (np.bincount(lines) % 2 == 0).all() and set(rows.tolist()) == set(range(8))


def test_mesh_beyond_the_lattice_is_cut():
    vertices, triangles = octahedron(6.0, 1.0)
    inside = fill_surface(vertices, triangles, (4, 3, 5))
    far = sum(np.abs(axis - 1.0) for axis in np.indices((4, 3, 5)))
    sure = np.abs(far - 6.0) > 1e-3
    assert np.array_equal(inside[sure], far[sure] < 6.0)


def test_a_cavity_is_outside():
    outer, inner = octahedron(6.3, 7.0), octahedron(3.3, 7.0)
    vertices, triangles = np.concatenate([outer[0], inner[0]]), np.concatenate([outer[1], inner[1][:, ::-1] + 6])
    inside = fill_surface(vertices, triangles.astype(np.uint32), (15, 15, 15))
    far = sum(np.abs(axis - 7.0) for axis in np.indices((15, 15, 15)))
    assert np.array_equal(inside, (far < 6.3) & (far > 3.3))
