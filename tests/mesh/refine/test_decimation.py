"""Decimation: fewer triangles, the same topology, within the bound."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh, split_components
from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.refine.clusters import Clusters, Quadrics, _find_flat
from clrecon.mesh.refine.decimation import _collapse, _mend, check_refinement, decimate_mesh
from clrecon.mesh.refine.deviation import Deviation
from clrecon.mesh.refine.shifts import measure_volumes
from clrecon.mesh.refine.smoothing import smooth_mesh
from clrecon.proof.surface.extract import extract_isosurface

pytestmark = pytest.mark.unit

FAR = np.array([-150.25, 1071.5, -846.0])


def noise_surface(seed: int, shape: tuple[int, int, int] = (12, 12, 12), closed: bool = True) -> Mesh:
    """Specks, bridges and tunnels of a voxel's size: what edge collapses tear."""
    voxels = np.random.default_rng(seed).integers(-500, 500, shape).astype(np.int16)
    affine = np.diag([0.7, 0.5, 1.25, 1.0])
    affine[:3, 3] = FAR
    vertices, _, triangles = extract_isosurface(Volume(voxels, affine), 120, closed=closed)
    return Mesh(vertices, triangles, None, {"affine_ijk_to_lps_mm": affine.tolist()})


def looked_at(mesh: Mesh) -> np.ndarray:
    """Vertices, middles of edges and centres of triangles."""
    corners = mesh.vertices[mesh.triangles].astype(float)
    middles = 0.5 * (corners + corners[:, (1, 2, 0)])
    return np.concatenate([mesh.vertices.astype(float), middles.reshape(-1, 3), corners.mean(axis=1)])


def check_within(mesh: Mesh, before: Mesh, bound: float) -> None:
    limit = bound + tolerances.float32_unit(before.vertices)
    for one, other in ((mesh, before), (before, mesh)):
        assert SurfaceDistance(other.vertices, other.triangles)(looked_at(one)).max() <= limit


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


@pytest.mark.slow
def test_the_bound_stops_the_decimation():
    sphere = Mesh(*samples.sphere(FAR, 20.0, 5))
    reached = []
    for bound in (0.002, 0.04, 0.2):
        small = decimate_mesh(sphere, 0.97, bound)
        check_within(small, sphere, bound)
        reached.append(small.report["refinement"]["decimate"]["reached"])
    assert 0.0 <= reached[0] < 0.5 < reached[1] < reached[2] < 0.97


def test_a_torus_stays_a_torus():
    small = decimate_mesh(Mesh(*samples.torus(120, 48)), 0.8, 0.3)
    quality = small.quality()
    assert (quality["closed"], quality["manifold"], quality["genus"]) == (True, True, 1)
    assert quality["triangles"] < 3000


@pytest.mark.slow
@pytest.mark.parametrize("seed", daily(1, range(10, 14)))
def test_no_triangle_of_either_surface_is_further_than_the_bound(seed):
    """Smoothing and decimation of noise, each from the surface that it was given."""
    rough = noise_surface(seed, (24, 25, 15))
    smooth = smooth_mesh(rough)
    check_within(smooth, rough, 0.125)
    check_within(decimate_mesh(smooth, 0.9), smooth, 0.125)


@pytest.mark.slow
@pytest.mark.parametrize("seed", daily(1, range(2)))
def test_faces_not_looked_at_again_stay_within_the_bound(seed):
    """After some rounds of mending, which look at what has changed, all of both surfaces is looked at."""
    mesh = smooth_mesh(noise_surface(seed, (24, 25, 15)))
    clusters = Clusters(mesh.vertices - FAR, mesh.triangles, FAR)
    deviation = Deviation(mesh.vertices - FAR, mesh.triangles, 0.1)
    for _ in range(3):
        _collapse(clusters, 0.5, 0.125)
        _mend(clusters, deviation)
        faces, rows = clusters.faces(), np.arange(mesh.triangle_count)
        rows = rows[deviation.can_be_far(rows, clusters.names, clusters.places)]
        assert 0 < len(rows) < mesh.triangle_count
        far, _ = deviation.is_far_from(rows, clusters.names, clusters.places, faces)
        assert not far.any()
        named = clusters.names[mesh.triangles]
        of = np.flatnonzero((named != named[:, (1, 2, 0)]).all(axis=1))
        assert not deviation.are_far(clusters.places, faces, of).any()


