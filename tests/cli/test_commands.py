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
from ct_files import ORIGIN, RADIUS_MM, SPACING, find_words, sphere_voxels, write_series
from printed_text import Printer

from clrecon.cli.common import Parser
from clrecon.cli.main import COMMANDS, main

CONTRACT = {
    "affine_ijk_to_lps_mm", "iso_value_hu", "space", "vertices", "triangles", "closed", "manifold", "components",
    "area_mm2", "volume_ml", "bounds_mm", "device", "driver", "version", "warnings", "seconds",
}  # fmt: skip
SECONDS = {"read", "upload", "build", "kernels", "download", "write", "total"}
TRUE_VOLUME_ML = 4.0 / 3.0 * math.pi * RADIUS_MM**3 / 1000.0
CENTRE = np.array(ORIGIN) + np.array(SPACING) * (15, 12, 8)
"""Of the sphere in the middle of 31 x 25 x 17 voxels; its surface lies at -150 HU, half way from -1000 to 700."""


def read_stl(path: Path) -> np.ndarray:
    content = path.read_bytes()
    count = int.from_bytes(content[80:84], "little")
    assert len(content) == 84 + 50 * count
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(content, record, offset=84)["corners"]


@pytest.fixture(scope="session")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere in 17 slices of 31 x 25 voxels."""
    return write_series(tmp_path_factory.mktemp("cli") / "Scan von Größe 3", sphere_voxels((17, 25, 31)))


@pytest.mark.every_device
@pytest.mark.parametrize(("space", "signs"), [("lps", (1, 1, 1)), ("ras", (-1, -1, 1))])
def test_mesh_of_a_sphere_lies_at_its_place_in_lps_and_ras(
    device: Any, space: str, signs: tuple[int, ...], ct: Path, tmp_path: Path
) -> None:
    output = tmp_path / "a.stl"
    arguments = ["mesh", str(ct), "-o", str(output), "--hu", "-150", "--space", space]
    assert main([*arguments, "--device", str(device.index), "-q"]) == 0
    corners = read_stl(output).reshape(-1, 3)
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    np.testing.assert_allclose(middle, CENTRE * signs, atol=1e-4)  # float32 in the file


def test_report_of_a_sphere_has_its_volume_bounds_and_file(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    output, report_path = tmp_path / "Kugel ä.stl", tmp_path / "a report.json"
    command = ["mesh", str(ct), "-o", str(output), "--report", str(report_path), "--hu", "-150", "-q"]

    assert main([*command, "--device", str(device.index)]) == 0

    report, corners = json.loads(report_path.read_text()), read_stl(output)
    assert (report["closed"], report["manifold"], report["components"]) == (True, True, 1)
    assert (report["iso_value_hu"], report["preset"], report["space"]) == (-150.0, None, "lps")
    assert report["volume_ml"] == pytest.approx(TRUE_VOLUME_ML, rel=tolerances.CLI_SPHERE_VOLUME_SHARE)
    bounds = [corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)]
    np.testing.assert_allclose(report["bounds_mm"], bounds, atol=1e-4)  # float32 in the file
    assert report["triangles"] == len(corners)
    assert report["output"] == {"format": "stl", "bytes": output.stat().st_size}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Kugel ä.stl", "a report.json"]


def test_words_of_mesh_have_the_shape_of_the_scan_the_iso_value_and_the_file(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    assert (
        main(["mesh", str(ct), "-o", str(tmp_path / "Kugel ä.stl"), "--hu", "-150", "--device", str(device.index)]) == 0
    )

    said = printed()
    said.assert_output(17, 31, 25, -150, "Kugel")
    assert said.error_lines == 0


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


def test_files_and_words_of_mesh_do_not_name_the_patient(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    output, report = tmp_path / "a.ply", tmp_path / "a.json"
    arguments = ["mesh", str(ct), "-o", str(output), "--report", str(report), "-v", "--device", str(device.index)]
    assert main(arguments) == 0
    written = output.read_bytes() + report.read_bytes() + printed().everything.encode()
    assert find_words(written) == []


def test_mesh_with_json_prints_its_report_alone(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    output = tmp_path / "a.glb"
    assert main(["mesh", str(ct), "-o", str(output), "--json", "--device", str(device.index)]) == 0
    captured = printed()
    report = captured.report()
    assert CONTRACT <= set(report)
    assert (report["preset"], report["iso_value_hu"], report["output"]["format"]) == ("bone", 200.0, "glb")
    assert captured.error_lines == 0


def test_quiet_mesh_prints_nothing_and_writes_its_file(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    output = tmp_path / "a.obj"
    assert main(["mesh", str(ct), "-o", str(output), "-q", "--device", str(device.index)]) == 0
    assert printed().is_silent
    assert output.stat().st_size > 70_000  # measured 149,399: a line for each vertex and triangle


def test_mesh_without_a_report_is_not_measured(device: Any, ct: Path, tmp_path: Path, printed: Printer) -> None:
    assert main(["mesh", str(ct), "-o", str(tmp_path / "a.stl"), "--device", str(device.index)]) == 0
    assert "component" not in printed().everything


def test_verbose_mesh_is_measured_and_its_components_are_printed(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mesh", str(ct), "-o", str(tmp_path / "a.stl"), "-v", "--device", str(device.index)]) == 0

    printed = capsys.readouterr()
    assert "1 component, closed, manifold" in printed.out
    assert "measuring the mesh" in printed.err


@pytest.mark.parametrize(
    ("level", "words"), [(["--preset", "skin"], "-500 HU (preset skin)"), (["--hu", "-400"], "-400 HU (as given)")]
)
def test_mesh_of_skin_is_warned_of_as_one_that_can_show_a_face(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], level: list[str], words: str
) -> None:
    assert main(["mesh", str(ct), "-o", str(tmp_path / "a.stl"), *level, "--device", str(device.index)]) == 0
    captured = capsys.readouterr()
    assert words in captured.out
    assert captured.err.startswith("clrecon: warning: a surface of the skin can show a face")


@pytest.fixture(scope="module")
def two_boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of a box of 5 x 10 x 12 voxels and one of 2 x 3 x 3, of 1.32 cubic mm each."""
    voxels = np.full((9, 20, 24), -1000, np.int16)
    voxels[2:7, 2:12, 2:14] = 800
    voxels[2:4, 15:18, 18:21] = 800
    return write_series(tmp_path_factory.mktemp("boxes") / "ct", voxels)


