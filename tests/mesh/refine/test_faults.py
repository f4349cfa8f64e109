"""Faults of merged vertices: beside what is new, and where the Euler number changes."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused

from clrecon.mesh.connectivity import Edges, find_edges
from clrecon.mesh.refine.clusters import Clusters
from clrecon.mesh.refine.topology import find_faults_beside, find_sheets, find_torn

pytestmark = pytest.mark.unit

RINGS, SIDES = 9, 6


def merged(triangles: np.ndarray, names: np.ndarray) -> np.ndarray:
    named = names[triangles]
    return named[(named != named[:, (1, 2, 0)]).all(axis=1)].astype(np.uint32)


def euler(faces: np.ndarray) -> int:
    return len(np.unique(faces)) - find_edges(faces, int(faces.max()) + 1).count + len(faces)


def test_a_tunnel_that_is_pinched_shut_is_torn_where_it_was():
    """One ring around the tube of a torus becomes a vertex: V - E + F of the ring is 0, not 1."""
    _, triangles = samples.torus(RINGS, SIDES)
    triangles = triangles.astype(np.uint32)
    names = np.arange(RINGS * SIDES)
    assert find_torn(triangles, names).tolist() == []
    names[:SIDES] = 0
    assert euler(merged(triangles, names)) == 1
    assert find_torn(triangles, names).tolist() == [0]
    names[1:SIDES] = np.arange(1, SIDES)
    names[1 : SIDES - 1] = 0  # all but one: a disc, but two strips lead from it to the last one
    assert euler(merged(triangles, names)) == 1
    assert find_torn(triangles, names).tolist() == [0, SIDES - 1]


def test_collapse_to_a_disc_tears_nothing():
    vertices, triangles = samples.sphere(rounds=2)
    triangles = triangles.astype(np.uint32)
    names = np.arange(len(vertices))
    names[np.linalg.norm(vertices - vertices[0], axis=1) < 8.0] = 0
    faces = merged(triangles, names)
    assert 0 < len(faces) < len(triangles) and euler(faces) == 2
    assert find_torn(triangles, names).tolist() == []


def test_an_open_border_is_no_tear():
    """Vertices of the border merged along it: the strips between begin at the border."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(6), np.arange(5)))
    corner = (x + 6 * y)[(x < 5) & (y < 4)]
    lower = np.column_stack([corner, corner + 1, corner + 7])
    upper = np.column_stack([corner, corner + 7, corner + 6])
    triangles = np.concatenate([lower, upper]).astype(np.uint32)
    names = np.arange(30)
    names[[1, 2]] = 1
    names[[3, 4, 9]] = 3
    assert euler(merged(triangles, names)) == 1
    assert find_torn(triangles, names).tolist() == []


@pytest.mark.parametrize("seed", range(6))
def test_faults_beside_new_faces_are_those_of_the_whole(seed):
    """Vertices of a torus are merged at random; all faults lie at vertices that are called new."""
    _, triangles = samples.torus(24, 12)
    rng = np.random.default_rng(seed)
    names = np.arange(24 * 12)
    gone = rng.choice(len(names), 40, replace=False)
    names[gone] = rng.choice(np.setdiff1d(names, gone), 40)
    faces = merged(triangles, names)
    new = np.zeros(len(names), dtype=bool)
    new[names[gone]] = True
    # Neighbours count as new here: a fan can come apart at a vertex whose own faces stay.
    found = find_faults_beside(faces, new)
    expected = np.unique(np.concatenate(find_sheets(faces, len(names), find_edges(faces, len(names)))))
    assert len(expected) > 0
    np.testing.assert_array_equal(found, expected)
    assert find_faults_beside(faces, np.zeros(len(names), dtype=bool)).tolist() == []


def test_a_fault_far_from_what_is_new_is_not_looked_for():
    one = samples.weld(samples.join(samples.box(), samples.box((1.0, 1.0, 1.0))))  # two boxes share a corner
    vertices, triangles = samples.join(one, samples.sphere((9.0, 9.0, 9.0), 1.0, 1))
    faces = triangles.astype(np.uint32)
    (shared,) = np.flatnonzero((vertices == 1.0).all(axis=1))
    new = np.zeros(len(vertices), dtype=bool)
    new[-1] = True
    assert find_faults_beside(faces, new).tolist() == []
    new[shared] = True
    assert shared in find_faults_beside(faces, new)