@pytest.mark.parametrize("seed", daily(1, range(4)))
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
    assert len(find_self_intersections(small.vertices, small.triangles)) == 0
    check_within(small, mesh, 0.125 if bound is None else bound)


def test_an_open_surface_keeps_its_border_in_the_plane():
    mesh = noise_surface(7, closed=False)
    before, small = mesh.quality(), decimate_mesh(mesh, 0.5)
    after = small.quality()
    assert before["boundary_edges"] > after["boundary_edges"] > 0
    assert (after["manifold"], after["components"]) == (before["manifold"], before["components"])


def test_report_says_what_ended_the_decimation():
    sphere = Mesh(*samples.sphere(FAR, 20.0, 5))
    said = [decimate_mesh(sphere, 0.9, bound).report["refinement"]["decimate"] for bound in (0.5, 0.001)]
    assert [each["ended_by"] for each in said] == ["share", "bound"]
    assert said[0]["reached"] == pytest.approx(0.9, abs=2 / sphere.triangle_count)
    assert said[1]["reached"] < 0.9


def test_each_component_keeps_its_volume():
    """Walls of a cavity count too; the shift is within the bound."""
    inner, outer = samples.sphere(FAR, 8.0, 4), samples.sphere(FAR, 10.0, 5)
    other = samples.sphere(FAR + (40.0, 0, 0), 3.0, 4)
    mesh = Mesh(*samples.join((inner[0], inner[1][:, ::-1]), outer, other))
    small = decimate_mesh(mesh, 0.8, 0.4)
    check_within(small, mesh, 0.4)
    for part, before in zip(split_components(small), split_components(mesh), strict=True):
        assert part.triangle_count < before.triangle_count
        assert part.quality()["volume_ml"] == pytest.approx(before.quality()["volume_ml"], rel=1e-5)


@pytest.mark.parametrize("seed", [4, 7])
def test_volumes_are_kept_where_vertices_cannot_be_shifted(seed):
    """Sheets so close that steps are taken back, and specks for which the step is too short."""
    mesh = noise_surface(seed)
    small = decimate_mesh(mesh, 0.6)
    assert small.triangle_count < 0.7 * mesh.triangle_count
    before, after = (np.sort(measure_volumes(each.vertices - FAR, each.triangles).mm3) for each in (mesh, small))
    large = np.abs(before) > 0.1  # of smaller ones the rounding of coordinates is as large
    assert np.abs(after / before - 1.0)[large].max() <= 5e-4


def test_collapses_that_do_not_lead_to_the_result_are_found():
    vertices, triangles = samples.sphere(rounds=1)
    clusters = Clusters(vertices, triangles.astype(np.uint32), np.zeros(3))
    clusters.collapse(np.zeros((0, 2), int), vertices, triangles)
    assert clusters.collapsed_count == 0
    with pytest.raises(RuntimeError, match="do not lead to its result"):
        clusters.collapse(triangles[:1, :2], vertices, triangles)


