"""`read_points`: clouds of other programs, the frame that a file names, and harmed files."""

from __future__ import annotations

import random
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_one_line, refused
from sample_meshes import LongTable

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.points import PointCloud
from clrecon.points.cloud_reader import _check_points, read_points

pytestmark = pytest.mark.unit

POINTS = np.array([[1.5, -2.25, 3.0], [4.0, 5.5, -6.75], [0.0, 0.125, 100.0]], np.float32)
HU = np.array([226.0, -100.5, 1500.0], np.float32)


def write(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode("latin-1"))
    return path


def ply(lines: str, form: str = "ascii") -> str:
    return f"ply\nformat {form} 1.0\n{lines}end_header\n"


AXES = "property float x\nproperty float y\nproperty float z\n"


def test_ascii_ply_with_crlf_other_names_and_faces_is_read(tmp_path):
    head = ply(
        "comment made by another program\nobj_info scanned\nelement vertex 3\nproperty double x\nproperty double y\n"
        "property double z\nproperty uchar red\nproperty float intensity\nproperty int cluster\n"
        "element face 1\nproperty list uchar int vertex_indices\n"
    ).replace("\n", "\r\n")
    rows = "".join(f"{x} {y} {z} 200 {hu} {n}\r\n" for (x, y, z), hu, n in zip(POINTS, HU, (3, -1, 0), strict=True))
    cloud = read_points(write(tmp_path / "a.ply", head + rows + "3 0 1 2\r\n"))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu.tolist() == HU.tolist() and cloud.labels.tolist() == [3, -1, 0]
    facts = cloud.report["file"]
    assert (facts["kind"], facts["space"], facts["space_from"], facts["points"]) == ("PLY", "LPS", "assumed", 3)
    assert facts["warnings"] == [
        "elements left out: 1 of 'face'",
        "clrecon render draws the faces of this file with mode='mesh'",
        "HU is taken from the column 'intensity'",
        "columns left out: red",
    ]


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_ply_of_both_byte_orders_is_read(form, order, tmp_path):
    head = ply(
        f"element camera 2\nproperty double a\nproperty uchar b\nelement vertex 3\n{AXES}property short scalar_HU\n"
        "property float nx\nproperty float ny\nproperty float nz\n",
        form,
    ).encode()
    rows = b"".join(struct.pack(f"{order}3fh3f", *p, int(hu), 0, 0, 2) for p, hu in zip(POINTS, HU, strict=True))
    cloud = read_points(write(tmp_path / "a.ply", head + bytes(18) + rows))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu.tolist() == [226, -100, 1500] and cloud.normals.tolist() == [[0, 0, 1]] * 3
    assert "3 normals are not of length 1: they are scaled" in cloud.report["file"]["warnings"]


@pytest.mark.parametrize("mark", [" ", "\t", ",", ", ", ";", " ; "])
@pytest.mark.parametrize("head", ["", "# a word\n", "//X Y Z scalar_HU\n", "x,y,z,hu\n"])
def test_tables_of_numbers_are_read_with_any_separator_and_head(mark, head, tmp_path):
    rows = "".join(mark.join(map(str, [*p, hu])) + "\n" for p, hu in zip(POINTS, HU, strict=True))
    cloud = read_points(write(tmp_path / "a.txt", head + rows + "\n"))
    np.testing.assert_array_equal(cloud.points, POINTS)
    warnings = cloud.report["file"]["warnings"]
    if "hu" in head.lower():
        assert cloud.hu.tolist() == HU.tolist() and warnings == []
    else:
        assert cloud.hu is None
        assert warnings == ["columns 4 to 4 have no names in a line before the first point and are left out"]


