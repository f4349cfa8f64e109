"""`clrecon cloud` on clouds of other programs: their units, normals, surfaces and degenerate clouds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer

import clrecon

pytestmark = pytest.mark.first_device


def write_ball(path: Path, *, radius_mm: float = 10.0) -> Path:
    """Write 3000 points on a ball."""
    directions = np.random.default_rng(4).normal(size=(3000, 3))
    np.savetxt(path, radius_mm * directions / np.linalg.norm(directions, axis=1, keepdims=True), "%.9f")
    return path


def test_surface_of_a_free_cloud_is_refused_without_normals_and_a_viewpoint(
    tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    source, surface = write_ball(tmp_path / "free.xyz"), ["--surface", str(tmp_path / "out.stl")]
    assert cloud_command(source, *surface) == 3
    printed().assert_error("--normals", "--viewpoint")
    assert cloud_command(source, "--normals", *surface) == 3
    printed().assert_error("--viewpoint")
    assert {path.name for path in tmp_path.iterdir()} == {"free.xyz"}


@pytest.mark.parametrize(("radius_mm", "unit"), [(0.05, "metres"), (50.0, ""), (50_000.0, "micrometres")])
def test_cloud_of_implausible_size_is_warned_of_with_the_unit_it_may_be_in(
    radius_mm: float, unit: str, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(write_ball(tmp_path / "free.xyz", radius_mm=radius_mm)) == 0
    error = capsys.readouterr().err
    assert (f"which is read as mm; perhaps they are in {unit}: then" in error) == bool(unit)
    assert error.count("\n") == bool(unit)


def test_bilateral_filter_of_the_paper_moves_points_otherwise_than_the_default(
    tmp_path: Path, cloud_command: Any
) -> None:
    source = write_ball(tmp_path / "free.xyz")
    assert cloud_command(source, "--denoise", "bilateral", "--paper", output="a.ply") == 0
    assert cloud_command(source, "--denoise", "bilateral", output="b.ply") == 0
    one, two = (clrecon.read_points(tmp_path / name).points for name in ("a.ply", "b.ply"))
    assert not np.array_equal(one, two)


@pytest.mark.parametrize("name", ["a.pcd", "a.E57", "a.laz"])
def test_cloud_in_a_format_that_is_not_read_is_refused_with_its_extension(
    name: str, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    (tmp_path / name).write_text("# .PCD")
    assert cloud_command(tmp_path / name) == 3
    printed().assert_error(name[1:].lower())


def test_cloud_of_numbers_with_the_extension_asc_is_read(tmp_path: Path, cloud_command: Any) -> None:
    source = write_ball(tmp_path / "free.xyz").rename(tmp_path / "free.asc")
    assert cloud_command(source, output="a.ply") == 0
    assert len(clrecon.read_points(tmp_path / "a.ply")) == len(clrecon.read_points(source))


@pytest.mark.parametrize(
    ("points", "words"),
    [
        pytest.param(1, "the cloud has one point, so that no edge of cells can be chosen", id="a single point"),
        pytest.param(50, "over half of the 50 points have 15 others at the same place", id="one place"),
    ],
)
def test_grid_filter_of_points_in_one_place_is_refused(
    points: int, words: str, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "one.xyz").write_text("1 2 3\n" * points)

    assert cloud_command(tmp_path / "one.xyz", "--denoise", "grid") == 3

    assert words in capsys.readouterr().err


def test_surface_of_an_uneven_cloud_is_warned_of_for_walls_that_no_points_support(
    tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    generator = np.random.default_rng(4)
    ball = generator.normal(size=(3000, 3))
    ball *= 10.0 / np.linalg.norm(ball, axis=1, keepdims=True)
    thinned_above = ball[(ball[:, 2] < 0.0) | (generator.random(3000) < 0.12)]
    np.savetxt(tmp_path / "free.xyz", thinned_above, "%.9f")
    options = ["--normals", "--viewpoint", "0,0,0", "--surface", str(tmp_path / "out.stl")]

    assert cloud_command(tmp_path / "free.xyz", *options, "--report", str(tmp_path / "r.json")) == 0

    report = json.loads((tmp_path / "r.json").read_text())
    assert report["surface"]["wall_share"] > 0.1  # measured 0.138
    assert report["surface"]["lost_share"] == 0.0
    assert any("walls that no points" in warning for warning in report["warnings"])
    said = printed()
    said.assert_error("surface", "walls")
    said.assert_output("walls", "without")


def test_free_cloud_with_a_viewpoint_gets_outward_normals_and_a_surface(tmp_path: Path, cloud_command: Any) -> None:
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centre, radius_mm = np.array([30.0, -20.0, 5.0]), 10.0
    np.savetxt(tmp_path / "free.xyz", radius_mm * directions + centre, "%.6f")
    at_the_centre = "--viewpoint=-30,20,5"  # in RAS
    options = ["--normals", at_the_centre, "--space", "ras", "--surface", str(tmp_path / "out.stl")]

    assert cloud_command(tmp_path / "free.xyz", *options, "--report", str(tmp_path / "r.json")) == 0

    cloud, report = clrecon.read_points(tmp_path / "out.ply"), json.loads((tmp_path / "r.json").read_text())
    outward = (cloud.points - centre) / radius_mm
    assert np.einsum("ij,ij->i", cloud.normals, outward).min() > 0.9  # within 26 degrees: planes of some 15 points
    assert report["steps"][0]["oriented_by"] == "viewpoint"
    triangles = report["surface"]["triangles"]
    assert triangles > 10_000  # measured 16,716
    assert (tmp_path / "out.stl").stat().st_size == 84 + 50 * triangles  # header of a binary STL, and 50 bytes each
