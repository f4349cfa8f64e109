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

TISSUE_HU, BONE_HU = 40.0, 1040.0


def ball(bone: float = BONE_HU) -> Volume:
    """A ball of bone of 10 mm in soft tissue, in HU, its edge blurred over 3 mm."""
    distance = np.linalg.norm(np.indices((36, 36, 36)).reshape(3, -1).T - (17.7, 17.4, 18.1), axis=1) - 10.0
    field = TISSUE_HU + (bone - TISSUE_HU) * np.clip(0.5 - distance / 3.0, 0.0, 1.0).reshape(36, 36, 36)
    voxels = np.rint(field).astype(np.int16)
    return Volume(voxels, np.eye(4))


@pytest.fixture
def scan_of_a_ball(monkeypatch: pytest.MonkeyPatch) -> list[Volume]:
    """What the job reads: the one entry of this list, at first `ball()`."""
    volumes = [ball()]
    monkeypatch.setattr("clrecon.reading.dicom.reader.read_series", lambda source, selection, progress: volumes[0])
    return volumes


def mesh_scan(tmp_path: Path, device: Any, **settings: Any) -> dict[str, Any]:
    """Mesh what `scan_of_a_ball` gives to b.ply and b.json; return the report."""
    return make_mesh(
        "scan", tmp_path / "b.ply", MeshSettings(device=str(device.index), **settings), report_path=tmp_path / "b.json"
    )


@pytest.mark.usefixtures("scan_of_a_ball")
def test_auto_chooses_the_iso_value_half_way_between_the_medians_of_tissue_and_bone(
    device: Any, tmp_path: Path
) -> None:
    report = mesh_scan(tmp_path, device, half_way="auto")

    half_way, step = (BONE_HU + TISSUE_HU) / 2, BONE_HU - TISSUE_HU
    assert abs(report["iso_value_hu"] - half_way) <= tolerances.HALF_WAY_STEP_SHARE * step
    choice = report["iso_value_choice"]
    assert (choice["method"], choice["bone_hu"], choice["tissue_hu"]) == ("auto", BONE_HU, TISSUE_HU)
    assert report["iso_value_reason"].startswith("half way between tissue 40 and bone 1040 HU, medians of ")


@pytest.mark.usefixtures("scan_of_a_ball")
def test_written_report_of_auto_has_the_choice_and_its_time_and_no_preset(device: Any, tmp_path: Path) -> None:
    report = mesh_scan(tmp_path, device, half_way="auto")

    written = json.loads((tmp_path / "b.json").read_text())
    assert written["iso_value_choice"] == report["iso_value_choice"]
    assert written["seconds"]["choose"] > 0.0
    assert (written["preset"], written["meshes"][0]["name"]) == (None, None)


@pytest.mark.usefixtures("scan_of_a_ball")
def test_mesh_of_auto_is_that_of_its_iso_value_given_as_a_number(device: Any, tmp_path: Path) -> None:
    automatic = mesh_scan(tmp_path, device, half_way="auto")
    mesh_of_auto = (tmp_path / "b.ply").read_bytes()

    given = mesh_scan(tmp_path, device, iso_value=automatic["iso_value_hu"])

    assert (tmp_path / "b.ply").read_bytes() == mesh_of_auto
    assert (given["iso_value_choice"], given["iso_value_reason"]) == (None, "as given")


@pytest.mark.usefixtures("scan_of_a_ball")
def test_mesh_of_two_given_materials_has_the_iso_value_half_way_between_them(device: Any, tmp_path: Path) -> None:
    report = mesh_scan(tmp_path, device, half_way=(1000, 40), split=True)

    assert report["iso_value_hu"] == (1000 + 40) / 2
    assert report["iso_value_reason"] == "half way between tissue 40 and bone 1000 HU, as given"
    assert report["iso_value_choice"]["edges"] is None  # none was looked at
    (mesh,) = report["meshes"]
    assert mesh["name"] == "001"
    assert report["warnings"] == []


