"""Meshes from files: ours of both frames, those of others, and files that are no meshes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tolerances
from refusals import assert_one_line, refused
from sample_meshes import ball

import clrecon
from clrecon import Mesh
from clrecon.errors import RefusedInputError, UsageError
from clrecon.exchange.formats import MESH_INPUTS
from clrecon.exchange.stl import join_corners
from clrecon.exchange.vtp import has_faces

RADIUS_MM = 8.0
BALL = Mesh(*ball(RADIUS_MM, rings=12))
BALL_NORMALS = BALL.vertices / RADIUS_MM


every_format = pytest.mark.parametrize("extension", MESH_INPUTS)
both_frames = pytest.mark.parametrize("space", ["lps", "ras"])


@pytest.fixture
def ball_file(tmp_path: Path, extension: str, space: str) -> Path:
    """A file of the ball, with normals and the entry iso_value_hu of its report."""
    path = tmp_path / f"ball{extension}"
    Mesh(BALL.vertices, BALL.triangles, BALL_NORMALS, {"iso_value_hu": 250.0}).save(path, space)
    return path


@every_format
@both_frames
def test_corners_of_a_written_mesh_are_read_back_to_the_bit_and_closed(ball_file: Path) -> None:
    back = clrecon.read_mesh(ball_file)
    assert np.array_equal(back.vertices[back.triangles], BALL.vertices[BALL.triangles])
    assert back.vertex_count == BALL.vertex_count
    assert back.quality().closed


@every_format
@both_frames
def test_frame_of_a_written_mesh_is_read_from_the_file_without_a_warning(ball_file: Path, space: str) -> None:
    facts = clrecon.read_mesh(ball_file).report["file"]
    assert (facts["space"], facts["space_from"], facts["warnings"]) == (space.upper(), "file", [])


@pytest.mark.parametrize("extension", [".ply"])
@both_frames
def test_ply_gives_back_normals_order_of_triangles_and_report(ball_file: Path) -> None:
    back = clrecon.read_mesh(ball_file)
    assert np.array_equal(back.triangles, BALL.triangles)
    assert back.normals is not None
    assert np.allclose(back.normals, BALL_NORMALS, atol=tolerances.MESH_UNIT_NORMAL)
    assert back.report["iso_value_hu"] == 250.0


@every_format
@both_frames
def test_reading_a_mesh_in_a_frame_that_its_file_contradicts_is_refused(ball_file: Path, space: str) -> None:
    with refused(UsageError, "space"):
        clrecon.read_mesh(ball_file, space="ras" if space == "lps" else "lps")


FACET = "facet normal 0 0 1\n outer loop\n  vertex 1 2 3\n  vertex 4 2 3\n  vertex 1 6e0 3\n endloop\nendfacet\n"


@pytest.fixture
def foreign_stl(tmp_path: Path) -> Path:
    """An STL of another program: two equal facets as text, of no named frame."""
    path = tmp_path / "a.stl"
    path.write_text(f"solid some thing\n{FACET}{FACET}endsolid\n")
    return path


def test_a_file_that_names_no_frame_is_read_as_lps_with_a_warning(foreign_stl: Path) -> None:
    mesh = clrecon.read_mesh(foreign_stl)
    assert mesh.vertices.tolist() == [[1, 2, 3], [4, 2, 3], [1, 6, 3]]
    assert mesh.triangle_count == 2
    assert mesh.report["file"]["space_from"] == "assumed"
    assert "no patient frame" in mesh.report["file"]["warnings"][0]


def test_a_file_that_names_no_frame_is_read_in_the_frame_that_the_caller_names(foreign_stl: Path) -> None:
    in_lps = clrecon.read_mesh(foreign_stl, space="ras")
    assert in_lps.vertices.tolist() == [[-1, -2, 3], [-4, -2, 3], [-1, -6, 3]]
    assert in_lps.report["file"]["space_from"] == "argument"
    assert not in_lps.report["file"]["warnings"]


PLY_VERTICES = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACES = "element face 1\nproperty list uchar int vertex_index\nend_header\n"


def test_a_ply_of_text_with_vertex_index_in_place_of_vertex_indices_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(f"{PLY_VERTICES}{PLY_FACES}0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    assert clrecon.read_mesh(path).triangles.tolist() == [[0, 1, 2]]


def test_only_scalars_of_a_ply_whose_name_is_plain_become_values(tmp_path: Path) -> None:
    names = ("confidence", "scalar_HU", "scalar_2nd", "scalar_")
    columns = "".join(f"property float {name}\n" for name in names)
    rows = "".join(f"{point} 1 {hu} 3 4\n" for hu, point in enumerate(("0 0 0", "1 0 0", "0 1 0")))
    path = tmp_path / "a.ply"
    path.write_text(f"{PLY_VERTICES}{columns}{PLY_FACES}{rows}3 0 1 2\n")
    assert {name: values.tolist() for name, values in clrecon.read_mesh(path).values.items()} == {"HU": [0, 1, 2]}


@pytest.mark.parametrize(("beyond", "found"), [(0, True), (1, False)], ids=["at its end", "a byte beyond"])
def test_polygons_of_a_vtp_are_looked_for_in_the_first_mebibyte(tmp_path: Path, beyond: int, found: bool) -> None:
    mark = b'NumberOfPolys="1"'
    (tmp_path / "a.vtp").write_bytes(bytes(2**20 - len(mark) + beyond) + mark + bytes(9))
    assert has_faces(tmp_path / "a.vtp") == found


CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (-0.0, 0, 0), (0, 1, 1)], np.float32)
"""Of two triangles; their corners 0 and 4, 1 and 3 are equal."""


def test_equal_corners_of_triangles_become_one_vertex() -> None:
    vertices, triangles = join_corners(CORNERS)
    assert len(vertices) == 4
    assert np.array_equal(vertices[triangles].reshape(-1, 3), CORNERS)


def test_corners_that_are_not_finite_leave_both_triangles() -> None:
    with_nan = CORNERS.copy()
    with_nan[2, 0] = np.nan
    _, triangles = join_corners(with_nan)
    assert len(triangles) == 2


def stl_with_nan(stl: bytes) -> bytes:
    first_corner = 84 + 12  # after the head, the count and the normal
    return stl[:first_corner] + np.float32(np.nan).tobytes() + stl[first_corner + 4 :]


def ply_without_faces(ply: bytes) -> bytes:
    return ply[: ply.index(b"element face")] + b"end_header\n" + ply[ply.index(b"end_header") + 11 :]


HARMED_STL: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "last bytes cut": (lambda stl: stl[:-7], "cut or corrupt"),
    "a byte too many": (lambda stl: stl + b"0", "cut or corrupt"),
    "corner of NaN": (stl_with_nan, "not finite"),
    "empty": (lambda _: b"", "cut or corrupt"),
    "text of one corner": (lambda _: b"solid\nfacet\nvertex 1 2 3\n", "whole facets"),
    "text of words": (lambda _: b"solid\nvertex a b c\nvertex 1 2 3\nvertex 1 2 3\nendfacet\n", "cut or corrupt"),
}
HARMED_PLY: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "last bytes cut": (lambda ply: ply[:-3], "cut or corrupt"),
    "corner beyond the vertices": (lambda ply: ply[:-4] + b"\xff\xff\xff\x7f", "refers to vertex"),
    "face of four corners": (lambda ply: ply[:-13] + b"\x04" + ply[-12:], "4 corners"),
    "list of another name": (
        lambda ply: ply.replace(b"property list uchar int vertex_indices", b"property list uchar int vertex_indexes"),
        "one list, of vertices, is read",
    ),
    "no faces": (ply_without_faces, "no faces"),
}
HARMED = [(".stl", *row) for row in HARMED_STL.values()] + [(".ply", *row) for row in HARMED_PLY.values()]
HARMED_IDS = [f"stl, {name}" for name in HARMED_STL] + [f"ply, {name}" for name in HARMED_PLY]


@pytest.mark.parametrize(("extension", "harm", "words"), HARMED, ids=HARMED_IDS)
def test_a_harmed_file_is_refused_in_one_line_that_names_it(
    tmp_path: Path, extension: str, harm: Callable[[bytes], bytes], words: str
) -> None:
    path = tmp_path / f"ball{extension}"
    BALL.save(path)
    path.write_bytes(harm(path.read_bytes()))
    with pytest.raises(RefusedInputError, match=words) as error:
        clrecon.read_mesh(path)
    assert_one_line(error.value, path.name)


def test_a_format_that_is_not_read_is_refused_with_those_that_are(tmp_path: Path) -> None:
    with refused(UsageError, *MESH_INPUTS):
        clrecon.read_mesh(tmp_path / "a.off")


def test_a_missing_file_is_refused_with_its_path(tmp_path: Path) -> None:
    with refused(UsageError, f"{tmp_path}/missing.stl"):
        clrecon.read_mesh(tmp_path / "missing.stl")
