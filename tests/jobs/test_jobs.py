"""The jobs: order of work, what is left when a step fails, the demonstration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from PIL import Image
from refusals import assert_facts, refused
from variants import daily

from clrecon.errors import DeviceError, NoSurfaceError, OutputError, UsageError
from clrecon.jobs.devices import survey_devices
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.proof.demo import make_demo
from clrecon.proof.phantom import PhantomSettings, write_phantom


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("jobs") / "ct"
    settings = PhantomSettings(
        kind="sphere",
        size=(44, 60),
        slices=31,
        spacing=(0.5, 0.7, 1.0),
        tilt=15.0,
        oblique=(20.0, 5.0, -40.0),
        noise=0.0,
    )
    return folder, write_phantom(folder, settings)


@pytest.mark.every_device
def test_a_tilted_oblique_sphere_has_its_volume_and_place(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, truth = sphere
    stages: list[str] = []
    report = make_mesh(
        folder,
        tmp_path / "sphere.stl",
        MeshSettings(iso_value=truth["iso_value_hu"], device=str(device.index)),
        measure=True,
        progress=lambda stage, done, total: stages.append(stage),
    )
    assert report["volume_ml"] == pytest.approx(
        truth["surface"]["volume_ml"], rel=tolerances.PHANTOM_SPHERE_VOLUME_SHARE
    )
    centre = [(low + high) / 2 for low, high in zip(*report["bounds_mm"], strict=True)]
    assert centre == pytest.approx(truth["surface"]["center_lps_mm"], abs=0.1)
    assert report["volume"]["tilt_deg"] == pytest.approx(15.0, abs=1e-3)
    assert report["device"] == device.label
    assert list(dict.fromkeys(stages)) == ["device", "scan", "read", "build", "measure", "write"]


def test_parts_of_the_time_sum_to_the_total(device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    report = make_mesh(sphere[0], tmp_path / "a.ply", MeshSettings(preset="bone", device=str(device.index)))
    seconds = dict(report["seconds"])
    assert seconds.pop("total") == pytest.approx(sum(seconds.values()), abs=0.01)
    assert (report["volume_ml"], report["quality"]) == (None, None)


def test_mesh_job_refuses_outputs_then_device_before_the_input(
    sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    nowhere = tmp_path / "nowhere"
    bad_device = MeshSettings(device="abacus")
    with refused(OutputError, "nowhere"):
        make_mesh(nowhere, nowhere / "a.stl", bad_device)
    with refused(DeviceError, "abacus"):
        make_mesh(nowhere, tmp_path / "a.stl", bad_device)


@pytest.mark.parametrize("fails", daily(1, ["clrecon.jobs.run.stage_mesh", "clrecon.jobs.run.stage_report"]))
def test_a_failed_write_leaves_both_old_files(
    fails: str, device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, report = tmp_path / "a.stl", tmp_path / "a.json"
    mesh.write_bytes(b"old mesh")
    report.write_bytes(b"old report")

    def fail(*_: Any, **__: Any) -> Any:
        raise OutputError("the disk is full")

    monkeypatch.setattr(fails, fail)
    with refused(OutputError, "full"):
        make_mesh(sphere[0], mesh, MeshSettings(device=str(device.index)), report_path=report)
    assert (mesh.read_bytes(), report.read_bytes()) == (b"old mesh", b"old report")
    assert sorted(tmp_path.iterdir()) == [report, mesh]


@pytest.mark.parametrize("level", [-5000.0, -1000.0])
def test_a_level_with_everything_inside_is_refused(
    level: float, device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    settings = MeshSettings(iso_value=level, device=str(device.index))
    with refused(NoSurfaceError, -1000, 1000):
        make_mesh(sphere[0], tmp_path / "box.stl", settings)
    assert not list(tmp_path.iterdir())


def test_survey_says_why_no_device_is_used(device: Any) -> None:
    survey, problem = survey_devices("abacus")
    assert survey["chosen"] is None
    assert len(survey["devices"]) > device.index
    assert_facts(str(problem), "abacus")


@pytest.mark.slow
def test_demo_replaces_an_earlier_one(device: Any, tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    (folder / "ct").mkdir(parents=True)
    for name in ("bone.stl", "bone.png", "report.json", "ct/truth.json", "ct/of an earlier one"):
        (folder / name).write_text("of an earlier demonstration")
    made = make_demo(folder, str(device.index))
    assert sorted(path.name for path in folder.iterdir()) == ["bone.png", "bone.stl", "ct", "report.json"]
    assert not (folder / "ct" / "of an earlier one").exists()
    report = json.loads((folder / "report.json").read_text())
    assert report["triangles"] == made["mesh"]["triangles"] > 100_000
    assert (report["closed"], report["manifold"]) == (True, True)
    assert made["affine_error_mm"] < 1e-6
    with Image.open(folder / "bone.png") as picture:
        pixels = np.asarray(picture)
    assert pixels.shape == (1024, 1024, 4) and 0.05 < (pixels[..., :3].max(axis=-1) > 60).mean() < 0.5
    assert made["picture"]["pictures"][0]["output"]["bytes"] == (folder / "bone.png").stat().st_size
    check = made["check"]
    assert check["volume_ml"] == pytest.approx(check["true_volume_ml"], rel=tolerances.PHANTOM_SPHERE_VOLUME_SHARE)
    assert check["radius_error_max_mm"] < 0.15 * max(check["spacing_mm"])


@pytest.mark.parametrize("there", [False, True], ids=["no folder", "an empty folder"])
def test_demo_without_a_device_or_room_leaves_nothing(
    there: bool, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_the_disk(folder: Path, *_: Any, **__: Any) -> None:
        folder.mkdir()
        (folder / "slice").write_bytes(b"half")
        raise OutputError(f"cannot write {folder / 'slice'}: the disk is full")

    folder = tmp_path / "demo"
    if there:
        folder.mkdir()
    with pytest.raises(DeviceError):
        make_demo(folder, "no such device")
    monkeypatch.setattr("clrecon.proof.demo.write_phantom", fill_the_disk)
    with refused(OutputError, f"{folder / 'ct' / 'slice'}", "full"):
        make_demo(folder, str(device.index))
    assert list(tmp_path.rglob("*")) == ([folder] if there else [])


def test_demo_refuses_a_folder_of_others(tmp_path: Path) -> None:
    (tmp_path / "bone.stl").write_text("mine")
    with pytest.raises(UsageError, match="not of a demo"):
        make_demo(tmp_path)
    (tmp_path / "thesis.txt").write_text("mine too")
    with pytest.raises(UsageError, match="thesis"):
        make_demo(tmp_path)
    with pytest.raises(OutputError, match="does not exist"):
        make_demo(tmp_path / "no" / "demo")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bone.stl", "thesis.txt"]
