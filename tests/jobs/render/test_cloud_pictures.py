"""`clrecon render` on files of points: pictures, turntables, reports, and what means nothing for points."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from printed_text import Printer
from refusals import refused

import clrecon
from clrecon.cli.main import main
from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.jobs.inputs import CLOUD_INPUTS, is_cloud_file
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import RenderSettings
from clrecon.points import PointCloud

pytestmark = pytest.mark.first_device

SIZE = "80x64"


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    """A ball of 8 mm whose labels are -1 to 2 from below to above."""
    normals = np.random.default_rng(1).normal(size=(6000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    heights = np.floor(2.0 * normals[:, 2]).astype(int) + 1
    return PointCloud(8.0 * normals + (5.0, 90.0, 40.0), normals, hu=300.0 * normals[:, 0], labels=heights)


@pytest.fixture(scope="module")
def file(cloud: PointCloud, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clouds") / "ball.ply"
    cloud.save(path)
    return path


def test_the_command_draws_what_the_function_draws(device: Any, file: Path, tmp_path: Path, printed: Printer) -> None:
    given = ["--device", str(device.index), "--size", SIZE, "--color", "removed", "--letters"]
    files = ["-o", str(tmp_path / "a.png"), "--depth", str(tmp_path / "d.npy"), "--report", str(tmp_path / "r.json")]
    assert main(["render", str(file), *files, *given, "--view", "20,30", "--point-radius", "0.4"]) == 0
    said = printed()
    said.assert_output(6000, 1, 1)
    cloud = clrecon.read_points(file)
    own = clrecon.render(
        cloud, color_by="removed", radius_mm=0.4, view=(20, 30), size=(80, 64), device=device
    ).annotated(letters=True)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png").convert("RGBA")), own.image)
    assert np.array_equal(np.load(tmp_path / "d.npy"), own.depth, equal_nan=True)
    report = json.loads((tmp_path / "r.json").read_text())
    points = report["pictures"][0]["points"]
    assert points["radius_mm"] == 0.4 and points["color_by"] == "removed" and points["shading"] == "normals"
    assert [entry["name"] for entry in points["legend"]] == [None, "kept", None, None][: len(points["legend"])]
    assert sum(entry["points"] for entry in points["legend"]) == report["cloud"]["points"] == 6000
    assert report["cloud"]["file"]["kind"] == "PLY" and report["volume"] == {}


def test_views_turntables_and_lights_of_a_cloud_are_drawn(device: Any, file: Path, tmp_path: Path) -> None:
    given = ["--device", str(device.index), "--size", "64", "-q"]
    assert main(["render", str(file), "-o", str(tmp_path / "a.png"), "--view", "left,anterior", *given]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"a_left.png", "a_anterior.png"}
    turn = ["--turntable", str(tmp_path / "t"), "--frames", "3", "--color", "hu", "--window=-300,300"]
    assert main(["render", str(file), *turn, *given]) == 0
    assert len(list((tmp_path / "t").glob("*.png"))) == 3
    for light in ("none", "left"):
        out = tmp_path / f"{light}.png"
        assert main(["render", str(file), "-o", str(out), "--color", "white", "--light", light, *given]) == 0
    flat, lit = (np.asarray(Image.open(tmp_path / f"{light}.png").convert("L")) for light in ("none", "left"))
    assert set(np.unique(flat)) == {0, 255} and len(np.unique(lit)) > 20


def test_options_about_scans_are_refused_for_clouds(
    device: Any, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = ["-o", str(tmp_path / "a.png"), "--device", str(device.index)]
    for option, says in (
        (["--mode", "mip"], "which mode points shows, and not mode mip"),
        (["--remove-table"], "--remove-table is about a scan"),
        (["--phase", "2"], "--phase is about a scan"),
        (["--iso", "300"], "--iso does not apply to mode points"),
        (["--shadows"], "--shadows does not apply to mode points"),
        (["--color", "hue"], "unknown colour 'hue'"),
        (["--point-radius", "0"], "the radius of points is a length in mm"),
        (["--color", "label", "--window", "0,9"], "--color hu"),
        (["--values", str(tmp_path / "v.npy")], "--values does not apply to mode points"),
    ):
        assert main(["render", str(file), *out, *option]) == 3, option
        assert says in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_files_that_are_no_clouds_are_refused_and_nothing_is_written(device: Any, file: Path, tmp_path: Path) -> None:
    own = {"device": str(device.index), "size": (64, 64)}
    files = PictureFiles(tmp_path / "a.png")
    with refused(UsageError, "points", "cloud"):
        make_pictures(tmp_path, files, RenderSettings.of("points", **own))
    with pytest.raises(NoDicomError):
        make_pictures(tmp_path, files, RenderSettings.of(**own))
    (tmp_path / "b.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(RefusedInputError):
        make_pictures(tmp_path / "b.ply", files, RenderSettings.of("points", **own))
    with refused(UsageError, "report", "ball.ply"):
        make_pictures(file, PictureFiles(tmp_path / "a.png", report=file), RenderSettings.of("points", **own))
    assert {path.name for path in tmp_path.iterdir()} == {"b.ply"}


def test_clouds_are_told_by_their_names(tmp_path: Path) -> None:
    assert all(is_cloud_file(f"a{extension}") and is_cloud_file(f"a{extension.upper()}") for extension in CLOUD_INPUTS)
    assert not is_cloud_file("a.nii.gz") and not is_cloud_file("folder")
    (tmp_path / "scan.ply").mkdir()
    assert not is_cloud_file(tmp_path / "scan.ply")


def test_a_mesh_drawn_as_points_names_the_mode_of_its_faces(device: Any, tmp_path: Path, printed: Printer) -> None:
    vertices = np.array([(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0)])
    clrecon.Mesh(vertices, np.array([(0, 1, 2)])).save(tmp_path / "bone.ply")
    files = [str(tmp_path / "bone.ply"), "-o", str(tmp_path / "a.png")]
    assert main(["render", *files, "--size", SIZE, "--device", str(device.index)]) == 0
    printed().assert_error("--mode", "mesh")
