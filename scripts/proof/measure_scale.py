#!/usr/bin/env python3
"""Count how often the gate ``hu_scale`` notices values that were shifted or stretched: a table of docs/certificate.md.

    python scripts/proof/measure_scale.py [SCAN ...]
    python scripts/proof/measure_scale.py page

The first tries phantoms of bodies and these scans, prints a line each and keeps the counts in
docs/benchmarks/scales.json; the second puts them into the page.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "guide"))

from marked_tables import markdown_table, put_table  # noqa: E402

import clrecon  # noqa: E402
from clrecon.proof.phantom import PhantomSettings, write_phantom  # noqa: E402
from clrecon.reading.common.plausibility import examine_voxels  # noqa: E402
from clrecon.reading.common.source_facts import PixelFacts  # noqa: E402

HEADS = ["values", "scans in which `hu_scale` fails"]
PAGE, FIGURES = ROOT / "docs" / "certificate.md", ROOT / "docs" / "benchmarks" / "scales.json"

PHANTOMS = [
    PhantomSettings(kind="hand"),
    PhantomSettings(kind="hand", seed=2, noise=40.0, spacing=(0.9, 0.9, 1.2)),
    PhantomSettings(kind="hand", spacing=(1.5, 1.5, 3.0)),
    PhantomSettings(kind="pair"),
    PhantomSettings(kind="pair", seed=6, spacing=(1.5, 1.5, 3.0), size=(300, 200)),
    *(PhantomSettings(kind=kind) for kind in ("hip", "mouse", "limb", "pelvis", "spine", "contrast")),
]
CHANGES: dict[str, tuple[float, float]] = {
    "unchanged": (1.0, 0.0),
    **{f"{shift:+d} HU": (1.0, shift) for shift in (-1024, -324, -150, -100, 100, 150, 200, 324, 500, 800, 1024)},
    **{f"HU x {slope:g}": (slope, 0.0) for slope in (0.5, 0.8, 1.2, 2.0)},
    "HU x 0.5, air still at -1000 HU": (0.5, -500.0),
    "HU x 1.5, air still at -1000 HU": (1.5, 500.0),
    "HU x 0.6 + 400": (0.6, 400.0),
    "HU x 10 + 20,000": (10.0, 20_000.0),
}
"""Slope and offset that HU are multiplied with and moved by."""


def is_noticed(voxels: NDArray[np.float32], padding: float | None) -> bool:
    """Tell whether values that are called HU are judged to be none."""
    facts = PixelFacts(0.0, float(voxels.min()), float(voxels.max()), padding)
    return any(
        gate.name == "hu_scale" and gate.ok is False for gate in examine_voxels(voxels, facts, (), known=True).gates
    )


def try_scan(scan: Path) -> dict[str, bool]:
    volume = clrecon.read_volume(scan)
    hu, padding = volume.voxels.astype(np.float32), volume.report.get("padding_hu")
    return {
        name: is_noticed(
            hu * np.float32(slope) + np.float32(offset), None if padding is None else padding * slope + offset
        )
        for name, (slope, offset) in CHANGES.items()
    }


def main(arguments: list[str]) -> int:
    if arguments == ["page"]:
        figures = json.loads(FIGURES.read_text(encoding="utf-8"))
        rows = [[name, f"{figures['noticed'][name]} of {figures['scans']}"] for name in CHANGES]
        text = put_table(PAGE.read_text(encoding="utf-8"), "other scales", markdown_table(HEADS, rows))
        PAGE.write_text(text, encoding="utf-8")
        return 0
    found = []
    with tempfile.TemporaryDirectory() as name:
        scans = [Path(name) / str(k) for k in range(len(PHANTOMS))]
        for folder, settings in zip(scans, PHANTOMS, strict=True):
            write_phantom(folder, settings)
        for scan in [*scans, *map(Path, arguments)]:
            found.append(try_scan(scan))
            print(scan.name, ", ".join(change for change, noticed in found[-1].items() if noticed), flush=True)
    noticed = {change: sum(one[change] for one in found) for change in CHANGES}
    FIGURES.write_text(json.dumps({"scans": len(found), "noticed": noticed}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
