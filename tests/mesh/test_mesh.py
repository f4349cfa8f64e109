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


@pytest.fixture
def sphere_and_cube():
    """Two parts from pyvista; the number at each vertex is twice its x."""
    pyvista = pytest.importorskip("pyvista")
    mesh = Mesh.from_pyvista(pyvista.Sphere() + pyvista.Cube(center=(9, 0, 0)).triangulate())
    mesh.values = {"HU": mesh.vertices[:, 0] * 2.0}
    return mesh


def test_numbers_at_vertices_are_point_data_of_pyvista(sphere_and_cube):
    surface = sphere_and_cube.to_pyvista()
    np.testing.assert_array_equal(surface.point_data["HU"], sphere_and_cube.values["HU"])


def test_of_the_point_data_of_pyvista_only_named_numbers_are_taken(sphere_and_cube):
    surface = sphere_and_cube.to_pyvista()
    surface.point_data["vectors"], surface.point_data["with space"] = surface.points, surface.points[:, 0]
    assert set(Mesh.from_pyvista(surface).values) == {"HU"}


def test_numbers_at_vertices_stay_with_a_moved_part(sphere_and_cube):
    sphere = sphere_and_cube.transformed(np.diag([1.0, 2.0, 1.0, 1.0])).keep_largest()
    assert len(sphere.values["HU"]) == sphere.vertex_count < sphere_and_cube.vertex_count
    np.testing.assert_allclose(sphere.values["HU"], sphere.vertices[:, 0] * 2.0, rtol=1e-6)


def test_numbers_at_vertices_are_scalars_of_a_ply(sphere_and_cube, tmp_path):
    sphere_and_cube.save(tmp_path / "a.ply")
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


@pytest.fixture
def two_boxes():
    """A box at the origin with HU, and one at x = 5 with mm; their reports differ in voxel and device."""
    one = Mesh(*samples.box(), report={"voxel_mm": 0.5, "iso_value_hu": 226, "device": "a"})
    other = Mesh(*samples.box((5.0, 0.0, 0.0)), report={"voxel_mm": 2.0, "iso_value_hu": 226, "device": "b"})
    one.values["HU"], other.values["mm"] = np.arange(8.0), np.ones(8)
    return one, other


def test_merged_meshes_stand_one_after_the_other(two_boxes):
    one, other = two_boxes
    merged = one.merge(other, one)
    np.testing.assert_array_equal(merged.vertices, np.concatenate([one.vertices, other.vertices, one.vertices]))
    np.testing.assert_array_equal(merged.triangles[12:24], other.triangles + 8)
    assert merged.volume == pytest.approx(3.0)
    assert len(merged.split()) == 3


def test_numbers_that_a_merged_mesh_lacks_are_nan(two_boxes):
    one, other = two_boxes
    merged = one.merge(other, one)
    np.testing.assert_array_equal(merged.values["HU"], [*range(8), *[np.nan] * 8, *range(8)])
    np.testing.assert_array_equal(merged.values["mm"], [*[np.nan] * 8, *[1.0] * 8, *[np.nan] * 8])


def test_report_of_merged_meshes_keeps_what_is_equal_and_the_shortest_voxel(two_boxes):
    one, other = two_boxes
    assert one.merge(other, one).report == {"iso_value_hu": 226, "voxel_mm": 0.5}


def test_merging_leaves_the_first_mesh_as_it_is(two_boxes):
    one, other = two_boxes
    one.merge(other, one)
    assert one.values.keys() == {"HU"}
    assert len(one.split()) == 1


def test_normals_are_merged_only_where_every_mesh_has_them(two_boxes):
    plain, _ = two_boxes
    with_normals = Mesh(plain.vertices, plain.triangles, np.tile([0.0, 0.0, 1.0], (8, 1)))
    assert with_normals.merge(with_normals).normals.shape == (16, 3)
    assert with_normals.merge(plain).normals is None
    assert plain.merge(plain).normals is None


def test_merging_a_list_of_meshes_is_refused(two_boxes):
    one, other = two_boxes
    with refused(UsageError, "mesh.merge", "meshes"):
        one.merge([other])


@pytest.fixture
def volume():
    return Volume(np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6), np.diag([0.5, 0.7, 2.0, 1.0]))


@pytest.fixture
def box_in_the_volume():
    return Mesh(*samples.box((0.3, 0.6, 1.0)), report={"iso_value_hu": 226})


def test_a_mesh_is_sampled_at_its_vertices(volume, box_in_the_volume):
    sampled = box_in_the_volume.sample(volume).sample(volume, "nearest", 0)
    np.testing.assert_array_equal(sampled.values["HU"], volume.sample(sampled.vertices).astype(np.float32))
    np.testing.assert_array_equal(sampled.values["nearest"], volume.sample(sampled.vertices, order=0))
    assert np.isfinite(sampled.values["HU"]).all()


