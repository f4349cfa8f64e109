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
from clrecon.points.cloud import PointCloud

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
def cloud_file(cloud: PointCloud, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ball.ply, the 6000 points of `cloud`."""
    path = tmp_path_factory.mktemp("clouds") / "ball.ply"
    cloud.save(path)
    return path


@pytest.fixture(scope="module")
def drawn_folder(device: Any, cloud_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """a.png, d.npy and r.json of a picture of the cloud, coloured by what was removed."""
    folder = tmp_path_factory.mktemp("drawn")
    look = ["--size", SIZE, "--color", "removed", "--letters", "--view", "20,30", "--point-radius", "0.4", "-q"]
    files = ["-o", str(folder / "a.png"), "--depth", str(folder / "d.npy"), "--report", str(folder / "r.json")]
    assert main(["render", str(cloud_file), *files, *look, "--device", str(device.index)]) == 0
    return folder


def test_picture_and_depths_of_a_cloud_by_the_command_are_those_of_the_function(
    device: Any, cloud_file: Path, drawn_folder: Path
) -> None:
    cloud = clrecon.read_points(cloud_file)

    picture = clrecon.render(cloud, color_by="removed", radius_mm=0.4, view=(20, 30), size=(80, 64), device=device)

    image = np.asarray(Image.open(drawn_folder / "a.png").convert("RGBA"))
    assert np.array_equal(image, picture.annotated(letters=True).image)
    assert np.array_equal(np.load(drawn_folder / "d.npy"), picture.depth, equal_nan=True)


def test_report_of_a_picture_of_a_cloud_has_its_look_and_counts_the_points_of_each_colour(drawn_folder: Path) -> None:
    report = json.loads((drawn_folder / "r.json").read_text())

    (picture,) = report["pictures"]
    points = picture["points"]
    assert (points["radius_mm"], points["color_by"], points["shading"]) == (0.4, "removed", "normals")
    reasons = [entry["name"] for entry in points["legend"]]
    assert reasons == [None, "kept", None, None]  # of the labels -1 to 2 only 0 has a name
    assert sum(entry["points"] for entry in points["legend"]) == report["cloud"]["points"] == 6000
    assert (report["cloud"]["file"]["kind"], report["volume"]) == ("PLY", {})


def test_words_of_a_picture_of_a_cloud_count_its_points(
    device: Any, cloud_file: Path, tmp_path: Path, printed: Printer
) -> None:
    command = ["render", str(cloud_file), "-o", str(tmp_path / "a.png"), "--size", SIZE]
    assert main([*command, "--device", str(device.index)]) == 0
    printed().assert_output(6000)


def test_views_of_a_cloud_are_pictures_named_after_them(device: Any, cloud_file: Path, tmp_path: Path) -> None:
    look = ["--view", "left,anterior", "--device", str(device.index), "--size", "64", "-q"]
    assert main(["render", str(cloud_file), "-o", str(tmp_path / "a.png"), *look]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"a_left.png", "a_anterior.png"}


def test_turntable_of_a_cloud_has_the_given_number_of_frames(device: Any, cloud_file: Path, tmp_path: Path) -> None:
    look = ["--color", "hu", "--window=-300,300", "--device", str(device.index), "--size", "64", "-q"]
    assert main(["render", str(cloud_file), "--turntable", str(tmp_path / "t"), "--frames", "3", *look]) == 0
    assert len(list((tmp_path / "t").glob("*.png"))) == 3


@pytest.mark.parametrize(("light", "is_shaded"), [("none", False), ("left", True)])
def test_white_cloud_has_shades_of_grey_only_with_a_light(
    light: str, is_shaded: bool, device: Any, cloud_file: Path, tmp_path: Path
) -> None:
    look = ["--color", "white", "--light", light, "--device", str(device.index), "--size", "64", "-q"]

    assert main(["render", str(cloud_file), "-o", str(tmp_path / "a.png"), *look]) == 0

    greys = set(np.unique(np.asarray(Image.open(tmp_path / "a.png").convert("L"))))
    background, white = 0, 255
    assert len(greys) > 100 if is_shaded else greys == {background, white}  # measured 202


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--mode", "mip"], "which mode points shows, and not mode mip"),
        (["--remove-table"], "--remove-table is about a scan"),
        (["--phase", "2"], "--phase is about a scan"),
        (["--iso", "300"], "--iso does not apply to mode points"),
        (["--shadows"], "--shadows does not apply to mode points"),
        (["--color", "hue"], "unknown colour 'hue'"),
        (["--color", "labels"], "did you mean label?"),
        (["--point-radius", "0"], "the radius of points is a length in mm"),
        (["--color", "label", "--window", "0,9"], "--color hu"),
        (["--values", "v.npy"], "--values does not apply to mode points"),
    ],
)
def test_wrong_option_for_a_picture_of_a_cloud_is_refused_and_no_picture_is_written(
    option: list[str], says: str, device: Any, cloud_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    assert main(["render", str(cloud_file), "-o", "a.png", "--device", str(device.index), *option]) == 3

    assert says in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_folder_in_mode_points_is_refused(device: Any, tmp_path: Path) -> None:
    settings = RenderSettings.of("points", device=str(device.index), size=(64, 64))
    with refused(UsageError, "points", "cloud"):
        make_pictures(tmp_path, PictureFiles(tmp_path / "a.png"), settings)
    assert not list(tmp_path.iterdir())


def test_folder_without_a_scan_is_refused(device: Any, tmp_path: Path) -> None:
    settings = RenderSettings.of(device=str(device.index), size=(64, 64))
    with pytest.raises(NoDicomError):
        make_pictures(tmp_path, PictureFiles(tmp_path / "a.png"), settings)
    assert not list(tmp_path.iterdir())


def test_ply_without_points_is_refused(device: Any, tmp_path: Path) -> None:
    (tmp_path / "b.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    settings = RenderSettings.of("points", device=str(device.index), size=(64, 64))
    with pytest.raises(RefusedInputError):
        make_pictures(tmp_path / "b.ply", PictureFiles(tmp_path / "a.png"), settings)
    assert {path.name for path in tmp_path.iterdir()} == {"b.ply"}


def test_report_of_a_picture_over_its_cloud_is_refused(device: Any, cloud_file: Path, tmp_path: Path) -> None:
    settings = RenderSettings.of("points", device=str(device.index), size=(64, 64))
    with refused(UsageError, "report", "ball.ply"):
        make_pictures(cloud_file, PictureFiles(tmp_path / "a.png", report=cloud_file), settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extension", CLOUD_INPUTS)
def test_file_with_an_extension_of_clouds_in_any_case_is_taken_for_one(extension: str) -> None:
    assert is_cloud_file(f"a{extension}")
    assert is_cloud_file(f"a{extension.upper()}")


def test_volume_or_folder_is_not_taken_for_a_cloud(tmp_path: Path) -> None:
    (tmp_path / "scan.ply").mkdir()

    assert not is_cloud_file("a.nii.gz")
    assert not is_cloud_file("folder")
    assert not is_cloud_file(tmp_path / "scan.ply")


@pytest.mark.parametrize("extension", [".ply", ".vtp"])
def test_mesh_of_a_format_of_clouds_is_drawn_as_points_only_where_an_option_asks_for_them(
    device: Any, tmp_path: Path, printed: Printer, extension: str
) -> None:
    vertices = np.array([(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0)])
    clrecon.Mesh(vertices, np.array([(0, 1, 2)])).save(tmp_path / f"bone{extension}")
    files = [str(tmp_path / f"bone{extension}"), "-o", str(tmp_path / "a.png")]
    assert main(["render", *files, "--size", SIZE, "--device", str(device.index)]) == 0
    printed().assert_output("mode", "mesh")
    for asked in (["--mode", "points"], ["--point-radius", "1"]):
        assert main(["render", *files, *asked, "--size", SIZE, "--device", str(device.index)]) == 0
        printed().assert_error("--mode", "mesh")
