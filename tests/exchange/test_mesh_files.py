"""Every format is read back by other libraries: same vertices, same triangles, same winding, same volume."""

from __future__ import annotations

import dataclasses
import io
import json
import struct
import zipfile

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused

from clrecon.errors import NoSurfaceError, OutputError, UsageError
from clrecon.exchange import formats as writers
from clrecon.exchange.content import write_lines
from clrecon.exchange.coordinates import _scramble, find_places, rounded_apart
from clrecon.exchange.formats import FORMATS
from clrecon.mesh import Mesh

pytestmark = pytest.mark.unit

AFFINE = [[0.7, 0.1, 0.0, -169.4], [0.0, 0.5, -0.3, 165.0], [0.0, 0.2, 2.5, -846.25], [0.0, 0.0, 0.0, 1.0]]
LPS_FROM_SCENE = np.array([[1000.0, 0, 0], [0, 0, -1000.0], [0, 1000.0, 0]])
SIGNS = {"lps": np.array([1, 1, 1], np.float32), "ras": np.array([-1, -1, 1], np.float32)}
EVERY = sorted(FORMATS)
REMARKS = ["SPACE=LPS", "UNIT=mm", "ISO_VALUE_HU=249.5"]


@pytest.fixture(params=[True, False], ids=["normals", "bare"])
def mesh(request) -> Mesh:
    """An oblique torus beside a sphere, far from the origin, one coordinate exactly 0, no vertex unused."""
    vertices, triangles = samples.join(samples.torus(), samples.sphere((40.3, 1.1, 5.7), 3.3))
    oblique = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    oblique *= np.sign(np.linalg.det(oblique))
    vertices = vertices @ oblique.T + (-169.4, 165.01, -846.25)
    vertices[5, 1] = 0.0
    normals = np.random.default_rng(4).normal(size=vertices.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    report = {"iso_value_hu": 249.5, "affine_ijk_to_lps_mm": AFFINE, "device": "a device", "patient": "DOE^JANE"}
    return Mesh(vertices, triangles, normals if request.param else None, report)


def check_same(mesh: Mesh, vertices, triangles, space="lps", atol=0.0):
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


def read_polydata(path):
    pyvista = pytest.importorskip("pyvista")
    if path.suffix == ".glb":
        blocks = list(pyvista.read(path).recursive_iterator(skip_none=True))
        assert len(blocks) == 1
        return np.asarray(blocks[0].points), blocks[0]
    polydata = pyvista.read(path)
    return np.asarray(polydata.points), polydata


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", [e for e in EVERY if e not in (".vtp", ".html")])
def test_trimesh_reads_the_same_mesh(mesh, extension, space, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"bone{extension}"
    assert mesh.save(path, space=space) == path.stat().st_size
    scene = trimesh.load_scene(path, process=False, maintain_order=True)
    read = scene.to_mesh()
    assert len(read.faces) == mesh.triangle_count
    if extension == ".glb":
        # The node matrix was applied: metres, Y up, the same place in the patient for both frames.
        atol = 1000 * tolerances.GLB_METRES * np.abs(mesh.vertices).max()
        check_same(mesh, np.asarray(read.vertices) @ LPS_FROM_SCENE.T, read.faces, atol=atol)
    else:
        check_same(mesh, read.vertices, read.faces, space)
    if extension == ".3mf":
        assert scene.units in ("mm", "millimeter", "millimeters")


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", [e for e in EVERY if e not in (".3mf", ".html")])
def test_vtk_reads_the_same_mesh(mesh, extension, space, tmp_path):
    path = tmp_path / f"bone{extension}"
    mesh.save(path, space=space)
    points, polydata = read_polydata(path)
    faces = polydata.regular_faces
    assert len(faces) == mesh.triangle_count
    if extension == ".glb":
        atol = 1000 * tolerances.GLB_METRES * np.abs(mesh.vertices).max()
        check_same(mesh, points @ LPS_FROM_SCENE.T, faces, atol=atol)
    else:
        check_same(mesh, points, faces, space)
    if extension in (".ply", ".obj", ".vtp") and mesh.normals is not None:
        normals = np.asarray(polydata.point_data["Normals"])
        np.testing.assert_allclose(normals, mesh.normals * SIGNS[space], atol=tolerances.MESH_UNIT_NORMAL)


@pytest.mark.parametrize("extension", EVERY)
def test_two_runs_give_the_same_bytes(mesh, extension, tmp_path, monkeypatch):
    mesh.save(tmp_path / f"one{extension}")
    monkeypatch.setattr("time.time", lambda: 2.0e9)
    mesh.save(tmp_path / f"two{extension.upper()}")
    assert (tmp_path / f"one{extension}").read_bytes() == (tmp_path / f"two{extension.upper()}").read_bytes()


@pytest.mark.parametrize("extension", EVERY)
def test_mesh_files_hold_no_patient_data_and_no_path(mesh, extension, tmp_path):
    path = tmp_path / f"DOE_JANE{extension}"
    mesh.save(path)
    content = path.read_bytes()
    if extension == ".3mf":
        with zipfile.ZipFile(path) as package:
            content += b"".join(package.read(name) for name in package.namelist())
    assert b"DOE" not in content and b"a device" not in content
    assert str(tmp_path).encode() not in content


@pytest.mark.parametrize(("space", "name"), [("lps", b"LPS"), ("ras", b"RAS")])
def test_stl_has_the_bytes_of_its_definition(mesh, space, name, tmp_path):
    mesh.save(tmp_path / "bone.stl", space)
    content = (tmp_path / "bone.stl").read_bytes()
    assert content[:80] == (b"clrecon SPACE=" + name + b" UNIT=mm").ljust(80)
    assert len(content) == 84 + 50 * mesh.triangle_count
    assert struct.unpack("<I", content[80:84]) == (mesh.triangle_count,)
    facets = np.frombuffer(content[84:], np.dtype([("floats", "<f4", (4, 3)), ("attribute", "<u2")]))
    corners = (mesh.vertices * SIGNS[space])[mesh.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(facets["floats"][:, 0], normals, atol=tolerances.MESH_UNIT_NORMAL)
    assert not facets["attribute"].any()


def test_stl_normals_of_a_box_have_no_negative_zeros(tmp_path):
    vertices, triangles = samples.box()
    Mesh(vertices, triangles[:, [1, 2, 0]]).save(tmp_path / "box.stl")  # edges of -1 mm times 0 mm among them
    facets = np.frombuffer((tmp_path / "box.stl").read_bytes()[84:], np.dtype([("f", "<f4", (4, 3)), ("rest", "<u2")]))
    normals = np.zeros((6, 3), np.float32)
    normals[range(6), [2, 2, 1, 1, 0, 0]] = [-1, 1] * 3  # as in CUBE_FACES
    assert facets["f"][:, 0].tobytes() == np.concatenate([normals, normals]).tobytes()


def test_stl_facet_without_area_has_no_normal(tmp_path):
    Mesh([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]]).save(tmp_path / "flat.stl")
    content = (tmp_path / "flat.stl").read_bytes()
    assert struct.unpack("<6f", content[84:108]) == (0, 0, 0, 0, 0, 0)


def test_ply_header_says_remarks_counts_and_normals(mesh, tmp_path):
    mesh.save(tmp_path / "bone.ply")
    lines = (tmp_path / "bone.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2:5] == [f"comment {remark}" for remark in REMARKS]
    assert lines[5] == f"element vertex {mesh.vertex_count}"
    assert lines[-2:] == [f"element face {mesh.triangle_count}", "property list uchar int vertex_indices"]
    assert ("property float nz" in lines) == (mesh.normals is not None)


def test_obj_has_its_header_and_every_digit_of_float32(mesh, tmp_path):
    mesh.save(tmp_path / "bone.obj", "ras")
    lines = (tmp_path / "bone.obj").read_text("ascii").splitlines()
    assert lines[:3] == ["# SPACE=RAS", "# UNIT=mm", "# ISO_VALUE_HU=249.5"]
    read = np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=np.float32)
    np.testing.assert_array_equal(read, mesh.in_space("ras")[0])
    assert not any("-0 " in f"{line} " for line in lines if line.startswith("v "))
    a, b, c = mesh.triangles[-1] + 1
    assert lines[-1] == (f"f {a} {b} {c}" if mesh.normals is None else f"f {a}//{a} {b}//{b} {c}//{c}")


def test_objects_of_an_obj_file_count_vertices_and_normals_apart(tmp_path):
    """The first of two tetrahedra has no normals: those of the second count from 1, its vertices from 5."""
    vertices, triangles = np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [1, 2, 3]]
    with writers.stage_assembly(
        [Mesh(vertices, triangles), Mesh(vertices, triangles, vertices)], tmp_path / "a.obj", "lps"
    ) as staged:
        staged.commit()
    faces = [line for line in (tmp_path / "a.obj").read_text().splitlines() if line.startswith("f ")]
    assert faces == ["f 1 3 2", "f 2 3 4", "f 5//1 7//3 6//2", "f 6//2 7//3 8//4"]


def test_iso_value_is_left_out_when_not_known(tmp_path):
    Mesh(*samples.box()).save(tmp_path / "box.obj")
    assert (tmp_path / "box.obj").read_text().splitlines()[:3] == ["# SPACE=LPS", "# UNIT=mm", "v 0 0 0"]


@pytest.mark.parametrize("space", ["lps", "ras"])
def test_glb_document_says_frame_unit_and_matrix(mesh, space, tmp_path):
    mesh.save(tmp_path / "bone.glb", space)
    content = (tmp_path / "bone.glb").read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, length, kind, json_length % 4) == (b"glTF", 2, len(content), b"JSON", 0)
    document = json.loads(content[20 : 20 + json_length])
    matrix = document["nodes"][0]["matrix"]
    s = 0.001 if space == "lps" else -0.001
    assert matrix == [s, 0, 0, 0, 0, 0, -s, 0, 0, 0.001, 0, 0, 0, 0, 0, 1]
    extras = document["asset"]["extras"]
    assert (extras["SPACE"], extras["unit"], extras["iso_value_hu"]) == (space.upper(), "mm", 249.5)
    back = np.array(extras[f"matrix_to_{space.upper()}_mm"]).reshape(4, 4).T
    np.testing.assert_allclose(back @ np.array(matrix).reshape(4, 4).T, np.eye(4), atol=1e-12)
    assert np.linalg.det(back) > 0
    position = document["accessors"][0]
    own = mesh.in_space(space)[0]
    assert (position["min"], position["max"]) == (own.min(axis=0).tolist(), own.max(axis=0).tolist())
    # The buffer holds millimetres of the patient frame as they are.
    np.testing.assert_array_equal(np.frombuffer(content, "<f4", own.size, 28 + json_length), own.ravel())
    if mesh.normals is not None:
        stored = np.frombuffer(content, "<f4", own.size, 28 + json_length + own.nbytes)
        np.testing.assert_array_equal(stored, mesh.in_space(space)[1].ravel())


