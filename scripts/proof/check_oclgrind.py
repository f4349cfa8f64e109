#!/usr/bin/env python3
"""Run the tests marked ``oclgrind`` under the Oclgrind simulator and fail on anything that it reports.

    python scripts/proof/check_oclgrind.py [--uninitialized] [COMMAND ...]

Oclgrind checks every memory access of every kernel and data races.  It always exits with 0, so this script checks that
its log exists and is empty.  COMMAND replaces the tests (the guard of this script uses that).  Run it with the Python
of an environment that has clrecon and its test extra (scripts/test.py does).

--uninitialized also reports uninitialised values, with the compiler's optimiser off.  It helps in a search but is not
part of the gate, because Oclgrind up to version 21.10 has faults in this mode.  It stops at LLVM's instruction
"freeze", which the optimiser makes of a quotient and its remainder.  It reports halves of vectors (v.lo | v.hi) or
crashes on them.  After a buffer is freed, it reports the end of a larger buffer that takes its place.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHOWN_LINES = 60


def default_command() -> list[str]:
    """Command for all tests marked ``oclgrind``; only files that name the mark are collected, which saves time."""
    files = sorted(path for path in (ROOT / "tests").rglob("test_*.py") if "mark.oclgrind" in path.read_text("utf-8"))
    marked = [str(path.relative_to(ROOT)) for path in files]
    return [sys.executable, "-m", "pytest", "-q", "-m", "oclgrind", "--assert=plain", "-p", "no:cacheprovider", *marked]


def run_under_oclgrind(command: list[str], uninitialized: bool = False) -> tuple[int, str]:
    """Run `command` with Oclgrind as its only OpenCL platform.

    Returns the exit status of the command and the log of Oclgrind.
    """
    with tempfile.TemporaryDirectory(prefix="clrecon-oclgrind-") as folder:
        log = Path(folder) / "oclgrind.log"
        environment = {
            **os.environ,
            "CLRECON_TEST_SIMULATORS": "1",
            "CLRECON_TEST_DEVICE": "oclgrind",
            "CLRECON_DEVICE": "oclgrind",
            "CLRECON_REQUIRE_DEVICE": "1",
            "CLRECON_REQUIRE_PLATFORMS": "Oclgrind",
            "PYOPENCL_NO_CACHE": "1",
        }
        for name in ("PYOPENCL_CTX", "CLRECON_COVERAGE"):
            environment.pop(name, None)
        wrapper = ["oclgrind", "--check-api", "--data-races", "--log", str(log)]
        if uninitialized:
            wrapper += ["--uninitialized", "--build-options", "-cl-opt-disable"]
        code = subprocess.run([*wrapper, *command], cwd=ROOT, env=environment).returncode
        return code, log.read_text(errors="replace") if log.exists() else "Oclgrind has written no log"


def main() -> int:
    if shutil.which("oclgrind") is None:
        print("oclgrind is not installed (on Debian and Ubuntu: apt install oclgrind)", file=sys.stderr)
        return 1
    command = sys.argv[1:]
    uninitialized = command[:1] == ["--uninitialized"]
    code, log = run_under_oclgrind(command[uninitialized:] or default_command(), uninitialized)
    if code:
        print(f"the command under Oclgrind failed with exit status {code}", file=sys.stderr)
    if log.strip():
        lines = [line for line in log.splitlines() if line.strip()]
        print(f"Oclgrind reports faults ({len(lines)} lines):", *lines[:SHOWN_LINES], sep="\n", file=sys.stderr)
    if code or log.strip():
        return 1
    print("Oclgrind reports nothing")
    return 0


if __name__ == "__main__":
    sys.exit(main())
