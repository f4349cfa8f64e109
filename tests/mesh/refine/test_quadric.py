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


def of_shapes(*shapes: samples.Arrays) -> Mesh:
    return Mesh(*samples.join(*shapes), None, {"iso_value_hu": 300.0})


def test_a_sphere_and_a_torus_stay_what_they_are():
    mesh = of_shapes(samples.sphere(FAR, 20.0, 5), samples.torus(60, 24))
    small = collapse_quadric(mesh, 0.8)
    said = small.report["refinement"]["quadric"]
    assert small.triangle_count == pytest.approx(0.2 * mesh.triangle_count, abs=2)
    assert (said["fraction"], said["triangles_before"]) == (0.8, mesh.triangle_count)
    assert said["reached"] == pytest.approx(1 - small.triangle_count / mesh.triangle_count)
    found, quality = said["topology"], small.quality()
    assert (found.euler_number_before, found.euler_number_after) == (2, 2) == (2, quality["euler_number"])
    assert (found.components_before, found.components_lost, found.loose_edges_after) == (2, 0, 0)
    assert (found.components_changed, found.changes) == (0, [])
    assert all(gate.ok for gate in said["gates"]) and "warnings" not in small.report
    assert small.report["iso_value_hu"] == 300.0
    assert 0.0 < said["farthest_mm"] < 1.0


@pytest.mark.parametrize("shares", [(0.9, "components_lost"), (0.7, "edges_opened")])
def test_lost_or_opened_components_are_warned_of(shares):
    """Three specks lie 30 mm from all else: only their own vertices say how far away a result without them is."""
    fraction, name = shares
    specks = [samples.sphere((40.0, 4.0 * i, 0.0), 0.05, 0) for i in range(3)]
    mesh = of_shapes(samples.sphere((0.0, 4.0, 0.0), 10.0, 5), *specks)
    small = collapse_quadric(mesh, fraction)
    said, quality = small.report["refinement"]["quadric"], small.quality()
    found = said["topology"]
    assert found.components_lost == 4 - quality["components"]
    assert found.loose_edges_after == quality["boundary_edges"] + quality["nonmanifold_edges"]
    assert found.euler_number_after == quality["euler_number"]
    assert [gate.name for gate in said["gates"] if not gate.ok] == [name]
    (warning,) = small.report["warnings"]
    if name == "components_lost":
        assert warning == "components of 4 that collapsing edges by their quadric error has lost: 3, none allowed"
        assert said["farthest_mm"] == pytest.approx(30.0, abs=0.5)
    else:
        assert "edges that collapsing has made" in warning and found.components_changed > 0
        assert said["farthest_mm"] < 0.1


def test_the_euler_number_is_that_of_each_component():
    """One sphere loses a triangle (a disc: 1), the other part is gone, a torus becomes a sphere."""
    parts = (samples.sphere(rounds=1), samples.sphere((30.0, 0, 0), 5.0, 1), samples.torus())
    vertices, triangles = samples.join(*parts)
    count, labels = label_components(triangles.astype(np.uint32), len(vertices))
    before = measure_topology(triangles.astype(np.uint32), labels, count)
    np.testing.assert_array_equal(before.euler, [2, 2, 0])
    np.testing.assert_array_equal(before.faces, [len(part[1]) for part in parts])
    first, second = len(parts[0][1]), len(parts[0][1]) + len(parts[1][1])
    after = measure_topology(np.delete(triangles, range(first - 1, second), 0).astype(np.uint32), labels, count)
    found = compare_topology(before, after)
    assert (found.euler_number_before, found.euler_number_after) == (4, 1)
    assert (found.components_before, found.components_lost, found.components_changed) == (3, 1, 1)
    assert (found.loose_edges_before, found.loose_edges_after) == (0, 3)
    assert found.changes == [{"component": 0, "euler_number_before": 2, "euler_number_after": 1}]


def test_the_farthest_of_points_is_exact():
    vertices, triangles = samples.sphere(FAR, 20.0, 3)
    points = FAR + np.random.default_rng(5).normal(0.0, 15.0, (500, 3))
    there = SurfaceDistance(vertices, triangles.astype(np.uint32))(points).max()
    found = _farthest_point(points - FAR, vertices - FAR, triangles.astype(np.uint32))
    assert found == pytest.approx(there, abs=tolerances.FLOAT32_POINT_MM)


def test_vertices_without_faces_are_in_no_component_that_is_lost():
    vertices, triangles = samples.join(samples.box(), samples.box())
    mesh = Mesh(np.vstack((vertices, FAR)), triangles)
    names = np.arange(len(mesh.vertices))
    found, lost = _compare_topology(mesh, mesh.triangles, names)
    assert (found.components_lost, lost.tolist()) == (0, [])
    names[8:16] = 8  # the second box shrinks to a point
    found, lost = _compare_topology(mesh, mesh.triangles[:12], names)
    assert (found.components_lost, lost.tolist()) == (1, list(range(8, 16)))


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 90.0, float("nan")])
def test_impossible_shares_are_refused(fraction):
    with refused(UsageError, 0, 1):
        collapse_quadric(Mesh(*samples.sphere()), fraction)


def test_meshes_with_nothing_to_collapse_or_nothing_left_are_refused():
    with refused(NoSurfaceError, "refine"):
        collapse_quadric(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint32)), 0.5)
    with refused(NoSurfaceError, 12, 0.99):
        collapse_quadric(Mesh(*samples.box()), 0.99)