@pytest.mark.parametrize("has_normals", [True, False])
def test_the_parts_of_a_glb_file_lie_one_after_the_other(has_normals, tmp_path):
    vertices, triangles = samples.box()
    Mesh(vertices, triangles, vertices - 0.5 if has_normals else None).save(tmp_path / "box.glb")
    content = (tmp_path / "box.glb").read_bytes()
    (json_length,) = struct.unpack("<I", content[12:16])
    document = json.loads(content[20 : 20 + json_length])
    # 8 vertices of three float32, as many normals, 12 triangles of three uint32: bytes, and the target of OpenGL.
    parts = [(96, 34962), (96, 34962), (144, 34963)] if has_normals else [(96, 34962), (144, 34963)]
    starts = np.cumsum([0] + [length for length, _ in parts]).tolist()
    assert document["bufferViews"] == [
        {"buffer": 0, "byteOffset": start, "byteLength": length, "target": target}
        for start, (length, target) in zip(starts, parts, strict=False)
    ]
    assert document["buffers"] == [{"byteLength": starts[-1]}]
    *coordinates, indices = (
        (part["bufferView"], part["componentType"], part["count"], part["type"]) for part in document["accessors"]
    )
    assert coordinates == [(number, 5126, 8, "VEC3") for number in range(len(parts) - 1)]
    assert indices == (len(parts) - 1, 5125, 36, "SCALAR")
    size, kind = struct.unpack("<I4s", content[20 + json_length : 28 + json_length])
    assert (size, kind, len(content)) == (starts[-1], b"BIN\0", 28 + json_length + starts[-1])


