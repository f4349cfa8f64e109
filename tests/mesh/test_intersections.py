"""Self-intersections: bodies that cut each other, against all pairs tried one by one."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh import Mesh
from clrecon.mesh.intersections import count_self_intersections

pytestmark = pytest.mark.unit


def count(arrays: samples.Arrays) -> int:
    mesh = Mesh(*arrays)
    return count_self_intersections(mesh.vertices, mesh.triangles)


def count_by_solving(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """All pairs, all edges: solve for where the edge's line meets the plane of the face."""
    found = 0
    for a in range(len(triangles)):
        for b in range(a):
            if set(triangles[a]) & set(triangles[b]):
                continue
            found += any(
                _edge_meets(vertices[triangles[f]], vertices[triangles[e]], i)
                for f, e in ((a, b), (b, a))
                for i in range(3)
            )
    return found


def _edge_meets(face: np.ndarray, corners: np.ndarray, edge: int) -> bool:
    start, end = corners[edge], corners[(edge + 1) % 3]
    matrix = np.column_stack([face[1] - face[0], face[2] - face[0], start - end])
    if abs(np.linalg.det(matrix)) < 1e-12:
        return False
    u, v, t = np.linalg.solve(matrix, start - face[0])
    return bool(u > 0 and v > 0 and u + v < 1 and 0 < t < 1)


def test_good_surfaces_have_none():
    assert count(samples.torus(60, 30)) == 0
    assert count(samples.sphere((300, -500, 20), 10, 4)) == 0
    assert count(([], [])) == 0


def test_two_triangles():
    flat, upright = [[0, 0, 0], [4, 0, 0], [0, 4, 0]], [[1, 1, -1], [1, 1, 3], [2, 1, 3]]
    assert count((np.array(flat + upright, float), [[0, 1, 2], [3, 4, 5]])) == 1
    above = np.array(flat + upright, float)
    above[3:, 2] += 1.0
    assert count((above, [[0, 1, 2], [3, 4, 5]])) == 0  # a corner touches the face
    assert count((np.array(flat + flat, float), [[0, 1, 2], [3, 4, 5]])) == 0  # one plane


@pytest.mark.parametrize("shift", [(3.1, 0.2, 0.3), (11.0, 4.0, -3.0), (19.5, 0.1, 0.2), (21.0, 0.0, 0.0)])
def test_spheres_that_cut_each_other(shift):
    vertices, triangles = samples.join(samples.sphere(rounds=2), samples.sphere(shift, 10.0, 1))
    vertices = vertices.astype(np.float32).astype(float)
    assert count((vertices, triangles)) == count_by_solving(vertices, triangles)
    assert (count((vertices, triangles)) > 0) == (shift[0] < 20)


def test_random_triangles_of_all_sizes():
    rng = np.random.default_rng(9)
    corners = rng.uniform(0, 10, (60, 1, 3)) + rng.normal(size=(60, 3, 3)) * rng.choice([0.3, 1.0, 4.0], (60, 1, 1))
    vertices = corners.reshape(-1, 3).astype(np.float32).astype(float)
    triangles = np.arange(180).reshape(-1, 3)
    assert count((vertices, triangles)) == count_by_solving(vertices, triangles) > 20
