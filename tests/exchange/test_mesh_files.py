"""Every format is read back by other libraries: same vertices, same triangles, same winding, same volume."""

from __future__ import annotations

import dataclasses
import errno
import io
import json
import struct
import zipfile

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from full_disk import FullDisk
from refusals import refused

from clrecon.errors import NoSurfaceError, OutputError, UsageError
from clrecon.exchange import formats as writers
from clrecon.exchange.formats import FORMATS
from clrecon.mesh import Mesh

pytestmark = pytest.mark.unit

AFFINE = [[0.7, 0.1, 0.0, -169.4], [0.0, 0.5, -0.3, 165.0], [0.0, 0.2, 2.5, -846.25], [0.0, 0.0, 0.0, 1.0]]
LPS_FROM_SCENE = np.array([[1000.0, 0, 0], [0, 0, -1000.0], [0, 1000.0, 0]])
SIGNS = {"lps": np.array([1, 1, 1], np.float32), "ras": np.array([-1, -1, 1], np.float32)}
EXTENSIONS = sorted(FORMATS)
REMARKS = ["SPACE=LPS", "UNIT=mm", "ISO_VALUE_HU=249.5"]


@pytest.fixture(params=[True, False], ids=["normals", "bare"])
def mesh(request) -> Mesh:
    """An oblique torus beside a sphere, far from the origin, one coordinate exactly 0, no vertex unused."""
    vertices, triangles = samples.join(samples.torus(), samples.sphere(centre=(40.3, 1.1, 5.7), radius=3.3))
    oblique, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    oblique *= np.sign(np.linalg.det(oblique))
    vertices = vertices @ oblique.T + (-169.4, 165.01, -846.25)
    vertices[5, 1] = 0.0
    normals = np.random.default_rng(4).normal(size=vertices.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    report = {"iso_value_hu": 249.5, "affine_ijk_to_lps_mm": AFFINE, "device": "a device", "patient": "DOE^JANE"}
    return Mesh(vertices, triangles, normals if request.param else None, report)


def assert_same_mesh(mesh: Mesh, vertices, triangles, space="lps", atol=0.0):
    """Same triangles with the same winding; exact float32 coordinates unless `atol` (mm) is given."""
    expected = samples.ordered_soup(mesh.vertices * SIGNS[space], mesh.triangles)
    read = np.asarray(vertices)
    if atol:
        # Snap to the vertices of the mesh, so that rounding cannot change the order.
        own = mesh.vertices * SIGNS[space]
        distance = np.linalg.norm(read[:, None] - own[None], axis=2)
        assert distance.min(axis=1).max() <= atol
        read = own[distance.argmin(axis=1)]
    np.testing.assert_array_equal(samples.ordered_soup(np.float32(read), triangles), expected)
    quality = Mesh(read, triangles).quality()
    assert quality["volume_ml"] == pytest.approx(mesh.quality()["volume_ml"], rel=tolerances.MESH_VOLUME)
    assert quality["volume_ml"] > 0


def assert_same_mesh_in_file(mesh: Mesh, extension: str, vertices, triangles, space: str):
    """The same of what a library read; a scene of GLB is in metres, Y up, at the same place for both frames."""
    assert len(triangles) == mesh.triangle_count
    if extension == ".glb":
        atol = 1000 * tolerances.GLB_METRES * np.abs(mesh.vertices).max()
        assert_same_mesh(mesh, np.asarray(vertices) @ LPS_FROM_SCENE.T, triangles, atol=atol)
    else:
        assert_same_mesh(mesh, vertices, triangles, space)


def read_polydata(path):
    pyvista = pytest.importorskip("pyvista")
    if path.suffix == ".glb":
        blocks = list(pyvista.read(path).recursive_iterator(skip_none=True))
        assert len(blocks) == 1
        return np.asarray(blocks[0].points), blocks[0]
    polydata = pyvista.read(path)
    return np.asarray(polydata.points), polydata


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", [e for e in EXTENSIONS if e not in (".vtp", ".html")])
def test_trimesh_reads_the_mesh_that_was_saved(mesh, extension, space, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh.save(tmp_path / f"bone{extension}", space=space)
    read = trimesh.load_scene(tmp_path / f"bone{extension}", process=False, maintain_order=True).to_mesh()
    assert_same_mesh_in_file(mesh, extension, read.vertices, read.faces, space)


def test_trimesh_reads_3mf_in_millimetres(mesh, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh.save(tmp_path / "bone.3mf")
    assert trimesh.load_scene(tmp_path / "bone.3mf").units in ("mm", "millimeter", "millimeters")


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_saving_a_mesh_returns_the_bytes_of_its_file(mesh, extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    assert mesh.save(path) == path.stat().st_size


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", [e for e in EXTENSIONS if e not in (".3mf", ".html")])
def test_vtk_reads_the_mesh_that_was_saved(mesh, extension, space, tmp_path):
    mesh.save(tmp_path / f"bone{extension}", space=space)
    points, polydata = read_polydata(tmp_path / f"bone{extension}")
    assert_same_mesh_in_file(mesh, extension, points, polydata.regular_faces, space)


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", [".ply", ".obj", ".vtp"])
@pytest.mark.parametrize("mesh", [True], ids=["normals"], indirect=True)
def test_vtk_reads_the_normals_that_were_saved(mesh, extension, space, tmp_path):
    mesh.save(tmp_path / f"bone{extension}", space=space)
    _, polydata = read_polydata(tmp_path / f"bone{extension}")
    normals = np.asarray(polydata.point_data["Normals"])
    np.testing.assert_allclose(normals, mesh.normals * SIGNS[space], atol=tolerances.MESH_UNIT_NORMAL)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_mesh_saved_at_another_time_has_the_same_bytes(mesh, extension, tmp_path, monkeypatch):
    mesh.save(tmp_path / f"one{extension}")
    monkeypatch.setattr("time.time", lambda: 2.0e9)
    mesh.save(tmp_path / f"two{extension.upper()}")
    assert (tmp_path / f"one{extension}").read_bytes() == (tmp_path / f"two{extension.upper()}").read_bytes()


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_mesh_file_holds_no_patient_no_device_and_no_path(mesh, extension, tmp_path):
    """The report of the mesh has DOE^JANE and a device."""
    path = tmp_path / f"DOE_JANE{extension}"
    mesh.save(path)
    content = path.read_bytes()
    if extension == ".3mf":
        with zipfile.ZipFile(path) as package:
            content += b"".join(package.read(name) for name in package.namelist())
    for secret in (b"DOE", b"a device", str(tmp_path).encode()):
        assert secret not in content


FACETS = np.dtype([("floats", "<f4", (4, 3)), ("attribute", "<u2")])
"""Of a binary STL: a normal and three corners, and two bytes."""


def read_stl(path):
    """Header, number and facets of a binary STL."""
    content = path.read_bytes()
    (count,) = struct.unpack("<I", content[80:84])
    return content[:80], count, np.frombuffer(content[84:], FACETS)


@pytest.mark.parametrize(("space", "name"), [("lps", b"LPS"), ("ras", b"RAS")], ids=["lps", "ras"])
def test_stl_has_frame_unit_and_number_of_triangles_in_its_header(mesh, space, name, tmp_path):
    mesh.save(tmp_path / "bone.stl", space)
    header, count, facets = read_stl(tmp_path / "bone.stl")
    assert header == (b"clrecon SPACE=" + name + b" UNIT=mm").ljust(80)
    assert count == len(facets) == mesh.triangle_count
    assert not facets["attribute"].any()


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_stl_facets_have_the_unit_normals_of_their_corners(mesh, space, tmp_path):
    mesh.save(tmp_path / "bone.stl", space)
    _, _, facets = read_stl(tmp_path / "bone.stl")
    corners = (mesh.vertices * SIGNS[space])[mesh.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(facets["floats"][:, 0], normals, atol=tolerances.MESH_UNIT_NORMAL)


def test_stl_normals_of_a_box_have_no_negative_zeros(tmp_path):
    vertices, triangles = samples.box()
    Mesh(vertices, triangles[:, [1, 2, 0]]).save(tmp_path / "box.stl")  # edges of -1 mm times 0 mm among them
    _, _, facets = read_stl(tmp_path / "box.stl")
    of_faces = np.array([(0, 0, -1), (0, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)], np.float32)
    two_triangles_a_face = np.concatenate([of_faces, of_faces])  # in the order of `samples.CUBE_FACES`
    assert facets["floats"][:, 0].tobytes() == two_triangles_a_face.tobytes()


def test_stl_facet_without_area_has_a_normal_of_zeros(tmp_path):
    Mesh([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]]).save(tmp_path / "line.stl")
    _, _, facets = read_stl(tmp_path / "line.stl")
    assert facets["floats"][0, 0].tolist() == [0, 0, 0]


def test_ply_header_has_remarks_counts_and_normals(mesh, tmp_path):
    mesh.save(tmp_path / "bone.ply")
    lines = (tmp_path / "bone.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    has_normals = mesh.normals is not None
    assert lines == [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {remark}" for remark in REMARKS),
        f"element vertex {mesh.vertex_count}",
        *(f"property float {name}" for name in ("x", "y", "z", *(("nx", "ny", "nz") if has_normals else ()))),
        f"element face {mesh.triangle_count}",
        "property list uchar int vertex_indices",
    ]


def read_obj_lines(mesh, path, space="lps"):
    mesh.save(path, space)
    return path.read_text("ascii").splitlines()


def test_obj_begins_with_frame_unit_and_iso_value(mesh, tmp_path):
    lines = read_obj_lines(mesh, tmp_path / "bone.obj", "ras")
    assert lines[:3] == ["# SPACE=RAS", "# UNIT=mm", "# ISO_VALUE_HU=249.5"]


def test_obj_has_every_digit_of_float32_and_no_negative_zero(mesh, tmp_path):
    lines = [line for line in read_obj_lines(mesh, tmp_path / "bone.obj", "ras") if line.startswith("v ")]
    read = np.array([line.split()[1:] for line in lines], dtype=np.float32)
    vertices, _ = mesh.in_space("ras")
    np.testing.assert_array_equal(read, vertices)
    assert not any("-0" in line.split() for line in lines)  # one coordinate is 0, and its sign turns in RAS


def test_obj_faces_name_vertices_and_normals_from_1(mesh, tmp_path):
    lines = read_obj_lines(mesh, tmp_path / "bone.obj")
    a, b, c = mesh.triangles[-1] + 1
    assert lines[-1] == (f"f {a} {b} {c}" if mesh.normals is None else f"f {a}//{a} {b}//{b} {c}//{c}")


def test_objects_of_an_obj_number_vertices_and_normals_apart(tmp_path):
    """The first of two tetrahedra has no normals: those of the second count from 1, its vertices from 5."""
    vertices, triangles = np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [1, 2, 3]]
    with writers.stage_assembly(
        [Mesh(vertices, triangles), Mesh(vertices, triangles, vertices)], tmp_path / "a.obj", "lps"
    ) as staged:
        staged.commit()
    faces = [line for line in (tmp_path / "a.obj").read_text().splitlines() if line.startswith("f ")]
    assert faces == ["f 1 3 2", "f 2 3 4", "f 5//1 7//3 6//2", "f 6//2 7//3 8//4"]


def test_iso_value_that_is_not_known_is_left_out_of_an_obj(tmp_path):
    Mesh(*samples.box()).save(tmp_path / "box.obj")
    assert (tmp_path / "box.obj").read_text().splitlines()[:3] == ["# SPACE=LPS", "# UNIT=mm", "v 0 0 0"]


@dataclasses.dataclass
class Glb:
    """Header, JSON document and what follows it in a GLB file."""

    header: tuple
    document: dict
    rest: bytes


def save_glb(mesh, path, space="lps"):
    size = mesh.save(path, space)
    content = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sIII4s", content[:20])
    assert length == size
    end = 20 + json_length
    return Glb((magic, version, kind, json_length % 4), json.loads(content[20:end]), content[end:])


def test_glb_begins_with_a_json_chunk_of_whole_words(mesh, tmp_path):
    glb = save_glb(mesh, tmp_path / "bone.glb")
    assert glb.header == (b"glTF", 2, b"JSON", 0)  # the last: bytes beyond whole words


@pytest.mark.parametrize(("space", "sign"), [("lps", 1.0), ("ras", -1.0)], ids=["lps", "ras"])
def test_matrix_of_a_glb_turns_millimetres_of_its_frame_into_metres_with_y_up(mesh, space, sign, tmp_path):
    matrix = save_glb(mesh, tmp_path / "bone.glb", space).document["nodes"][0]["matrix"]
    mm = 0.001 * sign  # left is x, and anterior is z: -y of LPS
    x, y, z = (mm, 0, 0, 0), (0, 0, -mm, 0), (0, 0.001, 0, 0)  # where each axis of the frame points
    assert matrix == [*x, *y, *z, 0, 0, 0, 1]


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_glb_has_frame_unit_iso_value_and_the_matrix_back_in_its_extras(mesh, space, tmp_path):
    document = save_glb(mesh, tmp_path / "bone.glb", space).document
    extras = document["asset"]["extras"]
    assert (extras["SPACE"], extras["unit"], extras["iso_value_hu"]) == (space.upper(), "mm", 249.5)
    matrix, back = (
        np.array(values).reshape(4, 4).T
        for values in (document["nodes"][0]["matrix"], extras[f"matrix_to_{space.upper()}_mm"])
    )
    np.testing.assert_allclose(back @ matrix, np.eye(4), atol=tolerances.EXACT_MATRIX)


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_buffer_of_a_glb_holds_vertices_and_normals_of_its_frame_as_they_are(mesh, space, tmp_path):
    glb = save_glb(mesh, tmp_path / "bone.glb", space)
    vertices, normals = mesh.in_space(space)
    chunk_header = 8
    stored = np.frombuffer(glb.rest, "<f4", vertices.size, chunk_header)
    np.testing.assert_array_equal(stored, vertices.ravel())
    if normals is not None:
        stored = np.frombuffer(glb.rest, "<f4", vertices.size, chunk_header + vertices.nbytes)
        np.testing.assert_array_equal(stored, normals.ravel())


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_positions_of_a_glb_have_their_bounds(mesh, space, tmp_path):
    positions = save_glb(mesh, tmp_path / "bone.glb", space).document["accessors"][0]
    vertices, _ = mesh.in_space(space)
    assert positions["min"] == vertices.min(axis=0).tolist()
    assert positions["max"] == vertices.max(axis=0).tolist()


VERTEX_BYTES, INDEX_BYTES = 8 * 3 * 4, 12 * 3 * 4
"""Of a box: 8 vertices of three float32, and as many normals; 12 triangles of three uint32."""
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
FLOAT, UNSIGNED_INT = 5126, 5125
"""Numbers of OpenGL."""


def save_box_as_glb(has_normals, path):
    vertices, triangles = samples.box()
    return save_glb(Mesh(vertices, triangles, vertices - 0.5 if has_normals else None), path)


@pytest.mark.parametrize("has_normals", [True, False], ids=["normals", "bare"])
def test_views_of_a_glb_follow_each_other_over_the_whole_buffer(has_normals, tmp_path):
    glb = save_box_as_glb(has_normals, tmp_path / "box.glb")
    floats = [VERTEX_BYTES, VERTEX_BYTES] if has_normals else [VERTEX_BYTES]
    ends = np.cumsum(floats).tolist()
    assert glb.document["bufferViews"] == [
        *(
            {"buffer": 0, "byteOffset": end - length, "byteLength": length, "target": ARRAY_BUFFER}
            for end, length in zip(ends, floats, strict=True)
        ),
        {"buffer": 0, "byteOffset": ends[-1], "byteLength": INDEX_BYTES, "target": ELEMENT_ARRAY_BUFFER},
    ]
    whole = ends[-1] + INDEX_BYTES
    assert glb.document["buffers"] == [{"byteLength": whole}]
    assert struct.unpack("<I4s", glb.rest[:8]) == (whole, b"BIN\0")
    assert len(glb.rest) == 8 + whole


@pytest.mark.parametrize("has_normals", [True, False], ids=["normals", "bare"])
def test_accessors_of_a_glb_have_type_and_count_of_vertices_normals_and_indices(has_normals, tmp_path):
    document = save_box_as_glb(has_normals, tmp_path / "box.glb").document
    accessors = [
        (accessor["bufferView"], accessor["componentType"], accessor["count"], accessor["type"])
        for accessor in document["accessors"]
    ]
    vectors = [(0, FLOAT, 8, "VEC3"), (1, FLOAT, 8, "VEC3")][: 1 + has_normals]
    assert accessors == [*vectors, (len(vectors), UNSIGNED_INT, 36, "SCALAR")]


def test_glb_of_a_patient_stands_upright_and_faces_the_viewer(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    head, nose, left = [0, 0, 1000], [0, -1000, 0], [1000, 0, 0]  # LPS mm: superior, anterior, left
    Mesh([head, nose, left], [[0, 1, 2]]).save(tmp_path / "axes.glb")
    read = trimesh.load_scene(tmp_path / "axes.glb", process=False).to_mesh()
    up, towards_viewer, right = [0, 1, 0], [0, 0, 1], [1, 0, 0]  # of a scene of glTF, m
    np.testing.assert_allclose(read.vertices, [up, towards_viewer, right], atol=tolerances.GLB_SCENE_M)


def test_vtp_has_frame_unit_iso_value_and_affine_as_field_arrays(mesh, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh.save(tmp_path / "bone.vtp", "ras")
    fields = pyvista.read(tmp_path / "bone.vtp").field_data
    assert list(fields["SPACE"]) == ["RAS"]
    assert list(fields["UNIT"]) == ["mm"]
    assert np.asarray(fields["ISO_VALUE_HU"]).ravel().tolist() == [249.5]
    assert np.asarray(fields["AFFINE_IJK_TO_LPS_MM"]).reshape(4, 4).tolist() == AFFINE


def test_3mf_has_its_three_parts_with_a_constant_date(mesh, tmp_path):
    mesh.save(tmp_path / "bone.3mf")
    with zipfile.ZipFile(tmp_path / "bone.3mf") as package:
        assert package.namelist() == ["[Content_Types].xml", "_rels/.rels", "3D/3dmodel.model"]
        assert {entry.date_time for entry in package.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_3mf_has_unit_and_description_in_its_model(mesh, tmp_path):
    mesh.save(tmp_path / "bone.3mf")
    with zipfile.ZipFile(tmp_path / "bone.3mf") as package:
        model = package.read("3D/3dmodel.model").decode("ascii")
    assert '<model unit="millimeter"' in model
    assert f'<metadata name="Description">{" ".join(REMARKS)}</metadata>' in model


@pytest.mark.parametrize("name", ["bone.step", "bone", "stl"])
def test_mesh_with_an_unknown_extension_is_refused_and_nothing_is_written(mesh, name, tmp_path):
    with refused(UsageError, ".3mf"):  # one of those that are written
        mesh.save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_mesh_in_an_unknown_frame_is_refused_and_nothing_is_written(mesh, tmp_path):
    with refused(UsageError, "space", "xyz"):
        mesh.save(tmp_path / "bone.stl", space="xyz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_mesh_without_triangles_is_refused_and_nothing_is_written(extension, tmp_path):
    with refused(NoSurfaceError, "surface", "empty"):
        Mesh([[0, 0, 0]], []).save(tmp_path / f"bone{extension}")
    assert list(tmp_path.iterdir()) == []


def test_mesh_with_an_index_beyond_its_vertices_is_refused_and_nothing_is_written(tmp_path):
    with refused(UsageError, 9, "vertex"):
        Mesh(np.eye(3), [[0, 1, 9]]).save(tmp_path / "bone.vtp")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_writer_of_every_mesh_format_notices_a_full_disk(mesh, extension):
    content = mesh.describe_parts("lps", 1) if extension == ".html" else mesh.describe("lps")
    with refused(OSError, errno.ENOSPC):
        FORMATS[extension].code.write(FullDisk(room=700), content)


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_check_of_a_mesh_file_accepts_it_whole_and_refuses_it_cut(mesh, extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    mesh.save(path)
    content, whole = mesh.describe("lps"), path.read_bytes()
    FORMATS[extension].code.verify(path, content)
    for length in (len(whole) - 2, len(whole) // 2, 90):  # in its end, its data and its header
        path.write_bytes(whole[:length])
        with refused(OutputError, "disk"):
            FORMATS[extension].code.verify(path, content)


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_check_of_a_mesh_file_refuses_that_of_a_mesh_with_a_triangle_less(mesh, extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    mesh.save(path)
    fewer = Mesh(mesh.vertices, mesh.triangles[1:], mesh.normals, mesh.report)
    with refused(OutputError, "disk"):
        FORMATS[extension].code.verify(path, fewer.describe("lps"))


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_mesh_file_that_fails_its_check_leaves_the_older_one(mesh, extension, tmp_path, monkeypatch):
    path = tmp_path / f"bone{extension}"
    path.write_bytes(b"older")
    monkeypatch.setattr(FORMATS[extension].code, "write", lambda stream, content: stream.write(b"x" * 200))
    with refused(OutputError, "disk"):
        mesh.save(path)
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_estimated_size_of_a_mesh_file_is_near_the_true_one(extension, tmp_path):
    mesh = Mesh(*samples.torus(rings=200, sides=100))
    size = mesh.save(tmp_path / f"bone{extension}")
    estimate = FORMATS[extension].code.estimate(mesh.describe("lps"))
    assert tolerances.ESTIMATE_LOW * size <= estimate <= tolerances.ESTIMATE_HIGH * size


@pytest.mark.parametrize("extension", [".stl", ".ply", ".glb"])
def test_estimated_size_of_a_binary_mesh_file_is_the_true_one(extension, tmp_path):
    mesh = Mesh(*samples.torus(rings=200, sides=100))
    size = mesh.save(tmp_path / f"bone{extension}")
    assert FORMATS[extension].code.estimate(mesh.describe("lps")) == size


def test_estimated_size_of_a_3mf_grows_with_the_text_of_its_triangles():
    """A triangle of five digits an index has 45 bytes; 6 are taken for it besides.  XML shrinks to a seventh."""
    vertices, triangles = samples.torus(rings=200, sides=100)
    estimate = FORMATS[".3mf"].code.estimate
    of_7000, of_14000 = (estimate(Mesh(vertices, triangles[:count]).describe("lps")) for count in (7_000, 14_000))
    bytes_a_triangle = len('<triangle v1="19999" v2="19999" v3="19999"/>\n') + 6
    assert of_14000 - of_7000 == 7_000 * bytes_a_triangle / 7


def test_more_vertices_than_a_ply_can_number_are_refused_before_anything_is_written():
    content = Mesh(*samples.box()).describe("lps")
    too_many = dataclasses.replace(content, vertices=samples.LongTable(2**31 + 1))
    stream = io.BytesIO()
    with refused(OutputError, "PLY", 2**31 + 1, 2**31):
        FORMATS[".ply"].code.write(stream, too_many)
    assert stream.getvalue() == b""


def test_check_of_a_vtp_with_a_wrong_end_names_the_end_that_is_missing(mesh, tmp_path):
    mesh.save(tmp_path / "bone.vtp")
    content = (tmp_path / "bone.vtp").read_bytes().rstrip()
    (tmp_path / "bone.vtp").write_bytes(content.removesuffix(b"</VTKFile>") + b"0123456789abcdefghij")
    with refused(OutputError, "VTKFile"):
        FORMATS[".vtp"].code.verify(tmp_path / "bone.vtp", mesh.describe("lps"))


def test_mesh_too_large_for_its_format_is_refused_with_formats_that_hold_it(mesh, tmp_path, monkeypatch):
    monkeypatch.setitem(FORMATS, ".stl", dataclasses.replace(FORMATS[".stl"], most_bytes=5000))
    with refused(OutputError, "PLY", "VTP", 4):  # GiB, of which the words are, whatever the number here
        mesh.save(tmp_path / "bone.stl")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", [".stl", ".glb"])
def test_formats_that_count_in_32_bits_hold_at_most_4_gib(extension):
    assert FORMATS[extension].most_bytes == 2**32 - 1


@pytest.mark.parametrize("extension", [".stl", ".ply", ".obj", ".vtp"])
def test_mesh_larger_than_the_pieces_that_writers_work_in_is_written_whole(extension, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh = Mesh(*samples.torus(rings=301, sides=113))  # 34,013 vertices: more than two pieces of 16,384 rows
    mesh.save(tmp_path / f"bone{extension}")
    polydata = pyvista.read(tmp_path / f"bone{extension}")
    corners = np.float32(polydata.points)[polydata.regular_faces]
    np.testing.assert_array_equal(corners, mesh.vertices[mesh.triangles])


@pytest.fixture(scope="module")
def far_sphere(tmp_path_factory):
    """A sphere of 0.02 mm 100 m from the origin, where steps of float32 are 0.008 mm; and its corners in an STL."""
    mesh = Mesh(*samples.sphere(centre=(1e5, -9e4, 8e4), radius=0.02, rounds=3))
    path = tmp_path_factory.mktemp("far") / "far.stl"
    mesh.save(path)
    _, _, facets = read_stl(path)
    return mesh, facets["floats"][:, 1:].reshape(-1, 3)


def test_stl_keeps_vertices_apart_that_float32_would_bring_together(far_sphere):
    mesh, corners = far_sphere
    assert len(np.unique(mesh.vertices.astype(np.float32), axis=0)) < mesh.vertex_count
    assert len(np.unique(corners, axis=0)) == mesh.vertex_count


def test_surface_finer_than_steps_of_float32_is_closed_in_an_stl(far_sphere):
    _, corners = far_sphere
    places, numbers = np.unique(corners, axis=0, return_inverse=True)
    quality = Mesh(places, numbers.reshape(-1, 3)).quality()
    assert (quality["closed"], quality["boundary_edges"], quality["manifold"]) == (True, 0, True)


def test_vertices_kept_apart_in_an_stl_move_by_a_few_steps_of_float32(far_sphere):
    mesh, corners = far_sphere
    moved = np.abs(corners - mesh.vertices[mesh.triangles].reshape(-1, 3)).max()
    assert moved < tolerances.FAR_STL_STEPS_MM
