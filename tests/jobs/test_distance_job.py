"""``clrecon distance``: figures, frames, coloured mesh, picture, and wrong usage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import check_refused
from PIL import Image
from printed_text import Printer
from sample_meshes import ball, box
from surface_volumes import MIDDLE, hollow_ball

import clrecon
from clrecon.cli.main import main
from clrecon.mesh import Mesh


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """Meshes of balls of 10 mm: a.stl, made 2 mm higher at both ends, and b.ply, in RAS, with one centre; a without the
    name of its frame, in RAS; b with a hole of a triangle; and a in metres."""
    vertices, triangles = ball(10.0, rings=30)
    middle = np.array([40.0, -25.0, -800.0])
    found = {name: str(tmp_path / name) for name in ("a.stl", "b.ply", "plain.stl", "open.stl", "metres.stl")}
    a = Mesh(vertices * (1.0, 1.0, 1.2) + middle, triangles)
    a.save(found["a.stl"])
    Mesh(vertices + middle, triangles).save(found["b.ply"], "ras")
    Mesh(vertices + middle, triangles[1:]).save(found["open.stl"])
    Mesh(a.vertices / 1000.0, triangles).save(found["metres.stl"])
    a.save(found["plain.stl"], "ras")
    content = Path(found["plain.stl"]).read_bytes()
    Path(found["plain.stl"]).write_bytes(content[:80].replace(b"SPACE=RAS", b"         ") + content[80:])
    return found


SAMPLED_MM = 0.05
"""Of a largest distance, from 4000 points on facets of up to 1 mm."""


def report_distances(*given: str) -> dict[str, Any]:
    """Run the command with these arguments, the first of them a file, and return its report."""
    out = Path(given[0]).parent / "report.json"
    assert main(["distance", *given, "--samples", "4000", "--report", str(out), "-q"]) == 0
    return dict(json.loads(out.read_text()))


def test_meshes_of_files_in_two_frames_are_compared_in_one(files: dict[str, str]) -> None:
    report = report_distances(files["a.stl"], files["b.ply"])

    assert (report["a"]["space"], report["b"]["space"], report["b"]["space_from"]) == ("LPS", "RAS", "file")
    assert report["hausdorff_mm"] == pytest.approx(10.0 * 1.2 - 10.0, abs=SAMPLED_MM)
    assert report["warnings"] == []
    assert (report["outputs"], report["device"]) == ([], None)  # nothing was asked for that needs them


def test_signed_distances_are_positive_outside_in_both_directions(files: dict[str, str]) -> None:
    report = report_distances(files["a.stl"], files["b.ply"])

    there, back = report["a_to_b_signed_mm"], report["b_to_a_signed_mm"]
    assert there["max"] == pytest.approx(2.0, abs=SAMPLED_MM)
    assert there["min"] == pytest.approx(0.0, abs=SAMPLED_MM)
    assert there["outside_share"] > 0.99  # a encloses b
    assert back["outside_share"] < 0.01  # and b lies in a


def test_words_of_distance_name_the_turned_frame_in_lines_of_60_letters(
    files: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["distance", files["a.stl"], files["b.ply"], "--samples", "500"]) == 0

    shown = capsys.readouterr().out
    assert "RAS, named by the file, turned to LPS" in shown
    assert max(map(len, shown.splitlines())) <= 60


def test_mesh_file_that_names_no_frame_is_taken_as_lps_and_doubted_where_it_lies_apart(files: dict[str, str]) -> None:
    report = report_distances(files["plain.stl"], files["b.ply"])

    # x and y of its middle, 40 and -25 mm, have the other sign.
    assert report["hausdorff_mm"] == pytest.approx(2 * np.hypot(40.0, 25.0), abs=SAMPLED_MM)
    assert any("taken as LPS" in text for text in report["warnings"])
    assert any("apart: is the frame of the file that names none another?" in text for text in report["warnings"])


def test_mesh_file_that_names_no_frame_is_read_in_the_given_one_without_a_warning(files: dict[str, str]) -> None:
    report = report_distances(files["plain.stl"], files["b.ply"], "--mesh-space", "ras")

    assert report["a"]["space_from"] == "argument"
    assert report["hausdorff_mm"] == pytest.approx(2.0, abs=SAMPLED_MM)
    assert report["warnings"] == []


@pytest.fixture
def ball_and_scan(tmp_path: Path) -> tuple[str, str]:
    """A mesh of a ball of 13.5 mm and a scan of a shell of bone of 13 mm about the same centre."""
    hollow_ball(thickness=3.0).save(tmp_path / "ct.nrrd")
    vertices, triangles = ball(13.5, rings=30)
    Mesh(vertices + MIDDLE, triangles).save(tmp_path / "a.stl")
    return str(tmp_path / "a.stl"), str(tmp_path / "ct.nrrd")


def test_mesh_is_half_a_mm_outside_of_the_surface_fitted_to_the_bone_of_a_scan(
    ball_and_scan: tuple[str, str], device: Any
) -> None:
    report = report_distances(*ball_and_scan, "--surface", "cortex", "--device", str(device.index))

    assert (report["b"]["kind"], report["b"]["iso_value_hu"]) == ("scan", 200.0)
    assert report["b"]["cortex"]["moved"] > 0
    assert report["a_to_b_signed_mm"]["mean"] == pytest.approx(13.5 - 13.0, abs=0.02)  # measured 0.501


def test_mesh_is_nearer_to_the_iso_surface_of_a_scan_than_to_its_bone(
    ball_and_scan: tuple[str, str], device: Any
) -> None:
    report = report_distances(*ball_and_scan, "--surface", "hu", "--device", str(device.index))

    assert (report["b"]["kind"], report["b"]["iso_value_hu"], report["b"]["cortex"]) == ("scan", 200.0, None)
    # 200 HU lies further outside: measured -0.28, of 0.5 from the bone.
    assert -0.4 < report["a_to_b_signed_mm"]["mean"] < -0.2


@pytest.mark.usefixtures("device")
def test_words_of_a_distance_from_a_scan_name_its_iso_value_and_the_shares_of_its_fit(
    ball_and_scan: tuple[str, str], printed: Printer
) -> None:
    assert main(["distance", *ball_and_scan, "--surface", "cortex", "--samples", "500"]) == 0
    printed().assert_output(200, 100, 0)  # HU, and shares of the fit in percent


def test_open_mesh_has_no_volume_and_none_outside_of_it_and_is_warned_of(files: dict[str, str]) -> None:
    report = report_distances(files["a.stl"], files["open.stl"])

    assert report["a_to_b_signed_mm"] is None
    assert report["b_to_a_signed_mm"] is not None  # a is closed
    assert report["b"]["volume_ml"] is None
    assert any("open.stl is not closed (3 edges" in text for text in report["warnings"])


def test_mesh_a_thousand_times_smaller_is_doubted_to_be_in_another_unit(files: dict[str, str]) -> None:
    report = report_distances(files["a.stl"], files["metres.stl"])
    assert any("in another unit?" in text for text in report["warnings"])


@pytest.fixture
def two_of_one_shape(tmp_path: Path) -> tuple[str, str]:
    """The same mesh in two files that name different frames of reference."""
    vertices, triangles = ball(5.0, rings=12)
    paths = str(tmp_path / "x.ply"), str(tmp_path / "y.ply")
    for path, code in zip(paths, ("0123456789abcdef", "fedcba9876543210"), strict=True):
        report = {"certificate": {"frame_of_reference_hash": code}}
        Mesh(vertices, triangles, report=report).save(path, keep_ids=True)
    return paths


def test_meshes_of_different_frames_of_reference_are_warned_of(two_of_one_shape: tuple[str, str]) -> None:
    report = report_distances(*two_of_one_shape)
    (warning,) = report["warnings"]
    assert "different frames of reference" in warning


def test_mesh_has_no_distance_from_itself_and_no_warning(two_of_one_shape: tuple[str, str]) -> None:
    path, _ = two_of_one_shape

    report = report_distances(path, path)

    assert report["hausdorff_mm"] == pytest.approx(0.0, abs=1e-6)  # points on triangles in float64
    assert report["warnings"] == []


def test_written_mesh_has_its_vertices_in_ras_and_the_distance_at_each(files: dict[str, str], tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    out = tmp_path / "out.ply"

    report = report_distances(files["a.stl"], files["b.ply"], "-o", str(out), "--space", "ras")

    (output,) = report["outputs"]
    assert (output["name"], output["bytes"]) == ("out.ply", out.stat().st_size)
    a, b = clrecon.read_mesh(files["a.stl"]), clrecon.read_mesh(files["b.ply"])
    assert clrecon.read_mesh(out).triangle_count == a.triangle_count
    written = trimesh.load(out, process=False)
    np.testing.assert_allclose(np.asarray(written.vertices) * (-1, -1, 1), a.vertices, atol=1e-4)  # float32 of 800 mm
    distances, _ = clrecon.measure_vertex_distances(a, b)
    values = written.metadata["_ply_raw"]["vertex"]["data"]["scalar_distance_mm"]
    np.testing.assert_allclose(np.ravel(values), distances, atol=1e-5)  # float32


def test_written_mesh_is_red_beyond_the_range_and_light_where_there_is_no_distance(
    files: dict[str, str], tmp_path: Path
) -> None:
    trimesh = pytest.importorskip("trimesh")
    out = tmp_path / "out.ply"

    report = report_distances(files["a.stl"], files["b.ply"], "-o", str(out), "--range", "1")

    distances = clrecon.read_mesh(out).values["distance_mm"]
    far, near = distances > 1.0, np.abs(distances) < 0.02
    assert far.any() and near.any()
    assert (report["colors"]["signed"], report["colors"]["range_mm"]) == (True, 1.0)
    assert 0.4 < report["colors"]["beyond_share"] < 0.6  # of the area, the ends: measured 0.48
    colors = np.asarray(trimesh.load(out, process=False).visual.vertex_colors)[:, :3].astype(int)
    dark_red, light_grey = (178, 24, 43), 222  # the end of the scale, and its middle
    assert (colors[far] == dark_red).all()
    assert (np.abs(colors[near] - light_grey) < 8).all()  # 0.02 of the range of 1 mm: up to 6


def test_picture_of_distances_is_red_at_the_ends_alone_with_its_scale_beside(
    device: Any, files: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out.png"

    report = report_distances(files["a.stl"], files["b.ply"], "--picture", str(out), "--device", str(device.index))

    assert report["device"]
    with Image.open(out) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    height, width = pixels.shape[:2]
    assert height == 1024
    assert width > 1100  # the bar of the scale, beside the ball in 1024 columns
    red_rows = np.any(pixels[:, :1024, 0] > pixels[:, :1024, 2] + 60, axis=1)
    third = height // 3
    assert red_rows[:third].any()
    assert red_rows[-third:].any()
    assert not red_rows[third:-third].any()  # measured from row 307 on none before row 716


@pytest.mark.parametrize(
    ("extra", "code", "fact"),
    [
        ([], 3, "required"),
        (["folder/no.stl"], 3, "folder/no.stl"),
        (["B", "-o", "x.stl"], 3, ".ply"),
        (["B", "--picture", "x.gif"], 3, ".png"),
        (["B", "-o", "no/x.ply"], 6, "no"),
        (["B", "-o", "x.ply", "--report", "x.ply"], 3, "x.ply"),
        (["B", "-o", "B"], 3, "b.ply"),
        (["B", "--range", "0"], 3, 0),
        (["B", "--samples", "0"], 3, "samples"),
        (["B", "--mesh-space", "xyz"], 3, "xyz"),
        (["B", "--view", "sideways"], 3, "sideways"),
        (["B", "--surface", "cortex"], 3, "scan"),
        (["x.off"], 3, ".stl"),
    ],
)
def test_wrong_usage_of_distance_is_refused_in_one_line_and_writes_nothing(
    extra: list[str], code: int, fact: str | int, files: dict[str, str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, printed: Printer,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    given = [files["b.ply"] if word == "B" else word for word in extra]
    check_refused(["distance", files["a.stl"], *given], code, fact, tmp_path, printed)


def test_of_two_missing_meshes_the_first_is_named(tmp_path: Path, printed: Printer) -> None:
    check_refused(["distance", "first.stl", "second.stl"], 3, "first.stl", tmp_path, printed)


def test_mesh_whose_triangles_have_no_area_is_refused(files: dict[str, str], tmp_path: Path, printed: Printer) -> None:
    vertices, triangles = box()
    flat = tmp_path / "flat.stl"
    Mesh(vertices * (0.0, 0.0, 1.0), triangles).save(flat)  # a line

    assert main(["distance", files["a.stl"], str(flat), "-q"]) == 2

    printed().assert_error("triangle", "area")
