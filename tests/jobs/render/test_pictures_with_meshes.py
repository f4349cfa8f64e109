"""Meshes from files in pictures: as the input, and with a scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer
from refusals import refused
from sample_meshes import ball

import clrecon
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import MeshFile, RenderSettings
from clrecon.rendering.looks.colors import ColorScale
from clrecon.rendering.looks.lighting import UNSHADED


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Return a ball in LPS, one in RAS 12 mm to the left, one without a frame, and a scan around them."""
    vertices, triangles = ball(5.0, 12)
    found = {name: tmp_path / name for name in ("lps.stl", "ras.ply", "plain.stl", "scan.nii")}
    clrecon.Mesh(vertices, triangles).save(found["lps.stl"])
    clrecon.Mesh(vertices + (12.0, 0.0, 0.0), triangles).save(found["ras.ply"], "ras")
    content = found["lps.stl"].read_bytes()
    found["plain.stl"].write_bytes(content[:80].replace(b"SPACE=LPS", b"         ") + content[80:])
    import nibabel

    affine = np.diag([-2.0, -2.0, 2.0, 1.0])
    affine[:3, 3] = 19.0, 19.0, -19.0
    image = nibabel.Nifti1Image(np.arange(8000, dtype=np.int16).reshape(20, 20, 20) % 500, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, found["scan.nii"])
    return found


