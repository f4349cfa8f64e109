#!/usr/bin/env python3
"""Many scans by `clrecon batch` and by a shell loop of `clrecon mesh`: processor seconds of both, and the same meshes.

    python scripts/bench/batches.py [--cases 12] [--pairs 3]

The scans are phantoms.  The second table is a batch on one worker of a Dask cluster beside one process.  The figures
are kept in docs/benchmarks/batch.json.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"
ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).resolve().parent)]

from measure import describe_machine, write_json  # noqa: E402
from wall_and_cpu import alternate_twice  # noqa: E402

FIGURES = ROOT / "docs" / "benchmarks" / "batch.json"
PHANTOM = ("--size", "96", "--slices", "40", "--spacing", "2", "2", "2.5")


def run_clrecon(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "clrecon", *map(str, arguments), "-q"], cwd=ROOT, check=True)


class Cohort:
    """So many phantoms in a folder, their manifest, and the ways to make their meshes."""

    def __init__(self, folder: Path, cases: int):
        self.folder = folder
        self.scans = [folder / f"p{number}" for number in range(1, cases + 1)]
        for number, scan in enumerate(self.scans, start=1):
            run_clrecon("phantom", scan, *PHANTOM, "--seed", str(number))
        rows = [f"{scan.name},{scan.name}\n" for scan in self.scans]
        (folder / "m.csv").write_text("".join(["case,input\n", *rows]))

    def make_batch(self, *options: str) -> None:
        run_clrecon("batch", self.folder / "m.csv", "-o", self.folder / "out", "--hu", "300", *options)

    def make_in_loop(self, measured: bool, pictured: bool) -> None:
        for scan in self.scans:
            mesh = scan.with_suffix(".stl")
            report = ("--report", scan.with_suffix(".json")) if measured else ()
            run_clrecon("mesh", scan, "-o", mesh, "--hu", "300", *report)
            if pictured:
                run_clrecon("render", mesh, "--mode", "mesh", "--size", "360", "-o", scan.with_suffix(".png"))

    def check_meshes(self) -> None:
        """Raise an error unless both ways have written the same bytes."""
        for scan in self.scans:
            if scan.with_suffix(".stl").read_bytes() != (self.folder / "out" / scan.name / "mesh.stl").read_bytes():
                raise SystemExit(f"the meshes of {scan.name} differ")


def measure_loops(cohort: Cohort, pairs: int) -> dict[str, Any]:
    """Time the batch beside the loop: meshes alone, with measures, and with measures and pictures."""
    ways = {
        "meshes": (("--no-measure", "--no-picture"), False, False),
        "meshes and measures": (("--no-picture",), True, False),
        "meshes, measures and pictures": ((), True, True),
    }
    figures = {}
    for name, (options, measured, pictured) in ways.items():
        figures[name] = alternate_twice(
            lambda options=options: cohort.make_batch(*options),  # type: ignore[misc]
            lambda measured=measured, pictured=pictured: cohort.make_in_loop(measured, pictured),  # type: ignore[misc]
            pairs,
        )
        cohort.check_meshes()
    return figures


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--pairs", type=int, default=3)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        cohort = Cohort(Path(folder), options.cases)
        figures: dict[str, Any] = {
            "machine": describe_machine(),
            "cases": options.cases,
            "phantom": " ".join(PHANTOM),
            "loop": measure_loops(cohort, options.pairs),
            "cluster": alternate_twice(
                lambda: cohort.make_batch("--no-picture", "--scheduler", "local"),
                lambda: cohort.make_batch("--no-picture"),
                options.pairs,
            ),
        }
    write_json(FIGURES, figures)
    for name, result in {**figures["loop"], "cluster beside one process": figures["cluster"]}.items():
        print(name, result["cpu"])


if __name__ == "__main__":
    main()
