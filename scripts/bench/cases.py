"""The benches: each measures clrecon beside its strongest peer in one run, on one input."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measure import alternate, run_program, summarise

__all__ = ["CASES"]

PEERS = Path(__file__).resolve().parent / "peers"


def _make_phantom(folder: Path, slices: int) -> Path:
    print(f"making a spine phantom of 512 x 512 x {slices} ...", file=sys.stderr)
    run_program([sys.executable, "-m", "clrecon", "phantom", str(folder), "--kind", "spine", "--size", "512",
                 "--slices", str(slices), "--spacing", "0.7", "0.7", "1.0", "-q"])  # fmt: skip
    return folder


def measure_main_job(ct_folder: Path | None, hu: float, pairs: int, device: str | None) -> dict[str, Any]:
    """CT folder to STL file, whole processes, warm caches, against SimpleITK + vtkFlyingEdges3D + vtkSTLWriter."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = ct_folder or _make_phantom(Path(scratch) / "ct", 149)
        mesh, peer_mesh = Path(scratch) / "clrecon.stl", Path(scratch) / "peer.stl"
        own = [sys.executable, "-m", "clrecon", "mesh", str(folder), "-o", str(mesh), "--hu", f"{hu:g}"]
        own += ["--device", device] if device else []
        peer = [sys.executable, str(PEERS / "simpleitk_vtk.py"), str(folder), str(peer_mesh), f"{hu:g}"]
        ours, theirs = alternate(lambda: run_program([*own, "-q"])[0], lambda: run_program(peer)[0], pairs)
        report = Path(scratch) / "report.json"
        run_program([*own, "-q", "--report", str(report)])
        facts = json.loads(report.read_text())
        peer_facts = json.loads(run_program(peer)[1])
        return {
            **summarise(ours, theirs),
            "hu": hu,
            "shape_ijk": facts["volume"]["shape_ijk"],
            "triangles": {"clrecon": facts["triangles"], "peer": peer_facts["triangles"]},
            "device": facts["device"],
            "driver": facts["driver"],
            "seconds_by_part": {"clrecon": facts["seconds"], "peer": peer_facts["seconds"]},
        }


def measure_isosurface(ct_folder: Path | None, hu: float, pairs: int, device: str | None) -> dict[str, Any]:
    """Host volume to host mesh in one process, kernels built, against vtkFlyingEdges3D with normals on two threads."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    import clrecon

    with tempfile.TemporaryDirectory() as scratch:
        volume = clrecon.read_volume(ct_folder or _make_phantom(Path(scratch) / "ct", 149))
    chosen = clrecon.device(device)
    vtk.vtkSMPTools.SetBackend("STDThread")
    vtk.vtkSMPTools.Initialize(2)
    grid = vtk.vtkImageData()
    grid.SetDimensions(*volume.shape_ijk)
    grid.GetPointData().SetScalars(numpy_to_vtk(volume.voxels.ravel()))
    counts = {}

    def run_peer() -> float:
        contour = vtk.vtkFlyingEdges3D()
        contour.SetInputData(grid)
        contour.SetValue(0, hu - 0.5)
        contour.ComputeNormalsOn()
        contour.ComputeScalarsOff()
        start = time.perf_counter()
        contour.Update()
        seconds = time.perf_counter() - start
        counts["peer"] = contour.GetOutput().GetNumberOfCells()
        return seconds

    kernels: dict[str, float] = {}

    def run_own() -> float:
        start = time.perf_counter()
        mesh = clrecon.extract_isosurface(volume, hu, chosen, closed=False)
        seconds = time.perf_counter() - start
        counts["clrecon"] = len(mesh.triangles)
        kernels.update(mesh.report["kernel_seconds"])
        return seconds

    ours, theirs = alternate(run_own, run_peer, pairs)
    return {
        **summarise(ours, theirs),
        "hu": hu,
        "shape_ijk": volume.shape_ijk,
        "triangles": counts,
        "device": chosen.label,
        "driver": chosen.driver,
        "kernel_seconds": kernels,
    }


CASES: dict[str, Callable[[Path | None, float, int, str | None], dict[str, Any]]] = {
    "main-job": measure_main_job,
    "isosurface": measure_isosurface,
}
