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

FAR = np.array([1e5, -1e5, 5e4])


@pytest.mark.parametrize(("extension", "warned"), daily_rows(1, [("ply", False), ("stl", True)]))
def test_mesh_a_hundred_metres_away_is_that_of_the_origin(
    device: Any, tmp_path: Path, extension: str, warned: bool
) -> None:
    meshes = []
    for name, origin in (("near", np.zeros(3)), ("far", FAR)):
        plan = Plan(shape=(9, 20, 24), origin=tuple(origin), decimals=6, angles=(0.0, 0.0, 0.0), tilt_deg=7.0)
        k, j, i = np.mgrid[:9, :20, :24]
        hu = np.clip(900 - 300 * np.hypot(np.hypot((i - 11.3) * 0.5, (j - 9.6) * 0.7), (k - 4.2) * 1.25), -1000, None)

        def change(ds: Any, k: int, hu: np.ndarray = hu) -> None:
            ds.PixelData = np.rint(hu[k] + 1024).astype(np.int16).tobytes()

        write_series(tmp_path / name, plan, change)
        output, report = tmp_path / f"{name}.{extension}", tmp_path / f"{name}.json"
        arguments = ["mesh", str(tmp_path / name), "-o", str(output), "--report", str(report)]
        assert main([*arguments, "--device", str(device.index)]) == 0
        meshes.append((output, json.loads(report.read_text())))
    (near, said_near), (far, said) = meshes
    assert (said["triangles"], said["closed"]) == (said_near["triangles"], True)
    assert said["volume_ml"] == pytest.approx(said_near["volume_ml"], rel=1e-5)
    assert [text for text in said["warnings"] if "vertices are float64" in text]
    assert bool([text for text in said["warnings"] if text.startswith("STL holds float32")]) == warned
    trimesh = pytest.importorskip("trimesh")
    corners = [np.asarray(trimesh.load(path, process=False, maintain_order=True).triangles) for path in (near, far)]
    off = np.abs(corners[1] - corners[0] - FAR).max()
    assert off <= (0.01 if warned else tolerances.FAR_SCAN_MM)