def test_a_vertex_outside_of_the_volume_gets_the_given_value(volume, box_in_the_volume):
    sampled = box_in_the_volume.sample(volume[:1], "first", outside=-1024)  # one slice: all vertices lie beside it
    assert sampled.values["first"].min() == -1024


def test_sampling_makes_a_mesh_of_its_own(volume, box_in_the_volume):
    sampled = box_in_the_volume.sample(volume)
    assert box_in_the_volume.values == {}
    assert sampled.report == box_in_the_volume.report and sampled.report is not box_in_the_volume.report


@pytest.mark.parametrize("name", ["a.ply", "a.vtp"])
def test_sampled_values_are_kept_by_mesh_files(volume, box_in_the_volume, tmp_path, name):
    sampled = box_in_the_volume.sample(volume).sample(volume, "nearest", 0)
    sampled.save(tmp_path / name)
    kept = read_mesh(tmp_path / name).values
    assert kept.keys() == {"HU", "nearest"}
    for column, values in kept.items():
        np.testing.assert_array_equal(values, sampled.values[column])


def test_sampled_values_are_an_attribute_of_a_glb(volume, box_in_the_volume, tmp_path):
    box_in_the_volume.sample(volume).save(tmp_path / "a.glb")
    assert b'"_HU":' in (tmp_path / "a.glb").read_bytes()


def test_sampled_values_and_labels_of_a_cloud_are_kept_by_its_file(volume, box_in_the_volume, tmp_path):
    vertices = box_in_the_volume.vertices
    PointCloud(vertices, labels=np.arange(8)).sample(volume).save(tmp_path / "a.npz")
    kept = read_points(tmp_path / "a.npz")
    np.testing.assert_array_equal(kept.hu, volume.sample(vertices).astype(np.float32))
    assert kept.labels.tolist() == list(range(8))


@pytest.mark.parametrize("kind", [Mesh, PointCloud])
def test_sampling_what_is_no_volume_is_refused(kind, box_in_the_volume):
    subject = box_in_the_volume if kind is Mesh else PointCloud(box_in_the_volume.vertices)
    with refused(UsageError, "Volume", "volume"):
        subject.sample(box_in_the_volume)


def test_sampling_under_a_name_with_a_space_is_refused(volume, box_in_the_volume):
    with refused(UsageError, "_", "names"):
        box_in_the_volume.sample(volume, "mean HU")


@pytest.fixture
def numbered_faces():
    """A box of 12 triangles and one eight times as large of 12, numbered from 0 to 23, with HU at the 16 vertices."""
    mesh = Mesh(*samples.box()).merge(Mesh(*samples.box((5.0, 0.0, 0.0), (2.0, 2.0, 2.0))))
    mesh.face_values["stress"], mesh.values["HU"] = np.arange(24.0), np.arange(16.0)
    return mesh


def test_merged_meshes_without_numbers_at_faces_have_none():
    assert Mesh(*samples.box()).merge(Mesh(*samples.box())).face_values == {}


def test_parts_keep_the_numbers_at_their_faces(numbered_faces):
    assert numbered_faces.keep_largest().face_values["stress"].tolist() == list(range(12, 24))
    assert [part.face_values["stress"][0] for part in numbered_faces.split()] == [12, 0]


def test_a_mirrored_mesh_keeps_the_numbers_at_its_faces(numbered_faces):
    mirrored = numbered_faces.transformed(np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert mirrored.face_values["stress"].tolist() == list(range(24))


def test_faces_of_a_merged_mesh_without_numbers_are_nan(numbered_faces):
    merged = numbered_faces.merge(Mesh(*samples.box()))
    np.testing.assert_array_equal(merged.face_values["stress"], [*range(24), *[np.nan] * 12])


def by_file(mesh, path):
    mesh.save(path)
    return read_mesh(path)


@pytest.mark.parametrize(
    "there_and_back",
    [
        lambda mesh, folder: by_file(mesh, folder / "a.ply"),
        lambda mesh, folder: by_file(mesh, folder / "a.vtp"),
        lambda mesh, folder: Mesh.from_pyvista(mesh.to_pyvista()),
        lambda mesh, folder: Mesh.from_trimesh(mesh.to_trimesh()),
    ],
    ids=["ply", "vtp", "pyvista", "trimesh"],
)
def test_numbers_at_faces_come_back_from_files_and_libraries(numbered_faces, tmp_path, there_and_back):
    pytest.importorskip("trimesh")
    back = there_and_back(numbered_faces, tmp_path)
    np.testing.assert_array_equal(back.triangles, numbered_faces.triangles)
    assert {name: values.tolist() for name, values in back.face_values.items()} == {"stress": list(range(24))}
    assert {name: values.tolist() for name, values in back.values.items()} == {"HU": list(range(16))}


def test_numbers_at_faces_that_are_too_few_are_refused(numbered_faces, tmp_path):
    numbered_faces.face_values["stress"] = np.zeros(16)
    with refused(UsageError, "face_values", "stress", 24):
        numbered_faces.save(tmp_path / "b.vtp")
