"""Targets that are no place for a file: one line that says why."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from variants import daily

from clrecon.errors import OutputError
from clrecon.system.paths import resolve_target

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="made with POSIX means")

IN_A_DELETED_FOLDER = """
import os, sys
from clrecon.cli.main import main
os.mkdir("gone"); os.chdir("gone"); os.rmdir("../gone")
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    "command",
    daily(
        2,
        [
            "mesh ../ct -o a.stl",
            "render ../ct -o a.png",
            "render ../ct --turntable a",
            "phantom a",
            "demo a",
            "bench --report a",
        ],
    ),
)
def test_command_that_writes_into_a_deleted_current_folder_is_refused_in_one_line(command: str, tmp_path: Path) -> None:
    call = [sys.executable, "-c", IN_A_DELETED_FOLDER, *command.split()]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True)
    target = command.split()[-1]
    fault = f"cannot write {target}: the current folder has been deleted, change to another one"
    assert (done.returncode, done.stdout, done.stderr) == (6, "", f"clrecon: error: {fault}\n")


@pytest.mark.skipif(not os.path.exists("/dev/stdout"), reason="the system has no /dev/stdout")
@pytest.mark.parametrize("sink", ["pipe", "file"])
def test_link_to_standard_output_is_refused_in_one_line_and_nothing_written(sink: str, tmp_path: Path) -> None:
    """A pipe cannot be replaced; a file would be, and whoever reads the stream would see nothing of it."""
    (tmp_path / "out.stl").symlink_to("/dev/stdout")
    code = "import sys; from clrecon.cli.main import main; sys.exit(main(['mesh', 'ct', '-o', 'out.stl']))"
    with open(tmp_path / "sink", "wb") as file:
        out = subprocess.PIPE if sink == "pipe" else file
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, stdout=out, stderr=subprocess.PIPE, text=True)

    assert done.returncode == 6
    [line] = done.stderr.splitlines()
    assert line.startswith("clrecon: error: cannot write out.stl: it leads to an open stream")
    written = done.stdout if sink == "pipe" else (tmp_path / "sink").read_text()
    assert written == ""


@pytest.mark.parametrize(("name", "why"), [("a\0b", "a null character"), ("\ud800", "no file name of this system")])
def test_name_that_no_file_can_have_is_refused_with_the_reason(name: str, why: str) -> None:
    with pytest.raises(OutputError, match=why):
        resolve_target(name)


def test_target_behind_a_link_to_a_link_is_the_file(tmp_path: Path) -> None:
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "c").symlink_to(tmp_path / "b")
    assert resolve_target(tmp_path / "c") == (tmp_path / "a").resolve()
