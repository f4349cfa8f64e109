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
def test_deleted_current_folder_is_told_by_every_command(command: str, tmp_path: Path) -> None:
    call = [sys.executable, "-c", IN_A_DELETED_FOLDER, *command.split()]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (6, "")
    assert (
        done.stderr
        == "clrecon: error: cannot write a: the current folder has been deleted, change to another one\n".replace(
            "write a:", f"write {command.split()[-1]}:"
        )
    )


@pytest.mark.skipif(not os.path.exists("/dev/stdout"), reason="the system has no /dev/stdout")
@pytest.mark.parametrize("sink", ["pipe", "file"])
def test_link_to_standard_output_is_refused(sink: str, tmp_path: Path) -> None:
    """A pipe cannot be replaced; a file would be, and whoever reads the stream would see nothing of it."""
    (tmp_path / "out.stl").symlink_to("/dev/stdout")
    code = "import sys; from clrecon.cli.main import main; sys.exit(main(['mesh', 'ct', '-o', 'out.stl']))"
    with open(tmp_path / "sink", "wb") as file:
        out = subprocess.PIPE if sink == "pipe" else file
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, stdout=out, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 6 and (done.stdout or "") == ""
    assert done.stderr.startswith("clrecon: error: cannot write out.stl: it leads to an open stream")
    assert done.stderr.count("\n") == 1 and (tmp_path / "sink").read_bytes() == b""


@pytest.mark.parametrize(("name", "why"), [("a\0b", "a null character"), ("\ud800", "no file name of this system")])
def test_names_that_no_file_can_have_are_refused(name: str, why: str) -> None:
    with pytest.raises(OutputError, match=why):
        resolve_target(name)


def test_links_to_files_are_followed(tmp_path: Path) -> None:
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "c").symlink_to(tmp_path / "b")
    assert resolve_target(tmp_path / "c") == (tmp_path / "a").resolve()
