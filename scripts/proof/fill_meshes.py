#!/usr/bin/env python3
"""Fill decimated bones of five phantoms with tetrahedra, by TetGen and by gmsh, and print what both said of them.

    python scripts/proof/fill_meshes.py --peers-python PEERS/bin/python [KIND ...]

PEERS is a Python environment with `tetgen` and `gmsh`.  Both refuse surfaces that are open or cross themselves; the sum
of the tetrahedra is the volume of the surface where they have filled the right side of all of it.  Exit code 1 where
one was refused or its volume differs.  Beside each stands what both said of `collapse_quadric`, which promises nothing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import clrecon

PEER = Path(__file__).resolve().parents[1] / "bench" / "peers" / "mesh_solid.py"
KINDS = {"spine": 226.0, "contrast": 200.0, "skull": 300.0, "limb": 200.0, "pelvis": 200.0}
"""Phantoms, and the iso value of their surface in HU."""

GRID = ("--size", "192", "--slices", "80", "--spacing", "1.2", "1.2", "1.5", "--noise", "30")
DECIMATED = 0.9
MOST_PARTS_PER_MILLION = 1.0
"""Most difference of the volumes: both sum float64."""


def make_bone(kind: str, folder: Path) -> clrecon.Mesh:
    """Return the largest bone of a phantom, its cavities filled."""
    scan = folder / "scan"
    command = [sys.executable, "-m", "clrecon", "phantom", str(scan), "--kind", kind, *GRID]
    subprocess.run(command, check=True, capture_output=True)
    return clrecon.extract_isosurface(clrecon.read_volume(scan), KINDS[kind]).keep_largest(1)


def fill(mesher: str, mesh: clrecon.Mesh, folder: Path, python: str) -> tuple[str, bool]:
    """Return what a mesher said of a mesh, and whether that is all it should."""
    path = folder / "surface.npz"
    np.savez(path, vertices=mesh.vertices, triangles=mesh.triangles)
    ran = subprocess.run([python, str(PEER), mesher, str(path)], capture_output=True, text=True, cwd=folder)
    if ran.returncode:
        return f"ended with code {ran.returncode}", False
    facts = json.loads(ran.stdout.splitlines()[-1])
    if "error" in facts:
        return f"refused: {facts['error'][0]}", False
    apart = abs(facts["mm3"] / mesh.volume - 1.0)
    line = f"{facts['tetrahedra']:,} tetrahedra, {facts['flat']} flat, volume {1e6 * apart:.3f} ppm off"
    return line, 1e6 * apart <= MOST_PARTS_PER_MILLION


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", metavar="KIND", nargs="*", default=list(KINDS), help="phantoms (default: all five)")
    parser.add_argument("--peers-python", default=sys.executable, metavar="PYTHON", help="has tetgen and gmsh")
    options = parser.parse_args()
    unknown = set(options.kinds) - set(KINDS)
    if unknown:
        parser.error(f"no phantom {', '.join(sorted(unknown))}: use {', '.join(KINDS)}")
    failed = 0
    print("| phantom | triangles before | after | TetGen | gmsh |\n|---|---|---|---|---|", flush=True)
    for kind in options.kinds:
        with tempfile.TemporaryDirectory() as folder:
            bone = make_bone(kind, Path(folder))
            for decimate in (clrecon.decimate_mesh, clrecon.collapse_quadric):
                small = decimate(bone, DECIMATED)
                said = [fill(mesher, small, Path(folder), options.peers_python) for mesher in ("tetgen", "gmsh")]
                if decimate is clrecon.decimate_mesh:
                    failed += sum(not is_good for _, is_good in said)
                counts = f"{bone.triangle_count:,} | {small.triangle_count:,}"
                print(f"| {kind}, {decimate.__name__} | {counts} | {said[0][0]} | {said[1][0]} |", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
