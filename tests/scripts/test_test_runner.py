"""scripts/test.py: what runs beside the tests is shown after them, and pytest's closing line stays the last."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import pytest

RUNNER = Path(__file__).resolve().parents[2] / "scripts" / "test.py"


@pytest.fixture
def runner():
    spec = importlib.util.spec_from_file_location("test_runner_under_test", RUNNER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_command(text, code=0):
    return [sys.executable, "-c", f"import sys; print({text!r}); sys.exit({code})"]


@pytest.mark.parametrize("closing", ["3 passed, 1 skipped in 2.10s (0:00:02)", "=== 1 failed, 3 passed in 61.00s ===",
                                     "no tests ran in 0.12s"])  # fmt: skip
def test_closing_line_comes_last(runner, capfd, closing):
    steps = {"one": make_command("of one"), "two": make_command("of two", 3)}
    failed = runner.run_beside(steps, make_command(f"....  [100%]\n{closing}\nafterwards"), dict(os.environ), [])
    lines = capfd.readouterr().out.splitlines()
    assert failed == ["two"]
    assert lines == ["== pytest", "....  [100%]", "afterwards", "== one", "of one", "== two", "of two", closing]


def test_tests_that_fail_are_named_and_print_all(runner, capfd):
    again = make_command("its values", 1)
    assert runner.run_beside({}, make_command("no closing line", 4), dict(os.environ), again) == ["pytest"]
    said = capfd.readouterr().out.splitlines()
    assert said[:2] == ["== pytest", "no closing line"] and said[2].startswith("== ") and said[3:] == ["its values"]


def test_steps_run_in_turn(runner, capfd):
    assert runner.run_in_turn({"a": make_command("A", 1), "b": make_command("B")}, dict(os.environ)) == ["a"]
    assert capfd.readouterr().out.splitlines() == ["== a", "A", "== b", "B"]
