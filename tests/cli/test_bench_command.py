"""``clrecon bench``: table, JSON, report, exit codes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from ct_files import find_words, sphere_voxels, write_series
from failing_devices import BurntDevice
from printed_text import Printer

from clrecon.cli import bench as command
from clrecon.cli.main import main
from clrecon.errors import PARTLY_DONE

CONTRACT = {
    "input", "iso_value_hu", "iso_level_hu", "runs", "processor", "platform", "version", "cores", "free_cores",
    "seconds", "devices", "warnings",
}  # fmt: skip
OF_A_DEVICE = {
    "device", "error", "vertices", "triangles", "first_seconds", "warm_seconds", "part_seconds", "kernel_seconds",
    "mvoxels_per_s", "mtriangles_per_s", "peer", "ratio", "resident_seconds",
}  # fmt: skip


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere in 17 slices of 31 x 25 voxels."""
    return write_series(tmp_path_factory.mktemp("bench") / "Scan von Jane", sphere_voxels((17, 25, 31)))


def test_table_of_a_bench_names_scan_device_stages_kernels_and_peer(
    device: Any, ct: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", str(ct), "--hu", "-150", "--runs", "2", "--device", str(device.index)]) == 0
    out = capsys.readouterr().out
    assert "17 slices of 31 x 25, spacing 0.8 x 1.1 x 1.5 mm" in out
    assert "-150 HU, open at the border" in out
    for words in (device.name, device.driver, "first surface", "later ones", "kernels", "flying edges", "ratio",
                  "Mvoxel/s", "Mtriangle/s"):  # fmt: skip
        assert words in out
    reading = re.search(r"^read +([\d.]+) (ms|s) \(([\d.]+) Mvoxel/s\)$", out, re.MULTILINE)
    assert reading is not None
    seconds = float(reading[1]) * {"s": 1.0, "ms": 1e-3}[reading[2]]
    assert float(reading[3]) * seconds == pytest.approx(1e-6 * 17 * 31 * 25, rel=0.1)  # the rate has two digits


def test_json_and_report_of_a_bench_have_the_names_of_the_contract_and_none_of_the_patient(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    report = tmp_path / "b.json"
    command = ["bench", str(ct), "--runs", "1", "--device", str(device.index), "--json", "--report", str(report)]

    assert main(command) == 0

    said = printed()
    result = said.report()
    assert result == json.loads(report.read_text())
    assert CONTRACT <= set(result)
    assert OF_A_DEVICE <= set(result["devices"][0])
    assert find_words(said.everything) == []


def test_bench_without_an_iso_value_is_of_bone_at_200_hu(device: Any, ct: Path, printed: Printer) -> None:
    assert main(["bench", str(ct), "--runs", "1", "--device", str(device.index), "--json"]) == 0
    assert printed().report()["iso_value_hu"] == 200.0


def test_bench_on_a_device_that_fails_is_partly_done_with_the_reason(
    device: Any, ct: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("clrecon.opencl.list_devices", lambda: [BurntDevice(device), device])
    assert main(["bench", str(ct), "--runs", "1", "--device", "all"]) == PARTLY_DONE
    captured = capsys.readouterr()
    assert "failed: it caught fire" in captured.out
    assert "it caught fire" in captured.err and "flying edges" in captured.out


@pytest.mark.parametrize(
    ("extra", "code", "fact"),
    [
        (["--runs", "0"], 3, 1000),
        (["--runs", "many"], 3, "many"),
        (["--hu", "nan"], 3, "finite"),
        (["--device", "abacus"], 5, "abacus"),
        (["--report", "no/such/folder/b.json"], 6, "exist"),
        (["--iso", "3"], 3, "unrecognized"),
    ],
)
def test_wrong_argument_of_bench_is_refused_in_one_line(
    extra: list[str], code: int, fact: str | int, ct: Path, printed: Printer
) -> None:
    assert main(["bench", str(ct), *extra]) == code
    said = printed()
    assert (said.output_lines, said.error_lines) == (0, 1)
    said.assert_error(fact)


def test_bench_of_a_missing_input_names_it(device: Any, tmp_path: Path, printed: Printer) -> None:
    assert main(["bench", str(tmp_path / "gone"), "--device", str(device.index)]) == 2
    printed().assert_error("gone")


def test_bench_command_runs_as_often_by_default_as_the_function() -> None:
    from clrecon.proof.bench import DEFAULT_RUNS

    assert command._RUNS == DEFAULT_RUNS
