"""Collapses in their order: which are undone, and where the parts of a cluster are placed."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.mesh.connectivity import Fans
from clrecon.mesh.refine.clusters import Collapses, Quadrics, last_of_collapses

pytestmark = pytest.mark.unit


def undone(collapses: Collapses, names: list[int], of: np.ndarray) -> tuple[list[int], list[list[int]]]:
    marked = np.zeros(len(of), dtype=bool)
    marked[names] = True
    which, left = collapses.undo(marked, of)
    return np.flatnonzero(which).tolist(), left.tolist()


def test_the_last_collapse_of_each_cluster_is_undone_first():
    pairs = np.array([[0, 1], [5, 6], [2, 3], [0, 2], [5, 7]])
    collapses = Collapses(9)
    collapses.add(pairs[:2])
    collapses.add(pairs[2:])
    names = last_of_collapses(pairs, 9)
    assert names.tolist() == [0, 0, 0, 0, 4, 5, 5, 5, 8]
    assert collapses.latest(names).tolist() == [3, -1, -1, -1, -1, 4, -1, -1, -1]
    assert undone(collapses, [1, 4, 8], names) == ([], [])  # names without collapses
    assert undone(collapses, [0, 4], names) == ([0], [[0, 1], [2, 3]])
    names = np.array([0, 0, 2, 2, 4, 5, 5, 5, 8])
    assert collapses.latest(names).tolist() == [0, -1, 2, -1, -1, 3, -1, -1, -1]
    assert undone(collapses, [2, 5], names) == ([2, 5], [[5, 6]])
    assert undone(collapses, [0, 2], np.array([0, 0, 2, 3, 4, 5, 5, 7, 8])) == ([0], [])


def test_a_cluster_that_is_undone_often_is_undone_faster():
    """Three turns of one collapse, three of two, then four; a part that comes off has had as many turns."""
    count = 40
    pairs = np.column_stack([np.zeros(count, int), np.arange(1, count + 1)])
    collapses = Collapses(count + 1)
    collapses.add(pairs)
    left: list[int] = []
    for _ in range(8):
        names = np.arange(count + 1)
        names[: 1 + (left[-1] if left else count)] = 0
        left.append(len(undone(collapses, [0], names)[1]))
    assert left == [39, 38, 37, 35, 33, 31, 27, 23]
    collapses.add(np.array([[40, 39]]))  # a new round begins anew
    assert len(undone(collapses, [0], names * (names > 23))[1]) == 22


def test_parts_of_a_cluster_have_had_as_many_turns():
    """Two halves of eight vertices each are joined four times over."""
    half = np.column_stack([np.zeros(7, int), np.arange(1, 8)])
    collapses = Collapses(19)
    collapses.add(np.concatenate([half, half + 8, [[0, 8], [0, 16], [0, 17], [0, 18]]]))
    for gone in (18, 17, 16):
        names = np.where(np.arange(19) < gone + 1, 0, np.arange(19))
        assert undone(collapses, [0], names)[0] == [0]
    names = np.repeat([0, 16, 17, 18], [16, 1, 1, 1])
    assert len(undone(collapses, [0], names)[1]) == 13  # the fourth turn: two
    names = np.repeat([0, 7, 8, 16, 17, 18], [7, 1, 8, 1, 1, 1])
    names[8:16] = 0  # [0, 8] and [8, 15] are gone
    names = np.repeat([0, 8, 15, 16, 17, 18], [8, 7, 1, 1, 1, 1])
    assert undone(collapses, [8], names) == ([8], (half[:4] + 8).tolist())  # its fifth: two more


def quadrics_of(vertices: np.ndarray, triangles: np.ndarray) -> Quadrics:
    faces = triangles.astype(np.uint32)
    return Quadrics(vertices, faces, Fans(faces, len(vertices)))


def test_three_planes_meet_in_the_best_place():
    vertices, triangles = samples.box()
    quadrics = quadrics_of(vertices, triangles)
    found = quadrics.best_places(np.arange(8), np.arange(8), 8)
    np.testing.assert_allclose(found, vertices, atol=1e-12)
    # Two corners: along the edge between them the mean, across it what all planes leave.
    (edge,) = np.flatnonzero((vertices[:, 1:] == 0.0).all(axis=1))[None]
    (place,) = quadrics.best_places(np.zeros(2, int), edge, 1)
    assert vertices[edge, 0].tolist() == [0.0, 1.0]
    assert place[0] == pytest.approx(0.5)
    assert (np.abs(place[1:]) < 1e-3).all()


def test_best_place_in_a_plane_is_the_mean():
    vertices = np.array([[0.0, 0.0, 3.0], [4.0, 0.0, 3.0], [0.0, 4.0, 3.0], [9.0, 9.0, 9.0]])
    quadrics = quadrics_of(vertices, np.array([[0, 1, 2]]))
    found = quadrics.best_places(np.array([1, 1, 1, 0]), np.array([0, 1, 2, 3]), 2)
    np.testing.assert_allclose(found, [[9.0, 9.0, 9.0], [4 / 3, 4 / 3, 3.0]], atol=1e-12)  # the last is in no triangle


def test_faces_without_area_have_no_plane():
    vertices, triangles = samples.box()
    flat = np.array([[0, 1, 1], [2, 2, 2]])
    both = quadrics_of(vertices, np.concatenate([triangles, flat]))
    np.testing.assert_allclose(both.best_places(np.arange(8), np.arange(8), 8), vertices, atol=1e-12)
