"""`clrecon cloud` on clouds of other programs: their units, normals, surfaces and degenerate clouds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer

import clrecon
from clrecon.cli.main import main

pytestmark = pytest.mark.first_device


@pytest.fixture
def cloud_command(device: Any, tmp_path: Path) -> Any:
    """Run the command in an empty folder; returns the exit code."""

    def run(source: Path, *options: str, output: str = "out.ply") -> int:
        return main(["cloud", str(source), "-o", str(tmp_path / output), "--device", str(device.index), *options])

    return run


def write_ball(path: Path, radius: float) -> Path:
    """Write 3000 points on a ball."""
    directions = np.random.default_rng(4).normal(size=(3000, 3))
    np.savetxt(path, radius * directions / np.linalg.norm(directions, axis=1, keepdims=True), "%.9f")
    return path


def test_a_free_cloud_without_a_viewpoint_gets_no_surface(tmp_path: Path, cloud_command: Any, printed: Printer) -> None:
    source, surface = write_ball(tmp_path / "free.xyz", 10.0), ["--surface", str(tmp_path / "out.stl")]
    assert cloud_command(source, *surface) == 3
    printed().assert_error("--normals", "--viewpoint")
    assert cloud_command(source, "--normals", *surface) == 3
    printed().assert_error("--viewpoint")
    assert {path.name for path in tmp_path.iterdir()} == {"free.xyz"}


@pytest.mark.parametrize(("radius", "unit"), [(0.05, "metres"), (50.0, ""), (50_000.0, "micrometres")])
def test_a_cloud_in_other_units_is_warned_of(
    radius: float, unit: str, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(write_ball(tmp_path / "free.xyz", radius)) == 0
    error = capsys.readouterr().err
    assert (f"which is read as mm; perhaps they are in {unit}: then" in error) == bool(unit)
    assert error.count("\n") == bool(unit)


def test_paper_option_filters_a_cloud_otherwise_than_the_default(tmp_path: Path, cloud_command: Any) -> None:
    source = write_ball(tmp_path / "free.xyz", 10.0)
    assert cloud_command(source, "--denoise", "bilateral", "--paper", output="a.ply") == 0
    assert cloud_command(source, "--denoise", "bilateral", output="b.ply") == 0
    one, two = (clrecon.read_points(tmp_path / name).points for name in ("a.ply", "b.ply"))
    assert not np.array_equal(one, two)


@pytest.mark.parametrize("name", ["a.pcd", "a.E57", "a.laz"])
def test_clouds_that_are_not_read_are_no_scans(name: str, tmp_path: Path, cloud_command: Any, printed: Printer) -> None:
    (tmp_path / name).write_text("# .PCD")
    assert cloud_command(tmp_path / name) == 3
    printed().assert_error(name[1:].lower())


def test_a_cloud_of_numbers_may_be_called_asc(tmp_path: Path, cloud_command: Any) -> None:
    source = write_ball(tmp_path / "free.xyz", 10.0).rename(tmp_path / "free.asc")
    assert cloud_command(source, output="a.ply") == 0
    assert len(clrecon.read_points(tmp_path / "a.ply")) == len(clrecon.read_points(source))


def test_a_single_point_has_no_cells(tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "one.xyz").write_text("1 2 3\n")
    assert cloud_command(tmp_path / "one.xyz", "--denoise", "grid") == 3
    assert "the cloud has one point, so that no edge of cells can be chosen" in capsys.readouterr().err
    (tmp_path / "same.xyz").write_text("1 2 3\n" * 50)
    assert cloud_command(tmp_path / "same.xyz", "--denoise", "grid") == 3
    assert "over half of the 50 points have 15 others at the same place" in capsys.readouterr().err


def test_walls_of_a_surface_are_warned_of(
    tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """One half of the ball has an eighth of the points of the other."""
    generator = np.random.default_rng(4)
    ball = generator.normal(size=(3000, 3))
    ball *= 10.0 / np.linalg.norm(ball, axis=1, keepdims=True)
    np.savetxt(tmp_path / "free.xyz", ball[(ball[:, 2] < 0.0) | (generator.random(3000) < 0.12)], "%.9f")
    given = ["--normals", "--viewpoint", "0,0,0", "--surface", str(tmp_path / "out.stl")]
    assert cloud_command(tmp_path / "free.xyz", *given, "--report", str(tmp_path / "r.json")) == 0
    said, report = capsys.readouterr(), json.loads((tmp_path / "r.json").read_text())
    assert "of the surface are walls that no points support" in said.err and "% walls without points" in said.out
    assert any("walls that no points" in warning for warning in report["warnings"])
    assert report["surface"]["wall_share"] > 0.1 and report["surface"]["lost_share"] == 0.0


def test_a_free_cloud_gets_its_surface_from_a_viewpoint(tmp_path: Path, cloud_command: Any) -> None:
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centre, source = np.array([30.0, -20.0, 5.0]), tmp_path / "free.xyz"
    np.savetxt(source, 10.0 * directions + centre, "%.6f")
    given = ["--normals", "--viewpoint=-30,20,5", "--space", "ras", "--surface", str(tmp_path / "out.stl")]
    assert cloud_command(source, *given, "--report", str(tmp_path / "r.json")) == 0
    cloud, report = clrecon.read_points(tmp_path / "out.ply"), json.loads((tmp_path / "r.json").read_text())
    outward = (cloud.points - centre) / 10.0
    assert np.einsum("ij,ij->i", cloud.normals, outward).min() > 0.9
    assert report["steps"][0]["oriented_by"] == "viewpoint" and report["surface"]["triangles"] > 1000
    assert (tmp_path / "out.stl").stat().st_size == 84 + 50 * report["surface"]["triangles"]
