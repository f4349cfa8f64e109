#!/usr/bin/env python3
"""Make .venv-test, then run ruff, codespell, mypy, the Oclgrind check (where oclgrind is installed) and the tests.

    python3 scripts/test.py [--fast] [PYTEST ARGUMENTS]

--fast runs all guards, and of the other tests the first parameter on the first device, without those marked seconds,
slow, long or fuzz and without the Oclgrind check.  Everything else goes to pytest; without such arguments the whole
suite runs in as many processes as there are cores, four at most.  The exit status is not 0 if a step fails or no test
ran.  See CONTRIBUTING.md for the variables that choose devices.
"""

import os
import sys

if sys.version_info < (3, 10):
    sys.exit("clrecon needs Python 3.10 or newer, this is %s (%s)" % (sys.version.split()[0], sys.executable))  # noqa: UP031

import shutil
import subprocess
import tempfile
from contextlib import ExitStack

from _environment import ROOT, SetupError, ensure_environment, program_path

MOST_PROCESSES = 4


def run_steps(steps: dict[str, list[str]], environment: dict[str, str], beside: str) -> list[str]:
    """Run the steps in their order and return the names of those that failed.

    The step `beside` uses one core: it runs in parallel from the beginning, and its output is printed in its turn.
    """
    failed = []
    with ExitStack() as early:
        if beside in steps:
            said = early.enter_context(tempfile.TemporaryFile())
            process = early.enter_context(
                subprocess.Popen(steps[beside], cwd=ROOT, env=environment, stdout=said, stderr=subprocess.STDOUT)
            )
            early.callback(process.kill)  # for an interrupted program; does nothing if the step has ended
        for name, command in steps.items():
            print(f"== {name}", flush=True)
            if name == beside:
                code = process.wait()
                said.seek(0)
                print(said.read().decode(errors="replace"), end="", flush=True)
            else:
                code = subprocess.run(command, cwd=ROOT, env=environment).returncode
            if code:
                failed.append(name)
                print(f"{name} failed", file=sys.stderr, flush=True)
    return failed


def quick_checks(folder: str) -> dict[str, list[str]]:
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
    try:
        folder = ensure_environment(".venv-test", extras="test,dev,docs", program="pytest", compiled=False)
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    python = program_path(folder, "python")
    steps = {**quick_checks(folder), "mypy": [program_path(folder, "mypy")]}
    if not fast and (shutil.which("oclgrind") or os.environ.get("CLRECON_REQUIRE_OCLGRIND")):
        steps["oclgrind"] = [python, os.path.join("scripts", "proof", "check_oclgrind.py")]
    # Much of the suite's time is the building of kernels, on one core.  Each process gets a part of the tests in order.
    # A process that is done takes half of the rest of another, so that none waits for the longest file.  A process that
    # crashes ends the run: pytest-xdist 3.8 would wait for ever for a process in its place.
    cores = min(os.cpu_count() or 1, MOST_PROCESSES)
    options = ["-n", str(cores), "--dist", "worksteal", "--max-worker-restart", "0"]
    spread = options if cores > 1 and not arguments else []
    # pytest comes last: its closing line is the closing line of this program
    steps["pytest"] = [python, "-m", "pytest", "-q", *spread, *arguments]
    environment = {**os.environ, "CLRECON_REQUIRE_TESTS": "1", "CLRECON_FAST_TESTS": "1" if fast else ""}
    # Hundreds of tests start a process that imports clrecon: it is compiled once, whatever the machine's habit.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    failed = run_steps(steps, environment, beside=("mypy" if fast else "oclgrind") if cores > 1 else "")
    if failed and failed != ["pytest"]:
        print(f"failed: {', '.join(failed)}", file=sys.stderr, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
