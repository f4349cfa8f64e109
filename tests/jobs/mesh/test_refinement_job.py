"""Smoothing, decimation and gates as parts of a job, and as options of the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from variants import daily

from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.proof.phantom import PhantomSettings, write_phantom

SPACING = (0.5, 0.7, 1.0)


@pytest.fixture(scope="module")
def noisy_torus(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("refine") / "ct"
    settings = PhantomSettings(kind="torus", size=(72, 56), slices=31, spacing=SPACING, tilt=15.0, noise=30.0)
    return folder, write_phantom(folder, settings)


def check_gates(report: dict[str, Any], *failed: str) -> None:
    assert {gate["name"] for gate in report["gates"] if gate["ok"] is False} == set(failed)


def test_a_job_measures_what_it_has_extracted(device: Any, noisy_torus: Any, tmp_path: Path) -> None:
    folder, truth = noisy_torus
    settings = MeshSettings(iso_value=truth["iso_value_hu"], keep_largest=1, device=str(device.index), strict=True)
    report = make_mesh(folder, tmp_path / "a.stl", settings)
    check_gates(report)
    assert len(report["gates"]) == 10
    assert all(gate["ok"] for gate in report["gates"])
    assert report["quality"]["self_intersections"] == 0
    assert report["quality"]["genus"] == 1
    assert 0.0 < report["quality"]["shortest_edge_mm"] < 0.5
    distance = report["iso_distance"]
    # float32 millimetres, and up to 2e-4 of a step by which vertices are held off the samples
    assert distance["vertices_voxel"]["max"] < tolerances.DEVICE_ISO_VERTEX_VOXEL
    assert 0.001 < distance["centres_voxel"]["mean"] < 0.1
    assert distance["voxel_mm"] == pytest.approx(0.5)
    assert report["refinement"] is None


def test_an_open_surface_passes_its_gates(device: Any, noisy_torus: Any, tmp_path: Path) -> None:
    settings = MeshSettings(iso_value=-990.0, closed=False, device=str(device.index))  # in the noise of air
    report = make_mesh(noisy_torus[0], tmp_path / "a.stl", settings, measure=True)
    assert not report["closed"]
    check_gates(report)
    assert report["iso_distance"]["vertices_voxel"]["max"] < tolerances.DEVICE_ISO_VERTEX_VOXEL


def test_smoothed_and_decimated_mesh_is_written(device: Any, noisy_torus: Any, tmp_path: Path) -> None:
    folder, truth = noisy_torus
    plain = MeshSettings(iso_value=truth["iso_value_hu"], keep_largest=1, device=str(device.index))
    before = make_mesh(folder, tmp_path / "a.stl", plain, measure=True)
    settings = MeshSettings(**{**vars(plain), "smooth": 20, "decimate": 0.8})
    stages: list[str] = []
    report = make_mesh(
        folder,
        tmp_path / "b.stl",
        settings,
        report_path=tmp_path / "b.json",
        progress=lambda stage, done, total: stages.append(stage),
    )
    assert json.loads((tmp_path / "b.json").read_text())["refinement"] == report["refinement"]
    assert [stage for stage in dict.fromkeys(stages) if stage in ("smooth", "decimate", "compare")] == [
        "smooth",
        "decimate",
        "compare",
    ]
    facts = report["refinement"]
    assert facts["decimate"]["triangles_before"] == before["triangles"]
    assert facts["decimate"]["reached"] == pytest.approx(1 - report["triangles"] / before["triangles"])
    assert 0.6 < facts["decimate"]["reached"] < 0.801  # it stops with the collapse that reaches it
    assert int.from_bytes((tmp_path / "b.stl").read_bytes()[80:84], "little") == report["triangles"]
    assert (report["closed"], report["manifold"], report["components"]) == (True, True, 1)
    assert report["quality"]["genus"] == 1
    change = facts["deviation"]["volume_change_percent"]
    assert change == pytest.approx(100 * (report["volume_ml"] / before["volume_ml"] - 1), abs=1e-6)
    assert report["volume_ml"] == pytest.approx(truth["surface"]["volume_ml"], rel=tolerances.REFINED_TORUS_VOLUME)
    assert (facts["voxel_mm"], facts["smooth"]["max_deviation_mm"]) == pytest.approx((0.5, 0.125))
    assert 0.0 < facts["deviation"]["assd_mm"] < facts["deviation"]["hd95_mm"] < 2 * 0.125
    check_gates(report)
    seconds = dict(report["seconds"])
    assert seconds["refine"] > 0.0
    assert seconds.pop("total") == pytest.approx(sum(seconds.values()), abs=0.01)


@pytest.mark.release
@pytest.mark.seconds
def test_each_of_several_meshes_has_its_own_gates(device: Any, noisy_torus: Any, tmp_path: Path) -> None:
    level = noisy_torus[1]["iso_value_hu"]
    settings = MeshSettings(iso_value=[level, level + 50], keep_largest=1, decimate=0.5, device=str(device.index))
    report = make_mesh(noisy_torus[0], tmp_path / "a.stl", settings, measure=True)
    names = [mesh["name"] for mesh in report["meshes"]]
    assert [gate["mesh"] for gate in report["gates"] if gate["name"] == "volume_change"] == names
    assert (report["refinement"], report["iso_distance"], report["quality"]) == (None, None, None)
    assert [mesh["refinement"]["decimate"]["fraction"] for mesh in report["meshes"]] == [0.5, 0.5]


@pytest.mark.release
@pytest.mark.seconds
def test_strict_is_an_exit_code_and_nothing_else(
    device: Any, noisy_torus: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "a.stl"
    level = f"{noisy_torus[1]['iso_value_hu']:g}"
    arguments = ["mesh", str(noisy_torus[0]), "-o", str(output), "--hu", level, "--keep-largest", "1"]
    arguments += ["--device", str(device.index), "--decimate", "0.97", "--max-deviation", "3"]
    assert main(arguments) == 0
    told = capsys.readouterr()
    assert "clrecon: warning: gate deviation_p95 failed: distance from the surface before" in told.err
    assert "% of the triangles removed" in told.out
    content = output.read_bytes()
    output.unlink()

    assert main([*arguments, "--strict", "-q"]) == 8
    told = capsys.readouterr()
    assert told.out == ""
    lines = told.err.splitlines()
    assert all(line.startswith("clrecon: error: gate ") for line in lines)
    assert any("deviation_p95 failed" in line for line in lines)
    assert output.read_bytes() == content

    assert main([*arguments, "--strict", "--json"]) == 8
    report = json.loads(capsys.readouterr().out)
    assert len([gate for gate in report["gates"] if gate["ok"] is False]) == len(lines)


@pytest.mark.release
def test_strict_passes_what_is_good(
    device: Any, noisy_torus: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    level = f"{noisy_torus[1]['iso_value_hu']:g}"
    arguments = ["mesh", str(noisy_torus[0]), "-o", str(tmp_path / "a.stl"), "--hu", level, "--keep-largest", "1"]
    assert main([*arguments, "--device", str(device.index), "--smooth", "--strict"]) == 0
    told = capsys.readouterr()
    assert "smoothed (20 iterations; roughness " in told.out
    assert "gate" not in told.err


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"smooth": 0}, "from 1 to 1000 iterations, not 0"),
        ({"decimate": 90.0}, "between 0 and 1, not 90"),
        ({"decimate": 0.5, "max_deviation_mm": 0.0}, "above 0, not 0"),
        ({"decimate": 0.5, "max_deviation_mm": float("nan")}, "above 0, not nan"),
        ({"max_deviation_mm": 0.2}, "ask for one of them too"),
    ],
)
def test_impossible_settings_are_refused(options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        MeshSettings(**options)


@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize("folder", daily(1, ["thoracolumbar_labels/ct_2mm_jpeg2000", "lumbar_4p25mm"]))
def test_real_surfaces_keep_every_gate(real_data: Path, device: Any, tmp_path: Path, folder: str) -> None:
    settings = MeshSettings(
        iso_value=226, keep_largest=1, smooth=20, decimate=0.9, strict=True, device=str(device.index)
    )
    report = make_mesh(real_data / folder, tmp_path / "a.stl", settings)
    assert (report["closed"], report["manifold"], report["components"]) == (True, True, 1)
    assert report["refinement"]["decimate"]["reached"] > 0.6
    check_gates(report)
    assert np.isfinite(report["refinement"]["deviation"]["max_mm"])
