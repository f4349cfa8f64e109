"""The Mesh itself: what it takes, keeps and refuses, and how VTK sees it."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused

from clrecon import PointCloud, Volume, read_mesh, read_points
from clrecon.errors import UsageError
from clrecon.mesh import Mesh

pytestmark = pytest.mark.unit


def test_arrays_of_float32_and_uint32_are_not_copied():
    vertices = np.zeros((3, 3), np.float32)
    triangles = np.array([[0, 1, 2]], np.uint32)
    mesh = Mesh(vertices, triangles, normals=vertices)
    assert mesh.vertices is vertices
    assert mesh.triangles is triangles
    assert mesh.normals is vertices


def test_new_mesh_counts_its_vertices_and_triangles_and_has_an_empty_report():
    mesh = Mesh(np.eye(3), [[0, 1, 2]])
    assert (mesh.vertex_count, mesh.triangle_count, mesh.report) == (3, 1, {})


@pytest.mark.parametrize("integers", [np.int64, np.uint32])
def test_lists_and_integers_become_float32_vertices_and_contiguous_uint32_triangles(integers):
    reversed_columns = np.array([[0, 1, 2]], integers)[:, ::-1]  # not contiguous
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 2.5, 0]], reversed_columns)
    assert (mesh.vertices.dtype, mesh.triangles.dtype) == (np.float32, np.uint32)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 2.5, 0]]
    assert mesh.triangles.tolist() == [[2, 1, 0]]
    assert mesh.triangles.flags.c_contiguous


def test_mesh_made_without_normals_has_none():
    assert Mesh(np.eye(3), [[0, 1, 2]]).normals is None


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
    ids=[
        "two columns of vertices",
        "four corners a triangle",
        "corners are floats",
        "negative corner",
        "corner beyond 32 bits",
        "vertices are text",
        "more normals than vertices",
    ],
)
def test_wrong_arrays_are_refused(arguments, words):
    with pytest.raises(UsageError, match=words):
        Mesh(*arguments)


def test_check_refuses_a_triangle_that_names_a_missing_vertex():
    with refused(UsageError, "vertex", 7, 3):
        Mesh(np.eye(3), [[0, 1, 7]]).check()


def test_check_refuses_a_vertex_that_is_not_finite():
    vertices = np.eye(3)
    vertices[1, 2] = np.nan
    with refused(UsageError, 1, "vertex"):
        Mesh(vertices, [[0, 1, 2]]).check()


def test_normals_that_are_not_finite_are_refused_on_the_way_to_pyvista():
    normals = np.eye(3)
    normals[1, 2] = np.nan
    with refused(UsageError, 1, "normal"):
        Mesh(np.eye(3), [[0, 1, 2]], normals=normals).to_pyvista()


SPHERE_CENTRE = (3, 0, -7)


def sphere_with_normals(report: dict | None = None) -> Mesh:
    """A sphere of 10 mm about (3, 0, -7)."""
    vertices, triangles = samples.sphere(SPHERE_CENTRE, radius=10.0)
    return Mesh(vertices, triangles, normals=(vertices - SPHERE_CENTRE) / 10.0, report=report)


def test_vertices_and_normals_in_ras_have_x_and_y_negated():
    mesh = sphere_with_normals()
    vertices, normals = mesh.in_space("ras")
    np.testing.assert_array_equal(vertices, mesh.vertices * [-1, -1, 1])
    np.testing.assert_array_equal(normals, mesh.normals * [-1, -1, 1])


def test_coordinates_in_ras_hold_no_negative_zero():
    vertices, _ = sphere_with_normals().in_space("ras")
    zeros = vertices[vertices == 0]
    assert len(zeros) > 0
    assert not np.signbit(zeros).any()


def test_a_mesh_in_ras_keeps_its_volume_and_its_sign():
    mesh = sphere_with_normals()
    vertices, _ = mesh.in_space("ras")
    assert Mesh(vertices, mesh.triangles).volume == pytest.approx(mesh.volume)


def test_vertices_in_lps_are_those_of_the_mesh_without_a_copy():
    mesh = sphere_with_normals()
    vertices, _ = mesh.in_space("lps")
    assert vertices is mesh.vertices


def test_a_frame_that_is_neither_lps_nor_ras_is_refused():
    with refused(UsageError, "RAI", "space"):
        sphere_with_normals().in_space("RAI")


@pytest.fixture
def torus_with_normals():
    """A closed torus; each vertex has the normal (0, 0, 1)."""
    vertices, triangles = samples.torus()
    return Mesh(vertices, triangles, normals=np.tile(np.float32([0, 0, 1]), (len(vertices), 1)))


def test_pyvista_shares_the_memory_of_vertices_and_normals(torus_with_normals):
    polydata = torus_with_normals.to_pyvista()
    assert np.shares_memory(np.asarray(polydata.points), torus_with_normals.vertices)
    assert np.shares_memory(np.asarray(polydata.point_data["Normals"]), torus_with_normals.normals)


def test_pyvista_has_the_same_closed_triangles_and_volume(torus_with_normals):
    polydata = torus_with_normals.to_pyvista()
    np.testing.assert_array_equal(polydata.regular_faces, torus_with_normals.triangles)
    assert polydata.is_manifold
    assert polydata.n_open_edges == 0
    assert polydata.volume == pytest.approx(torus_with_normals.volume, rel=tolerances.PEER_MEASURE)


def test_pyvista_data_name_their_normals_frame_and_unit(torus_with_normals):
    polydata = torus_with_normals.to_pyvista()
    assert polydata.point_data.active_normals_name == "Normals"
    assert list(polydata.field_data["SPACE"]) == ["LPS"]
    assert list(polydata.field_data["UNIT"]) == ["mm"]


def test_pyvista_data_outlive_their_mesh():
    mesh = Mesh(*samples.torus())
    expected = mesh.vertices.copy()
    polydata = mesh.to_pyvista()
    del mesh
    gc.collect()
    np.testing.assert_array_equal(polydata.points, expected)


def test_repr_of_a_mesh_says_vertices_triangles_and_frame():
    assert repr(Mesh(*samples.box())) == "Mesh(8 vertices, 12 triangles, LPS mm)"


def test_contents_of_a_file_have_name_and_colour_of_a_part():
    content = Mesh(*samples.box(), report={"part_name": "001", "color": [1, 0.5, 0]}).describe("LPS")
    assert (content.name, content.color) == ("001", (1.0, 0.5, 0.0))


def test_contents_of_a_file_of_a_mesh_without_a_part_have_no_name_and_no_colour():
    content = Mesh(*samples.box()).describe("LPS")
    assert (content.name, content.color) == (None, None)


@pytest.mark.parametrize("no_vertices", [[], np.zeros((0, 3))], ids=["list", "array"])
def test_empty_mesh_has_vertices_of_three_columns(no_vertices):
    assert Mesh(no_vertices, []).vertices.shape == (0, 3)


def test_empty_vertices_of_two_columns_are_refused():
    with refused(UsageError, 3, 0, 2):
        Mesh(np.zeros((0, 2)), [])


TURN_AND_STRETCH = np.array([[0, -2, 0, 5], [1, 0, 0, 6], [0, 0, 3, 7], [0, 0, 0, 1.0]])
"""(x, y, z) -> (5 - 2 y, 6 + x, 7 + 3 z): its determinant, the factor of volumes, is 6."""


def test_transformed_vertices_lie_where_the_matrix_puts_them():
    mesh = sphere_with_normals()
    x, y, z = mesh.vertices.T
    moved = mesh.transformed(TURN_AND_STRETCH)
    expected = np.stack([5 - 2 * y, 6 + x, 7 + 3 * z], axis=1)
    np.testing.assert_allclose(moved.vertices, expected, rtol=0, atol=tolerances.MOVED_VERTEX_MM)


def test_volume_of_a_transformed_mesh_changes_by_the_determinant():
    mesh = sphere_with_normals()
    moved = mesh.transformed(TURN_AND_STRETCH)
    assert moved.volume == pytest.approx(np.linalg.det(TURN_AND_STRETCH) * mesh.volume, rel=tolerances.PEER_MEASURE)


def test_transformed_normals_stay_square_to_the_surface():
    """Normals are stretched by the inverse of what points are stretched by, and made of length 1 again."""
    mesh = sphere_with_normals()
    x, y, z = mesh.normals.T
    expected = np.stack([-y / 2, x, z / 3], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    moved = mesh.transformed(TURN_AND_STRETCH)
    np.testing.assert_allclose(moved.normals, expected, rtol=0, atol=tolerances.MESH_UNIT_NORMAL)


def test_report_of_a_transformed_mesh_names_the_matrix_and_drops_the_certificate():
    mesh = sphere_with_normals({"iso_value_hu": 200.0, "certificate": {"a": 1}})
    moved = mesh.transformed(TURN_AND_STRETCH)
    assert moved.report == {"iso_value_hu": 200.0, "moved_by": TURN_AND_STRETCH.tolist()}


def test_transforming_leaves_the_given_mesh_as_it_is():
    mesh = sphere_with_normals()
    before = mesh.vertices.copy()
    mesh.transformed(TURN_AND_STRETCH)
    np.testing.assert_array_equal(mesh.vertices, before)


def test_the_inverse_matrix_moves_a_mesh_back():
    mesh = sphere_with_normals()
    back = mesh.transformed(TURN_AND_STRETCH).transformed(np.linalg.inv(TURN_AND_STRETCH))
    np.testing.assert_allclose(back.vertices, mesh.vertices, rtol=0, atol=tolerances.MOVED_VERTEX_MM)
    np.testing.assert_allclose(back.report["moved_by"], np.eye(4), rtol=0, atol=tolerances.FLOAT64_SHARE)


def test_a_mirrored_mesh_still_looks_outward():
    mesh = Mesh(*samples.torus())
    mirrored = mesh.transformed(np.diag([-1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_array_equal(mirrored.triangles, mesh.triangles[:, ::-1])
    assert mirrored.volume == pytest.approx(mesh.volume, rel=tolerances.MESH_VOLUME)


def test_a_transformed_mesh_without_normals_has_none():
    assert Mesh(*samples.torus()).transformed(np.diag([-1.0, 1.0, 1.0, 1.0])).normals is None


@pytest.mark.parametrize(
    ("matrix", "words"),
    [(np.eye(3), ("4x4",)), (np.diag([1.0, 0, 1, 1]), ("singular",)), (np.ones((4, 4)), ("row",))],
    ids=["3x3", "singular", "last row of ones"],
)
def test_a_matrix_that_is_no_invertible_affine_is_refused(matrix, words):
    with refused(UsageError, *words):
        Mesh(*samples.sphere()).transformed(matrix)


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


def test_vectors_and_names_with_a_space_in_point_data_of_pyvista_are_left_out(sphere_and_cube):
    surface = sphere_and_cube.to_pyvista()
    surface.point_data["vectors"] = surface.points
    surface.point_data["with space"] = surface.points[:, 0]
    assert set(Mesh.from_pyvista(surface).values) == {"HU"}


def test_numbers_at_vertices_stay_with_a_moved_part(sphere_and_cube):
    """The matrix doubles y alone: x, of which the numbers are twice, stays."""
    sphere = sphere_and_cube.transformed(np.diag([1.0, 2.0, 1.0, 1.0])).keep_largest()
    assert sphere.vertex_count < sphere_and_cube.vertex_count
    np.testing.assert_allclose(sphere.values["HU"], sphere.vertices[:, 0] * 2.0, rtol=tolerances.FLOAT32_SHARE)


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
    ids=["too few", "two columns", "text", "space in the name"],
)
def test_values_that_are_not_one_number_a_vertex_under_a_plain_name_are_not_written(values, words, tmp_path):
    corners = np.vstack([np.zeros(3), np.eye(3)])
    tetrahedron = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    mesh = Mesh(corners, tetrahedron)
    mesh.values = values
    with pytest.raises(UsageError, match=words):
        mesh.save(tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def two_boxes():
    """A box at the origin with HU, and one at x = 5 with mm; their reports differ in voxel and device."""
    one = Mesh(*samples.box(), report={"voxel_mm": 0.5, "iso_value_hu": 226, "device": "a"})
    other = Mesh(*samples.box(low=(5.0, 0.0, 0.0)), report={"voxel_mm": 2.0, "iso_value_hu": 226, "device": "b"})
    one.values["HU"] = np.arange(8.0)
    other.values["mm"] = np.ones(8)
    return one, other


def test_merged_meshes_stand_one_after_the_other(two_boxes):
    one, other = two_boxes
    merged = one.merge(other, one)
    np.testing.assert_array_equal(merged.vertices, np.concatenate([one.vertices, other.vertices, one.vertices]))
    expected = np.concatenate([one.triangles, other.triangles + 8, one.triangles + 16])  # 8 vertices a box
    np.testing.assert_array_equal(merged.triangles, expected)


def test_merged_meshes_stay_components_of_their_own(two_boxes):
    one, other = two_boxes
    assert len(one.merge(other, one).split()) == 3


def test_numbers_that_a_merged_mesh_lacks_are_nan(two_boxes):
    one, other = two_boxes
    merged = one.merge(other, one)
    np.testing.assert_array_equal(merged.values["HU"], [*range(8), *[np.nan] * 8, *range(8)])
    np.testing.assert_array_equal(merged.values["mm"], [*[np.nan] * 8, *[1.0] * 8, *[np.nan] * 8])


def test_report_of_merged_meshes_keeps_equal_entries_and_the_shortest_voxel(two_boxes):
    one, other = two_boxes
    assert one.merge(other, one).report == {"iso_value_hu": 226, "voxel_mm": 0.5}


def test_merging_leaves_the_first_mesh_as_it_is(two_boxes):
    one, other = two_boxes
    one.merge(other, one)
    assert one.values.keys() == {"HU"}
    assert len(one.split()) == 1


def test_normals_are_merged_only_where_every_mesh_has_them(two_boxes):
    plain, _ = two_boxes
    with_normals = Mesh(plain.vertices, plain.triangles, normals=np.tile([0.0, 0.0, 1.0], (8, 1)))
    assert with_normals.merge(with_normals).normals.shape == (8 + 8, 3)
    assert with_normals.merge(plain).normals is None
    assert plain.merge(plain).normals is None


def test_merging_a_list_of_meshes_is_refused(two_boxes):
    one, other = two_boxes
    with refused(UsageError, "mesh.merge", "meshes"):
        one.merge([other])


@pytest.fixture
def volume():
    """Each voxel has another value: 6 columns, 5 rows and 4 slices of 0.5 x 0.7 x 2 mm."""
    return Volume(np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6), np.diag([0.5, 0.7, 2.0, 1.0]))


@pytest.fixture
def box_in_the_volume():
    """A cube of 1 mm between the centres of the voxels of `volume`: its 8 vertices lie at z = 1 and z = 2."""
    return Mesh(*samples.box(low=(0.3, 0.6, 1.0)), report={"iso_value_hu": 226})


def test_a_mesh_is_sampled_at_its_vertices_between_voxels_or_in_the_nearest(volume, box_in_the_volume):
    vertices = box_in_the_volume.vertices
    between_voxels = box_in_the_volume.sample(volume).values["HU"]
    in_the_nearest = box_in_the_volume.sample(volume, name="nearest", order=0).values["nearest"]
    np.testing.assert_array_equal(between_voxels, volume.sample(vertices).astype(np.float32))
    np.testing.assert_array_equal(in_the_nearest, volume.sample(vertices, order=0))
    assert np.isfinite(between_voxels).all()


def test_a_vertex_outside_of_the_volume_gets_the_given_value(volume, box_in_the_volume):
    first_slice = volume[:1]  # 2 mm thick: it ends at z = 1, where the lower four corners of the box lie
    sampled = box_in_the_volume.sample(first_slice, name="first", outside=-1024)
    is_outside = box_in_the_volume.vertices[:, 2] == 2.0
    assert is_outside.sum() == 4
    np.testing.assert_array_equal(sampled.values["first"] == -1024, is_outside)


def test_sampling_leaves_the_values_and_the_report_of_the_given_mesh(volume, box_in_the_volume):
    sampled = box_in_the_volume.sample(volume)
    assert box_in_the_volume.values == {}
    assert sampled.report == box_in_the_volume.report
    assert sampled.report is not box_in_the_volume.report


@pytest.mark.parametrize("name", ["a.ply", "a.vtp"])
def test_sampled_values_are_kept_by_mesh_files(volume, box_in_the_volume, tmp_path, name):
    sampled = box_in_the_volume.sample(volume).sample(volume, name="nearest", order=0)
    sampled.save(tmp_path / name)
    kept = read_mesh(tmp_path / name).values
    assert kept.keys() == {"HU", "nearest"}
    np.testing.assert_array_equal(kept["HU"], sampled.values["HU"])
    np.testing.assert_array_equal(kept["nearest"], sampled.values["nearest"])


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
def test_sampling_from_a_mesh_in_place_of_a_volume_is_refused(kind, box_in_the_volume):
    subject = box_in_the_volume if kind is Mesh else PointCloud(box_in_the_volume.vertices)
    with refused(UsageError, "Volume", "volume"):
        subject.sample(box_in_the_volume)


def test_sampling_under_a_name_with_a_space_is_refused(volume, box_in_the_volume):
    with refused(UsageError, "_", "names"):
        box_in_the_volume.sample(volume, name="mean HU")


@pytest.fixture
def numbered_faces():
    """A box of 12 triangles and one eight times as large of 12, numbered from 0 to 23, with HU at the 16 vertices."""
    mesh = Mesh(*samples.box()).merge(Mesh(*samples.box(low=(5.0, 0.0, 0.0), size=(2.0, 2.0, 2.0))))
    mesh.face_values["stress"] = np.arange(24.0)
    mesh.values["HU"] = np.arange(16.0)
    return mesh


def test_merged_meshes_without_numbers_at_faces_have_none():
    assert Mesh(*samples.box()).merge(Mesh(*samples.box())).face_values == {}


def test_the_largest_part_keeps_the_numbers_at_its_faces(numbered_faces):
    assert numbered_faces.keep_largest().face_values["stress"].tolist() == list(range(12, 24))


def test_split_parts_keep_the_numbers_at_their_faces(numbered_faces):
    large, small = numbered_faces.split()
    assert large.face_values["stress"].tolist() == list(range(12, 24))
    assert small.face_values["stress"].tolist() == list(range(12))


def test_a_mirrored_mesh_keeps_the_numbers_at_its_faces(numbered_faces):
    mirrored = numbered_faces.transformed(np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert mirrored.face_values["stress"].tolist() == list(range(24))


def test_faces_of_a_merged_mesh_without_numbers_are_nan(numbered_faces):
    box_without_numbers = Mesh(*samples.box())
    merged = numbered_faces.merge(box_without_numbers)
    np.testing.assert_array_equal(merged.face_values["stress"], [*range(24), *[np.nan] * 12])


def save_and_read(mesh, path):
    mesh.save(path)
    return read_mesh(path)


@pytest.mark.parametrize(
    "there_and_back",
    [
        lambda mesh, folder: save_and_read(mesh, folder / "a.ply"),
        lambda mesh, folder: save_and_read(mesh, folder / "a.vtp"),
        lambda mesh, folder: Mesh.from_pyvista(mesh.to_pyvista()),
        lambda mesh, folder: Mesh.from_trimesh(mesh.to_trimesh()),
    ],
    ids=["ply", "vtp", "pyvista", "trimesh"],
)
def test_numbers_at_faces_and_vertices_come_back_from_files_and_libraries(numbered_faces, tmp_path, there_and_back):
    pytest.importorskip("trimesh")
    back = there_and_back(numbered_faces, tmp_path)
    np.testing.assert_array_equal(back.triangles, numbered_faces.triangles)
    assert {name: values.tolist() for name, values in back.face_values.items()} == {"stress": list(range(24))}
    assert {name: values.tolist() for name, values in back.values.items()} == {"HU": list(range(16))}


def test_numbers_at_faces_that_are_too_few_are_refused(numbered_faces, tmp_path):
    numbered_faces.face_values["stress"] = np.zeros(16)  # for 24 faces
    with refused(UsageError, "face_values", "stress", 24):
        numbered_faces.save(tmp_path / "b.vtp")
