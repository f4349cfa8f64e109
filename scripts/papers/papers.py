#!/usr/bin/env python3
"""Make the tables of both papers again, and the page docs/papers.md from them.

    papers.py run --work FOLDER [--paper-a CT_FOLDER] [--only NAME]...
    papers.py page

`run` makes the series, runs `clrecon compare` on each and keeps its figures in docs/papers; keep the machine quiet.
`page` writes docs/papers.md from them and from the table of functions.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parent)]

from paper_functions import ROOT, load_functions  # noqa: E402
from paper_page import make_page  # noqa: E402
from paper_sets import SETS, PaperSet, keep_figures  # noqa: E402

FIGURES = ROOT / "docs" / "papers"
PAGE = ROOT / "docs" / "papers.md"
GROWING = "growing"
SEEDED = (1, 2, 3, 4, 5, 12, 17)
"""Numbers of vertebrae of the series of 17 that hold seeds."""


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="measure")
    run.add_argument("--work", type=Path, required=True, help="folder for the series and the reports")
    run.add_argument("--paper-a", type=Path, help="CT folder that stands for the scan of paper A")
    run.add_argument("--only", action="append", choices=[*SETS, GROWING], default=[])
    run.add_argument("--device", default="0")
    commands.add_parser("page", help="write docs/papers.md")
    told = parser.parse_args()
    if told.command == "page":
        PAGE.write_text(make_page_from(FIGURES), encoding="utf-8")
        return 0
    told.work.mkdir(parents=True, exist_ok=True)
    for name in told.only or [*SETS, GROWING]:
        if name == GROWING:
            figures = measure_growing(make_series(SETS["b559"], told.work), told.device)
        else:
            folder = told.paper_a if name == "a" and told.paper_a else make_series(SETS[name], told.work)
            figures = keep_figures(compare(SETS[name], folder, told.work, told.device))
        FIGURES.mkdir(exist_ok=True)
        write_json(FIGURES / f"{name}.json", figures)
    return 0


def make_page_from(folder: Path) -> str:
    """Return the text of the page from the figures in `folder`."""
    reports = {name: json.loads((folder / f"{name}.json").read_text(encoding="utf-8")) for name in SETS}
    growing = json.loads((folder / f"{GROWING}.json").read_text(encoding="utf-8"))
    return make_page(reports, growing, load_functions())


def write_json(path: Path, figures: dict[str, Any]) -> None:
    """Write figures with four digits: more would be noise."""
    path.write_text(json.dumps(_round(figures), indent=1) + "\n", encoding="utf-8")


def _round(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        return {name: _round(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_round(each) for each in value]
    return value


def make_series(wanted: PaperSet, work: Path) -> Path:
    """Make the series of a set, once, and return its folder."""
    folder = work / wanted.name
    if not (folder / "truth.json").is_file():
        _clrecon("phantom", str(folder), *wanted.phantom)
    return folder


def compare(wanted: PaperSet, series: Path, work: Path, device: str) -> dict[str, Any]:
    """Run ``clrecon compare`` and return its report."""
    output = work / f"{wanted.name}-report"
    shutil.rmtree(output, ignore_errors=True)
    options = ["--hu", f"{wanted.iso_value:g}", "--device", device]
    options += ["--methods", ",".join(wanted.methods)] if wanted.methods else []
    options += ["--paper"] if wanted.paper else []
    options += ["--truth", str(series / "truth.json")] if wanted.truth else []
    _clrecon("compare", str(series), "-o", str(output), *options)
    report: dict[str, Any] = json.loads((output / "report.json").read_text(encoding="utf-8"))
    return report


def _clrecon(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "clrecon", *arguments], check=True)


def measure_growing(series: Path, device: str) -> dict[str, Any]:
    """Grow surfaces from seeds in some of the vertebrae; cells visited and times beside that of the whole surface."""
    import clrecon

    level = SETS["b559"].iso_value
    volume = clrecon.read_volume(series)
    labels = clrecon.read_labels(series / "levels.nrrd")
    with clrecon.DeviceVolume(volume, device=device) as resident:
        whole = _median_time(lambda: clrecon.extract_isosurface(resident, level))
        rows = []
        for count in SEEDED:
            seeds = [tip_of(labels, number) for number in labels.numbers[:count]]
            mesh = clrecon.extract_isosurface(resident, level, grow_from=seeds)
            seconds = _median_time(lambda seeds=seeds: clrecon.extract_isosurface(resident, level, grow_from=seeds))
            cells = mesh.report["cells"]
            rows.append(
                {"vertebrae": count, "cells_visited": cells["visited"], "cells_all": cells["all"], "warm_s": seconds}
            )
    return {"whole_s": whole, "rows": rows}


def tip_of(labels: Any, number: int) -> list[float]:
    """Return the hindmost voxel of a label in mm: the tip of a spinous process, on the outer surface of the bone."""
    import numpy as np

    from clrecon.geometry.affine import apply_affine

    k, j, i = np.nonzero(labels.voxels == number)
    last = int(np.argmax(j))
    return [float(x) for x in apply_affine(labels.affine, [[i[last], j[last], k[last]]])[0]]


def _median_time(run: Any, runs: int = 5) -> float:
    run()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return median(times)


if __name__ == "__main__":
    sys.exit(main())
