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


@pytest.mark.parametrize(("arguments", "code"), [("info '{empty}'", 2), ("mesh nowhere", 3)], ids=["info", "mesh"])
@pytest.mark.parametrize(
    ("redirect", "error_lines"), [(">&-", 1), ("2>&-", 0), (">&- 2>&-", 0)], ids=["output", "errors", "both"]
)
def test_refused_command_with_closed_streams_keeps_its_exit_code_and_its_line_where_there_is_one(
    redirect: str, error_lines: int, arguments: str, code: int, tmp_path: Path
) -> None:
    done = run_shell(arguments.format(empty=tmp_path), redirect)

    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == error_lines


WITH_A_RESULT = daily(2, ["--version", "info '{scan}'", "info '{scan}' --json", "completion bash"])


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A series of 4 slices of 16 x 16 voxels."""
    folder = tmp_path_factory.mktemp("closed") / "scan"
    assert run_shell(f"phantom '{folder}' --size 16 --slices 4", "").returncode == 0
    return folder


@pytest.mark.parametrize("arguments", WITH_A_RESULT)
def test_result_for_a_closed_standard_output_ends_with_6_and_one_line(arguments: str, phantom: Path) -> None:
    done = run_shell(arguments.format(scan=phantom), ">&-")

    assert (done.returncode, done.stdout) == (6, "")
    assert done.stderr.startswith("clrecon: error: cannot write to standard output: it is closed")


@pytest.mark.parametrize("arguments", WITH_A_RESULT)
def test_result_is_printed_with_a_closed_standard_error(arguments: str, phantom: Path) -> None:
    done = run_shell(arguments.format(scan=phantom), "2>&-")

    assert done.returncode == 0
    assert done.stdout


@pytest.mark.parametrize("arguments", ["-o -", "-o mesh.stl --report -"])
def test_file_for_a_closed_standard_output_is_refused_before_any_work(arguments: str) -> None:
    done = run_shell(f"mesh nowhere {arguments}", ">&-")
    assert done.returncode == 6 and "standard output is closed" in done.stderr


def test_quiet_command_with_a_closed_standard_output_writes_its_files(tmp_path: Path) -> None:
    made = tmp_path / "made"
    done = run_shell(f"phantom '{made}' --size 16 --slices 4 -q", ">&-")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(list(made.iterdir())) == 4 + 1  # slices, and truth.json


def test_file_opened_with_closed_streams_does_not_become_standard_output() -> None:
    """The next file that is opened would be standard output for a library in C, and get its words."""
    code = (
        "import os; from clrecon.system.foreign_words import own_streams\n"
        "with own_streams(): print(os.open(os.devnull, os.O_RDONLY) > 2, file=__import__('sys').stderr)"
    )
    done = subprocess.run(["/bin/sh", "-c", f'"{sys.executable}" -c "{code}" >&-'], capture_output=True, text=True)
    assert done.stderr == "True\n"
