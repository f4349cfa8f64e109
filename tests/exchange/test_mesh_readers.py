"""Readers of meshes: what other programs and hostile hands write in OBJ, GLB, 3MF, VTP and STL."""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
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


def tetrahedron_as_xml(attributes: str = 'id="1"') -> str:
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


def write_glb_of_tetrahedron(path: Path, **changes: Any) -> Path:
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


@pytest.mark.parametrize(
    ("unit", "mm"),
    [("micron", 1e-3), ("millimeter", 1.0), ("centimeter", 10.0), ("inch", 25.4)],
    ids=["micron", "millimeter", "centimeter", "inch"],
)
def test_3mf_is_placed_by_unit_build_and_components(tmp_path: Path, unit: str, mm: float) -> None:
    """A component shifted by (10, 0, 0), in an item that turns x to y, y to -x and shifts by (0, 0, 5)."""
    component = '<component objectid="1" transform="1 0 0 0 1 0 0 0 1 10 0 0"/>'
    parts = tetrahedron_as_xml() + f'<object id="2"><components>{component}</components></object>'
    build = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 5"/><item objectid="1"/>'
    mesh = clrecon.read_mesh(write_3mf(tmp_path / "a.3mf", parts, build, unit))
    placed = [(-y, x + 10, z + 5) for x, y, z in TETRA[0]]
    np.testing.assert_allclose(mesh.vertices, mm * np.array([*placed, *TETRA[0]]), rtol=tolerances.SCALED_MM)


def test_parts_of_a_3mf_have_the_names_of_their_objects(tmp_path: Path) -> None:
    build = '<item objectid="1"/><item objectid="1" transform="1 0 0 0 1 0 0 0 1 10 0 0"/>'
    mesh = clrecon.read_mesh(write_3mf(tmp_path / "a.3mf", tetrahedron_as_xml('id="1" name="pin"'), build))
    facts = mesh.report["file"]
    assert [(part["name"], part["triangles"]) for part in facts["parts"]] == [("pin", 4), ("pin", 4)]
    assert facts["space_from"] == "assumed"


TETRA_MM3 = 1 * 2 * 3 / 6
"""Of the tetrahedron with edges of 1, 2 and 3 along the axes, in mm; its GLB is in metres."""


def test_mesh_that_a_3mf_mirrors_is_read_outward(tmp_path: Path) -> None:
    build = '<item objectid="1" transform="-1 0 0 0 1 0 0 0 1 0 0 0"/>'
    mesh = clrecon.read_mesh(write_3mf(tmp_path / "a.3mf", tetrahedron_as_xml(), build))
    assert mesh.quality().volume_ml == pytest.approx(TETRA_MM3 / 1000)  # inward it would be negative


def test_mesh_that_a_glb_mirrors_is_read_outward(tmp_path: Path) -> None:
    mirrored = write_glb_of_tetrahedron(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [1, -1, 1]}])
    assert clrecon.read_mesh(mirrored).quality().volume_ml == pytest.approx(TETRA_MM3 * 1e9 / 1000)


def test_glb_of_other_programs_is_read_as_metres_with_y_up(tmp_path: Path) -> None:
    """(L, P, S) = 1000 (X, -Z, Y) mm."""
    mesh = clrecon.read_mesh(write_glb_of_tetrahedron(tmp_path / "a.glb"))
    expected = {(1000.0 * x, -1000.0 * z, 1000.0 * y) for x, y, z in TETRA[0]}
    assert {tuple(vertex) for vertex in mesh.vertices.tolist()} == expected
    assert (mesh.report["file"]["unit"], mesh.report["file"]["space_from"]) == ("m", "assumed")


def test_vertices_of_a_glb_that_coincide_are_joined(tmp_path: Path) -> None:
    """The tetrahedron is written with twelve vertices, one for each corner of a triangle."""
    mesh = clrecon.read_mesh(write_glb_of_tetrahedron(tmp_path / "a.glb"))
    assert mesh.vertex_count == 4
    assert mesh.quality().closed


def test_glb_of_one_part_gives_its_name_and_its_colour_in_srgb(tmp_path: Path) -> None:
    """Colours of glTF are linear: 0.214 is 0.5 in sRGB."""
    report = clrecon.read_mesh(write_glb_of_tetrahedron(tmp_path / "a.glb")).report
    assert report["part_name"] == "tetra"
    assert report["color"] == pytest.approx((1.0, 0.0, 0.5), abs=tolerances.GLB_COLOR)


