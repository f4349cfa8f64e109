"""A process that was started without standard output or error works all the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


def run_shell(arguments: str, redirect: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["/bin/sh", "-c", f'"{sys.executable}" -m clrecon {arguments} {redirect}'], capture_output=True, text=True
    )


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize("redirect", [">&-", "2>&-", ">&- 2>&-"])
def test_closed_streams_keep_the_exit_code(redirect: str, tmp_path: Path) -> None:
    for arguments, code in (("--version", 0), (f"info '{tmp_path}'", 2), ("mesh nowhere", 3)):
        done = run_shell(arguments, redirect)
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert len(done.stderr.splitlines()) == int(code != 0 and "2>&-" not in redirect)
