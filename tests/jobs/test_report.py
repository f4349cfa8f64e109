"""Reports are strict JSON and appear as a whole."""

from __future__ import annotations

import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import OutputError, RefusedInputError
from clrecon.jobs.run import error_as_dict, peak_memory_bytes, platform_name, stage_report, to_json


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        pytest.param(np.eye(2, dtype=np.float32), [[1.0, 0.0], [0.0, 1.0]], id="array"),
        pytest.param(np.uint32(7), 7, id="integer of numpy"),
        pytest.param(np.bool_(True), True, id="flag of numpy"),
        pytest.param([float("nan"), np.float32("inf"), -float("inf")], [None, None, None], id="not finite"),
        pytest.param((1, None, "ä"), [1, None, "ä"], id="tuple with a letter beyond ASCII"),
    ],
)
def test_report_is_ascii_json_of_plain_values_with_null_for_what_is_not_finite(value: Any, expected: Any) -> None:
    text = to_json({"value": value})

    assert text.isascii()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name)) == {"value": expected}


def test_value_that_json_cannot_hold_is_refused_with_its_type() -> None:
    with pytest.raises(TypeError, match="PosixPath|WindowsPath"):
        to_json({"path": Path("x")})


def test_report_appears_when_it_is_committed_with_its_size(tmp_path: Path) -> None:
    path = tmp_path / "report.json"

    with stage_report(path, {"a": 1}) as staged:
        assert not path.exists()
        staged.commit()

    assert json.loads(path.read_text()) == {"a": 1}
    assert staged.size == path.stat().st_size


def test_report_that_is_not_committed_leaves_an_older_one(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("older")

    with stage_report(path, {"a": 2}):
        pass

    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"report.json": "older"}


def test_report_that_json_cannot_hold_leaves_an_older_one(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("older")

    with refused(TypeError, "object", "report"):
        stage_report(path, {"a": object()})

    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"report.json": "older"}


def test_report_in_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with refused(OutputError, "nowhere"):
        stage_report(tmp_path / "nowhere" / "report.json", {}).__enter__()


def test_error_as_json_has_kind_exit_code_and_message() -> None:
    error = error_as_dict(RefusedInputError("two slices at 3 mm"))["error"]
    assert error == {"kind": "RefusedInputError", "exit_code": 4, "message": "two slices at 3 mm"}


def test_computer_is_described_by_its_python_and_not_by_its_name() -> None:
    described = platform_name()

    assert platform.python_version() in described
    assert platform.node() == "" or platform.node() not in described


def test_peak_of_memory_is_a_plausible_number_of_bytes_or_unknown() -> None:
    peak = peak_memory_bytes()
    assert peak is None or 10**7 < peak < 10**12  # Python with numpy takes 30 MB and more
