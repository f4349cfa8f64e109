"""Readers of meshes: what other programs and hostile hands write in OBJ, GLB, 3MF, VTP and STL."""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_one_line, refused
from sample_meshes import ball
from variants import daily

import clrecon
from clrecon import Mesh
from clrecon.errors import RefusedInputError
from clrecon.exchange.formats import stage_assembly

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
TETRA = ([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
FACET = "facet normal 0 0 1\n outer loop\n  vertex 1 2 3\n  vertex 4 2 3\n  vertex 1 6 3\n endloop\nendfacet\n"


def tetra_xml(attributes: str = 'id="1"') -> str:
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in TETRA[0])
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in TETRA[1])
    return (
        f"<object {attributes}><mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh></object>"
    )


def write_3mf(path: Path, resources: str, build: str, unit: str = "millimeter", head: str = "") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as package:
        text = f'<model unit="{unit}" xmlns="{CORE}"><resources>{resources}</resources><build>{build}</build></model>'
        package.writestr("3D/3dmodel.model", head + text)
    return path


def write_glb(path: Path, document: dict[str, Any], binary: bytes = b"") -> Path:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def glb_of(path: Path, **changes: Any) -> Path:
    """Write the tetrahedron as others do: metres, Y up, each corner a vertex of its own; `changes` replace entries."""
    vertices = np.array(TETRA[0], "<f4")[np.array(TETRA[1]).ravel()]
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "tetra"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0.21404114, 1]}}],
        "buffers": [{"byteLength": vertices.nbytes}],
        "bufferViews": [{"buffer": 0, "byteLength": vertices.nbytes}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 12}],
    } | changes
    return write_glb(path, document, vertices.tobytes())


@pytest.mark.parametrize("unit", [("micron", 1e-3), ("millimeter", 1.0), ("centimeter", 10.0), ("inch", 25.4)])
def test_3mf_is_placed_by_unit_build_and_components(tmp_path: Path, unit: tuple[str, float]) -> None:
    """A component shifted by (10, 0, 0), in an item that turns x to y, y to -x and shifts by (0, 0, 5)."""
    component = '<component objectid="1" transform="1 0 0 0 1 0 0 0 1 10 0 0"/>'
    parts = tetra_xml('id="1" name="pin"') + f'<object id="2"><components>{component}</components></object>'
    build = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 5"/><item objectid="1"/>'
    mesh = clrecon.read_mesh(write_3mf(tmp_path / "a.3mf", parts, build, unit[0]))
    placed = [(-y, x + 10, z + 5) for x, y, z in TETRA[0]]
    np.testing.assert_allclose(mesh.vertices, unit[1] * np.array([*placed, *TETRA[0]]), rtol=1e-7)
    facts = mesh.report["file"]
    assert [(part["name"], part["triangles"]) for part in facts["parts"]] == [("pin", 4), ("pin", 4)]
    assert facts["space_from"] == "assumed" and mesh.quality().closed


def test_a_mirror_turns_triangles_round(tmp_path: Path) -> None:
    build = '<item objectid="1" transform="-1 0 0 0 1 0 0 0 1 0 0 0"/>'
    mesh = clrecon.read_mesh(write_3mf(tmp_path / "a.3mf", tetra_xml(), build))
    assert mesh.quality().volume_ml == pytest.approx(1e-3)
    turned = glb_of(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [1, -1, 1]}])
    assert clrecon.read_mesh(turned).quality().volume_ml == pytest.approx(1e6)


