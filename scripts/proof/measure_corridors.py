#!/usr/bin/env python3
"""How wide corridors through pedicles are beside the true bone: fitted to the cortex, at auto and at 200 HU.

    python scripts/proof/measure_corridors.py phantoms
    python scripts/proof/measure_corridors.py page

`phantoms` writes spines whose bone is known as a function, finds the corridors of L1 to L3 by `clrecon corridor`, and
keeps the figures in docs/benchmarks/levels; `page` writes them into docs/corridor.md.  It needs an OpenCL device.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "guide")]

from marked_tables import markdown_table, put_table  # noqa: E402

from clrecon.cli.main import main as run_command  # noqa: E402
from clrecon.proof.phantom import PhantomSettings, PhantomTruth, phantom_truth, write_phantom  # noqa: E402

FIGURES = ROOT / "docs" / "benchmarks" / "levels" / "corridors.json"
PAGE = ROOT / "docs" / "corridor.md"
TABLE = "corridors of phantoms"
LABELS = ("L1", "L2", "L3")
RULES = {"fitted": ("--surface", "cortex"), "auto": ("--hu", "auto"), "200 HU": ("--hu", "200")}
SPINES: dict[str, dict[str, Any]] = {
    "1 x 1 x 1.25 mm": {"spacing": (1.0, 1.0, 1.25)},
    "1 x 1 x 1.25 mm, noise 50 HU": {"spacing": (1.0, 1.0, 1.25), "noise": 50.0},
    "0.7 x 0.7 x 1 mm, scoliosis 20, tilt 8 degrees": {
        "spacing": (0.7, 0.7, 1.0), "scoliosis_deg": 20.0, "tilt": 8.0, "seed": 3,
    },
    "1.4 x 1.4 x 2 mm": {"spacing": (1.4, 1.4, 2.0)},
    "2 x 2 x 3 mm": {"spacing": (2.0, 2.0, 3.0)},
}  # fmt: skip
_WIDTH_MM = 150.0
_POINTS = 100
"""At so many points of a line its distance from the true bone surface is taken."""

Side = dict[str, Any]


def find_sides(scan: Path, rule: str, folder: Path) -> dict[str, Side]:
    """Return the corridors of a scan that were found, by label and side."""
    labels = [word for label in LABELS for word in ("--label", label)]
    report = folder / f"{rule}.json"
    command = ["corridor", str(scan), "--labels", str(scan / "levels.nrrd"), *labels, *RULES[rule], "-q"]
    run_command([*command, "--report", str(report)])
    return {
        f"{vertebra['label']} {side['side']}": side
        for vertebra in json.loads(report.read_text("utf-8"))["vertebrae"]
        for side in vertebra["corridors"]
        if side["refused"] is None
    }


def true_radius_mm(side: Side, truth: PhantomTruth) -> float:
    """Return how far the line of a corridor is from the true surface where it is nearest."""
    line = np.linspace(side["counted_from_mm"], side["tip_mm"], _POINTS)
    return -float(truth.signed_distance(line).max())


def measure_spine(name: str, folder: Path) -> list[dict[str, Any]]:
    """Measure the corridors of a spine by each rule."""
    changes = SPINES[name]
    size = round(_WIDTH_MM / changes["spacing"][0])
    settings = PhantomSettings(**{"levels": "T12-L4", "size": (size, size), "slices": None, **changes})
    write_phantom(folder / "ct", settings)
    truth = phantom_truth(settings)
    found = {rule: find_sides(folder / "ct", rule, folder) for rule in RULES}
    true = {rule: {side: true_radius_mm(line, truth) for side, line in sides.items()} for rule, sides in found.items()}
    rows = []
    for rule, sides in found.items():
        errors = [line["radius_mm"] - true[rule][side] for side, line in sides.items()]
        lost = [max(each.get(side, -np.inf) for each in true.values()) - true[rule][side] for side in sides]
        rows.append({
            "name": name, "rule": rule, "pedicles": len(sides), "refused": 2 * len(LABELS) - len(sides),
            "error_mm": [round(min(errors), 3), round(max(errors), 3)], "lost_mm": round(max(lost), 3),
        })  # fmt: skip
    return rows


def make_table(figures: list[dict[str, Any]]) -> str:
    """Return the table of the page."""
    rows = []
    for one in figures:
        low, high = one["error_mm"]
        rows.append((one["name"], one["rule"], one["pedicles"], f"{low:+.2f} to {high:+.2f}", f"{one['lost_mm']:.2f}"))
    return markdown_table(
        ("phantom", "surface", "pedicles", "error along the line, mm", "less than the best, mm"), rows
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("phantoms", "page"))
    if parser.parse_args().what == "phantoms":
        figures = []
        for name in SPINES:
            with tempfile.TemporaryDirectory() as folder:
                figures += measure_spine(name, Path(folder))
            print(*figures[-len(RULES) :], sep="\n", flush=True)
        FIGURES.write_text(json.dumps(figures, indent=1) + "\n", "utf-8")
    else:
        table = make_table(json.loads(FIGURES.read_text("utf-8")))
        PAGE.write_text(put_table(PAGE.read_text("utf-8"), TABLE, table), "utf-8")


if __name__ == "__main__":
    main()
