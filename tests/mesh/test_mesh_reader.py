"""Meshes from files: ours of both frames, those of others, and files that are no meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from sample_meshes import ball

import clrecon
from clrecon import Mesh
from clrecon.errors import RefusedInputError, UsageError
from clrecon.exchange.formats import MESH_INPUTS
from clrecon.exchange.stl import join_corners
from clrecon.exchange.vtp import has_polygons

BALL = Mesh(*ball(8.0, 12))


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", MESH_INPUTS)
def test_written_mesh_is_read_back_unchanged(tmp_path: Path, extension: str, space: str) -> None:
    mesh = Mesh(BALL.vertices, BALL.triangles, BALL.vertices / 8.0, {"iso_value_hu": 250.0})
    path = tmp_path / f"ball{extension}"
    mesh.save(path, space)
    back = clrecon.read_mesh(path)
    assert np.array_equal(back.vertices[back.triangles], mesh.vertices[mesh.triangles])
    assert back.vertex_count == mesh.vertex_count and back.quality().closed
    facts = back.report["file"]
    assert (facts["space"], facts["space_from"], facts["warnings"]) == (space.upper(), "file", [])
    if extension == ".ply":
        assert back.normals is not None and np.allclose(back.normals, mesh.normals, atol=1e-6)
        assert np.array_equal(back.triangles, mesh.triangles) and back.report["iso_value_hu"] == 250.0
    with refused(UsageError, "space"):
        clrecon.read_mesh(path, space="ras" if space == "lps" else "lps")


def test_files_of_others_are_lps_unless_said(tmp_path: Path) -> None:
    facet = "facet normal 0 0 1\n outer loop\n  vertex 1 2 3\n  vertex 4 2 3\n  vertex 1 6e0 3\n endloop\nendfacet\n"
    text = tmp_path / "a.stl"
    text.write_text(f"solid some thing\n{facet}{facet}endsolid\n")
    mesh = clrecon.read_mesh(text)
    assert mesh.vertices.tolist() == [[1, 2, 3], [4, 2, 3], [1, 6, 3]] and mesh.triangle_count == 2
    assert mesh.report["file"]["space_from"] == "assumed" and "no patient frame" in mesh.report["file"]["warnings"][0]
    turned = clrecon.read_mesh(text, space="ras")
    assert turned.vertices.tolist() == [[-1, -2, 3], [-4, -2, 3], [-1, -6, 3]]
    assert turned.report["file"]["space_from"] == "argument" and not turned.report["file"]["warnings"]
    ply = tmp_path / "a.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    ply.write_text(
        head + "element face 1\nproperty list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    assert clrecon.read_mesh(ply).triangles.tolist() == [[0, 1, 2]]
    columns = "".join(f"property float {name}\n" for name in ("confidence", "scalar_HU", "scalar_2nd", "scalar_"))
    rows = "".join(f"{point} 1 {n} 3 4\n" for n, point in enumerate(("0 0 0", "1 0 0", "0 1 0")))
    faces = "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    ply.write_text(f"{head}{columns}{faces}{rows}3 0 1 2\n")
    assert {name: values.tolist() for name, values in clrecon.read_mesh(ply).values.items()} == {"HU": [0, 1, 2]}


def test_polygons_are_looked_for_in_the_first_mebibyte(tmp_path: Path) -> None:
    mark = b'NumberOfPolys="1"'
    for before, found in ((2**20 - len(mark), True), (2**20 - len(mark) + 1, False)):
        (tmp_path / "a.vtp").write_bytes(bytes(before) + mark + bytes(9))
        assert has_polygons(tmp_path / "a.vtp") == found


def test_corners_are_joined_where_they_are_equal() -> None:
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (-0.0, 0, 0), (0, 1, 1)], np.float32)
    vertices, triangles = join_corners(corners)
    assert len(vertices) == 4 and np.array_equal(vertices[triangles].reshape(-1, 3), corners)
    broken = corners.copy()
    broken[2, 0] = np.nan
    assert len(join_corners(broken)[1]) == 2


def test_harmed_files_are_refused_in_one_line(tmp_path: Path) -> None:
    whole = tmp_path / "ball.stl"
    BALL.save(whole)
    stl = whole.read_bytes()
    BALL.save(tmp_path / "ball.ply")
    ply = (tmp_path / "ball.ply").read_bytes()
    nan = bytearray(stl)
    nan[84 + 12 : 84 + 16] = np.float32(np.nan).tobytes()
    quads = ply.replace(b"property list uchar int vertex_indices", b"property list uchar int vertex_indexes")
    far = bytearray(ply)
    far[-4:] = b"\xff\xff\xff\x7f"
    four = bytearray(ply)
    four[-13] = 4
    for name, content, text in (
        ("cut.stl", stl[:-7], "cut or corrupt"),
        ("long.stl", stl + b"0", "cut or corrupt"),
        ("nan.stl", bytes(nan), "not finite"),
        ("empty.stl", b"", "cut or corrupt"),
        ("text.stl", b"solid\nfacet\nvertex 1 2 3\n", "whole facets"),
        ("words.stl", b"solid\nvertex a b c\nvertex 1 2 3\nvertex 1 2 3\nendfacet\n", "cut or corrupt"),
        ("cut.ply", ply[:-3], "cut or corrupt"),
        ("far.ply", bytes(far), "refers to vertex"),
        ("four.ply", bytes(four), "4 corners"),
        ("lists.ply", quads, "one list, of vertices, is read"),
        (
            "cloud.ply",
            ply[: ply.index(b"element face")] + b"end_header\n" + ply[ply.index(b"end_header") + 11 :],
            "no faces",
        ),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(RefusedInputError, match=text) as error:
            clrecon.read_mesh(path)
        assert "\n" not in str(error.value) and name in str(error.value)
    with pytest.raises(UsageError, match=r"\.stl, \.ply"):
        clrecon.read_mesh(tmp_path / "a.off")
    with pytest.raises(UsageError, match=f"there is no mesh {tmp_path}/missing.stl"):
        clrecon.read_mesh(tmp_path / "missing.stl")