def test_glb_of_others_is_metres_with_y_up(tmp_path: Path) -> None:
    """(L, P, S) = 1000 (X, -Z, Y) mm, after the matrix of the node; corners that coincide are joined."""
    mesh = clrecon.read_mesh(glb_of(tmp_path / "a.glb"))
    assert {tuple(place) for place in mesh.vertices.tolist()} == {
        (1000.0 * x, -1000.0 * z, 1000.0 * y) for x, y, z in TETRA[0]
    }
    assert mesh.vertex_count == 4 and mesh.quality().closed and mesh.quality().volume_ml == pytest.approx(1e6)
    facts = mesh.report["file"]
    assert (facts["unit"], facts["space_from"], mesh.report["part_name"]) == ("m", "assumed", "tetra")
    assert mesh.report["color"] == pytest.approx((1.0, 0.0, 0.5), abs=1e-4)
    quarter = {"translation": [0, 0, 1], "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "scale": [2, 2, 2], "mesh": 0}
    turned = clrecon.read_mesh(glb_of(tmp_path / "b.glb", nodes=[{"children": [1], "translation": [1, 0, 0]}, quarter]))
    expected = [(1000.0 * (1 - 2 * y), -1000.0 * (2 * z + 1), 2000.0 * x) for x, y, z in TETRA[0]]
    np.testing.assert_allclose(np.unique(turned.vertices, axis=0), np.unique(expected, axis=0), atol=1e-3)


def test_obj_of_other_programs_is_read_with_its_coloured_parts(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    first = ["# a tool", "mtllib a.mtl", "o first", "v 0 0 0 1 0 0", "v 1 0 0 1 0 0", "v 0 1 0 1 0 0", "vt 0 0"]
    second = ["o second part", "v 0 0 1 0 0 1", "v  1 0 1 0 0 1", "v 0 1 1 0 0 1", "f -3 -2 \\", "-1", "l 1 2", ""]
    path.write_text("\ufeff" + "\r\n".join([*first, "f 1/1 2/1 3/1", *second]), encoding="utf-8", newline="")
    mesh = clrecon.read_mesh(path)
    assert mesh.triangles.tolist() == [[0, 1, 2], [3, 4, 5]] and mesh.vertices[4].tolist() == [1, 0, 1]
    parts = mesh.report["file"]["parts"]
    assert [(part["name"], part["triangles"], part["color"]) for part in parts] == [
        ("first", 1, (1.0, 0.0, 0.0)),
        ("second part", 1, (0.0, 0.0, 1.0)),
    ]
    assert any("1 point, line or curved surface" in text for text in mesh.report["file"]["warnings"])


@pytest.mark.parametrize("mode", ["ascii", "binary", "appended", "zlib", "base64"])
def test_vtp_in_every_encoding_of_vtk_is_read(tmp_path: Path, mode: str) -> None:
    pyvista = pytest.importorskip("pyvista")
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    mesh = Mesh(*ball(8.0, 12))
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.triangles.astype(np.int64)))
    writer.SetFileName(str(tmp_path / "a.vtp"))
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(mode == "base64")
    if mode != "zlib":
        writer.SetCompressorTypeToNone()
    assert writer.Write() == 1
    back = clrecon.read_mesh(tmp_path / "a.vtp")
    assert np.array_equal(back.vertices, mesh.vertices) and np.array_equal(back.triangles, mesh.triangles)


@pytest.mark.parametrize("extension", [".ply", ".obj", ".glb", ".vtp"])
def test_normals_are_read_back(tmp_path: Path, extension: str) -> None:
    normals = [[0, 0, 1], [0, -1, 0], [1, 0, 0], [0, 0, -1]]
    Mesh(*TETRA, normals).save(tmp_path / f"a{extension}", "ras")
    assert clrecon.read_mesh(tmp_path / f"a{extension}").normals.tolist() == normals


