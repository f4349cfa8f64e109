"""Case of the topology of the trilinear field: its cost beside the default table."""

from __future__ import annotations

import time
from typing import Any

from measure import alternate, summarise
from registry import Job, case


@case("topology", "surfaces with the topology of the trilinear field, against the default's")
def measure_topology(job: Job) -> dict[str, Any]:
    """Time meshes from host to host with kernels built; the "peer" is the default table, so ratios are below 1."""
    from clrecon.operators.surface.extract import extract_isosurface
    from clrecon.system.arguments import Topology

    volume = job.input.volume()
    meshes: dict[str, Any] = {}

    def run(topology: Topology) -> float:
        start = time.perf_counter()
        meshes[topology] = extract_isosurface(volume, job.hu, device=job.device, topology=topology)
        return time.perf_counter() - start

    ours, theirs = alternate(lambda: run("trilinear"), lambda: run("separated"), job.pairs, limit_s=job.limit_s)
    summary = summarise(ours, theirs)
    counts = {name: {"vertices": m.vertex_count, "triangles": m.triangle_count} for name, m in meshes.items()}
    return {**summary, "ratios": {"separated_over_trilinear": summary["ratio"]}, "counts": counts}
