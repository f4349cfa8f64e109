"""`read_points`: clouds of other programs, the frame that a file names, and harmed files."""

from __future__ import annotations

import random
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import tolerances
from refusals import assert_one_line, refused
from sample_meshes import LongTable

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.points.cloud import PointCloud
from clrecon.points.cloud_reader import _check_points, read_points

pytestmark = pytest.mark.unit

POINTS = np.array([[1.5, -2.25, 3.0], [4.0, 5.5, -6.75], [0.0, 0.125, 100.0]], np.float32)
HU = np.array([226.0, -100.5, 1500.0], np.float32)


def write_file(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode("latin-1"))
    return path


def ply_text(lines: str, form: str = "ascii") -> str:
    return f"ply\nformat {form} 1.0\n{lines}end_header\n"


AXES = "property float x\nproperty float y\nproperty float z\n"


@pytest.fixture
def foreign_ply_cloud(tmp_path):
    """The cloud read from a PLY with CRLF, other names of columns, and a face."""
    head = ply_text(
        "comment made by another program\nobj_info scanned\nelement vertex 3\nproperty double x\nproperty double y\n"
        "property double z\nproperty uchar red\nproperty float intensity\nproperty int cluster\n"
        "element face 1\nproperty list uchar int vertex_indices\n"
    ).replace("\n", "\r\n")
    rows = "".join(f"{x} {y} {z} 200 {hu} {n}\r\n" for (x, y, z), hu, n in zip(POINTS, HU, (3, -1, 0), strict=True))
    return read_points(write_file(tmp_path / "a.ply", head + rows + "3 0 1 2\r\n"))


def test_points_hu_and_labels_are_read_from_an_ascii_ply_of_another_program(foreign_ply_cloud):
    np.testing.assert_array_equal(foreign_ply_cloud.points, POINTS)
    assert foreign_ply_cloud.hu.tolist() == HU.tolist()
    assert foreign_ply_cloud.labels.tolist() == [3, -1, 0]


def test_a_ply_of_another_program_is_reported_with_its_kind_and_an_assumed_frame(foreign_ply_cloud):
    facts = foreign_ply_cloud.report["file"]
    assert (facts["kind"], facts["space"], facts["space_from"], facts["points"]) == ("PLY", "LPS", "assumed", 3)


def test_faces_and_columns_left_out_and_the_column_of_hu_are_warned_of(foreign_ply_cloud):
    assert foreign_ply_cloud.report["file"]["warnings"] == [
        "elements left out: 1 of 'face'",
        "clrecon render draws the faces of this file with mode='mesh'",
        "HU is taken from the column 'intensity'",
        "columns left out: red",
    ]


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_ply_of_both_byte_orders_is_read(form, order, tmp_path):
    head = ply_text(
        f"element camera 2\nproperty double a\nproperty uchar b\nelement vertex 3\n{AXES}property short scalar_HU\n"
        "property float nx\nproperty float ny\nproperty float nz\n",
        form,
    ).encode()
    rows = b"".join(struct.pack(f"{order}3fh3f", *p, int(hu), 0, 0, 2) for p, hu in zip(POINTS, HU, strict=True))
    cloud = read_points(write_file(tmp_path / "a.ply", head + bytes(18) + rows))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu.tolist() == [226, -100, 1500]  # whole numbers are stored
    assert cloud.normals.tolist() == [[0, 0, 1]] * 3
    assert "3 normals are not of length 1: they are scaled" in cloud.report["file"]["warnings"]


separators = pytest.mark.parametrize(
    "separator",
    [" ", "\t", ",", ", ", ";", " ; "],
    ids=["space", "tab", "comma", "comma and space", "semicolon", "semicolon and spaces"],
)


def read_table(tmp_path: Path, head: str, separator: str) -> PointCloud:
    """Points and HU in columns of a file of text."""
    rows = "".join(separator.join(map(str, [*p, hu])) + "\n" for p, hu in zip(POINTS, HU, strict=True))
    return read_points(write_file(tmp_path / "a.txt", head + rows + "\n"))


