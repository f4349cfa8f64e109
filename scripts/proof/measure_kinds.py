#!/usr/bin/env python3
"""Measure what commands make of phantoms of kinds of scan, against their truth: the table of docs/scans.md.

    python scripts/proof/measure_kinds.py [KIND ...]
    python scripts/proof/measure_kinds.py page

The first prints a line a mesh and keeps the figures in docs/benchmarks/kinds.json, the second puts them into the page.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "guide"))

from marked_tables import markdown_table, put_table  # noqa: E402

import clrecon  # noqa: E402
from clrecon.cli.main import main as run_command  # noqa: E402
from clrecon.labels import read_labels  # noqa: E402
from clrecon.proof.phantom import MATERIALS, PhantomSettings, write_phantom  # noqa: E402
from clrecon.proof.phantom.scene_plans import plan_scene  # noqa: E402
from clrecon.proof.phantom.scenes import bone_depth  # noqa: E402

PAGE, FIGURES = ROOT / "docs" / "scans.md", ROOT / "docs" / "benchmarks" / "kinds.json"

WAYS: dict[str, dict[str, str]] = {
    "jaw": {
        "default": "",
        "auto": "--hu auto",
        "print": "--for print --hu 930 --all-parts",
        "print in HU": "--for print --hu auto --all-parts --rescale 1.25,-1717.5",
    },
    "longbone": {"default": "", "auto": "--hu auto", "print": "--for print --hu 520 --all-parts"},
    "hand": {
        "default": "",
        "auto": "--hu auto",
        "without table": "--remove-table --hu auto",
        "print": "--for print --hu auto --all-parts",
    },
    "pair": {
        "default": "",
        "auto": "--hu auto",
        "without table": "--remove-table --hu auto",
        "print": "--for print --hu auto --all-parts",
    },
    "hip": {
        "default": "",
        "auto": "--hu auto",
        "print": "--for print --hu auto --all-parts --seal 1",
        "default print": "--for print --hu auto --all-parts",
    },
    "mouse": {
        "default": "",
        "auto": "--hu auto",
        "without table": "--remove-table --hu auto",
        "print": "--for print --hu auto --all-parts",
    },
}
"""The options of `clrecon mesh` that are tried on each kind; a default may be wrong, and says why."""

HARD = ("bone", "metal")


def enclosed_by(hard: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what is hard or cut off by it from the four sides of the stack; its two ends close canals."""
    from scipy import ndimage

    padded = np.pad(~hard, ((0, 0), (1, 1), (1, 1)), constant_values=True)
    outside = ndimage.label(padded)[0]
    inside: NDArray[np.bool_] = outside[:, 1:-1, 1:-1] != outside[0, 0, 0]
    return inside


def measure_way(scan: Path, settings: PhantomSettings, options: str, folder: Path, device: str = "") -> dict[str, Any]:
    """Make a mesh with these options and compare it with the truth of the scan."""
    mesh_path, report_path = folder / "mesh.ply", folder / "mesh.json"
    for path in (mesh_path, report_path):
        path.unlink(missing_ok=True)
    command = ["mesh", str(scan), "-o", str(mesh_path), *options.split(), "--report", str(report_path), "-q"]
    code = run_command([*command, "--device", device] if device else command)
    if not mesh_path.exists():
        return {"code": code}
    report, mesh = json.loads(report_path.read_text()), clrecon.read_mesh(mesh_path)
    labels = read_labels(scan / "materials.nrrd").voxels
    hard = np.isin(labels, [MATERIALS.index(name) for name in HARD])
    voxel_ml = float(np.prod(settings.spacing)) / 1000.0
    solid = "print" in options
    true_ml = voxel_ml * int((enclosed_by(hard) if solid else hard).sum())
    # caps at the ends of the volume are no surface of bone
    volume = clrecon.read_volume(scan)
    ijk = volume.lps_to_ijk(mesh.vertices.astype(np.float64))
    free = ((ijk > 1.0) & (ijk < np.array(volume.shape_ijk) - 2.0)).all(axis=1)
    depth = bone_depth(plan_scene(settings), mesh.vertices[free].astype(np.float64), *HARD)
    gates = report["volume"]["gates"] + report["gates"]
    return {
        "code": code,
        "level": report["iso_value_hu"],
        "volume_ml": round(report["volume_ml"], 6),
        "true_ml": round(true_ml, 6),
        "off_voxels": round(float(np.median(np.abs(depth)) / min(settings.spacing)), 3),
        "closed": report["closed"],
        "failed": [gate["name"] for gate in gates if gate["ok"] is False],
        "warnings": report["warnings"],
    }


def volume_error(found: dict[str, Any]) -> float:
    """Return how much larger the volume of a mesh is than the true one, as a share."""
    return float(found["volume_ml"] / found["true_ml"] - 1.0)


def said_of(found: dict[str, Any]) -> str:
    """Name in a few words what gates and warnings say of a mesh."""
    words = {
        "not HU": ("hu_scale", "hu_known", "not known to be HU"),
        "metal": ("metal",),
        "a part is not bone": ("in part no bone",),
        "volume too large": ("too large",),
        "filled beside metal": ("filled lie beside",),
    }
    texts = " ".join([*found["failed"], *found["warnings"]])
    return ", ".join(name for name, parts in words.items() if any(part in texts for part in parts))


def make_table(figures: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the table of the page."""
    rows = []
    for kind, ways in figures.items():
        for way, found in ways.items():
            options = f"`{WAYS[kind][way]}`" if WAYS[kind][way] else "none"
            if "true_ml" not in found:
                rows.append([kind, options, found["code"], "", "", "", ""])
                continue
            off = f"{100.0 * volume_error(found):+.1f} %"
            rows.append([kind, options, found["code"], f"{found['level']:g}", off, found["off_voxels"], said_of(found)])
    heads = ["scan", "options", "exit code", "level", "volume error", "distance, voxels", "warnings"]
    return markdown_table(heads, rows)


def main(names: list[str]) -> int:
    if names == ["page"]:
        text = PAGE.read_text(encoding="utf-8")
        table = make_table(json.loads(FIGURES.read_text(encoding="utf-8")))
        PAGE.write_text(put_table(text, "kinds of scan", table), encoding="utf-8")
        return 0
    figures = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.exists() else {}
    with tempfile.TemporaryDirectory() as name:
        for kind in names or list(WAYS):
            settings, scan = PhantomSettings(kind=kind), Path(name) / kind
            write_phantom(scan, settings)
            figures[kind] = {}
            for way, options in WAYS[kind].items():
                found = figures[kind][way] = measure_way(scan, settings, options, Path(name))
                print(kind, way, json.dumps({k: v for k, v in found.items() if k != "warnings"}))
    FIGURES.write_text(json.dumps({k: figures[k] for k in WAYS if k in figures}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
