"""Decimation: fewer triangles, the same topology, within the bound."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.mesh.clusters import Clusters
from clrecon.mesh.distances import SurfaceDistance
from clrecon.mesh.intersections import count_self_intersections
from clrecon.mesh.refinement import decimate_mesh
from clrecon.reference.isosurface import extract_isosurface

pytestmark = pytest.mark.unit

FAR = np.array([-150.25, 1071.5, -846.0])


def noise_surface(seed: int, size: int = 12, closed: bool = True) -> Mesh:
    """Specks, bridges and tunnels of a voxel's size: what edge collapses tear."""
    voxels = np.random.default_rng(seed).integers(-500, 500, (size, size, size)).astype(np.int16)
    affine = np.diag([0.7, 0.5, 1.25, 1.0])
    affine[:3, 3] = FAR
    vertices, _, triangles = extract_isosurface(Volume(voxels, affine), 120, closed=closed)
    return Mesh(vertices, triangles, None, {"affine_ijk_to_lps_mm": affine.tolist()})


def check_within(mesh: Mesh, before: Mesh, bound: float) -> None:
    centres = mesh.vertices[mesh.triangles].mean(axis=1, dtype=float)
    there = SurfaceDistance(before.vertices, before.triangles)
    back = SurfaceDistance(mesh.vertices, mesh.triangles)
    limit = bound + tolerances.float32_unit(before.vertices)
    assert back(before.vertices.astype(float)).max() <= limit
    assert there(np.concatenate([mesh.vertices.astype(float), centres])).max() <= limit


def test_a_sphere_loses_nine_of_ten_triangles_within_the_bound():
    sphere = Mesh(*samples.sphere(FAR, 20.0, 6), None, {"iso_value_hu": 300.0})
    small = decimate_mesh(sphere, 0.9, 0.1)
    assert small.triangle_count == pytest.approx(0.1 * sphere.triangle_count, rel=0.02)
    check_within(small, sphere, 0.1)
    quality = small.quality()
    assert (quality["closed"], quality["manifold"], quality["genus"], quality["unused_vertices"]) == (True, True, 0, 0)
    assert quality["volume_ml"] == pytest.approx(4 / 3 * np.pi * 8.0, rel=tolerances.DECIMATED_VOLUME)
    outward = (small.vertices - FAR) / np.linalg.norm(small.vertices - FAR, axis=1, keepdims=True)
    assert np.einsum("na,na->n", small.normals, outward).min() > 0.98
    said = small.report["refinement"]["decimate"]
    assert said["reached"] == pytest.approx(1 - small.triangle_count / sphere.triangle_count)
    assert (said["fraction"], said["triangles_before"], small.report["iso_value_hu"]) == (0.9, 32768, 300.0)


def test_the_bound_stops_the_decimation():
    sphere = Mesh(*samples.sphere(FAR, 20.0, 6))
    reached = []
    for bound in (0.0005, 0.01, 0.05):
        small = decimate_mesh(sphere, 0.97, bound)
        check_within(small, sphere, bound)
        reached.append(small.report["refinement"]["decimate"]["reached"])
    assert 0.0 <= reached[0] < 0.5 < reached[1] < reached[2] < 0.97


def test_a_torus_stays_a_torus():
    small = decimate_mesh(Mesh(*samples.torus(120, 48)), 0.8, 0.3)
    quality = small.quality()
    assert (quality["closed"], quality["manifold"], quality["genus"]) == (True, True, 1)
    assert quality["triangles"] < 3000


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bound", [None, 0.6])
def test_torn_topology_is_mended(seed, bound):
    from fast_simplification import simplify

    mesh = noise_surface(seed)
    before = mesh.quality()
    assert (before["closed"], before["manifold"]) == (True, True)
    torn = Mesh(*simplify(mesh.vertices - FAR, mesh.triangles.view(np.int32), 0.6)).quality()
    assert not torn["manifold"] or torn["components"] < before["components"]  # else this tests nothing

    small = decimate_mesh(mesh, 0.6, bound)
    after = small.quality()
    assert (after["closed"], after["manifold"], after["oriented"], after["outward"]) == (True, True, True, True)
    assert (after["zero_area_faces"], after["duplicate_faces"], after["unused_vertices"]) == (0, 0, 0)
    assert after["components"] == before["components"]
    assert 0.0 < small.report["refinement"]["decimate"]["reached"] < 0.6
    assert count_self_intersections(small.vertices, small.triangles) == 0
    check_within(small, mesh, 0.125 if bound is None else bound)


def test_an_open_surface_keeps_its_border_in_the_plane():
    mesh = noise_surface(7, closed=False)
    before, small = mesh.quality(), decimate_mesh(mesh, 0.5)
    after = small.quality()
    assert before["boundary_edges"] > after["boundary_edges"] > 0
    assert (after["manifold"], after["components"]) == (before["manifold"], before["components"])


def test_clusters_that_do_not_lead_to_the_result_are_found():
    vertices, triangles = samples.sphere(rounds=1)
    faces = triangles.astype(np.uint32)
    clusters = Clusters.from_collapses(vertices, faces, np.zeros((0, 2), int), vertices, triangles)
    assert clusters.collapsed_count == 0
    with pytest.raises(RuntimeError, match="do not lead to its result"):
        Clusters.from_collapses(vertices, faces, triangles[:1, :2], vertices, triangles)


def test_clusters_are_undone_as_a_whole():
    vertices, triangles = samples.sphere(rounds=1)
    a, b, c = triangles[0]
    names = np.arange(len(vertices))
    names[[b, c]] = a
    places = vertices.copy()
    places[a] = vertices[[a, b, c]].mean(axis=0)
    clusters = Clusters(vertices, triangles.astype(np.uint32), names, places)
    assert (clusters.collapsed_count, len(clusters.faces())) == (2, len(triangles) - 4)
    assert clusters.undo(np.array([c])) == 0  # it stands for nothing any more
    assert clusters.undo(np.array([a])) == 3
    back, faces = clusters.surface(np.zeros(3))
    np.testing.assert_array_equal(faces, triangles)
    np.testing.assert_array_equal(back, vertices.astype(np.float32))


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 90.0, float("nan")])
def test_impossible_shares(fraction):
    with pytest.raises(UsageError, match="between 0 and 1"):
        decimate_mesh(Mesh(*samples.sphere()), fraction, 1.0)


def test_the_public_names():
    import clrecon

    assert clrecon.decimate_mesh is decimate_mesh
    assert {"smooth_mesh", "decimate_mesh", "compare_meshes"} <= set(clrecon.__all__)
