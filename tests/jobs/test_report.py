"""Reports are strict JSON and appear as a whole."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import OutputError, RefusedInputError
from clrecon.jobs.run import error_as_dict, peak_memory_bytes, platform_name, stage_report, to_json


def test_numpy_becomes_plain_and_nan_becomes_null() -> None:
    value = {
        "array": np.eye(2, dtype=np.float32),
        "integer": np.uint32(7),
        "flag": np.bool_(True),
        "bad": [float("nan"), np.float32("inf"), -float("inf")],
        "tuple": (1, None, "ä"),
    }
    text = to_json(value)
    assert text.isascii()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name)) == {
        "array": [[1.0, 0.0], [0.0, 1.0]],
        "integer": 7,
        "flag": True,
        "bad": [None, None, None],
        "tuple": [1, None, "ä"],
    }


def test_value_that_json_cannot_hold_is_an_error() -> None:
    with pytest.raises(TypeError, match="PosixPath|WindowsPath"):
        to_json({"path": Path("x")})


def test_a_report_that_fails_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    with stage_report(path, {"a": 1}) as staged:
        assert not path.exists()
        staged.commit()
    assert staged.size == path.stat().st_size
    with refused(TypeError, "object", "report"):
        stage_report(path, {"a": object()})
    with stage_report(path, {"a": 2}):
        pass  # never committed
    assert json.loads(path.read_text()) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]
    with refused(OutputError, "nowhere"):
        stage_report(tmp_path / "nowhere" / "report.json", {}).__enter__()


def test_error_as_json_has_kind_exit_code_and_message() -> None:
    assert error_as_dict(RefusedInputError("two slices at 3 mm")) == {
        "error": {"kind": "RefusedInputError", "exit_code": 4, "message": "two slices at 3 mm"}
    }


def test_the_computer_is_described_without_its_name() -> None:
    import platform

    assert platform.python_version() in platform_name()
    assert platform.node() == "" or platform.node() not in platform_name()
    peak = peak_memory_bytes()
    assert peak is None or 10**7 < peak < 10**12