@pytest.mark.release
def test_options_of_size_keep_the_large_component_of_two(
    device: Any, two_boxes: Path, tmp_path: Path, printed: Printer
) -> None:
    def mesh_with(*options: str) -> tuple[int, float]:
        command = ["mesh", str(two_boxes), "-o", str(tmp_path / "m.stl"), "--json", "--device", str(device.index)]
        assert main([*command, *options]) == 0
        report = printed().report()
        return report["components"], report["volume_ml"]

    components, ml = mesh_with()
    largest, largest_ml = mesh_with("--keep-largest", "1")
    big, big_ml = mesh_with("--min-volume", "0.1")

    assert (components, largest, big) == (2, 1, 1)
    assert largest_ml == big_ml < ml


@pytest.mark.release
def test_least_volume_above_all_components_is_refused_and_writes_nothing(
    device: Any, two_boxes: Path, tmp_path: Path, printed: Printer
) -> None:
    command = ["mesh", str(two_boxes), "-o", str(tmp_path / "none.stl"), "--min-volume", "50"]

    assert main([*command, "--device", str(device.index)]) == 2

    printed().assert_error("ml", 50)
    assert not (tmp_path / "none.stl").exists()


def test_several_meshes_of_one_job_are_written_and_printed_one_by_one(
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


@pytest.mark.parametrize("is_spaced", [True, False], ids=["after a space", "after an equals sign"])
def test_seed_with_a_negative_first_number_is_read_as_a_value(
    is_spaced: bool, device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    seeds = [",".join(f"{value:.3f}" for value in CENTRE + [0, 0, step]) for step in (0, RADIUS_MM)]
    assert seeds[0].startswith("-")
    extra = [word for seed in seeds for word in (["--seed", seed] if is_spaced else [f"--seed={seed}"])]
    arguments = ["mesh", str(ct), *extra, "-o", str(tmp_path / "a.stl"), "--json", "--device", str(device.index)]
    assert main([*arguments, "--hu", "-150"]) == 0
    report = printed().report()
    assert report["seeds_mm"] == [[float(value) for value in seed.split(",")] for seed in seeds]
    of_centre, of_surface = report["meshes"][0]["seed_distances_mm"]
    assert of_centre == pytest.approx(RADIUS_MM, abs=tolerances.CLI_SPHERE_RADIUS_MM)
    assert of_surface == pytest.approx(0.0, abs=tolerances.CLI_SPHERE_RADIUS_MM)


@pytest.mark.parametrize(
    ("words", "seeds", "rest"),
    [
        pytest.param(["--seed", "-1.5,2,3", "-q"], ["-1.5,2,3"], [], id="after a space"),
        pytest.param(["--seed=-1e3,.5,0"], ["-1e3,.5,0"], [], id="after an equals sign"),
        pytest.param(["--seed", "-.5,2"], ["-.5,2"], [], id="no digit before the point"),
        pytest.param(["--", "--seed", "-4,5"], None, ["--seed", "-4,5"], id="after two dashes"),
    ],
)
def test_list_that_begins_with_a_negative_number_is_the_value_of_its_option(
    words: list[str], seeds: list[str] | None, rest: list[str]
) -> None:
    parser = Parser()
    parser.add_argument("--seed", action="append")
    parser.add_argument("-q", action="store_true")
    parser.add_argument("rest", nargs="*")

    options = parser.parse_args(words)

    assert (options.seed, options.rest, options.q) == (seeds, rest, "-q" in words)


@pytest.mark.parametrize(("options", "is_closed"), [([], True), (["--open"], False)], ids=["by default", "--open"])
def test_mesh_of_bone_that_leaves_the_scan_is_closed_unless_asked_to_be_open(
    options: list[str], is_closed: bool, device: Any, tmp_path: Path, printed: Printer
) -> None:
    voxels = np.full((5, 8, 9), -1000, np.int16)
    voxels[:, 2:6, 3:6] = 600  # in all slices
    folder = write_series(tmp_path / "ct", voxels)
    command = ["mesh", str(folder), "-o", str(tmp_path / "m.stl"), "--json", "--device", str(device.index)]

    assert main([*command, *options]) == 0

    report = printed().report()
    assert report["closed"] == is_closed
    assert (report["volume_ml"] is not None) == is_closed


@pytest.mark.release
def test_trilinear_topology_joins_voxels_that_touch_at_an_edge_which_the_default_separates(
    device: Any, tmp_path: Path, printed: Printer
) -> None:
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


@pytest.fixture(scope="module")
def two_series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of series 1 of 17 slices, and 2 of 6."""
    folder = write_series(tmp_path_factory.mktemp("series") / "ct", sphere_voxels((17, 25, 31)), number=1)
    return write_series(folder, np.full((6, 9, 9), -1000, np.int16), number=2)


def test_largest_of_two_series_is_taken_with_a_warning(
    device: Any, two_series: Path, tmp_path: Path, printed: Printer
) -> None:
    assert main(["mesh", str(two_series), "-o", str(tmp_path / "a.stl"), "--device", str(device.index)]) == 0

    said = printed()
    said.assert_output(17)  # slices of the larger one
    said.assert_error(2, "CT")


def test_series_that_is_not_there_is_refused(two_series: Path, tmp_path: Path, printed: Printer) -> None:
    assert main(["mesh", str(two_series), "-o", str(tmp_path / "a.stl"), "--series", "9"]) == 3
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
def test_command_without_a_driver_is_refused_in_one_line_that_says_how_to_get_one(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clrecon.opencl import select

    monkeypatch.setattr(select, "_discover", lambda: ((("Clover", "OpenCL 1.1", "0 devices"),), ()))
    extra = [str(tmp_path), "-o", str(tmp_path / "a.stl")] if command == "mesh" else []
    assert main([command, *extra]) == 5
    captured = capsys.readouterr()
    assert captured.err.startswith("clrecon: error: no OpenCL device found")
    assert ": install " in captured.err  # behind the limit of the process's memory, where there is one
    assert len(captured.err.splitlines()) == 1
    assert ("Clover  0 devices  OpenCL 1.1" in captured.out) == (command == "devices")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_selftest_reports_each_operator_as_passed(
    device: Any, monkeypatch: pytest.MonkeyPatch, printed: Printer
) -> None:
    """With the first checks of the table; all of them run in tests/proof."""
    from clrecon.proof import run as table

    few = partial(table.run_device_selftest, checks=table.CHECKS[:2])
    monkeypatch.setattr(table, "run_device_selftest", few)
    assert main(["selftest", "--json", "--device", str(device.index)]) == 0
    outcome = printed().report()
    assert outcome["passed"] is True
    assert [result["operator"] for result in outcome["operators"]] == ["exclusive_scan", "compact"]
    assert all(set(result) == {"operator", "passed", "detail", "seconds"} for result in outcome["operators"])


def test_selftest_with_an_operator_that_fails_names_it_and_exits_with_5(
    device: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clrecon.proof import run

    wrong = [{"operator": "compact", "passed": False, "detail": "wrong positions", "seconds": 0.1}]
    monkeypatch.setattr(run, "run_selftest", lambda chosen, checks, **_: iter(wrong))
    assert main(["selftest", "--device", str(device.index)]) == 5
    captured = capsys.readouterr()
    assert "FAIL  compact" in captured.out
    assert captured.err.startswith("clrecon: error: the self-test failed on ")


PHANTOM = [
    "--kind", "sphere", "--size", "40x32", "--slices", "24", "--tilt", "-12", "--spacing", "0.7", "0.5", "1.0",
    "--oblique", "10", "-5", "30", "--noise", "0", "--seed", "3",
]  # fmt: skip


def test_phantom_with_json_prints_the_truth_that_it_writes(tmp_path: Path, printed: Printer) -> None:
    assert main(["phantom", str(tmp_path / "ph"), *PHANTOM, "--json"]) == 0

    truth = printed().report()
    assert truth == json.loads((tmp_path / "ph" / "truth.json").read_text())
    assert truth["shape_ijk"] == [40, 32, 24]


def test_info_of_a_phantom_has_the_affine_and_tilt_of_its_truth(tmp_path: Path, printed: Printer) -> None:
    folder = tmp_path / "ph"
    assert main(["phantom", str(folder), *PHANTOM, "-q"]) == 0

    assert main(["info", str(folder), "--json"]) == 0

    (series,) = printed().report()["series"]
    truth = json.loads((folder / "truth.json").read_text())
    affine = truth["affine_ijk_to_lps_mm"]
    np.testing.assert_allclose(series["affine_ijk_to_lps_mm"], affine, atol=tolerances.AFFINE_MM)
    assert truth["tilt_deg"] == pytest.approx(-12.0)
    assert series["tilt_deg"] == pytest.approx(-12.0, abs=1e-4)  # directions have 9 decimals


def test_phantom_over_an_earlier_one_takes_its_place_with_its_shape_in_words(tmp_path: Path, printed: Printer) -> None:
    assert main(["phantom", str(tmp_path / "ph"), *PHANTOM, "-q"]) == 0

    assert main(["phantom", str(tmp_path / "ph"), *PHANTOM, "--seed", "4"]) == 0

    printed().assert_output(24, 40, 32)
    assert json.loads((tmp_path / "ph" / "truth.json").read_text())["seed"] == 4


def test_phantom_in_a_folder_with_other_files_is_refused_and_they_stay(tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    assert main(["phantom", str(tmp_path), "--kind", "sphere"]) == 3
    assert (tmp_path / "thesis.txt").read_text() == "years of work"
    assert printed().error_lines == 1


@pytest.mark.parametrize(
    ("extra", "fact"), [(["--kind", "cat"], "sphere"), (["--size", "huge"], "huge"), (["--tilt", "80"], "80")]
)
def test_wrong_setting_of_phantom_is_refused_and_writes_nothing(
    extra: list[str], fact: str, tmp_path: Path, printed: Printer
) -> None:
    assert main(["phantom", str(tmp_path / "ph"), *extra]) == 3
    printed().assert_error(fact)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_of_every_command_has_the_common_options_and_exit_codes(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help-all"]) == 0
    text = capsys.readouterr().out
    for option in ("--json", "--quiet", "--verbose", "--debug", "exit codes: 0 done"):
        assert option in text


def test_version_option_prints_name_and_version_alone(capsys: pytest.CaptureFixture[str]) -> None:
    import clrecon

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"clrecon {clrecon.__version__}\n"
