#!/usr/bin/env python3
"""Run what a release needs, which is more than `.ci/run`, and list it.

    python scripts/release_checks.py [--list] [NAME ...]

NAME is one of the checks that --list names; without one all run, in their order.  What they keep (results of changed
code, so that an ended run goes on) goes to build/release.  The exit status is 1 if one fails.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
KEPT = ROOT / "build" / "release"


@dataclass(frozen=True)
class ReleaseCheck:
    """A check: what it holds, its command in the folder of the project (a script or a program), and its variables."""

    holds: str
    command: Sequence[str]
    variables: dict[str, str] = field(default_factory=dict)


CHECKS = {
    "tests": ReleaseCheck(
        "all that .ci/run checks, with the tests marked release: every check of the self-test and every test of an"
        " operator on every device, where .ci/run asks further devices checks of most rooms; the tools of"
        " a release (changed code, benches, the site of the Guide), and the truths of twins that devices reach"
        " every day; all types of voxels, products of parameters, odd bodies, real scans and pages of the Guide,"
        " of which .ci/run tries a few that differ; the methods of the comparison in processes of their own; a"
        " wheel that is built and installed; and the coverage",
        (".ci/run",),
        {"CLRECON_RELEASE_TESTS": "1", "CLRECON_COVERAGE": "1"},
    ),
    "package": ReleaseCheck(
        "the source distribution holds the whole project, the wheel built from it is pure Python and has full metadata,"
        " and writes a mesh from an environment of its own; needs the extra release and the package index",
        ("scripts/proof/check_package.py", str(KEPT / "package")),
    ),
    "versions": ReleaseCheck(
        "quick tests under each Python with the newest libraries, and with the oldest under the oldest: the table in"
        " docs/guide/development/releases.md; needs uv, of the extra release, and the package index",
        ("scripts/proof/check_versions.py",),
    ),
    "kernels": ReleaseCheck(
        "every mutation of every kernel is caught by the self-test, where .ci/run draws a few; on PoCL 3.1",
        ("scripts/proof/mutate_kernels.py", "--device", "0", "--results", str(KEPT / "kernels.json")),
    ),
    "gpu": ReleaseCheck(
        "what compilers for cards of NVIDIA, AMD and Intel make of every kernel: nothing spilled, no more memory and no"
        " fewer lanes than recorded; needs Debian 12, where .ci/run looks at the largest kernels with what is there",
        ("scripts/proof/check_gpu.py", "--tools", str(KEPT / "gpu_tools"), "--fetch"),
    ),
    "python": ReleaseCheck(
        "at most 5 % of the changes of a room survive its tests; needs the extra mutation",
        ("scripts/proof/mutate_python.py", "--changes", "70", "--json", str(KEPT / "changes.json"), "--resume"),
        {"CLRECON_TEST_DEVICE": "0"},
    ),
    "fuzz": ReleaseCheck(
        "ten minutes of harmed input without a fault, where .ci/run tries the first cases of each family",
        ("scripts/fuzz/fuzz.py", "--seconds", "600"),
    ),
    "outliers": ReleaseCheck(
        "every command with its common options ends on an ugly scan, and the table says which take over five seconds or"
        " three times their peer: docs/benchmarks.md; needs SimpleITK and pyvista for the peers",
        ("scripts/bench/outliers.py", "--json", str(KEPT / "outliers.json")),
    ),
}


def main(argv: Sequence[str] | None = None, *, checks: Mapping[str, ReleaseCheck] = CHECKS, kept: Path = KEPT) -> int:
    """Run the checks that are named on the command line, or list all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="say what each check holds, and run none")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(checks))
    options = parser.parse_args(argv)
    if unknown := [name for name in options.names if name not in checks]:
        parser.error(f"no check {unknown[0]!r}: there are {', '.join(checks)}")
    if options.list:
        for name, check in checks.items():
            said = [f"{variable}={value}" for variable, value in check.variables.items()]
            print(f"{name}: {check.holds}\n    {' '.join([*said, *check.command])}")
        return 0
    kept.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in options.names or checks:
        check = checks[name]
        print(f"== {name}: {check.holds}", flush=True)
        environment = {**os.environ, **check.variables}
        python = [sys.executable] if check.command[0].endswith(".py") else []
        if subprocess.run([*python, *check.command], cwd=ROOT, env=environment).returncode:
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
