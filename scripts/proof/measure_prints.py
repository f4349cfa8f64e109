#!/usr/bin/env python3
"""Measure how far prints of phantoms lie from the true bone: the table of docs/printing.md.

    python scripts/proof/measure_prints.py [PHANTOM ...]

PHANTOM is a name of scripts/proof/level_phantoms.py; without one the four of the table are measured.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from level_phantoms import PHANTOMS, Phantom, draw_phantom, find_on_mesh, sample_profiles

import clrecon
from clrecon.cli.main import main as run_command
from clrecon.mesh.triangles import enclosed_ml

OF_THE_TABLE = ("1 mm, slices 1.25 mm", "slices 3 mm", "head", "pelvis with metal")


def measure_print(phantom: Phantom, surface: str, folder: Path) -> str:
    """Return a line about the print of all bones at 200 HU or, with the surface "cortex", fitted to it."""
    volume = draw_phantom(phantom)
    scan, mesh_path, report_path = folder / "ct.nii.gz", folder / "print.ply", folder / "print.json"
    volume.save(scan)
    command = ["mesh", str(scan), "-o", str(mesh_path), "--for", "print", "--all-parts", "--surface", surface, "-q"]
    code = run_command([*command, "--report", str(report_path)])
    mesh = clrecon.read_mesh(mesh_path)
    errors = find_on_mesh(sample_profiles(phantom, volume), mesh.vertices, mesh.triangles)[0]
    found = errors[np.isfinite(errors)]
    facts = json.loads(report_path.read_text())["meshes"][0]["print"]
    thin, thin_bone = (facts[name]["thin_share"] for name in ("wall", "bone_wall"))
    return (
        f"{phantom.name}, {surface}: exit code {code}, {found.mean():+.2f} mm, {np.abs(found).mean():.2f} mm off,"
        f" {1.0 - len(found) / len(errors):.1%} lost, walls below 1 mm {thin:.1%}, of the bone {thin_bone:.1%},"
        f" {enclosed_ml(mesh.vertices, mesh.triangles):.0f} ml"
    )


def main() -> int:
    names = sys.argv[1:] or OF_THE_TABLE
    for phantom in PHANTOMS:
        if phantom.name in names:
            for surface in ("hu", "cortex"):
                with tempfile.TemporaryDirectory() as folder:
                    print(measure_print(phantom, surface, Path(folder)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