def test_glb_is_placed_by_the_nodes_above_its_mesh(tmp_path: Path) -> None:
    parent = {"children": [1], "translation": [1, 0, 0]}
    quarter_turn_about_z = [0, 0, 0.5**0.5, 0.5**0.5]
    child = {"translation": [0, 0, 1], "rotation": quarter_turn_about_z, "scale": [2, 2, 2], "mesh": 0}
    mesh = clrecon.read_mesh(write_glb_of_tetrahedron(tmp_path / "b.glb", nodes=[parent, child]))
    in_scene = [(1 - 2 * y, 2 * x, 2 * z + 1) for x, y, z in TETRA[0]]  # m
    expected = [(1000.0 * x, -1000.0 * z, 1000.0 * y) for x, y, z in in_scene]
    np.testing.assert_allclose(
        np.unique(mesh.vertices, axis=0), np.unique(expected, axis=0), atol=tolerances.GLB_NODE_MM
    )


def read_obj_of_other_programs(path: Path) -> Mesh:
    """Two triangles as parts with colours, in lines of Windows with byte order mark, one broken, and a line 1 2."""
    first = ["# a tool", "mtllib a.mtl", "o first", "v 0 0 0 1 0 0", "v 1 0 0 1 0 0", "v 0 1 0 1 0 0", "vt 0 0"]
    second = ["o second part", "v 0 0 1 0 0 1", "v  1 0 1 0 0 1", "v 0 1 1 0 0 1", "f -3 -2 \\", "-1", "l 1 2", ""]
    path.write_text("\ufeff" + "\r\n".join([*first, "f 1/1 2/1 3/1", *second]), encoding="utf-8", newline="")
    return clrecon.read_mesh(path)


def test_obj_of_other_programs_is_read_with_its_triangles(tmp_path: Path) -> None:
    mesh = read_obj_of_other_programs(tmp_path / "a.obj")
    assert mesh.triangles.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert mesh.vertices[4].tolist() == [1, 0, 1]


def test_obj_of_other_programs_is_read_with_names_and_colours_of_its_parts(tmp_path: Path) -> None:
    parts = read_obj_of_other_programs(tmp_path / "a.obj").report["file"]["parts"]
    assert [(part["name"], part["triangles"], part["color"]) for part in parts] == [
        ("first", 1, (1.0, 0.0, 0.0)),
        ("second part", 1, (0.0, 0.0, 1.0)),
    ]


def test_lines_of_an_obj_are_left_out_with_a_warning(tmp_path: Path) -> None:
    warnings = read_obj_of_other_programs(tmp_path / "a.obj").report["file"]["warnings"]
    assert any("1 point, line or curved surface" in warning for warning in warnings)


@pytest.mark.parametrize("mode", ["ascii", "binary", "appended", "zlib", "base64"])
def test_vtp_of_vtk_is_read_as_text_binary_appended_packed_by_zlib_and_in_base64(tmp_path: Path, mode: str) -> None:
    pyvista = pytest.importorskip("pyvista")
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    mesh = Mesh(*ball(radius=8.0, rings=12))
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.triangles.astype(np.int64)))
    writer.SetFileName(str(tmp_path / "a.vtp"))
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(mode == "base64")
    if mode != "zlib":
        writer.SetCompressorTypeToNone()
    assert writer.Write() == 1

    back = clrecon.read_mesh(tmp_path / "a.vtp")

    assert np.array_equal(back.vertices, mesh.vertices)
    assert np.array_equal(back.triangles, mesh.triangles)


@pytest.mark.parametrize("extension", [".ply", ".obj", ".glb", ".vtp"])
def test_normals_of_a_mesh_saved_in_ras_are_read_back_in_lps(tmp_path: Path, extension: str) -> None:
    normals = [[0, 0, 1], [0, -1, 0], [1, 0, 0], [0, 0, -1]]
    Mesh(*TETRA, normals).save(tmp_path / f"a{extension}", "ras")
    assert clrecon.read_mesh(tmp_path / f"a{extension}").normals.tolist() == normals


