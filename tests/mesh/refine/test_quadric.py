"""Quadric collapse without a bound: what it does is measured and said."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.mesh.connectivity import label_components
from clrecon.mesh.refine.quadric import _compare_topology, _farthest_point, collapse_quadric
from clrecon.mesh.refine.topology import compare_topology, measure_topology

pytestmark = pytest.mark.unit

FAR = np.array([-150.25, 1071.5, -846.0])


def joined_mesh(*shapes: samples.Arrays) -> Mesh:
    return Mesh(*samples.join(*shapes), report={"iso_value_hu": 300.0})


@pytest.fixture(scope="module")
def sphere_and_torus():
    """A mesh of both, and the same with a fifth of its triangles."""
    mesh = joined_mesh(samples.sphere(FAR, radius=20.0, rounds=5), samples.torus(rings=60, sides=24))
    return mesh, collapse_quadric(mesh, fraction=0.8)


def test_collapsing_reaches_the_share_asked_for_and_reports_it(sphere_and_torus):
    mesh, small = sphere_and_torus
    facts = small.report["refinement"]["quadric"]
    assert small.triangle_count == pytest.approx(0.2 * mesh.triangle_count, abs=2)  # an edge takes two
    assert (facts["fraction"], facts["triangles_before"]) == (0.8, mesh.triangle_count)
    assert facts["reached"] == pytest.approx(1 - small.triangle_count / mesh.triangle_count)


def test_a_sphere_and_a_torus_keep_their_topology_which_is_reported(sphere_and_torus):
    _, small = sphere_and_torus
    topology = small.report["refinement"]["quadric"]["topology"]
    assert small.quality()["euler_number"] == 2 + 0
    assert (topology.euler_number_before, topology.euler_number_after) == (2, 2)
    assert (topology.components_before, topology.components_lost, topology.loose_edges_after) == (2, 0, 0)
    assert (topology.components_changed, topology.changes) == (0, [])


def test_a_collapse_that_changed_no_topology_passes_its_gates_without_a_warning(sphere_and_torus):
    _, small = sphere_and_torus
    assert [gate.ok for gate in small.report["refinement"]["quadric"]["gates"]] == [True, True]
    assert "warnings" not in small.report
    assert small.report["iso_value_hu"] == 300.0


def test_the_largest_distance_of_a_collapsed_sphere_and_torus_is_reported(sphere_and_torus):
    _, small = sphere_and_torus
    assert 0.0 < small.report["refinement"]["quadric"]["farthest_mm"] < 0.3  # measured 0.15


@pytest.fixture(scope="module")
def sphere_and_three_specks():
    """A sphere of 10 mm, and three specks 30 mm from it: only their vertices say how far away a result without is.

    Their centres lie 40 mm from that of the sphere along x, and up to 4 mm along y.
    """
    specks = [samples.sphere((40.0, 4.0 * i, 0.0), radius=0.05, rounds=0) for i in range(3)]
    return joined_mesh(samples.sphere((0.0, 4.0, 0.0), radius=10.0, rounds=5), *specks)


def test_components_that_a_collapse_loses_are_counted_and_fail_their_gate_with_a_warning(sphere_and_three_specks):
    small = collapse_quadric(sphere_and_three_specks, fraction=0.9)
    facts = small.report["refinement"]["quadric"]
    assert facts["topology"].components_lost == 4 - small.quality()["components"] == 3
    assert [gate.name for gate in facts["gates"] if not gate.ok] == ["components_lost"]
    assert small.report["warnings"] == [
        "components of 4 that collapsing edges by their quadric error has lost: 3, none allowed"
    ]
    from_speck_to_sphere_mm = np.hypot(40.0, 4.0) - 10.0
    assert facts["farthest_mm"] == pytest.approx(from_speck_to_sphere_mm, abs=2 * 0.05)  # the radius of a speck


def test_edges_that_a_collapse_opens_are_counted_and_fail_their_gate_with_a_warning(sphere_and_three_specks):
    small = collapse_quadric(sphere_and_three_specks, fraction=0.7)
    facts, quality = small.report["refinement"]["quadric"], small.quality()
    loose_edges = quality["boundary_edges"] + quality["nonmanifold_edges"]
    assert facts["topology"].loose_edges_after == loose_edges > 0
    assert facts["topology"].components_changed > 0
    assert facts["topology"].euler_number_after == quality["euler_number"]
    assert [gate.name for gate in facts["gates"] if not gate.ok] == ["edges_opened"]
    (warning,) = small.report["warnings"]
    assert "edges that collapsing has made" in warning


def test_a_collapse_that_keeps_all_components_stays_near_the_surface(sphere_and_three_specks):
    small = collapse_quadric(sphere_and_three_specks, fraction=0.7)
    assert small.report["refinement"]["quadric"]["farthest_mm"] < 0.1  # measured 0.03; a speck lost is 30 mm away


@pytest.fixture
def two_spheres_and_a_torus():
    """The number of faces of each, all triangles, the component of each vertex, and the topology."""
    parts = (samples.sphere(rounds=1), samples.sphere((30.0, 0, 0), radius=5.0, rounds=1), samples.torus())
    vertices, triangles = samples.join(*parts)
    triangles = triangles.astype(np.uint32)
    count, labels = label_components(triangles, len(vertices))
    return [len(faces) for _, faces in parts], triangles, labels, measure_topology(triangles, labels, count)


def test_each_component_has_its_euler_number_and_its_faces(two_spheres_and_a_torus):
    faces, _, _, topology = two_spheres_and_a_torus
    assert topology.euler.tolist() == [2, 2, 0]
    assert topology.faces.tolist() == faces


def test_a_component_that_lost_a_triangle_is_changed_and_one_without_triangles_is_lost(two_spheres_and_a_torus):
    """The first sphere becomes a disc, with an Euler number of 1 and three loose edges; the second is gone."""
    (first, second, _), triangles, labels, before = two_spheres_and_a_torus
    left = np.delete(triangles, range(first - 1, first + second), axis=0)
    change = compare_topology(before, measure_topology(left, labels, 3))
    assert (change.euler_number_before, change.euler_number_after) == (2 + 2 + 0, 1 + 0)
    assert (change.components_before, change.components_lost, change.components_changed) == (3, 1, 1)
    assert (change.loose_edges_before, change.loose_edges_after) == (0, 3)
    assert change.changes == [{"component": 0, "euler_number_before": 2, "euler_number_after": 1}]


def test_the_largest_distance_of_points_from_a_surface_is_exact():
    vertices, triangles = samples.sphere(FAR, radius=20.0, rounds=3)
    points = FAR + np.random.default_rng(5).normal(0.0, 15.0, (500, 3))
    farthest = _farthest_point(points - FAR, vertices - FAR, triangles.astype(np.uint32))
    exact = SurfaceDistance(vertices, triangles.astype(np.uint32))(points)
    assert farthest == pytest.approx(exact.max(), abs=tolerances.FLOAT32_POINT_MM)


@pytest.fixture
def two_boxes_and_a_lone_vertex():
    """17 vertices: 0 to 7 and 8 to 15 of the boxes, which have 12 triangles each, and 16."""
    vertices, triangles = samples.join(samples.box(), samples.box())
    return Mesh(np.vstack((vertices, FAR)), triangles)


def test_a_vertex_without_triangles_is_no_lost_component(two_boxes_and_a_lone_vertex):
    mesh = two_boxes_and_a_lone_vertex
    change, lost_vertices = _compare_topology(mesh, mesh.triangles, np.arange(17))
    assert change.components_lost == 0
    assert lost_vertices.tolist() == []


def test_a_box_that_shrinks_to_a_point_is_a_lost_component_with_its_eight_vertices(two_boxes_and_a_lone_vertex):
    mesh = two_boxes_and_a_lone_vertex
    vertex_of = np.arange(17)
    vertex_of[8:16] = 8
    triangles_of_the_first = mesh.triangles[:12]
    change, lost_vertices = _compare_topology(mesh, triangles_of_the_first, vertex_of)
    assert change.components_lost == 1
    assert lost_vertices.tolist() == list(range(8, 16))


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 90.0, float("nan")])
def test_shares_that_are_not_between_0_and_1_are_refused(fraction):
    with refused(UsageError, 0, 1):
        collapse_quadric(Mesh(*samples.sphere()), fraction)


def test_collapsing_an_empty_mesh_is_refused():
    with refused(NoSurfaceError, "refine"):
        collapse_quadric(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint32)), 0.5)


def test_a_collapse_that_leaves_nothing_is_refused():
    with refused(NoSurfaceError, 12, 0.99):  # triangles
        collapse_quadric(Mesh(*samples.box()), 0.99)
