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
from report_schemas import find_faults
from variants import daily

from clrecon.errors import DeviceError, NoSurfaceError, OutputError, UsageError
from clrecon.jobs.devices import survey_devices
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.proof.demo import make_demo
from clrecon.proof.phantom import PhantomSettings, write_phantom


@pytest.fixture(scope="module")
def sphere_and_truth(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a CT of a sphere, its gantry tilted by 15 degrees and its axes turned, and the truth."""
    folder = tmp_path_factory.mktemp("jobs") / "ct"
    settings = PhantomSettings(
        kind="sphere", size=(44, 60), slices=31, spacing=(0.5, 0.7, 1.0), tilt=15.0, oblique=(20.0, 5.0, -40.0), noise=0
    )
    return folder, write_phantom(folder, settings)


@pytest.fixture(scope="module")
def sphere(sphere_and_truth: tuple[Path, dict[str, Any]]) -> Path:
    """The folder of the CT of a sphere."""
    folder, _ = sphere_and_truth
    return folder


@pytest.mark.every_device
def test_mesh_of_a_tilted_oblique_sphere_has_its_volume_and_place(
    device: Any, sphere_and_truth: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, truth = sphere_and_truth
    settings = MeshSettings(iso_value=truth["iso_value_hu"], device=str(device.index))

    report = make_mesh(folder, tmp_path / "sphere.stl", settings, measure=True)

    assert report["device"] == device.label
    assert report["volume"]["tilt_deg"] == pytest.approx(15.0, abs=1e-3)  # directions have 9 decimals
    true_ml = truth["surface"]["volume_ml"]
    assert report["volume_ml"] == pytest.approx(true_ml, rel=tolerances.PHANTOM_SPHERE_VOLUME_SHARE)
    centre = [(low + high) / 2 for low, high in zip(*report["bounds_mm"], strict=True)]
    assert centre == pytest.approx(truth["surface"]["center_lps_mm"], abs=0.1)  # a fifth of the smallest spacing


def test_progress_of_a_mesh_job_names_its_stages_in_order(device: Any, sphere: Path, tmp_path: Path) -> None:
    stages: list[str] = []

    make_mesh(
        sphere,
        tmp_path / "sphere.stl",
        MeshSettings(device=str(device.index)),
        measure=True,
        progress=lambda stage, done, total: stages.append(stage),
    )

    assert list(dict.fromkeys(stages)) == ["device", "scan", "read", "build", "measure", "write"]


def test_times_of_stages_sum_to_the_total_of_the_report(device: Any, sphere: Path, tmp_path: Path) -> None:
    report = make_mesh(sphere, tmp_path / "a.ply", MeshSettings(device=str(device.index)))

    seconds = dict(report["seconds"])
    total = seconds.pop("total")
    assert total == pytest.approx(sum(seconds.values()), abs=0.01)  # each is rounded to 0.1 ms


def test_mesh_that_is_not_measured_has_no_volume_and_no_quality(device: Any, sphere: Path, tmp_path: Path) -> None:
    report = make_mesh(sphere, tmp_path / "a.ply", MeshSettings(device=str(device.index)))
    assert (report["volume_ml"], report["quality"]) == (None, None)


def test_mesh_job_refuses_a_missing_output_folder_before_a_wrong_device(tmp_path: Path) -> None:
    with refused(OutputError, "nowhere"):
        make_mesh(tmp_path / "no scan", tmp_path / "nowhere" / "a.stl", MeshSettings(device="abacus"))


def test_mesh_job_refuses_a_wrong_device_before_a_missing_scan(tmp_path: Path) -> None:
    with refused(DeviceError, "abacus"):
        make_mesh(tmp_path / "no scan", tmp_path / "a.stl", MeshSettings(device="abacus"))


@pytest.mark.parametrize("failing_step", daily(1, ["clrecon.jobs.run.stage_mesh", "clrecon.jobs.run.stage_report"]))
def test_older_mesh_and_report_stay_where_one_of_them_cannot_be_written(
    failing_step: str, device: Any, sphere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, report = tmp_path / "a.stl", tmp_path / "a.json"
    mesh.write_bytes(b"old mesh")
    report.write_bytes(b"old report")

    def fail(*_: Any, **__: Any) -> Any:
        raise OutputError("the disk is full")

    monkeypatch.setattr(failing_step, fail)
    with refused(OutputError, "full"):
        make_mesh(sphere, mesh, MeshSettings(device=str(device.index)), report_path=report)

    assert (mesh.read_bytes(), report.read_bytes()) == (b"old mesh", b"old report")
    assert sorted(tmp_path.iterdir()) == [report, mesh]


@pytest.mark.parametrize("level", [-5000.0, -1000.0], ids=["below every voxel", "at the lowest voxel"])
def test_iso_value_with_every_voxel_inside_is_refused_with_the_range_of_the_scan(
    level: float, device: Any, sphere: Path, tmp_path: Path
) -> None:
    settings = MeshSettings(iso_value=level, device=str(device.index))

    with refused(NoSurfaceError, -1000, 1000):  # HU of the air and of the sphere
        make_mesh(sphere, tmp_path / "box.stl", settings)

    assert not list(tmp_path.iterdir())


def test_survey_of_devices_lists_those_found_and_why_none_is_chosen(device: Any) -> None:
    survey, problem = survey_devices("abacus")

    assert survey["chosen"] is None
    assert len(survey["devices"]) > device.index
    assert_facts(str(problem), "abacus")


@pytest.fixture(scope="module")
def demo(device: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a demonstration that was made over an earlier one, and its report."""
    folder = tmp_path_factory.mktemp("over") / "demo"
    (folder / "ct").mkdir(parents=True)
    for name in ("bone.stl", "bone.png", "report.json", "ct/truth.json", "ct/of an earlier one"):
        (folder / name).write_text("of an earlier demonstration")
    return folder, make_demo(folder, str(device.index))


@pytest.mark.slow
def test_demo_replaces_all_files_of_an_earlier_one(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = demo
    assert sorted(path.name for path in folder.iterdir()) == ["bone.png", "bone.stl", "ct", "report.json"]
    assert not (folder / "ct" / "of an earlier one").exists()


@pytest.mark.slow
def test_demo_writes_a_closed_manifold_mesh_of_its_report(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, made = demo
    report = json.loads((folder / "report.json").read_text())

    assert (report["closed"], report["manifold"]) == (True, True)
    stl_bytes = 84 + 50 * report["triangles"]  # of a binary STL: its header, and each triangle
    assert (folder / "bone.stl").stat().st_size == stl_bytes
    assert report["triangles"] == made["mesh"]["triangles"] > 100_000  # a lumbar spine in voxels of 1 x 1 x 1.25 mm


@pytest.mark.slow
def test_demo_checks_the_affine_of_its_phantom_and_the_volume_and_radius_of_a_sphere(
    demo: tuple[Path, dict[str, Any]],
) -> None:
    _, made = demo
    check = made["check"]

    assert find_faults(made, "demo") == []
    assert made["affine_error_mm"] < tolerances.AFFINE_MM
    assert check["volume_ml"] == pytest.approx(check["true_volume_ml"], rel=tolerances.PHANTOM_SPHERE_VOLUME_SHARE)
    assert check["radius_error_max_mm"] < 0.15 * max(check["spacing_mm"])  # of a voxel: partial volume bends its edge


@pytest.mark.slow
def test_demo_draws_bone_into_a_picture_of_1024_pixels(demo: tuple[Path, dict[str, Any]]) -> None:
    folder, made = demo

    with Image.open(folder / "bone.png") as picture:
        pixels = np.asarray(picture)
    assert pixels.shape == (1024, 1024, 4)
    bright_share = (pixels[..., :3].max(axis=-1) > 60).mean()
    assert 0.05 < bright_share < 0.5  # bone on black, with room beside it
    assert made["picture"]["pictures"][0]["output"]["bytes"] == (folder / "bone.png").stat().st_size


@pytest.fixture(params=["no folder", "an empty folder"])
def new_demo_folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    folder = tmp_path / "demo"
    if request.param == "an empty folder":
        folder.mkdir()
    return folder


def test_demo_on_a_wrong_device_leaves_nothing(new_demo_folder: Path, tmp_path: Path) -> None:
    before = list(tmp_path.rglob("*"))

    with refused(DeviceError, "abacus"):
        make_demo(new_demo_folder, "abacus")

    assert list(tmp_path.rglob("*")) == before


def test_demo_on_a_full_disk_leaves_nothing(
    device: Any, new_demo_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_the_disk(folder: Path, *_: Any, **__: Any) -> None:
        folder.mkdir()
        (folder / "slice").write_bytes(b"half")
        raise OutputError(f"cannot write {folder / 'slice'}: the disk is full")

    before = list(tmp_path.rglob("*"))
    monkeypatch.setattr("clrecon.proof.demo.write_phantom", fill_the_disk)

    with refused(OutputError, f"{new_demo_folder / 'ct' / 'slice'}", "full"):
        make_demo(new_demo_folder, str(device.index))

    assert list(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("others", "said"),
    [(["bone.stl"], "not of a demo"), (["bone.stl", "thesis.txt"], "thesis")],
    ids=["a file named as one of a demo", "another file"],
)
def test_demo_is_refused_in_a_folder_with_other_files_which_stay(others: list[str], said: str, tmp_path: Path) -> None:
    for name in others:
        (tmp_path / name).write_text("mine")

    with pytest.raises(UsageError, match=said):
        make_demo(tmp_path)

    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(others, "mine")


def test_demo_in_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        make_demo(tmp_path / "no" / "demo")
