"""The commands that are timed on an unusual scan, and when one of them stands out by its time."""

from __future__ import annotations

from pathlib import Path

import pytest

from clrecon.cli.main import main
from clrecon.errors import NoDicomError

import outliers  # isort: skip


def run_of(*, cpu_s: float, error: str | None = None) -> outliers.Run:
    return outliers.Run(wall_s=9.0, cpu_s=cpu_s, memory_bytes=10**9, error=error)


@pytest.mark.parametrize("name", sorted(outliers.COMMANDS.keys() - {"distance"}))
def test_timed_command_is_understood_up_to_its_missing_input(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [part.replace("{scan}", "absent") for part in outliers.COMMANDS[name].split()]
    assert main([*words, "-q"]) == NoDicomError.exit_code


def test_command_of_more_than_5_s_stands_out() -> None:
    assert "over 5 s" in outliers.judge(run_of(cpu_s=5.1), peer=None)


def test_command_of_more_than_three_times_its_peer_stands_out_with_the_factor() -> None:
    assert "3.2 times" in outliers.judge(run_of(cpu_s=3.2), run_of(cpu_s=1.0))


@pytest.mark.parametrize(
    ("run", "peer"),
    [
        pytest.param(run_of(cpu_s=4.9), None, id="below 5 s"),
        pytest.param(run_of(cpu_s=2.9), run_of(cpu_s=1.0), id="below three times its peer"),
        pytest.param(run_of(cpu_s=3.2), run_of(cpu_s=1.0, error="exit 1: no module"), id="its peer has failed"),
    ],
)
def test_command_within_both_limits_or_beside_a_peer_that_failed_does_not_stand_out(
    run: outliers.Run, peer: outliers.Run | None
) -> None:
    assert outliers.judge(run, peer) == ""


def test_error_of_a_process_that_fails_is_its_exit_code_and_last_line(tmp_path: Path) -> None:
    run = outliers.time_process(["sh", "-c", "echo first >&2; echo last >&2; exit 5"], str(tmp_path), limit_s=60.0)
    assert run.error == "exit 5: last"


def test_process_over_its_time_limit_is_ended_with_an_error(tmp_path: Path) -> None:
    run = outliers.time_process(["sleep", "3600"], str(tmp_path), limit_s=0.2)
    assert run.error == "over 0.2 s"