def test_clusters_are_undone_from_the_last_collapse_on():
    vertices, triangles = samples.sphere(rounds=1)
    a, b, c = (int(corner) for corner in triangles[0])
    faces = triangles.astype(np.uint32)
    clusters = Clusters(vertices, faces, np.zeros(3))
    places = {a: vertices[[a, b, c]].mean(axis=0)}

    def after(gone: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Points and faces when these have gone into the first corner."""
        names = np.arange(len(vertices))
        names[gone] = a
        left = names[triangles]
        left = left[(left != left[:, (1, 2, 0)]).all(axis=1)]
        standing = np.unique(left)
        points = np.array([places.get(int(vertex), vertices[vertex]) for vertex in standing])
        return points, np.searchsorted(standing, left)

    clusters.collapse(np.array([[a, b]]), *after([b]))
    standing = clusters.standing()
    one, other = np.searchsorted(standing, [a, c])
    clusters.collapse(np.array([[one, other]]), *after([b, c]))
    assert (clusters.collapsed_count, len(clusters.faces())) == (2, len(triangles) - 4)
    assert clusters.undo(np.array([c])) == 0  # it stands for nothing any more
    assert clusters.undo(np.array([a])) == 3  # all of the cluster gets new names and places
    assert (clusters.collapsed_count, len(clusters.faces())) == (1, len(triangles) - 2)
    assert clusters.names[[a, b, c]].tolist() == [a, a, c]
    best = Quadrics(vertices, faces, clusters.fans).best_places(np.zeros(2, int), np.array([a, b]), 1)[0]
    np.testing.assert_allclose(clusters.places[a], best, atol=1e-5)
    np.testing.assert_allclose(clusters.places[c], vertices[c], atol=1e-6)
    assert clusters.undo(np.array([a])) == 2
    np.testing.assert_array_equal(clusters.faces(), faces)
    np.testing.assert_allclose(clusters.places, vertices, atol=1e-6)
    assert clusters.undo(np.array([a])) == 0


def test_the_cluster_of_a_vertex_that_is_left_behind_is_found_once():
    """A corner of a box goes into its neighbour; what has not changed since is not looked at again."""
    vertices, triangles = samples.box()
    faces = triangles.astype(np.uint32)
    one, other = (int(corner) for corner in triangles[0, :2])
    names = np.where(np.arange(8) == other, one, np.arange(8))
    left = names[triangles]
    left = left[(left != left[:, (1, 2, 0)]).all(axis=1)]
    standing = np.unique(left)
    found = []
    for bound in (0.1, 9.0):
        clusters, deviation = Clusters(vertices, faces, np.zeros(3)), Deviation(vertices, faces, bound)
        assert clusters.find_left_behind(deviation).tolist() == []
        clusters.collapse(np.array([[one, other]]), vertices[standing], np.searchsorted(standing, left))
        found += [clusters.find_left_behind(deviation).tolist(), clusters.find_left_behind(deviation).tolist()]
    assert found == [[one], [], [], []]


def test_rest_of_a_cluster_at_a_border_stays_there():
    """Two vertices of the border of a sheet that is bent, and one collapse of the two undone."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(4), np.arange(3)))
    vertices = np.column_stack([x, y, 0.25 * y**2]).astype(float)
    corner = (x + 4 * y)[(x < 3) & (y < 2)]
    lower, upper = (np.column_stack([corner, corner + one, corner + other]) for one, other in ((1, 5), (5, 4)))
    faces = np.concatenate([lower, upper]).astype(np.uint32)
    clusters = Clusters(vertices, faces, np.zeros(3))
    names = np.array([0, 1, 1, 1, 4, 5, 6, 7, 8, 9, 10, 11])
    left = names[faces]
    left = left[(left != left[:, (1, 2, 0)]).all(axis=1)]
    standing = np.unique(left)
    clusters.collapse(np.array([[1, 2], [1, 3]]), vertices[standing], np.searchsorted(standing, left))
    clusters.undo(np.array([1]))
    assert clusters.names[[1, 2, 3]].tolist() == [1, 1, 3]
    np.testing.assert_array_equal(clusters.places[[1, 3]], vertices[[1, 3]])


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 90.0, float("nan")])
def test_impossible_shares_are_refused(fraction):
    with refused(UsageError, 0, 1):
        decimate_mesh(Mesh(*samples.sphere()), fraction, 1.0)


def test_mesh_refinement_is_public():
    import clrecon

    assert {"smooth_mesh", "decimate_mesh", "compare_meshes"} <= set(clrecon.__all__)


def test_rounds_end_where_one_takes_hardly_any_triangle():
    sphere = Mesh(*samples.sphere(rounds=1))
    said = decimate_mesh(sphere, 0.5, 1e-3).report["refinement"]["decimate"]
    assert (said["rounds"], said["reached"], said["ended_by"], said["vertices_taken_back"]) == (2, 0.0, "bound", 0)


def test_a_mesh_of_2_to_the_31_corners_is_too_large():
    def of(vertices: int, triangles: int) -> Any:
        return SimpleNamespace(vertex_count=vertices, triangle_count=triangles, check=lambda: None)

    assert check_refinement(of(1, 715_827_882), 1.0) == check_refinement(of(2**31 - 1, 1), 1.0) == 1.0
    for large in (of(1, 715_827_883), of(2**31, 1)):
        with refused(UsageError, 715827882):
            check_refinement(large, 1.0)


