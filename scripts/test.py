#!/usr/bin/env python3
"""Make .venv-test, then run ruff, mypy, the Oclgrind check (where oclgrind is installed) and the tests.

    python3 scripts/test.py [--fast] [PYTEST ARGUMENTS]

--fast leaves out the tests marked slow and the Oclgrind check.  Everything else goes to pytest; without such arguments
the whole suite runs in as many processes as there are cores, four at most.  The exit status is not 0 when any of the
four fails, or when no test ran.  See CONTRIBUTING.md for the variables that choose devices.
"""

import os
import sys

if sys.version_info < (3, 10):
    sys.exit("clrecon needs Python 3.10 or newer, this is %s (%s)" % (sys.version.split()[0], sys.executable))  # noqa: UP031

import shutil
import subprocess

from _environment import ROOT, SetupError, ensure_environment, program_path

MOST_PROCESSES = 4


def main() -> int:
    arguments = sys.argv[1:]
    if arguments[:1] in (["-h"], ["--help"]):
        print(__doc__.strip())
        return 0
    fast = "--fast" in arguments
    arguments = [argument for argument in arguments if argument != "--fast"]
    try:
        folder = ensure_environment(".venv-test", extras="test,dev", program="pytest")
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    python = program_path(folder, "python")
    steps = {
        "ruff": [program_path(folder, "ruff"), "check", "."],
        "mypy": [program_path(folder, "mypy")],
    }
    if not fast and (shutil.which("oclgrind") or os.environ.get("CLRECON_REQUIRE_OCLGRIND")):
        steps["oclgrind"] = [python, os.path.join("scripts", "check_oclgrind.py")]
    # Kernels are built on one core: much of the suite is that.  A file of tests stays in one process.  A process that
    # crashes ends the run, as it does without others: pytest-xdist 3.8 waits for ever for what took its place.
    cores = min(os.cpu_count() or 1, MOST_PROCESSES)
    options = ["-n", str(cores), "--dist", "loadfile", "--max-worker-restart", "0"]
    spread = options if cores > 1 and not arguments else []
    # pytest comes last: its closing line is the closing line of this program
    steps["pytest"] = [python, "-m", "pytest", "-q", *spread, *(["-m", "not slow"] if fast else []), *arguments]
    environment = {**os.environ, "CLRECON_REQUIRE_TESTS": "1"}
    failed = []
    for name, command in steps.items():
        print(f"== {name}", flush=True)
        if subprocess.run(command, cwd=ROOT, env=environment).returncode:
            failed.append(name)
            print(f"{name} failed", file=sys.stderr, flush=True)
    if failed and failed != ["pytest"]:
        print(f"failed: {', '.join(failed)}", file=sys.stderr, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