def test_a_mesh_is_an_input(device: Any, files: dict[str, Path], tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.png"
    code = main(
        ["render", str(files["ras.ply"]), "--mode", "mesh", "-o", str(out), "--size", "64x48", "--color", "orange"]
    )
    said = capsys.readouterr()
    assert code == 0 and out.exists() and not said.err, said.err
    assert "mode mesh" in said.out and "triangles" in said.out
    depth = tmp_path / "depth.npy"
    pictures = PictureFiles(str(out), str(depth), None, None, None)
    settings = RenderSettings.of("mesh", size=(64, 48), meshes=(MeshFile(str(files["lps.stl"]), "red"),))
    report = make_pictures(files["ras.ply"], pictures, settings)
    camera = report.pictures[0]["camera"]
    assert np.allclose(camera["focal_point_lps_mm"], (6.0, 0.0, 0.0), atol=0.2)  # the RAS ball is at the left
    assert [mesh["file"]["space"] for mesh in report.meshes] == ["RAS", "LPS"]
    assert [mesh["color"] for mesh in report.meshes][1] == [1.0, 0.0, 0.0]
    assert report.cloud is None and report.mode == "mesh"


def test_meshes_without_a_scan_are_drawn_with_their_looks(
    device: Any, files: dict[str, Path], tmp_path: Path, printed: Printer
) -> None:
    glb = tmp_path / "other.glb"
    clrecon.read_mesh(files["ras.ply"]).save(glb)
    report = tmp_path / "report.json"
    words = ["render", "--mesh", str(glb), "--mesh", f"{files['lps.stl']}=red,0.5", "--size", "64x48"]
    assert main([*words, "-o", str(tmp_path / "out.png"), "--report", str(report)]) == 0, printed()
    first, second = json.loads(report.read_text())["meshes"]
    assert (first["file"]["kind"], first["opacity"], second["file"]["kind"], second["opacity"]) == (
        "GLB",
        1,
        "STL",
        0.5,
    )
    assert second["color"] == [1.0, 0.0, 0.0] and first["color"] != second["color"]
    for wrong in (["render", "-o", "a.png"], [*words, "--mode", "mip", "-o", "a.png"]):
        assert main(wrong) == 3
        assert printed().error_lines == 1


@pytest.mark.parametrize("mode", ["dvr", "slices", "surface"])
def test_meshes_lie_in_a_scan(device: Any, files: dict[str, Path], tmp_path: Path, mode: str) -> None:
    out = tmp_path / "out.png"
    meshes = (MeshFile(str(files["lps.stl"])), MeshFile(str(files["plain.stl"]), opacity=0.5))
    extra = {"iso_value": 300.0} if mode == "surface" else {}
    settings = RenderSettings.of(mode, size=(64, 48), meshes=meshes, **extra)
    report = make_pictures(files["scan.nii"], PictureFiles(str(out), None, None, None, None), settings)
    assert out.exists() and report.mode == mode
    assert any("plain.stl names no patient frame" in text for text in report.warnings)
    assert report.meshes[0]["color"] != report.meshes[1]["color"]
    assert report.pictures[0]["hit_share"] > 0.02


def test_a_mesh_is_coloured_by_numbers_at_its_vertices(
    device: Any, files: dict[str, Path], tmp_path: Path, capsys: Any
) -> None:
    """Walls from 0.5 mm at the patient's right, the picture's left, to 1.5 mm; nothing is known of the lower half."""
    mesh = clrecon.read_mesh(files["lps.stl"])
    thickness = 1.0 + 0.1 * mesh.vertices[:, 0].astype(float)
    thickness[mesh.vertices[:, 2] < -1.0] = np.nan
    mesh.values = {"thickness_mm": thickness, "distance_mm": thickness - 1.0}
    named = tmp_path / "walls.ply"
    mesh.save(named)
    read = clrecon.read_mesh(named)
    assert np.array_equal(read.values["thickness_mm"], thickness.astype(np.float32), equal_nan=True)
    out, report = tmp_path / "out.png", tmp_path / "report.json"
    words = ["render", str(named), "-o", str(out), "--size", "200", "--color", "thickness", "--light", "none"]
    assert main([*words, "--report", str(report)]) == 0, capsys.readouterr().err
    shown = json.loads(report.read_text())["meshes"][0]
    assert shown["color_by"] == "thickness" and shown["range_mm"] == [0.0, 2.0]
    picture = clrecon.render(read, color_by="thickness", size=(200, 200), lighting=UNSHADED, device=device)
    image = picture.image.astype(int)
    from PIL import Image

    drawn = np.array(Image.open(out))
    assert drawn.shape[1] > 220 and np.array_equal(drawn[:, :200, :3], image[..., :3])
    scale = ColorScale(2.0, signed=False)
    for column, value in ((30, 0.57), (100, 1.0), (170, 1.43)):
        assert np.abs(image[80, column, :3] - scale.colors([value])[0]).max() < 12
    assert image[160, 100, :3].tolist() == [128, 128, 128]
    look = clrecon.MeshLook(color_by="distance", lighting=UNSHADED)
    signed = clrecon.render(read, look, size=(200, 200), device=device)
    assert np.abs(signed.image[80, 100, :3].astype(int) - 222).max() < 12
    with refused(UsageError, "error_mm", "vertices"):
        clrecon.render(read, color_by="error", device=device)
    assert main(["render", str(files["lps.stl"]), "-o", str(out), "--color", "thickness"]) == 3
    assert "a mesh fitted to the cortex has them" in capsys.readouterr().err


def test_turntable_of_a_mesh_has_its_frames(device: Any, files: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "frames"
    words = ["--turntable", str(out), "--frames", "3", "--size", "32"]
    assert main(["render", str(files["lps.stl"]), *words]) == 0
    assert len(list(out.iterdir())) == 3


def test_options_without_meaning_for_meshes_are_refused(files: dict[str, Path], tmp_path: Path, capsys: Any) -> None:
    out, ball_file = str(tmp_path / "out.png"), str(files["lps.stl"])
    for words, text in (
        ([str(files["scan.nii"]), "--mode", "mip", "--mesh", ball_file], "--mesh does not apply to mode mip"),
        ([str(files["scan.nii"]), "--mesh-space", "ras"], "name one with --mesh"),
        ([str(files["scan.nii"]), "--mesh", ball_file + "=octarine"], "unknown colour 'octarine'"),
        ([str(files["scan.nii"]), "--mesh", ball_file + "=red,2"], "opacity of a mesh"),
        ([str(files["scan.nii"]), "--mesh", ball_file + "=red,x"], "FILE[=COLOUR[,OPACITY]]"),
        ([str(files["scan.nii"]), "--mesh", str(tmp_path / "a.off")], ".stl, .ply"),
        ([ball_file, "--mode", "dvr"], "mode mesh shows, and not mode dvr"),
        ([ball_file, "--fov"], "the input is a mesh"),
        ([ball_file, "--mesh-space", "ras"], "leave the space out"),
        ([str(files["scan.nii"]), "--mode", "mesh"], ".stl, .ply"),
        ([str(files["scan.nii"]), "--opacity", "0.5"], "--opacity does not apply to mode dvr"),
    ):
        assert main(["render", *words, "-o", out]) != 0
        error = capsys.readouterr().err
        assert text in error and error.strip().count("\n") == 0, error
        assert not Path(out).exists()
    with refused(UsageError, "colour", "octarine"):
        MeshFile("a.stl", "octarine")