def test_glb_stands_upright_and_faces_the_viewer(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    head, nose, left = [0, 0, 1000], [0, -1000, 0], [1000, 0, 0]  # LPS mm: superior, anterior, left
    Mesh([head, nose, left], [[0, 1, 2]]).save(tmp_path / "axes.glb")
    read = trimesh.load_scene(tmp_path / "axes.glb", process=False).to_mesh()
    np.testing.assert_allclose(read.vertices, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-7)


def test_vtp_has_frame_unit_level_and_affine_as_field_arrays(mesh, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh.save(tmp_path / "bone.vtp", "ras")
    fields = pyvista.read(tmp_path / "bone.vtp").field_data
    assert (list(fields["SPACE"]), list(fields["UNIT"])) == (["RAS"], ["mm"])
    assert np.asarray(fields["ISO_VALUE_HU"]).ravel().tolist() == [249.5]
    assert np.asarray(fields["AFFINE_IJK_TO_LPS_MM"]).reshape(4, 4).tolist() == AFFINE


def test_3mf_has_its_three_parts_unit_and_description(mesh, tmp_path):
    mesh.save(tmp_path / "bone.3mf")
    with zipfile.ZipFile(tmp_path / "bone.3mf") as package:
        assert package.namelist() == ["[Content_Types].xml", "_rels/.rels", "3D/3dmodel.model"]
        assert {entry.date_time for entry in package.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        model = package.read("3D/3dmodel.model").decode("ascii")
    assert '<model unit="millimeter"' in model
    assert f'<metadata name="Description">{" ".join(REMARKS)}</metadata>' in model


def test_unknown_extension_lists_those_that_are_written(mesh, tmp_path):
    for name in ("bone.step", "bone", "stl"):
        with refused(UsageError, ".3mf"):
            mesh.save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_space_is_refused(mesh, tmp_path):
    with refused(UsageError, "space", "xyz"):
        mesh.save(tmp_path / "bone.stl", space="xyz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", EVERY)
def test_empty_mesh_writes_nothing(extension, tmp_path):
    with refused(NoSurfaceError, "surface", "empty"):
        Mesh([[0, 0, 0]], []).save(tmp_path / f"bone{extension}")
    assert list(tmp_path.iterdir()) == []


def test_wrong_index_writes_nothing(tmp_path):
    with refused(UsageError, 9, "vertex"):
        Mesh(np.eye(3), [[0, 1, 9]]).save(tmp_path / "bone.vtp")
    assert list(tmp_path.iterdir()) == []


class FullDisk(io.RawIOBase):
    """Takes some bytes and then says what a full disk says."""

    def __init__(self, room: int):
        self.room = room

    def writable(self):
        return True

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return len(data)


@pytest.mark.faults
@pytest.mark.parametrize("extension", EVERY)
def test_every_writer_notices_a_full_disk(mesh, extension):
    content = mesh.describe_parts("lps", 1) if extension == ".html" else mesh.describe("lps")
    with refused(OSError, 28):
        FORMATS[extension].code.write(FullDisk(700), content)


@pytest.mark.faults
@pytest.mark.parametrize("extension", EVERY)
def test_a_file_that_was_cut_or_belongs_to_another_mesh_is_found(mesh, extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    mesh.save(path)
    content = mesh.describe("lps")
    FORMATS[extension].code.verify(path, content)
    whole = path.read_bytes()
    for length in (len(whole) - 2, len(whole) // 2, 90):
        path.write_bytes(whole[:length])
        with refused(OutputError, "disk"):
            FORMATS[extension].code.verify(path, content)
    path.write_bytes(whole)
    fewer = Mesh(mesh.vertices, mesh.triangles[1:], mesh.normals, mesh.report)
    with refused(OutputError, "disk"):
        FORMATS[extension].code.verify(path, fewer.describe("lps"))


@pytest.mark.faults
@pytest.mark.parametrize("extension", EVERY)
def test_an_older_file_survives_a_failed_check(mesh, extension, tmp_path, monkeypatch):
    path = tmp_path / f"bone{extension}"
    path.write_bytes(b"older")
    monkeypatch.setattr(FORMATS[extension].code, "write", lambda stream, content: stream.write(b"x" * 200))
    with refused(OutputError, "disk"):
        mesh.save(path)
    assert path.read_bytes() == b"older"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("extension", EVERY)
def test_estimated_size_of_a_mesh_file_is_near_the_true_one(extension, tmp_path):
    mesh = Mesh(*samples.torus(200, 100))
    size = mesh.save(tmp_path / f"bone{extension}")
    estimate = FORMATS[extension].code.estimate(mesh.describe("lps"))
    assert 0.5 * size <= estimate <= 1.1 * size
    if extension in (".stl", ".ply", ".glb"):
        assert estimate == size


def test_estimate_of_3mf_counts_the_digits_of_triangles():
    """A triangle of five digits an index has 45 bytes; 6 are taken for it besides.  XML shrinks to a seventh."""
    vertices, triangles = samples.torus(200, 100)
    estimates = [
        FORMATS[".3mf"].code.estimate(Mesh(vertices, triangles[:count]).describe("lps")) for count in (7_000, 14_000)
    ]
    assert estimates[1] - estimates[0] == 1_000 * (len('<triangle v1="19999" v2="19999" v3="19999"/>\n') + 6)


def test_more_vertices_than_a_ply_file_can_count_are_refused():
    content = Mesh(*samples.box()).describe("lps")
    large = dataclasses.replace(content, vertices=samples.LongTable(2**31 + 1))
    stream = io.BytesIO()
    with refused(OutputError, "PLY", 2147483649, 2147483648):
        FORMATS[".ply"].code.write(stream, large)
    assert stream.getvalue() == b""


def test_the_end_of_a_vtp_file_is_quoted_where_it_is_wrong(mesh, tmp_path):
    mesh.save(tmp_path / "bone.vtp")
    content = (tmp_path / "bone.vtp").read_bytes().rstrip()
    assert content.endswith(b"</VTKFile>")
    (tmp_path / "bone.vtp").write_bytes(content[:-10] + b"0123456789abcdefghij")
    with refused(OutputError, "VTKFile"):
        FORMATS[".vtp"].code.verify(tmp_path / "bone.vtp", mesh.describe("lps"))


def test_mesh_too_large_for_its_format_is_refused_with_other_formats(mesh, tmp_path, monkeypatch):
    small = FORMATS[".stl"]
    monkeypatch.setitem(FORMATS, ".stl", dataclasses.replace(small, most_bytes=5000))
    with refused(OutputError, "PLY", "VTP", 4):
        mesh.save(tmp_path / "bone.stl")
    assert list(tmp_path.iterdir()) == []
    assert FORMATS[".glb"].most_bytes == small.most_bytes == 2**32 - 1


def test_meshes_larger_than_a_piece_are_written_whole(tmp_path):
    """Meshes larger than the pieces that writers work in."""
    pyvista = pytest.importorskip("pyvista")
    mesh = Mesh(*samples.torus(301, 113))
    for extension in (".stl", ".ply", ".obj", ".vtp"):
        mesh.save(tmp_path / f"bone{extension}")
        polydata = pyvista.read(tmp_path / f"bone{extension}")
        corners = np.float32(polydata.points)[polydata.regular_faces]
        np.testing.assert_array_equal(corners, mesh.vertices[mesh.triangles])


def test_stl_keeps_vertices_apart_that_float32_would_bring_together(tmp_path):
    """100 m from the origin steps are 8 um: a closed surface with finer details must not be open in the file."""
    vertices, triangles = samples.sphere((1e5, -9e4, 8e4), 0.02, 3)
    mesh = Mesh(vertices, triangles)
    assert mesh.vertices.dtype == np.float64
    assert len(np.unique(mesh.vertices.astype(np.float32), axis=0)) < mesh.vertex_count
    mesh.save(tmp_path / "far.stl")
    packed = np.frombuffer((tmp_path / "far.stl").read_bytes()[84:], np.uint8).reshape(-1, 50)
    corners = packed[:, 12:48].copy().view("<f4").reshape(-1, 3)
    places, number = np.unique(corners, axis=0, return_inverse=True)
    assert len(places) == mesh.vertex_count
    by_place = Mesh(places, number.reshape(-1, 3)).quality()
    assert (by_place["closed"], by_place["boundary_edges"], by_place["manifold"]) == (True, 0, True)
    assert np.abs(corners - mesh.vertices[mesh.triangles].reshape(-1, 3)).max() < 0.05


def test_rounding_brings_no_vertex_to_a_place_of_others():
    """1 km from the origin: 500 pairs of vertices at one place each stay pairs, and no third vertex joins them."""
    rng = np.random.default_rng(3)
    points = 1e6 + rng.uniform(0.0, 2.0, (10_000, 3))
    points[-500:] = points[:500]
    rounded = rounded_apart(points)
    assert np.array_equal(rounded[-500:], rounded[:500])
    assert len(np.unique(rounded, axis=0)) == len(np.unique(points, axis=0)) == 9_500


def test_places_of_one_sum_are_told_apart():
    vertices = np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3], [-0.0, 0, 0], [3, 2, 1]])
    first, place = find_places(vertices)
    assert (first.tolist(), place.tolist()) == ([0, 1, 4], [0, 1, 0, 1, 2])
    of_one, of_three = _scramble(vertices[[0, 4], :1])
    vertices[4, 1:] = (of_one ^ of_three ^ vertices[0, 1].view(np.uint64)).view(np.float64), 3.0
    assert np.isfinite(vertices).all() and len(np.unique(_scramble(vertices))) == 2
    first, place = find_places(vertices)
    assert (first.tolist(), place.tolist()) == ([0, 1, 4], [0, 1, 0, 1, 2])


@pytest.mark.parametrize("form", ["f %d %d %d\n", "%d,%d,%d;"])
@pytest.mark.parametrize("highest", [1, 10, 12_345, 4_294_967_296])
def test_whole_numbers_are_written_digit_for_digit(form, highest):
    rows = np.random.default_rng(3).integers(0, highest, (500, 3))
    rows[0] = 0, highest - 1, min(9, highest - 1)
    stream = io.BytesIO()
    write_lines(stream, form, rows)
    assert stream.getvalue().decode() == "".join(form % tuple(row) for row in rows.tolist())