@pytest.fixture(scope="module", params=[".obj", ".glb", ".3mf", ".vtp"])
def assembly(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Mesh], Mesh]:
    """Three balls with names and colours, and the mesh that is read from the file of all, in RAS."""
    vertices, triangles = ball(radius=5.0, rings=6)
    meshes = [
        Mesh(vertices + 20.0 * n, triangles, report={"part_name": f"L{n}", "color": (1.0, 0.2 * n, 0.0)})
        for n in (1, 2, 3)
    ]
    path = tmp_path_factory.mktemp("assembly") / f"all{request.param}"
    with stage_assembly(meshes, path, "ras") as staged:
        staged.commit()
    return meshes, clrecon.read_mesh(path)


def test_meshes_saved_in_one_file_are_read_back_in_their_order(assembly: tuple[list[Mesh], Mesh]) -> None:
    meshes, back = assembly
    first_vertices = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, first_vertices[:-1], strict=True)]
    assert np.array_equal(back.vertices, np.concatenate([mesh.vertices for mesh in meshes]))
    assert np.array_equal(back.triangles, np.concatenate(triangles))


def test_meshes_saved_in_one_file_keep_their_names_and_colours(assembly: tuple[list[Mesh], Mesh]) -> None:
    meshes, back = assembly
    parts = back.report["file"]["parts"]
    assert [part["name"] for part in parts] == ["L1", "L2", "L3"]
    assert [part["triangles"] for part in parts] == [mesh.triangle_count for mesh in meshes]
    for part, mesh in zip(parts, meshes, strict=True):
        assert part["color"] == pytest.approx(mesh.report["color"], abs=tolerances.ASSEMBLY_COLOR)


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
def test_text_stl_with_odd_letters_and_line_ends_is_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.stl").write_bytes(text.encode())
    mesh = clrecon.read_mesh(tmp_path / "a.stl")
    assert mesh.vertices.tolist() == [[1, 2, 3], [4, 2, 3], [1, 6, 3]]  # those of FACET
    assert mesh.triangle_count == 1


@pytest.mark.seconds
def test_distances_of_a_mesh_with_a_facet_without_area_are_those_without_it(tmp_path: Path) -> None:
    vertices, triangles = ball(radius=8.0, rings=12)
    Mesh(vertices, np.vstack([triangles, [(0, 0, 0)]])).save(tmp_path / "a.stl")
    distance = clrecon.measure_distance(clrecon.read_mesh(tmp_path / "a.stl"), Mesh(vertices, triangles))
    assert distance.hausdorff_mm < tolerances.SAME_SURFACE_MM
    assert distance.from_reference_signed_mm is not None


HOSTILE_3MF = {
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
            tetrahedron_as_xml('id="0"')
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
        lambda path: write_3mf(path, tetrahedron_as_xml(), '<item objectid="1" transform="0 0 0 0 0 0 0 0 0 0 0 0"/>'),
        "everything flat",
    ),
    "unit": (lambda path: write_3mf(path, tetrahedron_as_xml(), '<item objectid="1"/>', "cubit"), "the unit 'cubit'"),
    "vertex": (
        lambda path: write_3mf(path, tetrahedron_as_xml().replace('v1="2"', 'v1="9"'), '<item objectid="1"/>'),
        "refers to vertex 9 of 4",
    ),
    "not finite": (
        lambda path: write_3mf(path, tetrahedron_as_xml().replace('x="1"', 'x="nan"'), '<item objectid="1"/>'),
        "not finite",
    ),
}


@pytest.mark.parametrize("case", HOSTILE_3MF)
def test_hostile_3mf_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    write, words = HOSTILE_3MF[case]
    write(tmp_path / "a.3mf")
    assert_refused_in_one_line(tmp_path / "a.3mf", words)


