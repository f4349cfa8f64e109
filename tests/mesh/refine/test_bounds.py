"""Upper bounds of distances to a surface, by numpy: the twin of those on a device."""

from __future__ import annotations

import numpy as np
import pytest
from near_surfaces import FLAT_BOUND, FLAT_CASES, flat_case, sheet

from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.mesh.refine.deviation import SurfaceBounds

pytestmark = pytest.mark.unit


def test_bounds_are_those_of_the_nearest_triangle_around_the_hints():
    vertices, triangles = sheet(9)
    bounds = SurfaceBounds(vertices, triangles)
    points = np.array([[1.4, 1.2, 0.5], [6.4, 1.2, -0.25], [3.0, 3.0, 2.0]])
    home, away = 1 + 9, 7 + 9 * 7
    length, rows = bounds.find_bounds(points, np.array([[home], [6 + 9], [away]]), 0.0)
    assert length[:2] == pytest.approx([0.5, 0.25], abs=1e-4)
    assert rows[:2].tolist() == [1 + 8, 6 + 8]  # lower triangles of their cells
    assert length[2] == pytest.approx(np.sqrt(9 + 9 + 4), abs=1e-4)  # the corner (6, 6) is the nearest around (7, 7)
    length, _ = bounds.find_bounds(points, np.array([[away], [away], [away]]), 0.0, walks=7)
    assert length == pytest.approx([0.5, 0.25, 2.0], abs=1e-4)
    # The first hint is enough within its limit; without, the second is nearer.
    two = np.array([[away, home]] * 3)
    assert bounds.find_bounds(points[:1], two[:1], 9.0)[0] > 5.0
    assert bounds.find_bounds(points[:1], two[:1], 5.0)[0] == pytest.approx([0.5], abs=1e-4)


def test_vertices_without_triangles_bound_nothing():
    vertices, triangles = sheet(4)
    bounds = SurfaceBounds(np.concatenate([vertices, [[9.0, 9.0, 9.0]]]), triangles)
    length, rows = bounds.find_bounds(np.array([[0.3, 0.2, 1.0]] * 2), np.array([[16, 16], [16, 0]]), 0.0, walks=2)
    assert np.isinf(length[0]) and rows[0] == -1
    assert length[1] == pytest.approx(1.0, abs=1e-4) and rows[1] == 0
    assert bounds.find_bounds(np.zeros((0, 3)), np.zeros((0, 2), int), 1.0)[0].shape == (0,)


@pytest.mark.parametrize("case", FLAT_CASES)
def test_witnesses_are_the_faces_within_the_limit(case):
    bounds, arguments, expected = flat_case(SurfaceBounds, case)
    witnesses, left = bounds.find_witnesses(*arguments, FLAT_BOUND)
    assert (witnesses[:, 0].tolist(), int(left[0])) == expected


def test_bounds_are_never_less_than_the_distance():
    rng = np.random.default_rng(8)
    vertices, triangles = sheet(16)
    vertices = vertices + rng.normal(0.0, 0.3, vertices.shape)
    points = rng.uniform(0.0, 15.0, (900, 3)) * [1, 1, 0.1]
    exact = SurfaceDistance(vertices, triangles)(points)
    near = rng.integers(0, 256, (900, 2))
    bounds = SurfaceBounds(vertices, triangles)
    before = np.full(900, np.inf)
    for walks in (0, 1, 4, 40):
        length, rows = bounds.find_bounds(points, near, 0.0, walks)
        assert (length >= exact).all() and (length <= before).all() and (rows >= 0).all()
        before = length
    assert np.mean(length < exact + 1e-3) > 0.4  # in a rough surface walks end in dents