@pytest.mark.parametrize("extension", [".obj", ".glb", ".3mf", ".vtp"])
def test_objects_keep_their_names_colours_and_order(tmp_path: Path, extension: str) -> None:
    vertices, triangles = ball(5.0, 6)
    meshes = [
        Mesh(vertices + 20.0 * n, triangles, None, {"part_name": f"L{n}", "color": (1.0, 0.2 * n, 0.0)})
        for n in (1, 2, 3)
    ]
    path = tmp_path / f"all{extension}"
    with stage_assembly(meshes, path, "ras") as staged:
        staged.commit()
    back = clrecon.read_mesh(path)
    assert np.array_equal(back.vertices, np.concatenate([mesh.vertices for mesh in meshes]))
    counts = [mesh.vertex_count for mesh in meshes]
    expected = [mesh.triangles + sum(counts[:n]) for n, mesh in enumerate(meshes)]
    assert np.array_equal(back.triangles, np.concatenate(expected))
    parts = back.report["file"]["parts"]
    assert [part["name"] for part in parts] == ["L1", "L2", "L3"]
    for number, part in enumerate(parts, start=1):
        assert part["triangles"] == len(triangles) and part["color"] == pytest.approx(
            (1.0, 0.2 * number, 0.0), abs=1e-3
        )


@pytest.mark.parametrize(
    "text",
    [
        f"SOLID some thing\n{FACET.upper()}ENDSOLID\n",
        f"solid\n{FACET}endsolid\n".replace("\n", "\r"),
        f"solid\n{FACET}endsolid\n".replace("\n", "\r\n"),
        f"\ufeffsolid\n{FACET}endsolid\n",
    ],
    ids=["upper case", "carriage returns", "both", "byte order mark"],
)
def test_text_stl_in_odd_spelling_is_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.stl").write_bytes(text.encode())
    mesh = clrecon.read_mesh(tmp_path / "a.stl")
    assert mesh.vertices.tolist() == [[1, 2, 3], [4, 2, 3], [1, 6, 3]] and mesh.triangle_count == 1


@pytest.mark.seconds
def test_a_facet_without_area_is_no_hindrance_to_distances(tmp_path: Path) -> None:
    vertices, triangles = ball(8.0, 12)
    Mesh(vertices, np.vstack([triangles, [(0, 0, 0)]])).save(tmp_path / "a.stl")
    found = clrecon.measure_distance(clrecon.read_mesh(tmp_path / "a.stl"), Mesh(vertices, triangles))
    assert found.hausdorff_mm < 1e-6 and found.from_reference_signed_mm is not None


THREEMF = {
    "not a zip": (lambda path: path.write_bytes(b"PK\3\4 and no more"), "cut or corrupt"),
    "other archive": (lambda path: zipfile.ZipFile(path, "w").writestr("a.txt", "a"), "no 3MF file"),
    "bomb": (lambda path: write_3mf(path, "<!--" + " " * 40_000_000 + "-->", ""), "bytes of XML cannot come from"),
    "unknown encoding": (
        lambda path: write_3mf(path, "", "", head='<?xml version="1.0" encoding="no-such"?>'),
        "unknown encoding: no-such",
    ),
    "entities": (
        lambda path: write_3mf(path, "&a;", "", head='<!DOCTYPE m [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>'),
        "declares a document type",
    ),
    "within itself": (
        lambda path: write_3mf(
            path, '<object id="1"><components><component objectid="1"/></components></object>', '<item objectid="1"/>'
        ),
        "within themselves",
    ),
    "doubled 24 times": (
        lambda path: write_3mf(
            path,
            tetra_xml('id="0"')
            + "".join(
                f'<object id="{n}"><components>{f"""<component objectid="{n - 1}"/>""" * 2}</components></object>'
                for n in range(1, 25)
            ),
            '<item objectid="24"/>',
        ),
        "more than 10,000 shapes",
    ),
    "missing object": (lambda path: write_3mf(path, "", '<item objectid="7"/>'), "object 7 is not there"),
    "flat": (
        lambda path: write_3mf(path, tetra_xml(), '<item objectid="1" transform="0 0 0 0 0 0 0 0 0 0 0 0"/>'),
        "everything flat",
    ),
    "unit": (lambda path: write_3mf(path, tetra_xml(), '<item objectid="1"/>', "cubit"), "the unit 'cubit'"),
    "vertex": (
        lambda path: write_3mf(path, tetra_xml().replace('v1="2"', 'v1="9"'), '<item objectid="1"/>'),
        "refers to vertex 9 of 4",
    ),
    "not finite": (
        lambda path: write_3mf(path, tetra_xml().replace('x="1"', 'x="nan"'), '<item objectid="1"/>'),
        "not finite",
    ),
}


