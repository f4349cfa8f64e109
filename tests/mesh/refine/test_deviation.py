"""Deviation: which triangles are looked at, and at which points."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh.refine.clusters import _any_witness
from clrecon.mesh.refine.deviation import Deviation, _inner_weights
from clrecon.mesh.refine.topology import any_corner

pytestmark = pytest.mark.unit

BOUND = 0.5


def test_inner_weights_divide_edges_and_triangles_evenly():
    assert _inner_weights(2, 2).tolist() == [[0.5, 0.5]]
    assert _inner_weights(4, 2).tolist() == [[0.25, 0.75], [0.5, 0.5], [0.75, 0.25]]
    third = [1 / 3] * 3
    assert _inner_weights(2, 3).tolist() == [third]
    assert _inner_weights(4, 3).tolist() == [[0.25, 0.25, 0.5], [0.25, 0.5, 0.25], third, [0.5, 0.25, 0.25]]
    assert len(_inner_weights(12, 3)) == 55  # 10 + 9 + ... + 1; the middle is one of them


def test_triangles_can_be_far_where_they_are_gone_or_a_corner_has_moved_by_more_than_the_bound():
    vertices, triangles = samples.box()
    deviation = Deviation(vertices, triangles.astype(np.uint32), BOUND)
    rows, names = np.arange(12), np.arange(8)
    assert not deviation.can_be_far(rows, names, vertices).any()
    for corner in range(8):
        for way, is_far in ((BOUND, False), (BOUND + 1e-6, True)):
            places = vertices.copy()
            places[corner, corner % 3] -= way
            expected = (triangles == corner).any(axis=1) & is_far
            np.testing.assert_array_equal(deviation.can_be_far(rows, names, places), expected)
    for pair in triangles[:, 1:]:
        places = vertices.copy()
        places[pair] += 1.0
        np.testing.assert_array_equal(deviation.can_be_far(rows, names, places), np.isin(triangles, pair).any(axis=1))
    for one, other in triangles[:, :2]:
        renamed = np.where(names == one, other, names)
        places = np.where((names == other)[:, None], vertices.mean(axis=0), vertices)
        two = vertices[[one, other]] - vertices.mean(axis=0)
        moved = np.linalg.norm(two, axis=1) > BOUND
        assert moved.all()
        expected = np.isin(triangles, (one, other)).any(axis=1)
        np.testing.assert_array_equal(deviation.can_be_far(rows, renamed, places), expected)
        still = Deviation(vertices, triangles.astype(np.uint32), 9.0).can_be_far(rows, renamed, places)
        np.testing.assert_array_equal(still, np.isin(triangles, (one, other)).sum(axis=1) == 2)


def test_points_between_the_middle_and_the_corners_are_tested(monkeypatch):
    """A flat sheet over a surface with a dent at one of its vertices: two large faces stand for 288."""
    size = 13
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(size), np.arange(size)))
    corner = (x + size * y)[(x < size - 1) & (y < size - 1)]
    lower = np.column_stack([corner, corner + 1, corner + size + 1])
    upper = np.column_stack([corner, corner + size + 1, corner + size])
    triangles = np.concatenate([lower, upper]).astype(np.uint32)
    faces = np.array([[0, size - 1, size * size - 1], [0, size * size - 1, size * (size - 1)]], np.uint32)
    flat = np.column_stack([x, y, np.zeros(size * size)]).astype(float)

    def far(*dents: tuple[int, int]) -> list[bool]:
        vertices = flat.copy()
        for at_x, at_y in dents:
            vertices[at_x + size * at_y, 2] = -3.0
        deviation = Deviation(vertices, triangles, BOUND)
        found = deviation.are_far(flat, faces, np.array([0, 1]))
        # Where a face came from only says where to look first.
        np.testing.assert_array_equal(found, deviation.are_far(flat, faces, np.array([287, 100])))
        with monkeypatch.context() as patch:
            patch.setattr("clrecon.mesh.refine.deviation._POINTS", 20)  # less than the points of one face
            np.testing.assert_array_equal(found, deviation.are_far(flat, faces, np.array([0, 1])))
        return found.tolist()

    assert far() == [False, False]
    # Parts are at most four mean edges of 1.14 to 1.3 long, their number is even: eight of the diagonal, six of a side.
    assert far((12, 0)) == [True, False]  # a corner
    assert far((3, 3)) == far((6, 6)) == [True, True]  # a quarter and the middle of the diagonal
    assert far((4, 0)) == far((6, 0)) == [True, False]  # a third and the middle of a side
    assert far((0, 8)) == [False, True]
    assert far((6, 3)) == far((8, 4)) == [True, False]  # inside; the middle
    assert far((5, 0)) == far((7, 3)) == [False, False]  # between the points
    assert Deviation(flat, triangles, BOUND).are_far(flat, np.zeros((0, 3), np.uint32), np.zeros(0, int)).tolist() == []


def test_vertices_are_left_behind_beyond_the_bound_from_the_faces_around_their_name():
    vertices, triangles = samples.box()
    deviation = Deviation(vertices, triangles.astype(np.uint32), BOUND)
    top = vertices[:, 2] == 1.0
    for down, is_far in ((BOUND - 1e-3, False), (BOUND + 1e-3, True)):
        places = vertices - np.where(top, down, 0.0)[:, None] * [0.0, 0.0, 1.0]
        some = np.flatnonzero(top)[:3]
        found = deviation.are_left_behind(some, np.arange(8), places, triangles.astype(np.uint32))
        assert found.tolist() == [is_far] * 3


def test_one_flag_of_three_corners_is_enough():
    flags = np.array([False, True, False, False])
    triangles = np.array([[1, 0, 2], [0, 1, 2], [0, 2, 1], [0, 2, 3], [1, 1, 1]])
    assert any_corner(flags, triangles).tolist() == [True, True, True, False, True]
    assert any_corner(flags, triangles).dtype == np.bool_
    witnesses = np.repeat([[0, 2, 1, -1]], 7, axis=0)
    witnesses[6, 0] = 1
    assert _any_witness(flags, witnesses).tolist() == [True, False, True, True]
