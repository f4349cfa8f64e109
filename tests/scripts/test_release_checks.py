"""scripts/release_checks.py: the programs that it lists exist, and a check that fails is named."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import release_checks
from house import ROOT
from refusals import refused
from release_checks import CHECKS, ReleaseCheck


@pytest.mark.parametrize("name", CHECKS)
def test_check_for_a_release_is_a_program_of_the_project_that_can_be_run(name: str) -> None:
    path = ROOT / CHECKS[name].command[0]
    assert path.is_file()
    assert path.suffix == ".py" or os.access(path, os.X_OK)


def test_list_of_checks_for_a_release_has_what_each_holds_and_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert release_checks.main(["--list"]) == 0
    output = capsys.readouterr().out
    assert [name for name, check in CHECKS.items() if f"{name}: {check.holds}" not in output] == []
    assert "CLRECON_RELEASE_TESTS=1 CLRECON_COVERAGE=1 .ci/run" in output


@pytest.fixture
def run_checks(tmp_path: Path) -> Callable[[list[str]], int]:
    """Runs the script with two checks, "bad" that fails and "good" that passes, each of which prints a variable."""
    checks = {}
    for name, code in {"bad": 1, "good": 0}.items():
        path = tmp_path / f"{name}.py"
        path.write_text(f"import os, sys\nprint(os.environ['OF_CHECK'])\nsys.exit({code})\n")
        checks[name] = ReleaseCheck(f"holds {name}", (str(path),), {"OF_CHECK": name})
    return partial(release_checks.main, checks=checks, kept=tmp_path / "kept")


def test_check_that_fails_is_named_after_all_have_run_with_their_variables(
    run_checks: Callable[[list[str]], int], capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_checks([]) == 1
    output = capfd.readouterr()
    assert sorted(output.out.splitlines()) == sorted(["== bad: holds bad", "bad", "== good: holds good", "good"])
    assert output.err == "failed: bad\n"


def test_named_check_runs_alone(run_checks: Callable[[list[str]], int], capfd: pytest.CaptureFixture[str]) -> None:
    assert run_checks(["good"]) == 0
    assert capfd.readouterr().out.splitlines() == ["== good: holds good", "good"]


def test_unknown_check_is_refused(run_checks: Callable[[list[str]], int]) -> None:
    with refused(SystemExit, 2):
        run_checks(["none"])
