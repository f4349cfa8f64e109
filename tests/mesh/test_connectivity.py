"""Fans: the triangles around vertices."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh.connectivity import Fans, find_used, number_used

pytestmark = pytest.mark.unit


@pytest.fixture
def fans_of_three_triangles():
    """Triangle 0 has the vertices 0, 1, 2; triangle 1: 2, 1, 4; triangle 2: 4, 1, 0; no triangle has 3 or 5."""
    return Fans(np.array([[0, 1, 2], [2, 1, 4], [4, 1, 0]], np.uint32), 6)


def test_fans_list_the_triangles_around_each_given_vertex_and_their_number(fans_of_three_triangles):
    rows, count = fans_of_three_triangles.around(np.array([1, 3, 0, 5, 4]))
    assert rows.tolist() == [0, 1, 2] + [] + [0, 2] + [] + [1, 2]
    assert count.tolist() == [3, 0, 2, 0, 2]


@pytest.mark.parametrize(
    ("vertices", "triangles"), [([2, 3], [0, 1]), ([4, 1, 4], [0, 1, 2]), ([], [])], ids=["two", "one twice", "none"]
)
def test_triangles_that_touch_any_of_some_vertices_are_listed_once(fans_of_three_triangles, vertices, triangles):
    assert fans_of_three_triangles.touching(np.array(vertices, int)).tolist() == triangles


def test_fans_begin_where_those_of_the_vertices_before_end(fans_of_three_triangles):
    triangles_at_vertices = [2, 3, 2, 0, 2, 0]
    assert fans_of_three_triangles.begin.tolist() == [0, *np.cumsum(triangles_at_vertices)]


@pytest.fixture
def torus_triangles():
    """Triangles between 96 vertices."""
    _, triangles = samples.torus(rings=12, sides=8)
    return triangles.astype(np.uint32)


def test_triangles_that_touch_some_vertices_are_those_that_name_one_of_them(torus_triangles):
    some = np.array([3, 40, 41, 95])
    expected = np.flatnonzero(np.isin(torus_triangles, some).any(axis=1))
    assert Fans(torus_triangles, 96).touching(some).tolist() == expected.tolist()


@pytest.mark.parametrize("vertex", [3, 40, 41, 95])
def test_triangles_around_a_vertex_are_those_that_name_it(torus_triangles, vertex):
    rows, count = Fans(torus_triangles, 96).around(np.array([vertex]))
    expected = np.flatnonzero((torus_triangles == vertex).any(axis=1)).tolist()
    assert rows.tolist() == expected
    assert count.tolist() == [len(expected)]


def test_vertices_that_triangles_use_are_listed_once_and_in_order():
    triangles = np.array([[5, 0, 3], [3, 0, 1]], np.uint32)
    assert find_used(triangles, size=7).tolist() == [0, 1, 3, 5]


def test_no_triangles_use_no_vertices():
    assert find_used(np.zeros((0, 3), np.uint32), size=7).tolist() == []


def test_triangles_are_numbered_by_the_vertices_that_they_use():
    used, corners = number_used(np.array([[5, 0, 3], [3, 0, 1]], np.uint32), 7)
    assert used.tolist() == [0, 1, 3, 5]
    assert corners.tolist() == [[3, 0, 2], [2, 0, 1]]
