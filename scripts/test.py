#!/usr/bin/env python3
"""Make .venv-test, then run ruff, codespell, mypy, the Oclgrind check (where oclgrind is installed) and the tests.

    python3 scripts/test.py [--fast] [PYTEST ARGUMENTS]

--fast runs all guards, and of the other tests the first parameter on the first device, without those marked seconds,
slow, long or fuzz and without the Oclgrind check.  Everything else goes to pytest; without such arguments the whole
suite runs in as many processes as there are cores, four at most.  The exit status is not 0 if a step fails or no test
ran.  See docs/guide/development/tests.md for the variables that choose devices.
"""

import os
import re
import sys

if sys.version_info < (3, 10):
    sys.exit("clrecon needs Python 3.10 or newer, this is %s (%s)" % (sys.version.split()[0], sys.executable))  # noqa: UP031

import shutil
import subprocess
import tempfile
from contextlib import ExitStack
from typing import IO

from _environment import ROOT, SetupError, ensure_environment, program_path

MOST_PROCESSES = 4
CLOSING_LINE = re.compile(r"(=+ )?(\d+ (passed|failed|skipped|errors?)|no tests ran)\b.* in [\d.]+s")
Steps = dict[str, list[str]]


def run_in_turn(steps: Steps, environment: dict[str, str]) -> list[str]:
    """Run the steps one after the other and return the names of those that failed."""
    failed = []
    for name, command in steps.items():
        print(f"== {name}", flush=True)
        if subprocess.run(command, cwd=ROOT, env=environment).returncode:
            failed.append(name)
    return failed


def run_beside(steps: Steps, command: list[str], environment: dict[str, str], again: list[str]) -> list[str]:
    """Run `command`, pytest, with the steps beside it, `again` if it fails, and return the names of those that failed.

    What pytest prints comes as it is printed, that of the steps after it, and pytest's closing line last.
    """
    failed = []
    with ExitStack() as early:
        beside = {}
        for name, step in steps.items():
            said = early.enter_context(tempfile.TemporaryFile())
            process = subprocess.Popen(step, cwd=ROOT, env=environment, stdout=said, stderr=subprocess.STDOUT)
            early.enter_context(process)
            early.callback(process.kill)  # for an interrupted program; does nothing if the step has ended
            beside[name] = process, said
        print("== pytest", flush=True)
        tests = early.enter_context(subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE))
        early.callback(tests.kill)
        assert tests.stdout is not None
        closing = show_but_closing(tests.stdout)
        if tests.wait():
            failed.append("pytest")
            print("== what failed, once more, with the values of its asserts", flush=True)
            subprocess.run(again, cwd=ROOT, env=environment)
        for name, (process, said) in beside.items():
            print(f"== {name}", flush=True)
            if process.wait():
                failed.append(name)
            said.seek(0)
            print(said.read().decode(errors="replace"), end="", flush=True)
    print(closing, end="", flush=True)
    return failed


def show_but_closing(lines: IO[bytes]) -> str:
    """Print what pytest prints, line by line, but for its closing line: return that, or nothing if none came."""
    closing = ""
    for line in lines:
        text = line.decode(errors="replace")
        if CLOSING_LINE.match(text):
            text, closing = closing, text
        print(text, end="", flush=True)
    return closing


def quick_checks(folder: str) -> Steps:
    """Return the checks that take a second, by name: the same as in .pre-commit-config.yaml."""
    ruff = program_path(folder, "ruff")
    return {
        "ruff": [ruff, "check", "."],
        "format": [ruff, "format", "--check", "--quiet", "."],
        "codespell": [program_path(folder, "codespell"), "."],
    }


def main() -> int:
    arguments = sys.argv[1:]
    if arguments[:1] in (["-h"], ["--help"]):
        print(__doc__.strip())
        return 0
    fast = "--fast" in arguments
    arguments = [argument for argument in arguments if argument != "--fast"]
    is_release = os.environ.get("CLRECON_RELEASE_TESTS", "") not in ("", "0")
    try:
        extras = "test,dev,docs,release" if is_release else "test,dev"
        folder = ensure_environment(".venv-test", extras=extras, program="pytest", compiled=False)
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    python = program_path(folder, "python")
    # Bodies of tests are half of mypy's time: running them asks the same, and those that do not run wait for a release.
    steps = {"mypy": [program_path(folder, "mypy"), *([] if is_release else ["clrecon", "scripts", "tests/support"])]}
    if not fast and (shutil.which("oclgrind") or os.environ.get("CLRECON_REQUIRE_OCLGRIND")):
        steps["oclgrind"] = [python, os.path.join("scripts", "proof", "check_oclgrind.py")]
    # Much of the suite's time is the building of kernels, on one core.  Each process gets a part of the tests in order.
    # A process that is done takes half of the rest of another, so that none waits for the longest file.  A process that
    # crashes ends the run: pytest-xdist 3.8 would wait for ever for a process in its place.
    # Asserts that can show their values take each process 10 s to compile: what fails runs once more with such.
    cores = min(os.cpu_count() or 1, MOST_PROCESSES)
    options = ["-n", str(cores), "--dist", "worksteal", "--max-worker-restart", "0", "--assert=plain"]
    tests = [python, "-m", "pytest", "-q", *(options if cores > 1 and not arguments else []), *arguments]
    again = [python, "-m", "pytest", "-q", "--last-failed", "--last-failed-no-failures", "none"]
    environment = {**os.environ, "CLRECON_REQUIRE_TESTS": "1", "CLRECON_FAST_TESTS": "1" if fast else ""}
    # Hundreds of tests start a process that imports clrecon: it is compiled once, whatever the machine's habit.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    failed = run_in_turn(quick_checks(folder), environment)
    if cores > 1 and not arguments:
        failed += run_beside(steps, tests, environment, again)
    else:
        failed += run_in_turn({**steps, "pytest": tests}, environment)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
