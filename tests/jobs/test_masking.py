"""Table and field of view in the job: options, report, and a mesh without the table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import Plan, write_series
from refusals import refused

from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import MeshSettings


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A body of 80 mm with a bone of 24 mm, and a table top of 4 mm below it."""
    y, x = (np.mgrid[:64, :64] - 31.5) * 2.0
    hu = np.full((64, 64), -1000, dtype=np.int16)
    hu[np.hypot(x, y + 10) < 40] = 40
    hu[np.hypot(x, y + 10) < 12] = 900
    hu[(y > 40) & (y < 44) & (abs(x) < 58)] = 400
    folder = tmp_path_factory.mktemp("table")

    def change(ds: Any, k: int) -> None:
        noise = np.random.default_rng(k).normal(0, 5, hu.shape)
        ds.PixelData = (hu + 1024 + noise).round().astype(np.int16).tobytes()

    write_series(folder, Plan(shape=(8, 64, 64), pixel_spacing=(2.0, 2.0), gap=2.5), change)
    return folder


def mesh_with(scan: Path, tmp_path: Path, device: Any, *options: str) -> dict[str, Any]:
    """Mesh the scan with further options; return the report."""
    report = tmp_path / "report.json"
    command = ["mesh", str(scan), "-o", str(tmp_path / "bone.stl"), "--report", str(report), "-q"]
    assert main([*command, "--device", str(device.index), *options]) == 0
    return dict(json.loads(report.read_text()))


def test_mesh_without_masks_has_bone_and_table_and_no_warning_of_air(device: Any, scan: Path, tmp_path: Path) -> None:
    report = mesh_with(scan, tmp_path, device)

    assert report["components"] == 2
    assert not any("is air now" in text for text in report["warnings"])


@pytest.mark.parametrize("options", [["--remove-table"], ["--fov", "40"]], ids=["table", "field of view"])
def test_mesh_without_the_table_is_that_of_the_bone_alone(
    device: Any, scan: Path, tmp_path: Path, options: list[str]
) -> None:
    report = mesh_with(scan, tmp_path, device, *options)
    assert (report["components"], report["closed"]) == (1, True)
    (left, *_), (right, *_) = report["bounds_mm"]
    assert right - left == pytest.approx(24.0, abs=2 * 2.0)  # mm, and a pixel at either end: the table is 116 mm wide


@pytest.mark.parametrize(
    ("options", "entry"),
    [(["--remove-table"], "remove_table"), (["--fov", "40"], "field_of_view")],
    ids=["table", "field of view"],
)
def test_report_counts_the_voxels_that_a_mask_made_air_and_warns_of_them(
    device: Any, scan: Path, tmp_path: Path, options: list[str], entry: str
) -> None:
    report = mesh_with(scan, tmp_path, device, *options)

    facts = report["volume"][entry]
    assert facts["air_hu"] == pytest.approx(-1000, abs=2)  # in noise of 5 HU
    assert 0 < facts["dense_voxels_removed"] <= facts["voxels_removed"]
    (warning,) = [text for text in report["warnings"] if "is air now" in text]
    assert f"{facts['dense_voxels_removed']:,} of them dense" in warning
    assert report["seconds"]["mask"] > 0.0


def test_field_of_view_without_a_number_is_the_circle_that_fits_into_the_slices(
    device: Any, scan: Path, tmp_path: Path
) -> None:
    report = mesh_with(scan, tmp_path, device, "--fov")

    half_of_64_pixels_of_2_mm = 64.0
    assert report["volume"]["field_of_view"]["radius_mm"] == half_of_64_pixels_of_2_mm


@pytest.mark.parametrize("radius", ["0", "-3", "nan"])
def test_impossible_radius_of_the_field_of_view_is_refused(scan: Path, tmp_path: Path, radius: str) -> None:
    assert main(["mesh", str(scan), "-o", str(tmp_path / "bone.stl"), f"--fov={radius}"]) == 3
    with refused(UsageError, "field", "view"):
        MeshSettings(field_of_view=float(radius))


def test_field_of_view_of_another_word_than_auto_is_refused() -> None:
    with refused(UsageError, "wide", "auto"):
        MeshSettings(field_of_view="wide")
