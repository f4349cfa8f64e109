"""A crop in the jobs: meshes, clouds and pictures of a part of a scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_files import write_nrrd
from refusals import refused

from clrecon import PointLook, read_mesh, read_points
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.geometry.blocks import crop_box
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.render.settings import RenderSettings

pytestmark = pytest.mark.first_device

AFFINE = np.diag((0.8, 0.8, 1.0, 1.0))
AFFINE[:3, 3] = (-16.0, 30.0, 100.0)
SHAPE = (40, 40, 40)
CENTRE, RADIUS = np.array([0.0, 46.0, 120.0]), 12.0
"""A ball, LPS mm."""


def places() -> np.ndarray:
    k, j, i = np.indices(SHAPE).reshape(3, -1).astype(float)
    return np.column_stack([i, j, k]) * AFFINE.diagonal()[:3] + AFFINE[:3, 3]


def away() -> np.ndarray:
    return np.linalg.norm(places() - CENTRE, axis=1).reshape(SHAPE)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    voxels = np.clip(100.0 * (RADIUS - away()) + 300.0, -1000, 1000).astype(np.int16)
    return write_nrrd(tmp_path_factory.mktemp("ball") / "ct.nrrd", voxels, AFFINE)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def mesh_of(scan: Path, folder: Path, *words: str) -> tuple[Any, dict[str, Any]]:
    assert run("mesh", scan, "-o", folder / "a.stl", "--report", folder / "a.json", "--hu", "300", "-q", *words) == 0
    return read_mesh(folder / "a.stl"), json.loads((folder / "a.json").read_text())


HALF = ("--between", f"{CENTRE[2]:g},")


def test_half_a_ball_is_closed_at_the_crop(scan: Path, tmp_path: Path) -> None:
    _, report = mesh_of(scan, tmp_path, *HALF)
    assert report["closed"] and report["manifold"]
    half_ml = 2.0 / 3.0 * np.pi * RADIUS**3 / 1000.0
    # Up to one slice goes on beyond the lowest centre, where it meets the air outside.
    slice_ml = np.pi * RADIUS**2 * 1.0 / 1000.0
    assert half_ml < report["volume_ml"] < half_ml + slice_ml


def test_half_a_ball_is_open_at_the_crop_on_request(scan: Path, tmp_path: Path) -> None:
    left, report = mesh_of(scan, tmp_path, *HALF, "--open")
    assert not report["closed"] and left.vertices[:, 2].min() >= CENTRE[2]


def test_vertices_away_from_the_crop_are_those_of_the_whole(scan: Path, tmp_path: Path) -> None:
    whole, half = (mesh_of(scan, tmp_path, *options)[0].vertices for options in ((), HALF))
    above = [np.unique(vertices[vertices[:, 2] > CENTRE[2] + 0.5], axis=0) for vertices in (whole, half)]
    assert np.array_equal(*above) and len(above[0]) > 100


def test_report_of_a_crop_counts_the_voxels_that_stay(scan: Path, tmp_path: Path) -> None:
    _, report = mesh_of(scan, tmp_path, *HALF)
    assert report["volume"]["crop"]["voxels"] == 40 * 40 * 20 and report["volume"]["shape_ijk"] == [40, 40, 20]
    assert any("cropped to z from 120 mm (LPS): 32,000 of 64,000 voxels stay (50 %)" in w for w in report["warnings"])


def test_crop_is_read_in_the_frame_of_space(scan: Path, tmp_path: Path) -> None:
    lps, _ = mesh_of(scan, tmp_path, "--around", "8,52,126,9")
    ras, _ = mesh_of(scan, tmp_path, "--around", "-8,-52,126,9", "--space", "ras")
    assert np.allclose(np.sort(ras.vertices, axis=0), np.sort(lps.vertices, axis=0), atol=1e-4)  # both are read as LPS
    assert 9.0 <= np.ptp(lps.vertices, axis=0).max() <= 18.0 + 2.0


def test_several_crop_boxes_are_intersected(scan: Path, tmp_path: Path) -> None:
    _, report = mesh_of(scan, tmp_path, "--between", "110,130", "--clip-box", ",0,,,115,")
    assert report["volume"]["crop"]["box_mm"] == [[None, None, 115.0], [0.0, None, 130.0]]
    assert report["volume"]["shape_ijk"] == [21, 40, 16]


def test_labels_end_at_the_crop(scan: Path, tmp_path: Path) -> None:
    labels = write_nrrd(tmp_path / "l.nrrd", (away() < RADIUS).astype(np.uint8), AFFINE)
    for surface in ("hu", "mask"):
        words = ["mesh", scan, "-o", tmp_path / "b.stl", "--labels", labels, "--surface", surface, "-q"]
        assert run(*words, "--between", "120,") == 0
        assert 118.9 < read_mesh(tmp_path / "b.stl").vertices[:, 2].min() < 120.0
        assert run(*words, "--between", "134,") == 4  # no label there


def test_points_end_at_the_crop(scan: Path, tmp_path: Path) -> None:
    words = ["cloud", scan, "-o", tmp_path / "c.npz", "--hu", "300", "-q"]
    assert run(*words) == 0
    whole = len(read_points(tmp_path / "c.npz").points)
    assert run(*words, "--around", "0,46,132,8") == 0
    part = read_points(tmp_path / "c.npz").points
    assert 0 < len(part) < whole
    assert (np.abs(part - (0, 46, 132)) <= 8.0 + 1.0).all()


def test_pictures_are_framed_on_the_crop(scan: Path, tmp_path: Path) -> None:
    words = ["render", scan, "-o", tmp_path / "p.png", "--iso", "300", "--size", "64", "-q", "--report"]
    figures = {}
    for name, more in {"whole": [], "part": ["--around", "0,46,120,8"]}.items():
        assert run(*words, tmp_path / f"{name}.json", *more) == 0
        figures[name] = json.loads((tmp_path / f"{name}.json").read_text())
    assert figures["part"]["pictures"][0]["pixel_mm"] < figures["whole"]["pictures"][0]["pixel_mm"]
    assert len(figures["part"]["clip_planes_lps_mm"]) == 6  # rays end exactly at the box
    assert figures["part"]["volume"]["shape_ijk"] == [23, 23, 19]  # one voxel more on each side
    assert run(*words, tmp_path / "s.json", "--mode", "slice", "--between", "110,130", "--iso", "300") == 3
    assert run("render", scan, "-o", tmp_path / "p.png", "--mode", "slice", "--between", "110,130", "-q") == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--between", "5,1"), "--between runs from 5 to 1 mm along z: it holds nothing; give the lower end first"),
        (("--between", "nan,1"), "--between takes numbers, and one of them is NaN"),
        (("--between", "1"), "are no two heights"),
        (("--around", "1,2,3"), "is no point and length"),
        (("--around", "1,2,3,0"), "a length above 0 in mm, not 1,2,3,0"),
        (("--around", "1,2,inf,4"), "a length above 0 in mm"),
        (("--clip-box", "1,2,3"), "X0,X1,Y0,Y1,Z0,Z1"),
        (("--clip-box", ",,9,3,,"), "--clip-box runs from 9 to 3 mm along y"),
        (("--between", "0,50"), "nothing is left: no voxel lies in the box z 0 to 50 mm (LPS); the scan runs from"),
        (("--between", "100,110", "--around", "0,46,130,5"), "the boxes have nothing in common: along z"),
    ],
)
def test_wrong_boxes_are_one_line(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], line: str
) -> None:
    for command, name in (("mesh", "a.stl"), ("export", "a.nrrd")):
        assert run(command, scan, "-o", tmp_path / name, *words) == 3
        said = capsys.readouterr().err
        assert line in said and len(said.strip().splitlines()) == 1
        assert not list(tmp_path.iterdir())


@pytest.mark.unit
def test_crop_box_is_the_common_part_of_its_limits() -> None:
    assert crop_box(None, None, None) is None
    everywhere = float("inf")
    assert crop_box(None, (1, 2), None) == ((-everywhere, -everywhere, 1), (everywhere, everywhere, 2))
    assert crop_box((0, 9, 0, 9, 0, 9), (3, 20), (1, 5, 5, 4)) == ((0, 1, 3), (5, 9, 9))
    with refused(UsageError, "clip_box", "x" * 60):
        crop_box("x" * 99, None, None)
    with refused(UsageError, "clip_box", 2):
        MeshSettings(clip_box=(1, 2))
    assert RenderSettings.of(clip_box=(0, 1, 0, 1, 0, 1)).crop_margin == 1
    assert RenderSettings.of("slice", clip_box=(0, 1, 0, 1, 0, 1)).crop_margin == 0
    points = RenderSettings.of("points", between=(0, 1))
    assert isinstance(points.style, PointLook) and points.style.clip is not None
    assert points.crop is None and len(points.style.clip.planes) == 2
