#!/usr/bin/env python3
"""Measure how far prints of phantoms lie from the true bone: the table of docs/printing.md.

    python scripts/proof/measure_prints.py phantoms
    python scripts/proof/measure_prints.py page

`phantoms` makes `--for print` of all bones at 200 HU and fitted to the cortex, and keeps the figures in
docs/benchmarks/levels; `page` writes them into docs/printing.md.  It needs an OpenCL device.
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
sys.path[:0] = [str(ROOT), str(Path(__file__).parent), str(ROOT / "scripts" / "guide")]

from level_phantoms import PHANTOMS, Phantom, draw_phantom, find_on_mesh, sample_profiles  # noqa: E402
from marked_tables import markdown_table, put_table  # noqa: E402

import clrecon  # noqa: E402
from clrecon.cli.main import main as run_command  # noqa: E402
from clrecon.mesh.triangles import enclosed_ml  # noqa: E402

FIGURES = ROOT / "docs" / "benchmarks" / "levels" / "prints.json"
PAGE = ROOT / "docs" / "printing.md"
TABLE = "prints of phantoms"
PRINTED = {
    "1 mm, slices 1.25 mm": "spine, slices 1.25 mm",
    "slices 3 mm": "spine, slices 3 mm",
    "head": "head, slices 1.5 mm",
    "pelvis with metal": "pelvis with metal",
}
"""Phantoms of `level_phantoms.py`, and their names on the page."""
SURFACES = {"hu": "200 HU", "cortex": "`--surface cortex`"}


def measure_print(phantom: Phantom, surface: str, folder: Path) -> dict[str, Any]:
    """Measure the print of all bones at 200 HU or, with the surface "cortex", fitted to it."""
    volume = draw_phantom(phantom)
    scan, mesh_path, report_path = folder / "ct.nii.gz", folder / "print.ply", folder / "print.json"
    volume.save(scan)
    command = ["mesh", str(scan), "-o", str(mesh_path), "--for", "print", "--all-parts", "--surface", surface, "-q"]
    code = run_command([*command, "--report", str(report_path)])
    mesh = clrecon.read_mesh(mesh_path)
    errors = find_on_mesh(sample_profiles(phantom, volume), mesh.vertices, mesh.triangles)[0]
    found = errors[np.isfinite(errors)]
    facts = json.loads(report_path.read_text())["meshes"][0]["print"]
    return {
        "exit_code": code,
        "bias_mm": round(float(found.mean()), 3),
        "mean_mm": round(float(np.abs(found).mean()), 3),
        "lost_share": round(1.0 - len(found) / len(errors), 4),
        **{f"thin_{name}": round(facts[name]["thin_share"], 4) for name in ("wall", "bone_wall")},
        "volume_ml": round(enclosed_ml(mesh.vertices, mesh.triangles), 1),
    }


def measure_phantoms() -> list[dict[str, Any]]:
    """Measure the prints of the table."""
    rows = []
    for phantom in [phantom for phantom in PHANTOMS if phantom.name in PRINTED]:
        row: dict[str, Any] = {"name": phantom.name}
        for surface in SURFACES:
            with tempfile.TemporaryDirectory() as folder:
                row[surface] = measure_print(phantom, surface, Path(folder))
            print(phantom.name, surface, row[surface], flush=True)
        rows.append(row)
    return rows


def _cell(one: dict[str, Any]) -> str:
    lost, thin, thin_bone = (100.0 * one[name] for name in ("lost_share", "thin_wall", "thin_bone_wall"))
    off = f"{one['bias_mm']:+.2f}, {one['mean_mm']:.2f}"
    return f"{off}, {lost:.1f} %, {thin:.1f} and {thin_bone:.1f} %, {one['volume_ml']:.0f} ml"


def make_table(figures: list[dict[str, Any]]) -> str:
    """Return the table of the page."""
    rows = [(PRINTED[one["name"]], *(_cell(one[surface]) for surface in SURFACES)) for one in figures]
    return markdown_table(("print of", *SURFACES.values()), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("phantoms", "page"))
    if parser.parse_args().what == "phantoms":
        FIGURES.write_text(json.dumps(measure_phantoms(), indent=1) + "\n", "utf-8")
    else:
        table = make_table(json.loads(FIGURES.read_text("utf-8")))
        PAGE.write_text(put_table(PAGE.read_text("utf-8"), TABLE, table), "utf-8")


if __name__ == "__main__":
    main()