def test_npz_of_other_programs_is_read_with_a_warning(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", xyz=POINTS.astype(np.float64), hu=HU, labels=np.array([0.5, 1, 2]))
    cloud = read_points(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu.tolist() == HU.tolist() and cloud.labels is None
    assert cloud.report["file"]["warnings"] == ["the column 'labels' has values that are no labels: left out"]


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.array([{"a": 1}, 2, 3], dtype=object))
    with refused(RefusedInputError, "array", "size", "a.npz"):
        read_points(tmp_path / "a.npz")


@pytest.mark.parametrize("points", [np.zeros((2, 4)), np.zeros(3), np.zeros((2, 3), complex), np.zeros((2, 3), bool)])
def test_arrays_that_are_no_points_are_refused(points, tmp_path):
    np.savez(tmp_path / "a.npz", points=points)
    with refused(RefusedInputError, "a.npz", 3):
        read_points(tmp_path / "a.npz")


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended"])
@pytest.mark.parametrize("packing", ["None", "ZLib"])
@pytest.mark.parametrize("base64", [True, False])
def test_vtp_cloud_in_every_encoding_of_vtk_is_read(mode, packing, base64, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    chance = np.random.default_rng(3)
    polydata = pyvista.PolyData(chance.integers(-999, 999, (5000, 3)).astype(np.float32))
    polydata.point_data["HU"] = np.arange(5000, dtype=np.float32)
    polydata.point_data["label"] = np.arange(5000, dtype=np.int64)
    polydata.point_data.active_normals = np.tile(np.float32([0, 1, 0]), (5000, 1))
    polydata.field_data["SPACE"] = ["RAS"]
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(polydata)
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{packing}")()
    writer.SetEncodeAppendedData(base64)
    writer.SetByteOrderToBigEndian()
    writer.SetFileName(str(tmp_path / "a.vtp"))
    assert writer.Write() == 1
    cloud = read_points(tmp_path / "a.vtp")
    np.testing.assert_array_equal(cloud.points, polydata.points * np.float32([-1, -1, 1]))
    assert cloud.normals[0].tolist() == [0, -1, 0] and cloud.labels[-1] == 4999 and cloud.hu[77] == 77


def test_a_surface_of_vtp_gives_its_vertices(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    ball = pyvista.Sphere(radius=30.0)
    ball.save(tmp_path / "a.vtp")
    cloud = read_points(tmp_path / "a.vtp")
    assert len(cloud) == ball.n_points and cloud.normals is not None
    left_out, hint = cloud.report["file"]["warnings"]
    assert left_out == f"elements left out: {ball.n_cells:,} lines, strips and polygons" and "mode='mesh'" in hint


def test_lines_of_vtp_are_no_faces_to_draw(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    pyvista.Line().save(tmp_path / "a.vtp")
    said = " ".join(read_points(tmp_path / "a.vtp").report["file"]["warnings"])
    assert "elements left out: 1 lines" in said and "mode=" not in said


def test_frame_of_a_cloud_is_that_of_its_file_or_of_the_caller(tmp_path):
    PointCloud(POINTS).save(tmp_path / "ras.ply", "ras")
    bare = write(tmp_path / "bare.xyz", "1 2 3\n")
    assert read_points(bare).points.tolist() == [[1, 2, 3]]
    assert read_points(bare, space="ras").points.tolist() == [[-1, -2, 3]]
    assert read_points(bare, space="RAS").report["file"]["space_from"] == "argument"
    np.testing.assert_array_equal(read_points(tmp_path / "ras.ply", space="ras").points, POINTS)
    with refused(UsageError, "RAS", "LPS"):
        read_points(tmp_path / "ras.ply", space="lps")
    with refused(UsageError, "space", "scanner"):
        read_points(bare, space="scanner")
    odd = read_points(write(tmp_path / "odd.xyz", "# SPACE=MNI\n1 2 3\n"))
    assert odd.report["file"]["warnings"] == ["odd.xyz names the frame 'MNI', which is not known"]
    assert odd.report["file"]["space_from"] == "assumed"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", ply(f"element vertex 3\n{AXES}") + "1 2 3\n4 nan 5\ninf 0 0\n", "2 of the 3 points .* is number 1"),
        ("a.ply", ply(f"element vertex 0\n{AXES}"), "has 0 points"),
        (
            "a.ply",
            ply(f"element vertex 99999999999\n{AXES}", "binary_little_endian"),
            "99,999,999,999 vertices of 12 b",
        ),
        ("a.ply", ply(f"element vertex 99999999999\n{AXES}") + "1 2 3\n", "cannot come from"),
        ("a.ply", ply(f"element vertex 2\n{AXES}") + "1 2 3\n4 5\n", "is cut or corrupt"),
        ("a.ply", ply(f"element vertex 2\n{AXES}") + "1 2 3\n        ", "2 lines of 3 numbers are needed"),
        ("a.ply", ply("element vertex 1\nproperty float x\nproperty float y\n") + "1 2\n", "have no z"),
        ("a.ply", ply(f"element vertex 1\n{AXES}property list uchar int a\n") + "1 2 3 0\n", "have a list"),
        ("a.ply", ply("element vertex 1\nproperty half x\n"), "in line 4 of its header: 'property half x'"),
        ("a.ply", ply("element vertex -1\n"), "in line 3 of its header: 'element vertex -1'"),
        ("a.ply", ply("element face 1\nproperty list uchar int i\n"), "before its vertices: not read"),
        ("a.ply", ply(""), "no element 'vertex'"),
        ("a.ply", ply("").replace("ascii", "morse"), "in line 2 of its header: 'format morse 1.0'"),
        ("a.ply", "ply\n" + "comment x\n" * 9000, "have no line 'end_header'"),
        ("a.xyz", "1 2 3\n4 5\n", "is cut or corrupt"),
        ("a.xyz", "1 2\n3 4\n", "has 2 numbers a line"),
        ("a.xyz", "words\n" * 3, "holds no line of numbers"),
        ("a.xyz", "words\n" * 2000, "is no table of points"),
        ("a.xyz", "1 2 3\n1 x 3\n", "is cut or corrupt"),
        ("a.bin", "\0" * 600, "is no cloud that is read"),
        ("a.xyz", "", "is no cloud that is read"),
        ("a.npz", b"PK\3\4" + bytes(100), "is cut or corrupt"),
        ("a.las", b"LASF" + bytes(100), "is cut: it has 104 bytes"),
        ("a.las", b"LASF" + bytes(20) + b"\1\4" + bytes(348), "is cut: it has 374 bytes"),
        (
            "a.las",
            b"LASF" + bytes(20) + b"\1\2" + bytes(74) + b"\xff" * 4 + b"\0\x14" + bytes(200),
            "4,294,967,295 and 0 variable records have no room",
        ),
        (
            "a.las",
            b"LASF" + bytes(20) + b"\1\4" + bytes(78) + b"\0\x14" + bytes(137) + b"\xff" * 4 + bytes(200),
            "0 and 4,294,967,295 variable records have no room",
        ),
        ("a.vtp", '<VTKFile type="ImageData"></VTKFile>', "holds 'ImageData' of VTK"),
        ("a.vtp", '<VTKFile type="PolyData"><PolyData/></VTKFile>', "has no points"),
        ("a.vtp", '<!DOCTYPE a><VTKFile type="PolyData"></VTKFile>', "it declares a document type"),
        ("a.vtp", '<VTKFile type="PolyData" compressor="vtkLZ4DataCompressor"></VTKFile>', "is packed by vtkLZ4"),
    ],
)
def test_bad_files_are_refused_in_one_line(name, content, words, tmp_path):
    with pytest.raises(RefusedInputError, match=words) as caught:
        read_points(write(tmp_path / name, content))
    assert "\n" not in str(caught.value) and str(tmp_path) not in str(caught.value)


def test_missing_files_folders_and_other_archives_are_refused_as_clouds(tmp_path):
    with pytest.raises(UsageError, match=r"there is no cloud .*/none\.ply"):
        read_points(tmp_path / "none.ply")
    with pytest.raises(RefusedInputError, match="cannot be read"):
        read_points(tmp_path)
    np.savez(tmp_path / "a.npz", other=POINTS)
    with pytest.raises(RefusedInputError, match="an archive without points"):
        read_points(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", points=POINTS[:, :2])
    with pytest.raises(RefusedInputError, match=r"points of shape \(3, 2\)"):
        read_points(tmp_path / "b.npz")


@pytest.mark.fuzz
@pytest.mark.parametrize("extension", ["ply", "vtp", "npz", "xyz", "las"])
def test_harmed_files_are_read_or_refused(extension, tmp_path):
    """Changed, lost and added bytes: a cloud of finite points, or one clear line."""
    cloud = PointCloud(np.tile(POINTS, (10, 1)), np.tile([0, 0, 1.0], (30, 1)), np.tile(HU, 10), np.arange(30))
    path = tmp_path / f"a.{extension}"
    cloud.save(path)
    whole, chance, refused = path.read_bytes(), random.Random(7), 0
    for _ in range(200):
        harmed = bytearray(whole)
        for _ in range(chance.choice([1, 1, 2, 5])):
            place = chance.randrange(len(harmed))
            kind = chance.randrange(4)
            if kind == 0:
                harmed[place] = chance.randrange(256)
            elif kind == 1:
                del harmed[place : place + chance.randrange(1, 40)]
            elif kind == 2:
                harmed[place:place] = chance.choice([b"9", b"-1", b"e9", b"\n", b'"', b"<"])
            else:
                harmed = harmed[: max(place, 1)]
        path.write_bytes(harmed)
        try:
            assert np.isfinite(read_points(path).points).all()
        except ClreconError as error:
            refused += 1
            assert_one_line(error, letters=400)
    assert 50 < refused <= 200


def test_a_binary_ply_is_read_to_its_last_byte_and_refused_without_it(tmp_path):
    rows = np.arange(9, dtype="<f4")
    content = ply(f"element vertex 3\n{AXES}", "binary_little_endian").encode() + rows.tobytes()
    assert np.array_equal(read_points(write(tmp_path / "a.ply", content)).points, rows.reshape(3, 3))
    with refused(RefusedInputError, 3, 12, 35):
        read_points(write(tmp_path / "b.ply", content[:-1]))


@pytest.mark.parametrize("line", [b"1;2;3\n4;5;6\n", b"# x y z\n1 2 3\n4 5 6\n", b"x,y,z\n1,2,3\n4,5,6\n"])
def test_a_byte_order_mark_costs_no_point(tmp_path, line):
    file = tmp_path / "a.xyz"
    file.write_bytes(b"\xef\xbb\xbf" + line)
    cloud = read_points(file)
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.report["file"]["warnings"] == []


@pytest.mark.parametrize(("line", "wrong"), [("1;2;abc", "abc"), ("1,2x,3", "2x"), ("  1 - 3", "-")])
def test_a_first_point_that_holds_words_is_refused(tmp_path, line, wrong):
    file = tmp_path / "a.xyz"
    file.write_text(f"# made by hand\n{line}\n4 5 6\n7 8 9\n")
    with refused(RefusedInputError, "a.xyz", wrong, 2):
        read_points(file)


def test_a_line_of_words_and_numbers_before_the_points_is_said(tmp_path):
    file = tmp_path / "a.xyz"
    file.write_text("# 3 points\nX1 2 3\n4 5 6\n7 8 9\n")
    cloud = read_points(file)
    assert len(cloud) == 2
    (warning,) = cloud.report["file"]["warnings"]
    assert warning.startswith("line 2 holds words and numbers and is left out, 'X1 2 3'")


@pytest.mark.parametrize(
    ("side", "unit"),
    [
        (0, ""),
        (0.25, "metres: then multiply them by 1000"),
        (2.5, "metres: then multiply them by 1000"),
        (3, ""),
        (5000, ""),
        (5001, "micrometres: then divide them by 1000"),
    ],
)
def test_a_unit_is_doubted_by_the_longest_side(side, unit, tmp_path):
    rows = [f"{side * n / 99} 0 0" for n in range(100)]
    warnings = read_points(write(tmp_path / "a.xyz", "\n".join(rows) + "\n")).report["file"]["warnings"]
    doubt = f"the points lie in a box of {side:.3g} x 0 x 0, which is read as mm; perhaps they are in {unit}"
    assert [line for line in warnings if "perhaps" in line] == [doubt] * bool(unit)


def test_more_points_than_a_number_of_32_bits_can_tell_are_refused():
    with refused(RefusedInputError, "a.npz", 2147483648, 1, 2147483647):
        _check_points(LongTable(2**31), "a.npz")


@pytest.mark.parametrize(
    ("text", "facts"),
    [("1 2 3\n4 5 6\n7 8\n", (3, 2)), ("1 2 3\n4 x 6\n", ("x", 2)), ("1,5 2,5 3,5\n2,5 3,5 4,5\n", (1,))],
)
def test_tables_with_faults_are_named_by_row_without_words_of_numpy(
    tmp_path: Path, text: str, facts: tuple[str | int, ...]
) -> None:
    (tmp_path / "a.xyz").write_text(text)
    with refused(RefusedInputError, "row", *facts) as caught:
        read_points(tmp_path / "a.xyz")
    assert not re.search("usecols|float64|convert", repr(caught.value))


@pytest.mark.parametrize("name", ["a.asc", "A.ASC", "a.pts"])
def test_tables_of_numbers_are_read_by_content_whatever_they_are_called(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("X;Y;Z\n1;2;3\n4;5;6\n")
    assert read_points(tmp_path / name).points.tolist() == [[1, 2, 3], [4, 5, 6]]
