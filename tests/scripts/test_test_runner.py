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
    """The module scripts/test.py, whose name is taken by Python."""
    spec = importlib.util.spec_from_file_location("test_runner_under_test", RUNNER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_command(text, *, code=0):
    return [sys.executable, "-c", f"import sys; print({text!r}); sys.exit({code})"]


@pytest.mark.parametrize("closing", ["3 passed, 1 skipped in 2.10s (0:00:02)", "=== 1 failed, 3 passed in 61.00s ===",
                                     "no tests ran in 0.12s"])  # fmt: skip
def test_closing_line_of_pytest_is_printed_after_the_output_of_the_other_checks(runner, capfd, closing):
    checks = {"one": make_command("of one"), "two": make_command("of two", code=3)}
    pytest_command = make_command(f"....  [100%]\n{closing}\nafterwards")
    failed = runner.run_beside(checks, pytest_command, dict(os.environ), [])
    assert failed == ["two"]
    lines = capfd.readouterr().out.splitlines()
    assert lines == ["== pytest", "....  [100%]", "afterwards", "== one", "of one", "== two", "of two", closing]


def test_tests_that_fail_are_run_again_with_all_their_output(runner, capfd):
    again = make_command("its values", code=1)
    failed = runner.run_beside({}, make_command("no closing line", code=4), dict(os.environ), again)
    assert failed == ["pytest"]
    first_title, first_output, second_title, second_output = capfd.readouterr().out.splitlines()
    assert (first_title, first_output) == ("== pytest", "no closing line")
    assert second_title.startswith("== ")
    assert second_output == "its values"


def test_checks_run_one_after_the_other_also_after_one_that_fails(runner, capfd):
    failed = runner.run_in_turn({"a": make_command("A", code=1), "b": make_command("B")}, dict(os.environ))
    assert failed == ["a"]
    assert capfd.readouterr().out.splitlines() == ["== a", "A", "== b", "B"]