HOSTILE_GLB: dict[str, tuple[dict[str, Any], str]] = {
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


@pytest.mark.parametrize("case", daily(5, HOSTILE_GLB))
def test_hostile_glb_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    changes, words = HOSTILE_GLB[case]
    assert_refused_in_one_line(write_glb_of_tetrahedron(tmp_path / "a.glb", **changes), words)


@pytest.mark.parametrize("kind", [b"BIM\0", b"BIO\0"])
def test_glb_whose_second_chunk_is_not_bin_is_refused(kind: bytes, tmp_path: Path) -> None:
    path = write_glb_of_tetrahedron(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes().replace(b"BIN\0", kind))
    assert_refused_in_one_line(path, "its second chunk is no binary data of its length")


def test_glb_without_triangles_is_read_as_an_empty_mesh(tmp_path: Path) -> None:
    mesh = clrecon.read_mesh(write_glb_of_tetrahedron(tmp_path / "a.glb", meshes=[{"primitives": []}]))
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
def test_mesh_file_with_impossible_content_is_refused_in_one_line(
    name: str, content: bytes, words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    assert_refused_in_one_line(tmp_path / name, words)


@pytest.mark.parametrize("extension", [".obj", ".glb", ".3mf", ".vtp"])
def test_mesh_file_cut_at_forty_places_is_refused_unless_it_is_an_obj_cut_between_lines(
    extension: str, tmp_path: Path
) -> None:
    """Nothing tells that an OBJ was cut between two lines; the last bytes of VTP are no data, and are not cut here."""
    whole = tmp_path / f"whole{extension}"
    Mesh(*ball(radius=5.0, rings=6)).save(whole)
    data, cut = whole.read_bytes(), tmp_path / f"cut{extension}"
    refusals = 0
    for length in np.linspace(0, len(data) - 60, 40).astype(int):
        cut.write_bytes(data[:length])
        try:
            clrecon.read_mesh(cut)
        except RefusedInputError as error:
            assert_one_line(error, cut.name)
            refusals += 1
        else:
            assert extension == ".obj"
    assert refusals > 0


@pytest.mark.parametrize(
    ("name", "member"), [("a.3mf", b"3D/3dmodel.model"), ("a.npz", b"points.npy")], ids=["3MF", "NPZ"]
)
def test_file_whose_packed_bytes_are_overwritten_is_refused(name: str, member: bytes, tmp_path: Path) -> None:
    vertices, triangles = ball(radius=5.0, rings=6)
    path = tmp_path / name
    if name == "a.3mf":
        Mesh(vertices, triangles).save(path)
    else:
        np.savez_compressed(path, points=vertices)
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        packed = archive.getinfo(member.decode()).header_offset + 30 + len(member)  # behind the header of the entry
    data[packed + 40 : packed + 80] = b"\xff" * 40
    path.write_bytes(bytes(data))
    with refused(RefusedInputError, "corrupt"):
        (clrecon.read_mesh if name == "a.3mf" else clrecon.read_points)(path)


def assert_refused_in_one_line(path: Path, words: str) -> None:
    with pytest.raises(RefusedInputError, match=words) as refusal:
        clrecon.read_mesh(path)
    assert_one_line(refusal.value, path.name)


FACE_ROW = [("shade", "f4"), ("count", "u1"), ("corners", "i4", (3,)), ("red", "u1"), ("flag", "i2")]
FACE_HEAD = """property float shade
property list uchar int vertex_indices
property uchar red
property short scalar_flag
end_header
"""


def write_ply_of_tetrahedron(path: Path, form: str) -> Path:
    """As MeshLab writes it: at each face a shade of 0.5, a red of 200 and a flag of -7, around its corners."""
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
    path.write_bytes(head.encode() + body)
    return path


PLY_FORMS = pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])


@PLY_FORMS
def test_ply_with_numbers_at_its_faces_is_read_with_its_triangles(tmp_path: Path, form: str) -> None:
    mesh = clrecon.read_mesh(write_ply_of_tetrahedron(tmp_path / "a.ply", form))
    assert np.array_equal(mesh.vertices, TETRA[0])
    assert np.array_equal(mesh.triangles, TETRA[1])


@PLY_FORMS
def test_scalars_at_the_faces_of_a_ply_are_read_and_other_numbers_left_out_with_a_warning(
    tmp_path: Path, form: str
) -> None:
    mesh = clrecon.read_mesh(write_ply_of_tetrahedron(tmp_path / "a.ply", form))
    assert {name: values.tolist() for name, values in mesh.face_values.items()} == {"flag": [-7.0] * 4}
    assert "numbers at faces left out: shade, red" in mesh.report["file"]["warnings"]


def test_ply_with_a_face_of_four_corners_beside_numbers_is_refused(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    text = f"{head}element face 1\n{FACE_HEAD}0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 4 0 1 2 3 200 -7\n"
    (tmp_path / "a.ply").write_text(text)
    with refused(RefusedInputError, "a.ply", 0, 4):
        clrecon.read_mesh(tmp_path / "a.ply")
