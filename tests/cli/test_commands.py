"""The commands at work, in this process: results, JSON, reports."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from ct_files import ORIGIN, RADIUS_MM, SPACING, find_words, write_series
from printed_text import Printer

from clrecon.cli.main import COMMANDS, main

CONTRACT = {
    "affine_ijk_to_lps_mm", "iso_value_hu", "space", "vertices", "triangles", "closed", "manifold", "components",
    "area_mm2", "volume_ml", "bounds_mm", "device", "driver", "version", "warnings", "seconds",
}  # fmt: skip
SECONDS = {"read", "upload", "build", "kernels", "download", "write", "total"}
TRUE_VOLUME_ML = 4.0 / 3.0 * math.pi * RADIUS_MM**3 / 1000.0


def read_stl(path: Path) -> np.ndarray:
    content = path.read_bytes()
    count = int.from_bytes(content[80:84], "little")
    assert len(content) == 84 + 50 * count
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(content, record, offset=84)["corners"]


@pytest.fixture(scope="session")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_series(tmp_path_factory.mktemp("cli") / "Scan von Größe 3")


@pytest.mark.every_device
@pytest.mark.parametrize(("space", "signs"), [("lps", (1, 1, 1)), ("ras", (-1, -1, 1))])
def test_mesh_writes_the_sphere_where_it_is(
    device: Any, space: str, signs: tuple[int, ...], ct: Path, tmp_path: Path
) -> None:
    output = tmp_path / "a.stl"
    arguments = ["mesh", str(ct), "-o", str(output), "--hu", "-150", "--space", space]
    assert main([*arguments, "--device", str(device.index), "-q"]) == 0
    corners = read_stl(output).reshape(-1, 3)
    centre = (np.array(ORIGIN) + np.array(SPACING) * np.array([15, 12, 8])) * signs
    np.testing.assert_allclose(0.5 * (corners.min(axis=0) + corners.max(axis=0)), centre, atol=0.05)


def test_mesh_reports_the_sphere_and_its_file(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    output, report_path = tmp_path / "Kugel ä.stl", tmp_path / "a report.json"
    arguments = ["mesh", str(ct), "-o", str(output), "--report", str(report_path), "--hu", "-150", "--space", "lps"]
    assert main([*arguments, "--device", str(device.index)]) == 0
    captured = printed()
    assert captured.error_lines == 0
    captured.assert_output(17, 31, 25, -150, "Kugel")
    report, corners = json.loads(report_path.read_text()), read_stl(output)
    assert (report["closed"], report["manifold"], report["components"]) == (True, True, 1)
    assert report["volume_ml"] == pytest.approx(TRUE_VOLUME_ML, rel=tolerances.CLI_SPHERE_VOLUME_SHARE)
    assert (report["iso_value_hu"], report["preset"], report["space"]) == (-150.0, None, "lps")
    assert (report["output"], report["triangles"]) == ({"format": "stl", "bytes": output.stat().st_size}, len(corners))
    bounds = [corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)]
    np.testing.assert_allclose(report["bounds_mm"], bounds, atol=1e-4)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Kugel ä.stl", "a report.json"]


def test_report_of_a_mesh_has_the_names_of_the_contract_and_the_affine_of_the_scan(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    arguments = ["mesh", str(ct), "-o", str(tmp_path / "a.stl"), "--json", "--device", str(device.index)]
    assert main(arguments) == 0
    report = printed().report()
    assert CONTRACT <= set(report)
    assert SECONDS <= set(report["seconds"])
    assert report["seconds"]["total"] >= report["seconds"]["read"] > 0.0
    expected = np.diag([*SPACING, 1.0])
    expected[:3, 3] = ORIGIN
    np.testing.assert_allclose(report["affine_ijk_to_lps_mm"], expected, atol=1e-9)


def test_mesh_says_nothing_of_the_patient(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    output, report = tmp_path / "a.ply", tmp_path / "a.json"
    arguments = ["mesh", str(ct), "-o", str(output), "--report", str(report), "-v", "--device", str(device.index)]
    assert main(arguments) == 0
    written = output.read_bytes() + report.read_bytes() + printed().everything.encode()
    assert find_words(written) == []


def test_mesh_json_is_the_report(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    output = tmp_path / "a.glb"
    assert main(["mesh", str(ct), "-o", str(output), "--json", "--device", str(device.index)]) == 0
    captured = printed()
    report = captured.report()
    assert CONTRACT <= set(report)
    assert (report["preset"], report["iso_value_hu"], report["output"]["format"]) == ("bone", 200.0, "glb")
    assert captured.error_lines == 0


def test_mesh_quiet_prints_nothing(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    output = tmp_path / "a.obj"
    assert main(["mesh", str(ct), "-o", str(output), "-q", "--device", str(device.index)]) == 0
    assert printed().is_silent
    assert output.stat().st_size > 1000


def test_mesh_without_report_measures_nothing(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mesh", str(ct), "-o", str(tmp_path / "a.stl"), "--device", str(device.index)]) == 0
    assert "component" not in capsys.readouterr().out
    assert main(["mesh", str(ct), "-o", str(tmp_path / "a.stl"), "-v", "--device", str(device.index)]) == 0
    captured = capsys.readouterr()
    assert "1 component, closed, manifold" in captured.out
    assert "measuring the mesh" in captured.err


@pytest.mark.parametrize(("level", "said"), [(["--preset", "skin"], "-500 HU (preset skin)"), (["--hu", "-400"], "")])
def test_skin_warns_that_a_face_shows(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], level: list[str], said: str
) -> None:
    assert main(["mesh", str(ct), "-o", str(tmp_path / "a.stl"), *level, "--device", str(device.index)]) == 0
    captured = capsys.readouterr()
    assert said in captured.out
    assert captured.err.startswith("clrecon: warning: a surface of the skin can show a face")


@pytest.mark.release
def test_mesh_keeps_components_by_size(device: Any, tmp_path: Path, printed: Printer) -> None:
    voxels = np.full((9, 20, 24), -1000, np.int16)
    voxels[2:7, 2:12, 2:14] = 800
    voxels[2:4, 15:18, 18:21] = 800
    folder = write_series(tmp_path / "ct", voxels)
    found = {}
    for name, extra in {
        "all": [], "largest": ["--keep-largest", "1"], "big": ["--min-volume", "0.1"],
    }.items():  # fmt: skip
        arguments = ["mesh", str(folder), "-o", str(tmp_path / "m.stl"), "--json", "--device", str(device.index)]
        assert main([*arguments, *extra]) == 0
        found[name] = printed().report()
    assert [found[name]["components"] for name in found] == [2, 1, 1]
    assert found["largest"]["volume_ml"] == found["big"]["volume_ml"] < found["all"]["volume_ml"]
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "none.stl"), "--min-volume", "50"]
    assert main([*arguments, "--device", str(device.index)]) == 2
    printed().assert_error("ml", 50)
    assert not (tmp_path / "none.stl").exists()


def test_several_meshes_are_shown_one_by_one(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["mesh", str(ct), "-o", str(tmp_path / "a.stl"), "--split", "-v", "--device", str(device.index)]
    assert main([*arguments, "--hu", "-150,200.5"]) == 0
    text = capsys.readouterr().out
    assert "-150, 200.5 HU (as given)" in text
    assert "2 components, closed, manifold" in text
    assert "a_-150hu_001.stl and" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_-150hu_001.stl", "a_200.5hu_001.stl"]
    triangles = [len(read_stl(path)) for path in sorted(tmp_path.iterdir())]
    assert [f"hu_001: {count:,} triangles, " in text for count in triangles] == [True, True]


@pytest.mark.parametrize("spaced", [True, False])
def test_seeds_may_be_negative(spaced: bool, device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    centre = np.array(ORIGIN) + np.array(SPACING) * np.array([15, 12, 8])
    seeds = [",".join(f"{value:.3f}" for value in centre + [0, 0, step]) for step in (0, RADIUS_MM)]
    assert seeds[0].startswith("-")
    extra = [word for seed in seeds for word in (["--seed", seed] if spaced else [f"--seed={seed}"])]
    arguments = ["mesh", str(ct), *extra, "-o", str(tmp_path / "a.stl"), "--json", "--device", str(device.index)]
    assert main([*arguments, "--hu", "-150"]) == 0
    report = printed().report()
    assert report["seeds_mm"] == [[float(value) for value in seed.split(",")] for seed in seeds]
    inside, on = report["meshes"][0]["seed_distances_mm"]
    assert (inside, on) == (
        pytest.approx(RADIUS_MM, abs=tolerances.CLI_SPHERE_RADIUS_MM),
        pytest.approx(0.0, abs=tolerances.CLI_SPHERE_RADIUS_MM),
    )


def test_lists_of_negative_numbers_are_values() -> None:
    from clrecon.cli.common import Parser

    parser = Parser()
    parser.add_argument("--seed", action="append")
    parser.add_argument("-q", action="store_true")
    parser.add_argument("rest", nargs="*")
    options = parser.parse_args(["--seed", "-1.5,2,3", "-q", "--seed=-1e3,.5,0", "--", "--seed", "-4,5"])
    assert (options.seed, options.q) == (["-1.5,2,3", "-1e3,.5,0"], True)
    assert options.rest == ["--seed", "-4,5"]
    assert parser.parse_args(["--seed", "-.5,2"]).seed == ["-.5,2"]


def test_open_leaves_the_border_open(device: Any, tmp_path: Path, printed: Printer) -> None:
    voxels = np.full((5, 8, 9), -1000, np.int16)
    voxels[:, 2:6, 3:6] = 600
    folder = write_series(tmp_path / "ct", voxels)
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "m.stl"), "--json", "--device", str(device.index)]
    closed = []
    for extra in ([], ["--open"]):
        assert main([*arguments, *extra]) == 0
        report = printed().report()
        closed.append((report["closed"], report["volume_ml"] is None))
    assert closed == [(True, False), (False, True)]


@pytest.mark.release
def test_topology_joins_what_the_trilinear_field_joins(device: Any, tmp_path: Path, printed: Printer) -> None:
    voxels = np.full((5, 8, 9), -1000, np.int16)
    voxels[2, 3, 3] = voxels[2, 4, 4] = 600  # the saddle between them is at -200
    folder = write_series(tmp_path / "ct", voxels)
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "m.stl"), "--hu", "-300", "--json"]
    found = []
    for extra in ([], ["--topology", "trilinear"]):
        assert main([*arguments, "--device", str(device.index), *extra]) == 0
        report = printed().report()
        found.append((report["topology"], report["components"], report["closed"], report["manifold"]))
    assert found == [("separated", 2, True, True), ("trilinear", 1, True, True)]


def test_largest_of_two_series_is_taken_and_an_unknown_one_is_refused(
    device: Any, tmp_path: Path, printed: Printer
) -> None:
    folder = write_series(tmp_path / "ct", number=1)
    write_series(folder, np.full((6, 9, 9), -1000, np.int16), number=2)
    assert main(["mesh", str(folder), "-o", str(tmp_path / "a.stl"), "--device", str(device.index)]) == 0
    said = printed()
    said.assert_output(17)
    said.assert_error(2, "CT")
    assert main(["mesh", str(folder), "-o", str(tmp_path / "a.stl"), "--series", "9"]) == 3
    printed().assert_error("series", 9)


@pytest.mark.every_device
def test_devices_in_json_have_the_chosen_device_with_its_memory(device: Any, printed: Printer) -> None:
    assert main(["devices", "--json", "--device", str(device.index)]) == 0
    survey = printed().report()
    entry = survey["devices"][device.index]
    assert survey["chosen"] == device.index
    assert (entry["name"], entry["chosen"], entry["memory_bytes"]) == (device.name, True, device.memory_bytes)
    assert sum(other["chosen"] for other in survey["devices"]) == 1
    assert survey["reason"].startswith("named, ")


@pytest.mark.every_device
def test_devices_marks_the_chosen_device_and_says_why(device: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--device", str(device.index)]) == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert any(line.startswith(f"* {device.index}  ") and device.name in line for line in lines)
    assert any(line.startswith("taken named, ") for line in lines)


@pytest.mark.parametrize("command", ["devices", "selftest", "mesh"])
def test_no_driver_says_how_to_get_one(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clrecon.opencl import select

    monkeypatch.setattr(select, "_discover", lambda: ((("Clover", "OpenCL 1.1", "0 devices"),), ()))
    extra = [str(tmp_path), "-o", str(tmp_path / "a.stl")] if command == "mesh" else []
    assert main([command, *extra]) == 5
    captured = capsys.readouterr()
    assert captured.err.startswith("clrecon: error: no OpenCL device found: install ")
    assert len(captured.err.splitlines()) == 1
    assert ("Clover  0 devices  OpenCL 1.1" in captured.out) == (command == "devices")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_selftest_passes(device: Any, monkeypatch: pytest.MonkeyPatch, printed: Printer) -> None:
    """With the first checks of the table; all of them run in tests/proof."""
    from clrecon.proof import run as table

    few = partial(table.run_device_selftest, checks=table.CHECKS[:2])
    monkeypatch.setattr(table, "run_device_selftest", few)
    assert main(["selftest", "--json", "--device", str(device.index)]) == 0
    outcome = printed().report()
    assert outcome["passed"] is True
    assert [result["operator"] for result in outcome["operators"]] == ["exclusive_scan", "compact"]
    assert all(set(result) == {"operator", "passed", "detail", "seconds"} for result in outcome["operators"])


def test_selftest_that_fails_exits_5(
    device: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clrecon.proof import run

    wrong = [{"operator": "compact", "passed": False, "detail": "wrong positions", "seconds": 0.1}]
    monkeypatch.setattr(run, "run_selftest", lambda chosen, checks, **_: iter(wrong))
    assert main(["selftest", "--device", str(device.index)]) == 5
    captured = capsys.readouterr()
    assert "FAIL  compact" in captured.out
    assert captured.err.startswith("clrecon: error: the self-test failed on ")


def test_info_reads_the_geometry_that_the_truth_of_a_phantom_states(tmp_path: Path, printed: Printer) -> None:
    folder = tmp_path / "ph"
    arguments = ["phantom", str(folder), "--kind", "sphere", "--size", "40x32", "--slices", "24", "--tilt", "-12"]
    arguments += ["--spacing", "0.7", "0.5", "1.0", "--oblique", "10", "-5", "30", "--noise", "0", "--seed", "3"]
    assert main([*arguments, "--json"]) == 0
    truth = printed().report()
    assert truth["shape_ijk"] == [40, 32, 24]
    assert truth == json.loads((folder / "truth.json").read_text())
    assert main(["info", str(folder), "--json"]) == 0
    (entry,) = printed().report()["series"]
    np.testing.assert_allclose(entry["affine_ijk_to_lps_mm"], truth["affine_ijk_to_lps_mm"], atol=1e-6)
    assert entry["tilt_deg"] == pytest.approx(-12.0, abs=1e-4) == truth["tilt_deg"]
    assert main([*arguments, "--seed", "4"]) == 0
    printed().assert_output(24, 40, 32)


def test_phantom_refuses_a_folder_with_other_files(tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    assert main(["phantom", str(tmp_path), "--kind", "sphere"]) == 3
    assert (tmp_path / "thesis.txt").read_text() == "years of work"
    assert printed().error_lines == 1


@pytest.mark.parametrize(
    ("extra", "fact"), [(["--kind", "cat"], "sphere"), (["--size", "huge"], "huge"), (["--tilt", "80"], "80")]
)
def test_phantom_command_refuses_wrong_settings(extra: list[str], fact: str, tmp_path: Path, printed: Printer) -> None:
    assert main(["phantom", str(tmp_path / "ph"), *extra]) == 3
    printed().assert_error(fact)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_has_help_and_the_common_options(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help-all"]) == 0
    text = capsys.readouterr().out
    for option in ("--json", "--quiet", "--verbose", "--debug", "exit codes: 0 done"):
        assert option in text


def test_version_is_printed_alone(capsys: pytest.CaptureFixture[str]) -> None:
    import clrecon

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"clrecon {clrecon.__version__}\n"
