"""The Mesh itself: what it takes, keeps and refuses, and how VTK sees it."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused

from clrecon import PointCloud, Volume, read_mesh, read_points
from clrecon.errors import UsageError
from clrecon.mesh import Mesh

pytestmark = pytest.mark.unit


def test_arrays_of_the_right_type_are_not_copied():
    vertices = np.zeros((3, 3), np.float32)
    triangles = np.array([[0, 1, 2]], np.uint32)
    mesh = Mesh(vertices, triangles, vertices)
    assert mesh.vertices is vertices and mesh.triangles is triangles and mesh.normals is vertices
    assert (mesh.vertex_count, mesh.triangle_count, mesh.report) == (3, 1, {})


def test_arrays_of_other_types_are_converted():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 2.5, 0]], np.array([[0, 1, 2]], np.int64)[:, ::-1])
    assert (mesh.vertices.dtype, mesh.triangles.dtype) == (np.float32, np.uint32)
    assert mesh.vertices[2, 1] == 2.5
    assert mesh.triangles.tolist() == [[2, 1, 0]]
    assert mesh.triangles.flags.c_contiguous
    assert mesh.normals is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([[0, 0]], []), r"vertices have shape \(n, 3\), these have \(1, 2\)"),
        (([[0, 0, 0]], [[0, 0, 0, 0]]), r"triangles have shape \(n, 3\)"),
        (([[0, 0, 0]], [[0.0, 0.0, 0.0]]), "integers"),
        (([[0, 0, 0]], [[0, 0, -1]]), "from -1 to 0"),
        (([[0, 0, 0]], [[0, 0, 2**32]]), "must fit 32 bits"),
        (([["a", "b", "c"]], []), "vertices are numbers"),
        (([[0, 0, 0]], [], [[0, 0, 1], [0, 0, 1]]), "2 normals for 1 vertices"),
    ],
)
def test_wrong_arrays_are_refused(arguments, words):
    with pytest.raises(UsageError, match=words):
        Mesh(*arguments)


def test_check_finds_what_the_constructor_does_not_look_at():
    corners = np.eye(3)
    with refused(UsageError, "vertex", 7, 3):
        Mesh(corners, [[0, 1, 7]]).check()
    corners[1, 2] = np.nan
    with refused(UsageError, 1, "vertex"):
        Mesh(corners, [[0, 1, 2]]).check()
    with refused(UsageError, 1, "normal"):
        Mesh(np.eye(3), [[0, 1, 2]], corners).to_pyvista()


def test_ras_is_a_half_turn():
    vertices, triangles = samples.sphere((3, 0, -7))
    mesh = Mesh(vertices, triangles, (vertices - (3, 0, -7)) / 10)
    turned, normals = mesh.in_space("ras")
    np.testing.assert_array_equal(turned, mesh.vertices * [-1, -1, 1])
    np.testing.assert_array_equal(normals, mesh.normals * [-1, -1, 1])
    assert not np.signbit(turned[turned == 0]).any()
    assert Mesh(turned, triangles).quality()["volume_ml"] == pytest.approx(mesh.quality()["volume_ml"])
    assert mesh.in_space("lps")[0] is mesh.vertices
    with refused(UsageError, "RAI", "space"):
        mesh.in_space("RAI")


def test_pyvista_sees_the_same_mesh_without_a_copy():
    vertices, triangles = samples.torus()
    mesh = Mesh(vertices, triangles, np.tile(np.float32([0, 0, 1]), (len(vertices), 1)))
    polydata = mesh.to_pyvista()
    assert np.shares_memory(np.asarray(polydata.points), mesh.vertices)
    assert np.shares_memory(np.asarray(polydata.point_data["Normals"]), mesh.normals)
    np.testing.assert_array_equal(polydata.regular_faces, triangles)
    assert polydata.is_manifold and polydata.n_open_edges == 0
    assert polydata.volume / 1000 == pytest.approx(mesh.quality()["volume_ml"], rel=1e-5)
    assert polydata.point_data.active_normals_name == "Normals"
    assert (list(polydata.field_data["SPACE"]), list(polydata.field_data["UNIT"])) == (["LPS"], ["mm"])
    expected = mesh.vertices.copy()
    del mesh, vertices
    gc.collect()
    np.testing.assert_array_equal(polydata.points, expected)


def test_repr_of_a_mesh_says_vertices_triangles_and_frame():
    assert repr(Mesh(*samples.box())) == "Mesh(8 vertices, 12 triangles, LPS mm)"


def test_contents_of_a_file_have_name_and_colour_of_a_part():
    content = Mesh(*samples.box(), None, {"part_name": "001", "color": [1, 0.5, 0]}).describe("LPS")
    assert (content.name, content.color) == ("001", (1.0, 0.5, 0.0))
    plain = Mesh(*samples.box()).describe("LPS")
    assert (plain.name, plain.color) == (None, None)


def test_empty_mesh_has_arrays_of_three_columns():
    assert Mesh([], []).vertices.shape == Mesh(np.zeros((0, 3)), []).vertices.shape == (0, 3)
    with refused(UsageError, 3, 0, 2):
        Mesh(np.zeros((0, 2)), [])


def test_a_moved_turned_and_scaled_mesh_has_its_points_normals_and_volume():
    vertices, triangles = samples.sphere((3, 0, -7))
    mesh = Mesh(vertices, triangles, (vertices - (3, 0, -7)) / 10, {"iso_value_hu": 200.0, "certificate": {"a": 1}})
    turn_and_stretch = np.array([[0, -2, 0, 5], [1, 0, 0, 6], [0, 0, 3, 7], [0, 0, 0, 1.0]])
    moved = mesh.transformed(turn_and_stretch)
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(moved.vertices, np.stack([5 - 2 * y, 6 + x, 7 + 3 * z], axis=1), rtol=0, atol=1e-5)
    assert moved.quality()["volume_ml"] == pytest.approx(6 * mesh.quality()["volume_ml"], rel=1e-5)
    towards = np.stack([-mesh.normals[:, 1] / 2, mesh.normals[:, 0], mesh.normals[:, 2] / 3], axis=1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(moved.normals, towards, rtol=0, atol=1e-6)
    assert moved.report == {"iso_value_hu": 200.0, "moved_by": turn_and_stretch.tolist()}
    np.testing.assert_array_equal(mesh.vertices, vertices.astype(np.float32))
    back = moved.transformed(np.linalg.inv(turn_and_stretch))
    np.testing.assert_allclose(back.vertices, mesh.vertices, rtol=0, atol=1e-5)
    np.testing.assert_allclose(back.report["moved_by"], np.eye(4), rtol=0, atol=1e-12)


def test_a_mirrored_mesh_still_looks_outward():
    mesh = Mesh(*samples.torus())
    mirrored = mesh.transformed(np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert mirrored.quality()["volume_ml"] == pytest.approx(mesh.quality()["volume_ml"], rel=1e-6)
    assert mirrored.normals is None
    np.testing.assert_array_equal(mirrored.triangles, mesh.triangles[:, ::-1])


@pytest.mark.parametrize(
    ("matrix", "words"), [(np.eye(3), ("4x4",)), (np.diag([1.0, 0, 1, 1]), ("singular",)), (np.ones((4, 4)), ("row",))]
)
def test_matrix_that_is_no_affine_moves_no_mesh(matrix, words):
    with refused(UsageError, *words):
        Mesh(*samples.sphere((0, 0, 0))).transformed(matrix)


def test_numbers_at_vertices_go_with_the_mesh(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh = Mesh.from_pyvista(pyvista.Sphere() + pyvista.Cube(center=(9, 0, 0)).triangulate())
    mesh.values = {"HU": mesh.vertices[:, 0] * 2.0}
    surface = mesh.to_pyvista()
    np.testing.assert_array_equal(surface.point_data["HU"], mesh.values["HU"])
    surface.point_data["vectors"], surface.point_data["with space"] = surface.points, surface.points[:, 0]
    back = Mesh.from_pyvista(surface)
    assert set(back.values) == {"HU"}
    moved = back.transformed(np.diag([1.0, 2.0, 1.0, 1.0]))
    largest = moved.keep_largest()
    np.testing.assert_allclose(largest.values["HU"], largest.vertices[:, 0] * 2.0, rtol=1e-6)
    assert len(largest.values["HU"]) == largest.vertex_count < mesh.vertex_count
    back.save(tmp_path / "a.ply")
    assert b"property float scalar_HU" in (tmp_path / "a.ply").read_bytes()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"HU": np.zeros(3)}, r"values\['HU'\] are float64 of shape \(3,\): one number a vertex is needed, \(4,\)"),
        ({"HU": np.zeros((4, 2))}, "one number a vertex"),
        ({"HU": ["a"] * 4}, "one number a vertex"),
        ({"a b": np.zeros(4)}, "letters, digits and _"),
    ],
)
def test_numbers_that_fit_no_vertex_are_refused(values, words, tmp_path):
    corners = np.vstack([np.zeros(3), np.eye(3)])
    mesh = Mesh(corners, [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    mesh.values = values
    with pytest.raises(UsageError, match=words):
        mesh.save(tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())


def test_merged_meshes_keep_their_arrays_and_numbers_and_the_shortest_voxel():
    one = Mesh(*samples.box(), report={"voxel_mm": 0.5, "iso_value_hu": 226, "device": "a"})
    other = Mesh(*samples.box((5.0, 0.0, 0.0)), report={"voxel_mm": 2.0, "iso_value_hu": 226, "device": "b"})
    one.values["HU"], other.values["mm"] = np.arange(8.0), np.ones(8)
    both = one.merge(other, one)
    assert both.vertices.tolist() == [*one.vertices.tolist(), *other.vertices.tolist(), *one.vertices.tolist()]
    assert both.triangles[12:24].tolist() == (other.triangles + 8).tolist() and both.volume == pytest.approx(3.0)
    np.testing.assert_array_equal(both.values["HU"], [*range(8), *[np.nan] * 8, *range(8)])
    np.testing.assert_array_equal(both.values["mm"], [*[np.nan] * 8, *[1.0] * 8, *[np.nan] * 8])
    assert both.report == {"iso_value_hu": 226, "voxel_mm": 0.5} and both.normals is None
    assert one.values.keys() == {"HU"} and len(one.split()) == 1 and len(both.split()) == 3
    turned = Mesh(one.vertices, one.triangles, np.tile([0.0, 0.0, 1.0], (8, 1)))
    assert turned.merge(turned).normals.shape == (16, 3) and turned.merge(one).normals is None
    with refused(UsageError, "mesh.merge", "meshes"):
        one.merge([other])


def test_the_values_of_a_volume_are_sampled_at_vertices_and_points_and_kept_by_files(tmp_path):
    volume = Volume(np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6), np.diag([0.5, 0.7, 2.0, 1.0]))
    mesh = Mesh(*samples.box((0.3, 0.6, 1.0)), report={"iso_value_hu": 226})
    made = mesh.sample(volume).sample(volume, "nearest", 0).sample(volume[:1], "first", outside=-1024)
    assert mesh.values == {} and made.report == mesh.report and made.report is not mesh.report
    np.testing.assert_array_equal(made.values["HU"], volume.sample(mesh.vertices).astype(np.float32))
    np.testing.assert_array_equal(made.values["nearest"], volume.sample(mesh.vertices, order=0))
    assert made.values["first"].min() == -1024 and np.isfinite(made.values["HU"]).all()
    for name in ("a.ply", "a.vtp"):
        made.save(tmp_path / name)
        back = read_mesh(tmp_path / name).values
        assert {name: values.tolist() for name, values in back.items()} == {
            name: values.tolist() for name, values in made.values.items()
        }
    made.save(tmp_path / "a.glb")
    assert b'"_HU":' in (tmp_path / "a.glb").read_bytes()
    cloud = PointCloud(mesh.vertices, labels=np.arange(8)).sample(volume)
    cloud.save(tmp_path / "a.npz")
    again = read_points(tmp_path / "a.npz")
    assert again.hu.tolist() == made.values["HU"].tolist() and again.labels.tolist() == list(range(8))
    for asked in (mesh, cloud):
        with refused(UsageError, "Volume", "volume"):
            asked.sample(mesh)
    with refused(UsageError, "_", "names"):
        mesh.sample(volume, "mean HU")


def test_numbers_at_faces_go_with_the_mesh_and_its_files(tmp_path):
    pytest.importorskip("trimesh")
    mesh = Mesh(*samples.box()).merge(Mesh(*samples.box((5.0, 0.0, 0.0), (2.0, 2.0, 2.0))))
    assert mesh.face_values == {}
    mesh.face_values["stress"], mesh.values["HU"] = np.arange(24), np.arange(16.0)
    np.testing.assert_array_equal(mesh.keep_largest().face_values["stress"], np.arange(12, 24))
    assert [part.face_values["stress"][0] for part in mesh.split()] == [12, 0]
    mirrored = mesh.transformed(np.diag([-1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_array_equal(mirrored.face_values["stress"], np.arange(24))
    both = mesh.merge(Mesh(*samples.box()))
    np.testing.assert_array_equal(both.face_values["stress"], [*range(24), *[np.nan] * 12])
    for name in ("a.ply", "a.vtp"):
        mirrored.save(tmp_path / name)
    for back in (
        read_mesh(tmp_path / "a.ply"),
        read_mesh(tmp_path / "a.vtp"),
        Mesh.from_pyvista(mirrored.to_pyvista()),
        Mesh.from_trimesh(mirrored.to_trimesh()),
    ):
        np.testing.assert_array_equal(back.triangles, mirrored.triangles)
        assert back.face_values["stress"].tolist() == list(range(24))
        assert back.values["HU"].tolist() == list(range(16))
        assert back.values.keys() == {"HU"} and back.face_values.keys() == {"stress"}
    mesh.face_values["stress"] = np.zeros(16)
    with refused(UsageError, "face_values", "stress", 24):
        mesh.save(tmp_path / "b.vtp")