def test_auto_without_bone_in_the_scan_is_refused_and_writes_nothing(
    scan_of_a_ball: list[Volume], device: Any, tmp_path: Path
) -> None:
    scan_of_a_ball[0] = ball(bone=60.0)

    with refused(NoSurfaceError, "bone", "half_way"):
        mesh_scan(tmp_path, device, half_way="auto")

    assert list(tmp_path.iterdir()) == []


def test_given_bone_brighter_than_the_scan_is_warned_of() -> None:
    choice = half_iso_value(bone_hu=1800, tissue_hu=40)
    entries, warnings = describe_level(ball(), MeshSettings(half_way=(1800, 40)), choice)

    assert entries["iso_value_choice"]["bone_hu"] == 1800
    (warning,) = warnings
    assert "bone was given as 1800 HU, but the volume runs from 40 to 1040 HU" in warning


def warn_of_auto_level(slice_spacing_mm: float) -> list[str]:
    """Warnings for the iso value that ``half_way="auto"`` chooses in the ball with slices so far apart."""
    volume = Volume(ball().voxels, np.diag((1.0, 1.0, slice_spacing_mm, 1.0)))
    settings = MeshSettings(half_way="auto")
    _, warnings = describe_level(volume, settings, choose_level(volume, settings))
    return warnings


def test_auto_in_slices_3_mm_apart_is_warned_of_with_its_iso_value() -> None:
    # Beyond 2.5 mm; the next test has less.
    (warning,) = warn_of_auto_level(slice_spacing_mm=3.0)
    assert "slices are 3 mm apart" in warning
    assert f"{(BONE_HU + TISSUE_HU) / 2:g} HU" in warning


def test_auto_in_slices_2_mm_apart_has_no_warning() -> None:
    assert warn_of_auto_level(slice_spacing_mm=2.0) == []


def test_reason_of_an_iso_value_names_its_preset() -> None:
    entries, warnings = describe_level(ball(), MeshSettings(preset="bone"), choice=None)

    assert entries["iso_value_reason"].startswith("preset bone: ")
    assert warnings == []


def test_no_iso_value_is_chosen_from_the_scan_without_half_way() -> None:
    assert choose_level(ball(), MeshSettings()) is None


def test_settings_with_two_materials_have_the_level_half_way_and_no_preset() -> None:
    settings = MeshSettings(half_way=(1200.0, 40.0))
    assert (settings.levels, settings.preset_used) == (((1200.0 + 40.0) / 2,), None)


def test_settings_with_auto_have_an_unknown_level_and_no_preset() -> None:
    settings = MeshSettings(half_way="auto")
    assert math.isnan(settings.levels[0])
    assert settings.preset_used is None


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


VALUES_0_TO_999 = np.arange(1000, dtype=np.int16).reshape(10, 10, 10)


@pytest.mark.parametrize("report", [None, {}], ids=["no report", "an empty report"])
def test_level_within_a_volume_made_from_an_array_is_accepted(report: dict[str, Any] | None) -> None:
    assert check_levels(Volume(VALUES_0_TO_999, np.eye(4), report), plan_surfaces([500.0])) is None


@pytest.mark.parametrize("report", [None, {}], ids=["no report", "an empty report"])
def test_level_at_the_lowest_value_of_a_volume_made_from_an_array_is_refused(report: dict[str, Any] | None) -> None:
    with refused(NoSurfaceError, 0, 999):
        check_levels(Volume(VALUES_0_TO_999, np.eye(4), report), plan_surfaces([0.0]))


@pytest.mark.parametrize("report", [None, {}], ids=["no report", "an empty report"])
def test_field_of_view_removed_from_a_volume_made_from_an_array_is_warned_of(report: dict[str, Any] | None) -> None:
    volume = Volume(VALUES_0_TO_999, np.eye(4), report)

    masked = mask_volume(volume, MeshSettings(field_of_view=3.0), ignore_progress)

    (warning,) = masked.report["warnings"]
    assert warning.startswith("outside of 3 mm around the centre of the slices is air now")