@pytest.mark.parametrize("bound", [0.05, 0.4])
def test_the_last_iteration_of_a_round_reaches_four_squares_of_the_bound(monkeypatch, bound):
    """fast-simplification ends after iteration 99, with the error 1e-9 * (99 + 3)**agg in units of what it is given."""
    seen = []

    def look(points: np.ndarray, faces: np.ndarray, agg: float, **_: object) -> tuple[np.ndarray, ...]:
        seen.append((points, agg))
        return points, faces, np.zeros((0, 2), int)

    monkeypatch.setattr("fast_simplification.simplify", look)
    vertices, triangles = samples.sphere(rounds=1)
    _collapse(Clusters(vertices, triangles.astype(np.uint32), np.zeros(3)), 0.5, bound)
    ((points, agg),) = seen
    scale = np.ptp(points, axis=0) / np.ptp(vertices, axis=0)
    np.testing.assert_allclose(4.0 * (bound * scale) ** 2, 1e-9 * 102.0**agg, rtol=1e-6)


def test_a_cluster_whose_place_alone_has_changed_is_undone():
    """The vertex that stays is moved down along all axes, and goes back to its place."""
    vertices, triangles = samples.sphere(rounds=1)
    a, b = (int(corner) for corner in triangles[0, :2])
    clusters = Clusters(vertices, triangles.astype(np.uint32), np.zeros(3))
    names = np.arange(len(vertices))
    names[b] = a
    left = names[triangles]
    left = left[(left != left[:, (1, 2, 0)]).all(axis=1)]
    standing = np.unique(left)
    points = vertices[standing]
    points[standing == a] -= 0.25
    before = clusters.places[a].copy()
    clusters.collapse(np.array([[a, b]]), points, np.searchsorted(standing, left))
    np.testing.assert_allclose(clusters.places[a], before - 0.25, atol=1e-6)
    assert clusters.undo(np.array([a])) == 2  # the vertex that stays, and the one that had gone
    np.testing.assert_array_equal(clusters.places[a], before)


def test_a_face_that_is_as_at_first_again_can_cut_one_that_has_moved_there():
    """The upper tip of an octahedron is taken away, the bottom of a box comes down there, and the tip comes back."""
    vertices, triangles = samples.join(samples.sphere(radius=1.0, rounds=0), samples.box((-3, -3, 1.5), (6, 6, 1)))
    clusters = Clusters(vertices, triangles.astype(np.uint32), np.zeros(3))
    pairs = np.array([[0, 4], [6, 7]])
    names = np.arange(len(vertices))
    names[pairs[:, 1]] = pairs[:, 0]
    left = names[triangles]
    left = left[(left != left[:, (1, 2, 0)]).all(axis=1)]
    standing = np.unique(left)
    points = vertices[standing]
    points[standing == 6] = [0.0, -3.0, -0.5]
    clusters.collapse(pairs, points, np.searchsorted(standing, left))
    assert len(clusters.find_crossing()) == 0
    assert clusters.undo(np.array([0])) == 2
    assert {4, 6} <= set(clusters.find_crossing().tolist())


def test_all_of_a_surface_without_faces_is_a_fault():
    vertices, triangles = samples.box()
    clusters = Clusters(vertices, triangles.astype(np.uint32), np.zeros(3))
    clusters.collapse(np.array([[5, n] for n in range(8) if n != 5]), np.zeros((0, 3)), np.zeros((0, 3), int))
    assert len(clusters.faces()) == 0 and clusters.find_faults().tolist() == [5]


def test_the_corners_of_faces_without_area_are_faults():
    """A corner on the edge between two others: the face between them is flat, and its neighbour is not."""
    vertices, triangles = samples.box()
    vertices = np.concatenate([vertices, [[0.5, 0.0, 0.0]]])
    clusters = Clusters(vertices, np.concatenate([triangles, [[0, 8, 1]]]).astype(np.uint32), np.zeros(3))
    found = np.concatenate(_find_flat(clusters._stored(), clusters.faces()))
    assert found.tolist() == [0, 8, 1]


def test_less_is_taken_where_the_shift_that_restores_a_volume_is_too_short():
    large, (vertices, triangles) = samples.sphere((20.0, 0.0, 0.0), 10.0, 3), samples.sphere((0.0, 0.0, 0.0), 1.4, 2)
    mesh = Mesh(*samples.join(large, (vertices, triangles)))
    coarse = decimate_mesh(mesh, 0.7, 0.2)
    small = coarse.vertices[coarse.triangles][:, :, 0].max(axis=1) < 5.0
    assert 0 < small.sum() < len(triangles)
    part = Mesh(coarse.vertices, coarse.triangles[small])
    wanted = Mesh(vertices, triangles).quality()["volume_ml"]
    assert part.quality()["volume_ml"] == pytest.approx(wanted, rel=0.004)
    assert coarse.report["refinement"]["decimate"]["vertices_taken_back"] > 0