def test_a_tunnel_is_opened_again():
    """Of a ring of a torus that was merged into one vertex, half comes back, and the topology is what it was."""
    vertices, triangles = samples.torus(RINGS, SIDES)
    clusters = Clusters(vertices, triangles.astype(np.uint32), np.zeros(3))
    names = np.arange(len(vertices))
    names[: SIDES - 1] = 0
    faces = merged(triangles, names)
    standing = np.unique(faces)
    collapses = np.column_stack([np.zeros(SIDES - 2, int), np.arange(1, SIDES - 1)])
    clusters.collapse(collapses, vertices[standing], np.searchsorted(standing, faces))
    found = clusters.compare_topology()
    assert (found.euler_number_before, found.euler_number_after, found.components_changed) == (0, 1, 1)
    while clusters.undo(clusters.find_faults()):
        pass
    assert clusters.compare_topology().changes == []
    assert clusters.collapsed_count == SIDES // 2  # three edges around the tube are left


def test_two_faces_back_to_back_beside_what_is_new_are_found():
    vertices, triangles = samples.sphere(rounds=1)
    count = len(vertices)
    both = [[count, count + 1, count + 2], [count, count + 2, count + 1]]
    faces = np.concatenate([triangles, both]).astype(np.uint32)
    new = np.zeros(count + 3, dtype=bool)
    new[count + 1] = True
    assert find_faults_beside(faces, new).tolist() == [count, count + 1, count + 2]


def test_all_of_a_surface_is_examined_before_what_is_new(monkeypatch):
    def beside(*given):
        raise AssertionError("the surroundings alone were examined")

    monkeypatch.setattr("clrecon.mesh.refine.clusters.find_faults_beside", beside)
    vertices, triangles = samples.box()
    clusters = Clusters(np.asarray(vertices, np.float64), np.asarray(triangles, np.uint32), np.zeros(3))
    clusters._new["faults"][0] = True
    assert clusters.find_faults().tolist() == [] and not clusters._new["faults"].any()
    assert clusters.find_faults().tolist() == []  # nothing is new
    clusters._new["faults"][0] = True
    with refused(AssertionError, "surroundings"):
        clusters.find_faults()


def test_components_that_did_not_change_are_not_examined_again(monkeypatch):
    one, other = samples.box(), samples.box()
    vertices, triangles = samples.join(one, (other[0] + 5.0, other[1]))
    clusters = Clusters(np.asarray(vertices, np.float64), np.asarray(triangles, np.uint32), np.zeros(3))
    a, b = (int(corner) for corner in triangles[-1, :2])
    names = np.where(np.arange(16) == b, a, np.arange(16))
    left = names[triangles]
    left = left[(left != left[:, (1, 2, 0)]).all(axis=1)]
    standing = np.unique(left)
    clusters.collapse(np.array([[a, b]]), vertices[standing], np.searchsorted(standing, left))
    seen = []

    def look(faces: np.ndarray, count: int) -> Edges:
        seen.append((len(faces), count))
        return find_edges(faces, count)

    monkeypatch.setattr("clrecon.mesh.refine.clusters.find_edges", look)
    assert clusters.find_faults().tolist() == [] and clusters.find_faults(everywhere=True).tolist() == []
    assert seen == [(10, 7), (0, 0)]
    standing, faces = clusters.take_changed()
    assert standing.tolist() == [row for row in range(8, 16) if row != b]
    np.testing.assert_array_equal(standing[faces], clusters.faces()[12:])
    assert len(clusters.take_changed()[0]) == 0


def test_a_component_that_is_gone_is_found_though_none_of_its_vertices_stands():
    vertices, triangles = samples.join(samples.box(), (samples.box()[0] + 5.0, samples.box()[1]))
    clusters = Clusters(np.asarray(vertices, np.float64), np.asarray(triangles, np.uint32), np.zeros(3))
    pairs = np.column_stack([np.full(7, 8), np.arange(9, 16)])
    clusters.collapse(pairs, np.asarray(vertices, np.float64)[:8], np.asarray(triangles)[:12])
    assert clusters.find_faults().tolist() == [8]
