"""A process that was started without standard output or error works all the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from variants import daily


def run_shell(arguments: str, redirect: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["/bin/sh", "-c", f'"{sys.executable}" -m clrecon {arguments} {redirect}'], capture_output=True, text=True
    )


pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")


@pytest.mark.parametrize("redirect", [">&-", "2>&-", ">&- 2>&-"])
def test_closed_streams_keep_the_exit_code(redirect: str, tmp_path: Path) -> None:
    for arguments, code in ((f"info '{tmp_path}'", 2), ("mesh nowhere", 3)):
        done = run_shell(arguments, redirect)
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert len(done.stderr.splitlines()) == int("2>&-" not in redirect)


@pytest.mark.parametrize(
    "arguments", daily(2, ["--version", "info '{scan}'", "info '{scan}' --json", "completion bash"])
)
def test_a_result_that_nobody_can_get_is_exit_code_6(arguments: str, tmp_path: Path) -> None:
    scan = tmp_path / "scan"
    if "scan" in arguments:
        assert run_shell(f"phantom '{scan}' --size 16 --slices 4", "").returncode == 0
    done = run_shell(arguments.format(scan=scan), ">&-")
    assert (done.returncode, done.stdout) == (6, "")
    assert done.stderr.startswith("clrecon: error: cannot write to standard output: it is closed")
    assert run_shell(arguments.format(scan=scan), "2>&-").returncode == 0


@pytest.mark.parametrize("arguments", ["-o -", "-o mesh.stl --report -"])
def test_a_file_for_a_closed_stream_is_refused_before_any_work(arguments: str) -> None:
    done = run_shell(f"mesh nowhere {arguments}", ">&-")
    assert done.returncode == 6 and "standard output is closed" in done.stderr


def test_nothing_is_missing_of_a_quiet_command(tmp_path: Path) -> None:
    made = tmp_path / "made"
    done = run_shell(f"phantom '{made}' --size 16 --slices 4 -q", ">&-")
    assert (done.returncode, done.stderr) == (0, "") and len(list(made.iterdir())) == 5


def test_files_are_not_written_over_a_closed_stream() -> None:
    """The next file that is opened would be standard output for a library in C, and get its words."""
    code = (
        "import os; from clrecon.system.foreign_words import own_streams\n"
        "with own_streams(): print(os.open(os.devnull, os.O_RDONLY) > 2, file=__import__('sys').stderr)"
    )
    done = subprocess.run(["/bin/sh", "-c", f'"{sys.executable}" -c "{code}" >&-'], capture_output=True, text=True)
    assert done.stderr == "True\n"
