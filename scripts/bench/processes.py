"""Cases that need a fresh process for every run: the first call, memory, and the whole job from DICOM to STL."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from measure import alternate, medians, run_program, spread, summarise
from registry import HERE, Job, case


class Child:
    """Runs of child.py, with their outputs."""

    def __init__(self, job: Job, task: str, arrays: tuple[Path, Path]):
        facts = (task, *map(str, arrays), f"{job.hu!r}", str(job.device.index), str(job.peer_threads))
        self._command = [sys.executable, str(HERE / "child.py"), *facts]
        self.wholes: list[float] = []
        self.printed: list[dict[str, Any]] = []

    def run(self) -> float:
        """Run the child once; returns the seconds that it measured itself."""
        whole, text = run_program(self._command)
        self.wholes.append(whole)
        self.printed.append(json.loads(text))
        return float(self.printed[-1].get("seconds", whole))


@case(
    "isosurface-first-call", "first surface of a fresh process, kernel cache warm, against the same with flying edges"
)
def measure_first_call(job: Job) -> dict[str, Any]:
    """Time the first call with the volume in memory; opening the device counts, imports do not."""
    arrays = job.input.arrays()
    own, peer = Child(job, "first-own", arrays), Child(job, "first-peer", arrays)
    ours, theirs = alternate(own.run, peer.run, job.pairs, limit_s=job.limit_s)
    call, whole = summarise(ours, theirs), summarise(_in_turn(own), _in_turn(peer))
    without_open = summarise([seen["seconds"] - seen["open"] for seen in own.printed[1:]], theirs)
    last = own.printed[-1]
    return {
        "ratios": {
            "first_call": call["ratio"],
            "without_opening": without_open["ratio"],
            "whole_process": whole["ratio"],
        },
        "sides": {"first_call": call, "without_opening": without_open, "whole_process": whole},
        "open_seconds": spread([seen["open"] for seen in own.printed[1:]]),
        "seconds_by_part": medians([seen["parts"] for seen in own.printed[1:]]),
        "vertices": last["vertices"],
        "triangles": last["triangles"],
        "equal_counts": last["triangles"] == peer.printed[-1]["triangles"],
        "kernel_cache": "warm: one untimed process of each beforehand",
    }


def _in_turn(child: Child) -> list[float]:
    """Whole seconds of the timed processes."""
    return child.wholes[1:]


MEMORY_RUNS = 3
FEWEST_VOXELS = 1 << 22
"""Smallest volume: in smaller ones the pages of libraries are as many as those of the scratch memory."""


@case("memory", "scratch bytes a voxel beyond volume and output: as the operator sums it, and as the system saw it")
def measure_memory(job: Job) -> dict[str, Any]:
    """Measure the scratch memory in fresh processes: peak of resident memory, less that before, less the output."""
    arrays = job.input.arrays()
    own, peer = Child(job, "memory-own", arrays), Child(job, "memory-peer", arrays)
    for _ in range(min(job.pairs, MEMORY_RUNS)):
        own.run(), peer.run()
    voxels = _count_voxels(arrays[0])
    seen = {"clrecon": [_scratch(run) for run in own.printed], "peer": [_scratch(run) for run in peer.printed]}
    summed = own.printed[-1]["device_bytes"]
    figures: dict[str, Any] = {
        "ratios": {},
        "voxels": voxels,
        "triangles": own.printed[-1]["triangles"],
        "device_bytes": summed,
        "scratch_bytes_a_voxel": None if summed is None else summed["scratch"] / voxels,
        "runs": {"clrecon": own.printed, "peer": peer.printed},
    }
    if None not in (*seen["clrecon"], *seen["peer"]):
        each = {side: [value / voxels for value in values if value is not None] for side, values in seen.items()}
        figures["resident_scratch_bytes_a_voxel"] = {side: spread(values) for side, values in each.items()}
        pairs = zip(each["clrecon"], each["peer"], strict=True)
        if voxels >= FEWEST_VOXELS:
            figures["ratios"]["scratch"] = spread([theirs / max(ours, 0.01) for ours, theirs in pairs])
    return figures


def _scratch(printed: dict[str, Any]) -> int | None:
    if printed["before"] is None or printed["peak"] is None:
        return None
    return int(printed["peak"] - printed["before"] - printed["output"])


def _count_voxels(path: Path) -> int:
    import numpy as np

    return int(np.load(path, mmap_mode="r").size)


@case("main-job", "CT folder to STL file, whole processes, against SimpleITK, flying edges and vtkSTLWriter")
def measure_main_job(job: Job) -> dict[str, Any]:
    """Time the whole job with warm caches: each side has one untimed run before."""
    folder = job.input.ct_folder()
    with tempfile.TemporaryDirectory(prefix="clrecon-bench-") as scratch:
        mesh, peer_mesh, report = (Path(scratch) / name for name in ("clrecon.stl", "peer.stl", "report.json"))
        own = [sys.executable, "-m", "clrecon", "mesh", str(folder), "-o", str(mesh), "--hu", f"{job.hu:g}", "-q"]
        own += ["--device", str(job.device.index)]
        peer = [sys.executable, str(HERE / "peers" / "simpleitk_vtk.py"), str(folder), str(peer_mesh)]
        peer += [f"{job.hu:g}", str(job.peer_threads)]
        ours, theirs = alternate(
            lambda: run_program(own)[0], lambda: run_program(peer)[0], job.pairs, limit_s=job.limit_s
        )
        run_program([*own, "--report", str(report)])
        facts = json.loads(report.read_text())
        peer_facts = json.loads(run_program(peer)[1])
    summary = summarise(ours, theirs)
    return {
        "ratios": {"whole_process": summary["ratio"]},
        "sides": {"whole_process": summary},
        "triangles": facts["triangles"],
        "peer_triangles": peer_facts["triangles"],
        "seconds_by_part": {"clrecon": facts["seconds"], "peer": peer_facts["seconds"]},
    }
