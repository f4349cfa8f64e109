"""``clrecon distance``: figures, frames, coloured mesh, picture, and wrong usage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import check_refused
from printed_text import Printer
from sample_meshes import ball, box
from surface_volumes import MIDDLE, hollow_ball

import clrecon
from clrecon.cli.main import main
from clrecon.mesh import Mesh


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    vertices, triangles = ball(10.0, 30)
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


def run(*given: str) -> tuple[int, dict[str, Any]]:
    out = Path(given[0]).parent / "report.json"
    code = main(["distance", *given, "--samples", "4000", "--report", str(out), "-q"])
    return code, json.loads(out.read_text()) if out.exists() else {}


def test_a_file_in_ras_is_turned_and_both_directions_are_measured(files: dict[str, str], capsys: Any) -> None:
    code, report = run(files["a.stl"], files["b.ply"])
    assert code == 0 and report["warnings"] == [] and report["outputs"] == [] and report["device"] is None
    assert (report["a"]["space"], report["b"]["space"], report["b"]["space_from"]) == ("LPS", "RAS", "file")
    assert report["hausdorff_mm"] == pytest.approx(2.0, abs=0.05)
    there, back = report["a_to_b_signed_mm"], report["b_to_a_signed_mm"]
    assert there["max"] == pytest.approx(2.0, abs=0.05) and there["min"] == pytest.approx(0.0, abs=0.05)
    assert there["outside_share"] > 0.9 > 0.1 > back["outside_share"]
    assert main(["distance", files["a.stl"], files["b.ply"], "--samples", "500"]) == 0
    shown = capsys.readouterr().out
    assert "RAS, named by the file, turned to LPS" in shown and max(map(len, shown.splitlines())) <= 60


def test_a_file_without_a_frame_is_doubted_until_it_is_said(files: dict[str, str]) -> None:
    code, report = run(files["plain.stl"], files["b.ply"])
    assert code == 0 and report["hausdorff_mm"] > 50.0
    assert any("taken as LPS" in text for text in report["warnings"])
    assert any("apart: is the frame of the file that names none another?" in text for text in report["warnings"])
    code, report = run(files["plain.stl"], files["b.ply"], "--mesh-space", "ras")
    assert code == 0 and report["hausdorff_mm"] == pytest.approx(2.0, abs=0.05) and report["warnings"] == []
    assert report["a"]["space_from"] == "argument"


def test_a_mesh_is_measured_against_the_bone_of_a_scan(tmp_path: Path, printed: Printer, device: Any) -> None:
    volume = hollow_ball(thickness=3.0)
    volume.save(tmp_path / "ct.nrrd")
    vertices, triangles = ball(13.5, 30)
    mesh = str(tmp_path / "a.stl")
    Mesh(vertices + MIDDLE, triangles).save(mesh)
    found = {}
    for kind in ("hu", "cortex"):
        code, found[kind] = run(mesh, str(tmp_path / "ct.nrrd"), "--surface", kind, "--device", str(device.index))
        assert code == 0 and (found[kind]["b"]["kind"], found[kind]["b"]["iso_value_hu"]) == ("scan", 200.0)
    level, fitted = (found[kind]["a_to_b_signed_mm"]["mean"] for kind in ("hu", "cortex"))
    assert fitted == pytest.approx(0.5, abs=0.08) and level < 0.1
    assert found["cortex"]["b"]["cortex"]["moved"] and found["hu"]["b"]["cortex"] is None
    assert main(["distance", mesh, str(tmp_path / "ct.nrrd"), "--surface", "cortex", "--samples", "500"]) == 0
    printed().assert_output(200, 100, 0)


def test_an_open_mesh_and_one_in_metres_are_said(files: dict[str, str]) -> None:
    _, report = run(files["a.stl"], files["open.stl"])
    assert report["a_to_b_signed_mm"] is None and report["b_to_a_signed_mm"] is not None
    assert "open.stl is not closed (3 edges" in report["warnings"][0] and report["b"]["volume_ml"] is None
    _, report = run(files["a.stl"], files["metres.stl"])
    assert any("in another unit?" in text for text in report["warnings"])


def test_different_frames_of_reference_are_said(files: dict[str, str], tmp_path: Path) -> None:
    vertices, triangles = ball(5.0, 12)
    paths = [str(tmp_path / f"{name}.ply") for name in "xy"]
    for path, code in zip(paths, ("0123456789abcdef", "fedcba9876543210"), strict=True):
        told = {"certificate": {"frame_of_reference_hash": code}}
        Mesh(vertices, triangles, report=told).save(path, keep_ids=True)
    _, report = run(*paths)
    assert "different frames of reference" in report["warnings"][0]
    _, report = run(paths[0], paths[0])
    assert report["warnings"] == [] and report["hausdorff_mm"] == pytest.approx(0.0, abs=1e-6)


def test_the_coloured_mesh_has_colours_and_distances(files: dict[str, str], tmp_path: Path) -> None:
    import trimesh

    out = tmp_path / "out.ply"
    code, report = run(files["a.stl"], files["b.ply"], "-o", str(out), "--range", "1", "--space", "ras")
    assert code == 0 and report["colors"]["signed"] is True and report["colors"]["range_mm"] == 1.0
    assert 0.05 < report["colors"]["beyond_share"] < 0.9
    a = clrecon.read_mesh(files["a.stl"])
    distances, _ = clrecon.measure_vertex_distances(a, clrecon.read_mesh(files["b.ply"]))
    read = trimesh.load(out, process=False)
    np.testing.assert_allclose(np.asarray(read.vertices) * (-1, -1, 1), a.vertices, atol=1e-4)
    vertex = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(np.ravel(vertex["scalar_distance_mm"]), distances, atol=1e-5)
    colors = np.asarray(read.visual.vertex_colors)[:, :3].astype(int)
    far, near = distances > 1.0, np.abs(distances) < 0.02
    assert far.any() and near.any()
    assert (colors[far] == (178, 24, 43)).all() and (np.abs(colors[near] - 222) < 8).all()
    assert report["outputs"][0]["name"] == "out.ply" and report["outputs"][0]["bytes"] == out.stat().st_size
    assert clrecon.read_mesh(out).triangle_count == a.triangle_count


def test_the_picture_shows_red_ends_and_its_scale(device: Any, files: dict[str, str], tmp_path: Path) -> None:
    from PIL import Image

    out = tmp_path / "out.png"
    code, report = run(files["a.stl"], files["b.ply"], "--picture", str(out), "--device", str(device.index))
    assert code == 0 and report["device"]
    with Image.open(out) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    height, width = pixels.shape[:2]
    assert height == 1024 and width > 1100
    ball_itself = pixels[:, :1024]
    red = np.any(ball_itself[..., 0] > ball_itself[..., 2] + 60, axis=1)
    assert red[: height // 4].any() and red[-height // 3 :].any() and not red[height // 2 - 20 : height // 2 + 20].any()


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
        (["x.off"], 3, ".stl"),
    ],
)
def test_wrong_usage_is_one_line_and_writes_nothing(
    extra: list[str], code: int, fact: str | int, files: dict[str, str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, printed: Printer,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    given = [files["b.ply"] if word == "B" else word for word in extra]
    check_refused(["distance", files["a.stl"], *given], code, fact, tmp_path, printed)


def test_a_mesh_of_nothing_has_no_distances(files: dict[str, str], tmp_path: Path, capsys: Any) -> None:
    vertices, triangles = box()
    flat = tmp_path / "flat.stl"
    Mesh(vertices * (0.0, 0.0, 1.0), triangles).save(flat)
    assert main(["distance", files["a.stl"], str(flat), "-q"]) == 2
    assert "no triangle with an area" in capsys.readouterr().err
