#!/usr/bin/env python3
"""Run quick tests under each Python with the oldest and the newest allowed libraries, and keep what ran.

    python scripts/proof/check_versions.py [--only PYTHON ...] [--table]

Needs uv, of the extra release, which brings the Pythons that the machine lacks.  The environments are made from
setup.cfg alone and removed again: the newest libraries under every Python, and the oldest that setup.cfg allows under
the oldest.  What came of each goes to docs/benchmarks/versions.json, and from there to the table of
docs/guide/development/releases.md; --table writes that table alone.  The exit status is 1 if a run failed; a Python
that could not be had is said in the table.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "guide"))

from marked_tables import markdown_table, put_table  # noqa: E402

PAGE = ROOT / "docs" / "guide" / "development" / "releases.md"
FIGURES = ROOT / "docs" / "benchmarks" / "versions.json"
RUNS = [("3.10", "lowest-direct"), *((python, "highest") for python in ("3.10", "3.11", "3.12", "3.13", "3.14"))]
"""Pythons, and which libraries uv chooses: with lowest-direct those of setup.cfg are the oldest that it allows."""
LIBRARIES = ("numpy", "pydicom", "pyopencl", "scikit-image", "pyvista")
QUICK = (
    "tests/geometry",
    "tests/reading/dicom/test_elements.py",
    "tests/reading/dicom/test_pixels.py",
    "tests/exchange/test_mesh_files.py",
    "tests/operators/surface/test_isosurface.py",
    "tests/operators/rays/test_raycast_values.py",
    "tests/mesh/refine/test_decimation.py",
)
"""Tests of what each of these libraries is used for."""
COUNT = re.compile(r"(\d+) (passed|failed|skipped|errors?)\b")


def _uv(*arguments: str) -> str:
    """Run uv, and return its last line: nothing where it did its work."""
    done = subprocess.run(["uv", *arguments], cwd=ROOT, capture_output=True, text=True)
    if not done.returncode:
        return ""
    lines = done.stderr.strip().splitlines() or ["no word"]
    return next((line for line in lines if line.startswith("error")), lines[-1])


def try_run(python: str, resolution: str, folder: Path) -> dict[str, Any]:
    """Return what came of the quick tests under one Python, with an environment in `folder`."""
    run: dict[str, Any] = {"python": python, "libraries": "oldest" if resolution == "lowest-direct" else "newest"}
    program = str(folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python"))
    install = ["pip", "install", "--quiet", "--python", program, "-r", "setup.cfg"]
    # Programs of the tests have no lower bounds that hold for themselves: they are the newest that go with the rest.
    for stage, arguments in {
        "Python": ["venv", "--quiet", "--python", python, str(folder)],
        "libraries": [*install, "--resolution", resolution],
        "test programs": [*install, "--extra", "test"],
    }.items():
        if fault := _uv(*arguments):
            return {**run, "not_run": f"no {stage} here", "uv": fault}
    ask = f"from importlib.metadata import version; print(*map(version, {LIBRARIES}))"
    versions = subprocess.run([program, "-c", ask], capture_output=True, text=True, check=True).stdout.split()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CLRECON_FAST_TESTS": "1", "CLRECON_REQUIRE_DEVICE": "1"}
    command = [program, "-m", "pytest", "-q", "--assert=plain", "-p", "no:cacheprovider", *QUICK]
    started = time.monotonic()
    said = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True).stdout
    counts = {word.rstrip("s") if word == "errors" else word: int(number) for number, word in COUNT.findall(said)}
    if not counts:  # pytest itself ended
        counts["error"] = 1
    failed = [line.partition(" - ")[0] for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    seconds = round(time.monotonic() - started)
    return {
        **run,
        "versions": dict(zip(LIBRARIES, versions, strict=True)),
        **counts,
        "seconds": seconds,
        "lines": failed,
    }


def make_table(runs: Sequence[dict[str, Any]]) -> str:
    """Return the table of runs, with what did not run."""
    rows = []
    for run in runs:
        versions = run.get("versions", {})
        counts = [f"{run[word]} {word}" for word in ("passed", "failed", "error", "skipped") if run.get(word)]
        cells = [versions.get(library, "-") for library in LIBRARIES]
        rows.append([run["python"], run["libraries"], *cells, ", ".join(counts) or f"not run: {run['not_run']}"])
    return markdown_table(["Python", "libraries", *LIBRARIES, "quick tests"], rows)


def main(argv: Sequence[str] | None = None, figures: Path = FIGURES, page: Path = PAGE) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="*", default=[], metavar="PYTHON", help="3.10, for example")
    parser.add_argument("--table", action="store_true", help="write the table of the kept figures, and run nothing")
    options = parser.parse_args(argv)
    kept = json.loads(figures.read_text(encoding="utf-8")) if figures.exists() else []
    done = {(run["python"], run["libraries"]): run for run in kept}

    def in_order() -> list[dict[str, Any]]:
        return sorted(done.values(), key=lambda run: (run["libraries"] != "oldest", run["python"]))

    tried = []
    for python, resolution in [] if options.table else RUNS:
        if options.only and python not in options.only:
            continue
        with tempfile.TemporaryDirectory() as temporary:
            run = try_run(python, resolution, Path(temporary, "environment"))
        tried.append(run)
        print(json.dumps(run), flush=True)
        done[run["python"], run["libraries"]] = run
        figures.write_text(json.dumps(in_order(), indent=1) + "\n", encoding="utf-8")
    text = page.read_text(encoding="utf-8")
    page.write_text(put_table(text, "versions", make_table(in_order())), encoding="utf-8")
    return 1 if any(run.get("failed") or run.get("error") for run in tried) else 0


if __name__ == "__main__":
    sys.exit(main())