@separators
@pytest.mark.parametrize("head", ["//X Y Z scalar_HU\n", "x,y,z,hu\n"])
def test_points_and_hu_are_read_from_a_table_whose_head_names_its_columns(separator, head, tmp_path):
    cloud = read_table(tmp_path, head, separator)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu.tolist() == HU.tolist()
    assert cloud.report["file"]["warnings"] == []


@separators
@pytest.mark.parametrize("head", ["", "# a word\n"], ids=["no head", "words"])
def test_the_fourth_column_of_a_table_without_names_is_left_out_with_a_warning(separator, head, tmp_path):
    cloud = read_table(tmp_path, head, separator)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu is None
    assert cloud.report["file"]["warnings"] == [
        "columns 4 to 4 have no names in a line before the first point and are left out"
    ]


def test_points_and_hu_are_read_from_an_npz_of_another_program_and_labels_of_halves_left_out(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", xyz=POINTS.astype(np.float64), hu=HU, labels=np.array([0.5, 1, 2]))
    cloud = read_points(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.hu.tolist() == HU.tolist()
    assert cloud.labels is None
    assert cloud.report["file"]["warnings"] == ["the column 'labels' has values that are no labels: left out"]


def test_pickled_objects_in_an_npz_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.array([{"a": 1}, 2, 3], dtype=object))
    with refused(RefusedInputError, "array", "size", "a.npz"):
        read_points(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "points",
    [np.zeros((2, 4)), np.zeros(3), np.zeros((2, 3), complex), np.zeros((2, 3), bool)],
    ids=["four columns", "one row", "complex", "truth values"],
)
def test_arrays_of_an_npz_that_are_no_points_are_refused(points, tmp_path):
    np.savez(tmp_path / "a.npz", points=points)
    with refused(RefusedInputError, "a.npz", 3):
        read_points(tmp_path / "a.npz")


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended"])
@pytest.mark.parametrize("packing", ["None", "ZLib"])
@pytest.mark.parametrize("base64", [True, False])
def test_vtp_cloud_in_text_or_binary_data_as_it_is_or_packed_by_zlib_is_read(mode, packing, base64, tmp_path):
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
    cloud = read_points(tmp_path / "a.vtp")  # in LPS; the file is in RAS
    np.testing.assert_array_equal(cloud.points, polydata.points * np.float32([-1, -1, 1]))
    assert cloud.normals.tolist() == [[0, -1, 0]] * 5000
    assert cloud.labels.tolist() == list(range(5000))
    assert cloud.hu.tolist() == list(range(5000))


@pytest.fixture
def cloud_of_a_surface(tmp_path):
    """A ball saved by pyvista as a surface, and the same read as a cloud."""
    pyvista = pytest.importorskip("pyvista")
    ball = pyvista.Sphere(radius=30.0)
    ball.save(tmp_path / "a.vtp")
    return ball, read_points(tmp_path / "a.vtp")


def test_a_surface_of_vtp_is_read_as_its_vertices_with_their_normals(cloud_of_a_surface):
    ball, cloud = cloud_of_a_surface
    assert len(cloud) == ball.n_points
    np.testing.assert_array_equal(cloud.points, ball.points)
    np.testing.assert_allclose(cloud.normals, ball.point_data["Normals"], atol=tolerances.MESH_UNIT_NORMAL)


def test_faces_of_a_vtp_that_are_left_out_are_warned_of_with_the_mode_that_draws_them(cloud_of_a_surface):
    ball, cloud = cloud_of_a_surface
    left_out, hint = cloud.report["file"]["warnings"]
    assert left_out == f"elements left out: {ball.n_cells:,} lines, strips and polygons"
    assert "mode='mesh'" in hint


def test_lines_of_a_vtp_are_left_out_without_a_mode_that_draws_them(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    pyvista.Line().save(tmp_path / "a.vtp")
    warnings = " ".join(read_points(tmp_path / "a.vtp").report["file"]["warnings"])
    assert "elements left out: 1 lines" in warnings
    assert "mode=" not in warnings


@pytest.fixture
def bare_file(tmp_path):
    """A point at (1, 2, 3) in a file that names no frame."""
    return write_file(tmp_path / "bare.xyz", "1 2 3\n")


@pytest.fixture
def ras_file(tmp_path):
    """A file that names RAS as its frame."""
    PointCloud(POINTS).save(tmp_path / "ras.ply", space="ras")
    return tmp_path / "ras.ply"


def test_points_of_a_file_that_names_no_frame_are_in_lps(bare_file):
    assert read_points(bare_file).points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("space", ["ras", "RAS"])
def test_points_of_a_file_that_names_no_frame_are_in_the_frame_that_the_caller_names(bare_file, space):
    cloud = read_points(bare_file, space=space)
    assert cloud.points.tolist() == [[-1, -2, 3]]
    assert cloud.report["file"]["space_from"] == "argument"


def test_points_of_a_file_are_in_the_frame_that_file_and_caller_name(ras_file):
    np.testing.assert_array_equal(read_points(ras_file, space="ras").points, POINTS)


def test_a_file_whose_frame_contradicts_the_caller_is_refused(ras_file):
    with refused(UsageError, "RAS", "LPS"):
        read_points(ras_file, space="lps")


def test_an_unknown_frame_of_the_caller_is_refused(bare_file):
    with refused(UsageError, "space", "scanner"):
        read_points(bare_file, space="scanner")


def test_an_unknown_frame_of_a_file_is_warned_of_and_lps_assumed(tmp_path):
    facts = read_points(write_file(tmp_path / "odd.xyz", "# SPACE=MNI\n1 2 3\n")).report["file"]
    assert facts["warnings"] == ["odd.xyz names the frame 'MNI', which is not known"]
    assert facts["space_from"] == "assumed"


NO_CLOUDS = [  # name and content of a file, and what is said
    ("a.ply", ply_text(f"element vertex 3\n{AXES}") + "1 2 3\n4 nan 5\ninf 0 0\n", "2 of the 3 points .* is number 1"),
    ("a.ply", ply_text(f"element vertex 0\n{AXES}"), "has 0 points"),
    (
        "a.ply",
        ply_text(f"element vertex 99999999999\n{AXES}", "binary_little_endian"),
        "99,999,999,999 vertices of 12 b",
    ),
    ("a.ply", ply_text(f"element vertex 99999999999\n{AXES}") + "1 2 3\n", "cannot come from"),
    ("a.ply", ply_text(f"element vertex 2\n{AXES}") + "1 2 3\n4 5\n", "is cut or corrupt"),
    ("a.ply", ply_text(f"element vertex 2\n{AXES}") + "1 2 3\n        ", "2 lines of 3 numbers are needed"),
    ("a.ply", ply_text("element vertex 1\nproperty float x\nproperty float y\n") + "1 2\n", "have no z"),
    ("a.ply", ply_text(f"element vertex 1\n{AXES}property list uchar int a\n") + "1 2 3 0\n", "have a list"),
    ("a.ply", ply_text("element vertex 1\nproperty half x\n"), "in line 4 of its header: 'property half x'"),
    ("a.ply", ply_text("element vertex -1\n"), "in line 3 of its header: 'element vertex -1'"),
    ("a.ply", ply_text("element face 1\nproperty list uchar int i\n"), "before its vertices: not read"),
    ("a.ply", ply_text(""), "no element 'vertex'"),
    ("a.ply", ply_text("").replace("ascii", "morse"), "in line 2 of its header: 'format morse 1.0'"),
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
]


@pytest.mark.parametrize(("name", "content", "words"), NO_CLOUDS, ids=[words for _, _, words in NO_CLOUDS])
def test_a_file_that_is_no_cloud_is_refused_in_one_line_without_its_folder(name, content, words, tmp_path):
    with pytest.raises(RefusedInputError, match=words) as caught:
        read_points(write_file(tmp_path / name, content))
    assert_one_line(caught.value)
    assert str(tmp_path) not in str(caught.value)


def test_a_missing_file_is_refused_as_a_cloud(tmp_path):
    with refused(UsageError, "cloud", "none.ply"):
        read_points(tmp_path / "none.ply")


def test_a_folder_is_refused_as_a_cloud(tmp_path):
    with refused(RefusedInputError, "read"):
        read_points(tmp_path)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [({"other": POINTS}, "an archive without points"), ({"points": POINTS[:, :2]}, r"points of shape \(3, 2\)")],
    ids=["no points", "points of two columns"],
)
def test_an_archive_without_points_of_three_columns_is_refused(tmp_path, arrays, words):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(RefusedInputError, match=words):
        read_points(tmp_path / "a.npz")


@pytest.mark.fuzz
@pytest.mark.parametrize("extension", ["ply", "vtp", "npz", "xyz", "las"])
def test_files_with_changed_lost_and_added_bytes_give_finite_points_or_one_clear_line(extension, tmp_path):
    """Some changes are not noticed, or do no harm; more than a quarter are refused."""
    cloud = PointCloud(
        np.tile(POINTS, (10, 1)), normals=np.tile([0, 0, 1.0], (30, 1)), hu=np.tile(HU, 10), labels=np.arange(30)
    )
    path = tmp_path / f"a.{extension}"
    cloud.save(path)
    whole, chance, refused, files = path.read_bytes(), random.Random(7), 0, 200
    for _ in range(files):
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
    assert files / 4 < refused <= files


NUMBERS = np.arange(9, dtype="<f4")


def binary_ply() -> bytes:
    """Three points in 36 bytes after the head."""
    return ply_text(f"element vertex 3\n{AXES}", "binary_little_endian").encode() + NUMBERS.tobytes()


def test_a_binary_ply_is_read_to_its_last_byte(tmp_path):
    assert np.array_equal(read_points(write_file(tmp_path / "a.ply", binary_ply())).points, NUMBERS.reshape(3, 3))


def test_a_binary_ply_without_its_last_byte_is_refused_with_the_bytes_that_it_has(tmp_path):
    with refused(RefusedInputError, 3, 12, 35):
        read_points(write_file(tmp_path / "b.ply", binary_ply()[:-1]))


@pytest.mark.parametrize(
    "text",
    [b"1;2;3\n4;5;6\n", b"# x y z\n1 2 3\n4 5 6\n", b"x,y,z\n1,2,3\n4,5,6\n"],
    ids=["numbers", "comment", "names of columns"],
)
def test_every_point_after_a_byte_order_mark_is_read_without_a_warning(tmp_path, text):
    file = tmp_path / "a.xyz"
    file.write_bytes(b"\xef\xbb\xbf" + text)
    cloud = read_points(file)
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.report["file"]["warnings"] == []


@pytest.mark.parametrize(("line", "wrong"), [("1;2;abc", "abc"), ("1,2x,3", "2x"), ("  1 - 3", "-")])
def test_a_first_point_that_holds_words_is_refused(tmp_path, line, wrong):
    file = tmp_path / "a.xyz"
    file.write_text(f"# made by hand\n{line}\n4 5 6\n7 8 9\n")
    with refused(RefusedInputError, "a.xyz", wrong, 2):
        read_points(file)


def test_a_line_of_words_and_numbers_before_the_points_is_left_out_with_a_warning(tmp_path):
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
def test_points_in_a_box_below_3_mm_or_above_5_m_are_warned_of_as_perhaps_in_another_unit(side, unit, tmp_path):
    rows = [f"{side * n / 99} 0 0" for n in range(100)]
    warnings = read_points(write_file(tmp_path / "a.xyz", "\n".join(rows) + "\n")).report["file"]["warnings"]
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
