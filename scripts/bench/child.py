#!/usr/bin/env python3
"""Program for cases that need a fresh process: child.py TASK VOXELS.npy AFFINE.npy HU DEVICE THREADS.

TASK is first-own, first-peer, memory-own or memory-peer.  Prints one JSON object.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np


def load(voxels: str, affine: str) -> Any:
    """Load the volume into memory, with every page touched."""
    from clrecon.geometry import Volume

    return Volume(np.load(voxels), np.load(affine))


def first_own(volume: Any, hu: float, device: str, threads: int) -> dict[str, Any]:
    """Seconds from choosing the device to the mesh in host memory, after the imports."""
    import pyopencl  # noqa: F401

    from clrecon.opencl import choose_device
    from clrecon.operators.surface.extract import extract_isosurface

    start = time.perf_counter()
    chosen = choose_device(device)
    _ = chosen.queue
    opened = time.perf_counter()
    mesh = extract_isosurface(volume, hu, device=chosen, closed=False)
    done = time.perf_counter()
    return {
        "seconds": done - start,
        "open": opened - start,
        "parts": mesh.report["seconds"],
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
    }


def first_peer(volume: Any, hu: float, device: str, threads: int) -> dict[str, Any]:
    """Seconds of the first ``Update()``, after the imports."""
    from clrecon.geometry.iso_rule import choose_iso_rule
    from clrecon.proof.bench import FlyingEdges

    peer = FlyingEdges(volume, threads)
    level = choose_iso_rule(volume, hu, closed=False).iso_level
    import vtkmodules.vtkFiltersCore  # noqa: F401

    done = peer.run(level)
    return {"seconds": done.seconds, "vertices": done.vertices, "triangles": done.triangles}


def resident_bytes(name: str) -> int | None:
    """VmRSS (now) or VmHWM (peak) of this process; None if the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith(f"{name}:")]
    return int(found[0]) * 1024 if found else None


def forget_peak() -> bool:
    """Reset VmHWM to the memory that is resident now."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def measure_peak(run: Any) -> dict[str, Any]:
    """Measure the resident bytes before a run and at its peak; `run` returns the bytes of its outputs."""
    reset = forget_peak()
    before = resident_bytes("VmRSS")
    output = run()
    peak = resident_bytes("VmHWM")
    return {"before": before, "peak": peak, "output": output, "peak_reset": reset}


def small_volume(volume: Any) -> Any:
    """Return a corner of a volume with a surface in it, for a warm-up that needs little memory."""
    from clrecon.geometry import Volume

    voxels = np.zeros((16, 16, 16), dtype=volume.voxels.dtype)
    voxels[4:12, 4:12, 4:12] = 100
    return Volume(voxels, volume.affine)


def memory_own(volume: Any, hu: float, device: str, threads: int) -> dict[str, Any]:
    """Measure the resident memory of one extraction, after a small one as warm-up."""
    from clrecon.opencl import choose_device
    from clrecon.operators.surface.extract import extract_isosurface

    chosen = choose_device(device)
    extract_isosurface(small_volume(volume), 50, device=chosen, closed=False)
    kept: list[Any] = []

    def run() -> int:
        kept.append(extract_isosurface(volume, hu, device=chosen, closed=False))
        mesh = kept[0]
        return int(mesh.vertices.nbytes + mesh.normals.nbytes + mesh.triangles.nbytes)

    peak = measure_peak(run)
    mesh = kept[0]
    return {**peak, "device_bytes": mesh.report.get("device_bytes"), "triangles": len(mesh.triangles)}


def memory_peer(volume: Any, hu: float, device: str, threads: int) -> dict[str, Any]:
    """Measure the resident memory of one run of flying edges; its output is counted as VTK stores it."""
    from clrecon.geometry.iso_rule import choose_iso_rule
    from clrecon.proof.bench import FlyingEdges

    FlyingEdges(small_volume(volume), threads).run(49.5)
    peer = FlyingEdges(volume, threads)
    level = choose_iso_rule(volume, hu, closed=False).iso_level
    counts: list[int] = []

    def run() -> int:
        done = peer.run(level)
        counts.append(done.triangles)
        # float32 positions and normals; cells of three 64-bit indices and one 64-bit offset
        return 24 * done.vertices + 32 * done.triangles

    return {**measure_peak(run), "triangles": counts[0]}


TASKS = {"first-own": first_own, "first-peer": first_peer, "memory-own": memory_own, "memory-peer": memory_peer}


def main(task: str, voxels: str, affine: str, hu: str, device: str, threads: str) -> None:
    print(json.dumps(TASKS[task](load(voxels, affine), float(hu), device, int(threads))), flush=True)
    os._exit(0)  # `clrecon` ends like this: freeing memory and drivers piece by piece is not part of the work


if __name__ == "__main__":
    main(*sys.argv[1:])
