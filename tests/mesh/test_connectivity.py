"""Fans: the triangles around vertices."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh.connectivity import Fans, find_used

pytestmark = pytest.mark.unit


def test_fans_list_the_triangles_around_each_vertex():
    triangles = np.array([[0, 1, 2], [2, 1, 4], [4, 1, 0]], np.uint32)
    fans = Fans(triangles, 6)
    rows, count = fans.around(np.array([1, 3, 0, 5, 4]))
    assert rows.tolist() == [0, 1, 2, 0, 2, 1, 2] and count.tolist() == [3, 0, 2, 0, 2]
    assert fans.touching(np.array([2, 3])).tolist() == [0, 1]
    assert fans.touching(np.array([4, 1, 4])).tolist() == [0, 1, 2]
    assert fans.touching(np.zeros(0, int)).tolist() == []
    assert fans.begin.tolist() == [0, 2, 5, 7, 7, 9, 9]


def test_fans_equal_a_look_at_all_triangles():
    _, triangles = samples.torus(12, 8)
    fans = Fans(triangles.astype(np.uint32), int(triangles.max()) + 1)
    some = np.array([3, 40, 41, 95])
    assert fans.touching(some).tolist() == np.flatnonzero(np.isin(triangles, some).any(axis=1)).tolist()
    for vertex in some:
        rows, count = fans.around(np.array([vertex]))
        assert rows.tolist() == np.flatnonzero((triangles == vertex).any(axis=1)).tolist() and count == len(rows)


def test_numbers_that_occur_are_each_found_once():
    triangles = np.array([[5, 0, 3], [3, 0, 1]], np.uint32)
    assert find_used(triangles, 7).tolist() == [0, 1, 3, 5]
    assert find_used(triangles[:0], 7).tolist() == []
