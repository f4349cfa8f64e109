"""Table and field of view in the job: options, report, and a mesh without the table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import Plan, write_series
from printed_text import Printer
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


@pytest.mark.parametrize(
    ("options", "components", "entry"),
    [([], 2, None), (["--remove-table"], 1, "remove_table"), (["--fov", "40"], 1, "field_of_view")],
)
def test_the_mesh_has_no_table(
    device: Any, scan: Path, tmp_path: Path, printed: Printer, options: list[str],
    components: int, entry: str | None,
) -> None:  # fmt: skip
    arguments = ["mesh", str(scan), "-o", str(tmp_path / "bone.stl"), "--json", "--device", str(device.index), *options]
    assert main(arguments) == 0
    report = printed().report()
    assert (report["components"], report["closed"]) == (components, True)
    assert len([words for words in report["warnings"] if "is air now" in words]) == (entry is not None)
    if entry is not None:
        facts = report["volume"][entry]
        assert facts["air_hu"] == pytest.approx(-1000, abs=2)
        assert 0 < facts["dense_voxels_removed"] <= facts["voxels_removed"]
        assert f"{facts['dense_voxels_removed']:,} of them dense" in report["warnings"][0]
        assert report["seconds"]["mask"] > 0.0


def test_the_circle_that_fits_needs_no_number(device: Any, scan: Path, tmp_path: Path) -> None:
    arguments = ["mesh", str(scan), "-o", str(tmp_path / "bone.stl"), "--device", str(device.index)]
    assert main([*arguments, "--report", str(tmp_path / "report.json"), "--fov"]) == 0
    assert json.loads((tmp_path / "report.json").read_text())["volume"]["field_of_view"]["radius_mm"] == 64.0


@pytest.mark.parametrize("radius", ["0", "-3", "nan"])
def test_impossible_radii_are_wrong_usage(scan: Path, tmp_path: Path, radius: str) -> None:
    assert main(["mesh", str(scan), "-o", str(tmp_path / "bone.stl"), f"--fov={radius}"]) == 3
    with refused(UsageError, "field", "view"):
        MeshSettings(field_of_view=float(radius))
    with refused(UsageError, "wide", "auto"):
        MeshSettings(field_of_view="wide")