@pytest.mark.parametrize("case", THREEMF)
def test_hostile_3mf_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    write, words = THREEMF[case]
    write(tmp_path / "a.3mf")
    check_refused(tmp_path / "a.3mf", words)


GLB: dict[str, tuple[dict[str, Any], str]] = {
    "node in itself": ({"nodes": [{"children": [0]}]}, "nodes within themselves"),
    "missing node": ({"scenes": [{"nodes": [3]}]}, "nodes has no number 3"),
    "beyond the end": (
        {"accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 13}]},
        "behind the end of its data",
    ),
    "a huge count": (
        {"accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 10**9}]},
        "behind the end of its data",
    ),
    "negative": ({"bufferViews": [{"buffer": 0, "byteLength": 144, "byteOffset": -12}]}, "byteOffset is -12"),
    "another file": ({"buffers": [{"byteLength": 144, "uri": "a.bin"}]}, "in another file"),
    "compressed": ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
    "strips": ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}]}, "triangle strips"),
    "kinds": ({"nodes": [{"mesh": "0"}]}, "meshes has no number '0'"),
    "not finite": ({"nodes": [{"mesh": 0, "matrix": [float("nan")] * 16}]}, "no affine of finite numbers"),
    "doubled 31 times": ({"nodes": [*({"children": [n + 1, n + 1]} for n in range(30)), {"mesh": 0}]}, "more than"),
}


@pytest.mark.parametrize("case", daily(5, GLB))
def test_hostile_glb_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    changes, words = GLB[case]
    check_refused(glb_of(tmp_path / "a.glb", **changes), words)


@pytest.mark.parametrize("kind", [b"BIM\0", b"BIO\0"])
def test_a_second_chunk_of_another_kind_is_refused(kind: bytes, tmp_path: Path) -> None:
    path = glb_of(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes().replace(b"BIN\0", kind))
    check_refused(path, "its second chunk is no binary data of its length")


