"""Iso values half way between two materials as a setting of a job, and what its report says."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.anatomy.iso_choice import half_iso_value
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.make import check_levels
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import choose_level, describe_level, plan_surfaces
from clrecon.jobs.preprocess import mask_volume
from clrecon.system.progress import ignore_progress


def ball(bone: float = 1040.0, tissue: float = 40.0) -> Volume:
    distance = np.linalg.norm(np.indices((36, 36, 36)).reshape(3, -1).T - (17.7, 17.4, 18.1), axis=1) - 10.0
    field = tissue + (bone - tissue) * np.clip(0.5 - distance / 3.0, 0.0, 1.0).reshape(36, 36, 36)
    voxels = np.rint(field).astype(np.int16)
    return Volume(voxels, np.eye(4))


@pytest.fixture
def scan(monkeypatch: pytest.MonkeyPatch) -> list[Volume]:
    """What the job reads: the one entry of this list."""
    volumes = [ball()]
    monkeypatch.setattr("clrecon.reading.dicom.reader.read_series", lambda source, selection, progress: volumes[0])
    return volumes


def run(tmp_path: Path, device: Any, **settings: Any) -> dict[str, Any]:
    return make_mesh(
        "scan", tmp_path / "b.ply", MeshSettings(device=str(device.index), **settings), report_path=tmp_path / "b.json"
    )


@pytest.mark.usefixtures("scan")
def test_auto_is_the_mesh_at_the_chosen_value(device: Any, tmp_path: Path) -> None:
    report = run(tmp_path, device, half_way="auto")
    automatic = (tmp_path / "b.ply").read_bytes()
    assert abs(report["iso_value_hu"] - 540.0) <= tolerances.HALF_WAY_STEP_SHARE * 1000.0
    choice = report["iso_value_choice"]
    assert (choice["method"], choice["bone_hu"], choice["tissue_hu"]) == ("auto", 1040.0, 40.0)
    assert report["iso_value_reason"].startswith("half way between tissue 40 and bone 1040 HU, medians of ")
    assert (report["preset"], report["meshes"][0]["name"]) == (None, None)
    assert report["seconds"]["choose"] > 0.0
    assert json.loads((tmp_path / "b.json").read_text())["iso_value_choice"] == choice
    given = run(tmp_path, device, iso_value=report["iso_value_hu"])
    assert (tmp_path / "b.ply").read_bytes() == automatic
    assert (given["iso_value_choice"], given["iso_value_reason"]) == (None, "as given")


@pytest.mark.usefixtures("scan")
def test_given_materials_are_the_mesh_half_way(device: Any, tmp_path: Path) -> None:
    report = run(tmp_path, device, half_way=(1000, 40), split=True)
    assert (report["iso_value_hu"], report["meshes"][0]["name"]) == (520.0, "001")
    assert report["iso_value_reason"] == "half way between tissue 40 and bone 1000 HU, as given"
    assert report["iso_value_choice"]["edges"] is None and report["warnings"] == []


def test_nothing_is_written_where_auto_finds_no_bone(scan: list[Volume], device: Any, tmp_path: Path) -> None:
    scan[0] = ball(bone=60.0)
    with refused(NoSurfaceError, "bone", "half_way"):
        run(tmp_path, device, half_way="auto")
    assert list(tmp_path.iterdir()) == []


def test_a_material_that_the_scan_does_not_hold_is_said() -> None:
    entries, warnings = describe_level(ball(), MeshSettings(half_way=(1800, 40)), half_iso_value(1800, 40))
    assert entries["iso_value_choice"]["bone_hu"] == 1800
    (warning,) = warnings
    assert "bone was given as 1800 HU, but the volume runs from 40 to 1040 HU" in warning


@pytest.mark.parametrize(("spacing", "expected"), [(2.0, 0), (3.0, 1)])
def test_thick_slices_are_said(spacing: float, expected: int) -> None:
    volume = ball()
    thick = Volume(volume.voxels, np.diag((1.0, 1.0, spacing, 1.0)), volume.report)
    settings = MeshSettings(half_way="auto")
    warnings = describe_level(thick, settings, choose_level(thick, settings))[1]
    assert len(warnings) == expected
    assert all("slices are 3 mm apart" in warning and "540 HU" in warning for warning in warnings)


def test_a_preset_says_its_reason() -> None:
    entries, warnings = describe_level(ball(), MeshSettings(preset="bone"), None)
    assert entries["iso_value_reason"].startswith("preset bone: ") and warnings == []
    assert choose_level(ball(), MeshSettings()) is None


def test_settings_with_two_materials_have_the_level_half_way() -> None:
    settings = MeshSettings(half_way=(1200.0, 40.0))
    assert (settings.levels, settings.preset_used) == ((620.0,), None)
    automatic = MeshSettings(half_way="auto")
    assert math.isnan(automatic.levels[0]) and automatic.preset_used is None


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"half_way": "otsu"}, "'otsu' is neither auto nor"),
        ({"half_way": (40.0, 1200.0)}, "40 HU is not above 1200 HU"),
        ({"half_way": (1.0, 2.0, 3.0)}, "needs two numbers"),
        ({"half_way": (math.nan, 2.0)}, "finite"),
        ({"half_way": "auto", "iso_value": 3.0}, "not more than one"),
        ({"half_way": "auto", "preset": "bone"}, "not more than one"),
    ],
)
def test_impossible_materials_are_refused(settings: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        MeshSettings(**settings)


@pytest.mark.parametrize("report", [None, {}])
def test_steps_of_the_job_take_volumes_made_from_arrays(report: dict[str, Any] | None) -> None:
    volume = Volume(np.arange(1000, dtype=np.int16).reshape(10, 10, 10), np.eye(4), report)
    check_levels(volume, plan_surfaces([500.0]))
    with refused(NoSurfaceError, 0, 999):
        check_levels(volume, plan_surfaces([0.0]))
    settings = MeshSettings(half_way=(2000.0, 40.0))
    warnings = describe_level(volume, settings, choose_level(volume, settings))[1]
    assert "bone was given as 2000 HU, but the volume runs from 0 to 999 HU" in warnings[0]
    masked = mask_volume(volume, MeshSettings(field_of_view=3.0), ignore_progress)
    assert len(masked.report["warnings"]) == 1
