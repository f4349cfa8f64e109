"""A scan whose coordinates are 1e5 mm, from its files to the file of its mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, write_series
from variants import daily_rows

from clrecon.cli.main import main

FAR_MM = np.array([1e5, -1e5, 5e4])


def mesh_ball_at(origin_mm: np.ndarray, folder: Path, extension: str, device: Any) -> tuple[Path, dict[str, Any]]:
    """Write a tilted CT of a ball, its first voxel at `origin_mm`, and mesh it; return the file and the report."""
    k, j, i = np.mgrid[:9, :20, :24]
    hu = np.clip(900 - 300 * np.hypot(np.hypot((i - 11.3) * 0.5, (j - 9.6) * 0.7), (k - 4.2) * 1.25), -1000, None)

    def set_pixels(ds: Any, k: int) -> None:
        ds.PixelData = np.rint(hu[k] + 1024).astype(np.int16).tobytes()

    plan = Plan(shape=(9, 20, 24), origin=tuple(origin_mm), decimals=6, angles=(0.0, 0.0, 0.0), tilt_deg=7.0)
    write_series(folder / "ct", plan, set_pixels)
    output, report = folder / f"ball.{extension}", folder / "report.json"
    command = ["mesh", str(folder / "ct"), "-o", str(output), "--report", str(report)]
    assert main([*command, "--device", str(device.index)]) == 0
    return output, json.loads(report.read_text())


STL_STEP_MM = 0.01
"""float32 coordinates of 1e5 mm are 1/128 mm apart."""


@pytest.mark.parametrize(
    ("extension", "bound_mm"),
    daily_rows(1, [pytest.param("ply", tolerances.FAR_SCAN_MM, id="ply"), pytest.param("stl", STL_STEP_MM, id="stl")]),
)
def test_mesh_of_a_scan_a_hundred_metres_away_is_that_at_the_origin_moved(
    device: Any, tmp_path: Path, extension: str, bound_mm: float
) -> None:
    trimesh = pytest.importorskip("trimesh")

    near, near_report = mesh_ball_at(np.zeros(3), tmp_path / "near", extension, device)
    far, far_report = mesh_ball_at(FAR_MM, tmp_path / "far", extension, device)

    assert (far_report["triangles"], far_report["closed"]) == (near_report["triangles"], True)
    assert far_report["volume_ml"] == pytest.approx(near_report["volume_ml"], rel=1e-5)  # float32 about its own middle
    near_corners, far_corners = (
        np.asarray(trimesh.load(path, process=False, maintain_order=True).triangles) for path in (near, far)
    )
    assert np.abs(far_corners - near_corners - FAR_MM).max() <= bound_mm


@pytest.mark.parametrize(("extension", "holds_float32"), daily_rows(1, [("stl", True), ("ply", False)]))
def test_mesh_a_hundred_metres_away_is_warned_of_as_float64_and_in_stl_as_rounded(
    device: Any, tmp_path: Path, extension: str, holds_float32: bool
) -> None:
    _, report = mesh_ball_at(FAR_MM, tmp_path, extension, device)

    assert any("vertices are float64" in text for text in report["warnings"])
    assert any(text.startswith("STL holds float32") for text in report["warnings"]) == holds_float32