def test_a_scene_without_triangles_is_an_empty_mesh(tmp_path: Path) -> None:
    mesh = clrecon.read_mesh(glb_of(tmp_path / "a.glb", meshes=[{"primitives": []}]))
    assert (mesh.vertices.shape, mesh.triangles.shape) == ((0, 3), (0, 3))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.glb", b"glTF", "no GLB file"),
        ("a.glb", struct.pack("<4sII", b"glTF", 1, 20) + bytes(8), "glTF 1"),
        ("a.glb", struct.pack("<4sIII4s", b"glTF", 2, 20, 2**31, b"JSON"), "bytes are needed"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "refers to vertex 3"),
        ("a.obj", b"v 0 0 0\nf 0 1 1\n", "indices from -1"),
        ("a.obj", b"v 0 0 0\nv 1 0\n", "unequally many"),
        ("a.obj", b"v 0 0 0\nf 1 1 1 1\n", "4 corners"),
        ("a.obj", b"v a b c\n", "cut or corrupt"),
        (
            "a.obj",
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//3 3//1\n",
            "refers to a vertex or normal that is not",
        ),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nquality float x\nend_header\n",
            "in line 4 .*'quality float x'",
        ),
        ("a.vtp", b'<VTKFile type="PolyData"><PolyData/></VTKFile>', "no triangles"),
        ("a.vtp", b'<?xml version="1.0" encoding="no-such"?><VTKFile/>', "unknown encoding: no-such"),
        ("a.vtp", b'<!DOCTYPE a><VTKFile type="PolyData"></VTKFile>', "document type"),
    ],
)
def test_harmed_files_are_refused_in_one_line(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    check_refused(tmp_path / name, words)


@pytest.mark.parametrize("extension", [".obj", ".glb", ".3mf", ".vtp"])
def test_a_file_cut_anywhere_is_refused_or_whole(extension: str, tmp_path: Path) -> None:
    """Of text that is cut between two lines nothing tells, and the end of VTP is no data; all else is refused."""
    whole = tmp_path / f"whole{extension}"
    Mesh(*ball(5.0, 6)).save(whole)
    data, path = whole.read_bytes(), tmp_path / f"cut{extension}"
    for place in np.linspace(0, len(data) - 60, 40).astype(int):
        path.write_bytes(data[:place])
        try:
            clrecon.read_mesh(path)
        except RefusedInputError as error:
            assert_one_line(error, path.name)
        else:
            assert extension == ".obj"


def test_harmed_packed_bytes_are_refused(tmp_path: Path) -> None:
    Mesh(*ball(5.0, 6)).save(tmp_path / "a.3mf")
    np.savez_compressed(tmp_path / "a.npz", points=ball(5.0, 6)[0])
    for name, read in (("a.3mf", clrecon.read_mesh), ("a.npz", clrecon.read_points)):
        data = bytearray((tmp_path / name).read_bytes())
        place = data.index(b".model" if name == "a.3mf" else b"points.npy", 100 if name == "a.3mf" else 0) + 40
        data[place : place + 40] = b"\xff" * 40
        (tmp_path / name).write_bytes(bytes(data))
        with refused(RefusedInputError, "corrupt"):
            read(tmp_path / name)


def check_refused(path: Path, words: str) -> None:
    with pytest.raises(RefusedInputError, match=words) as error:
        clrecon.read_mesh(path)
    assert "\n" not in str(error.value) and path.name in str(error.value)


FACE_ROW = [("shade", "f4"), ("count", "u1"), ("corners", "i4", (3,)), ("red", "u1"), ("flag", "i2")]
FACE_HEAD = """property float shade
property list uchar int vertex_indices
property uchar red
property short scalar_flag
end_header
"""


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_numbers_at_the_faces_of_a_ply_file_that_are_no_scalars_are_left_out_with_a_warning(
    tmp_path: Path, form: str
) -> None:
    """MeshLab writes colours, flags and qualities at faces, before or after the list of corners."""
    points, faces = (np.array(each) for each in TETRA)
    order = ">" if "big" in form else "<"
    head = f"ply\nformat {form} 1.0\nelement vertex 4\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face 4\n{FACE_HEAD}"
    rows = np.zeros(4, np.dtype(FACE_ROW).newbyteorder(order))
    rows["shade"], rows["count"], rows["corners"], rows["red"], rows["flag"] = 0.5, 3, faces, 200, -7
    body = points.astype(f"{order}f4").tobytes() + rows.tobytes()
    if form == "ascii":
        lines = [" ".join(map(str, point)) for point in points]
        lines += [f"0.5 3 {' '.join(map(str, face))} 200 -7" for face in faces]
        body = ("\n".join(lines) + "\n").encode()
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    mesh = clrecon.read_mesh(tmp_path / "a.ply")
    assert np.array_equal(mesh.vertices, points) and np.array_equal(mesh.triangles, faces)
    assert "numbers at faces left out: shade, red" in mesh.report["file"]["warnings"]
    assert {name: values.tolist() for name, values in mesh.face_values.items()} == {"flag": [-7.0] * 4}


def test_faces_of_four_corners_beside_numbers_are_refused(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    text = f"{head}element face 1\n{FACE_HEAD}0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 4 0 1 2 3 200 -7\n"
    (tmp_path / "a.ply").write_text(text)
    with refused(RefusedInputError, "a.ply", 0, 4):
        clrecon.read_mesh(tmp_path / "a.ply")
