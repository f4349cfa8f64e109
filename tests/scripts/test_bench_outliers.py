"""The list of commands that are timed on an ugly scan, and what makes one of them stand out."""

from __future__ import annotations

from pathlib import Path

import pytest

from clrecon.cli.main import main
from clrecon.errors import NoDicomError

import outliers  # isort: skip


def _run(cpu_s: float, error: str | None = None) -> outliers.Run:
    return outliers.Run(wall_s=9.0, cpu_s=cpu_s, memory_bytes=10**9, error=error)


@pytest.mark.parametrize("name", sorted(outliers.COMMANDS.keys() - {"distance"}))
def test_timed_command_is_understood_up_to_its_missing_input(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [part.replace("{scan}", "absent") for part in outliers.COMMANDS[name].split()]
    assert main([*words, "-q"]) == NoDicomError.exit_code


@pytest.mark.parametrize(
    ("cpu_s", "peer_s", "said"), [(4.9, None, ""), (5.1, None, "over 5 s"), (2.9, 1.0, ""), (3.2, 1.0, "3.2 times")]
)
def test_command_stands_out_by_seconds_or_by_its_peer(cpu_s: float, peer_s: float | None, said: str) -> None:
    peer = None if peer_s is None else _run(peer_s)
    why = outliers.judge(_run(cpu_s), peer)
    assert (said in why) if said else why == ""


def test_failed_peer_is_no_measure() -> None:
    assert outliers.judge(_run(3.2), _run(1.0, "exit 1: no module")) == ""


def test_process_that_fails_says_so_by_its_last_line(tmp_path: Path) -> None:
    run = outliers.time_process(["sh", "-c", "echo first >&2; echo last >&2; exit 5"], str(tmp_path), 60.0)
    assert run.error == "exit 5: last"


def test_process_over_its_limit_is_ended(tmp_path: Path) -> None:
    run = outliers.time_process(["sleep", "3600"], str(tmp_path), 0.2)
    assert run.error == "over 0.2 s"
