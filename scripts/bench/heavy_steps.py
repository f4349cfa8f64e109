"""Cases of steps that a user waits for beside the surface: canal, table, triangles that cut each other, fit to bone."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measure import busy_seconds, spread
from registry import Job, case
from wall_and_cpu import alternate_twice


@case("canal", "search for the spinal canal: seconds, processor seconds and memory above the scan; it has no peer")
def measure_canal(job: Job) -> dict[str, Any]:
    """Time `find_spine_line`; a scan in which no spine is found is timed as well."""
    from clrecon.anatomy.spine_line import find_spine_line
    from clrecon.errors import RefusedInputError

    volume = job.input.volume()

    def search() -> dict[str, Any]:
        try:
            line = find_spine_line(volume)
        except RefusedInputError as error:
            return {"refused": str(error)}
        return {"height_mm": line.height_mm, "points": line.points.tolist()}

    return {"ratios": {}, **_alone(search, job), "result": search()}


@case("table", "removal of the table: seconds, processor seconds and memory above the scan; it has no peer")
def measure_table(job: Job) -> dict[str, Any]:
    """Time `remove_table`; its memory includes the masked scan."""
    import clrecon

    volume = job.input.volume()
    facts = clrecon.remove_table(volume, allow_bone_loss=True).report["remove_table"]
    return {
        "ratios": {},
        **_alone(lambda: clrecon.remove_table(volume, allow_bone_loss=True), job),
        "masked_bytes": volume.voxels.nbytes,
        "result": dict(facts),
    }


@case("crossings", "triangles that cut each other: the device marks, the host looks, against the host alone")
def measure_crossings(job: Job) -> dict[str, Any]:
    """Time `find_crossings` beside `find_self_intersections` on one surface."""
    import clrecon
    from clrecon.mesh.intersections import find_self_intersections
    from clrecon.operators.surface.decimation import find_crossings

    mesh = clrecon.extract_isosurface(job.input.volume(), job.hu, device=job.device)
    arrays = mesh.vertices, mesh.triangles
    sides = alternate_twice(
        lambda: find_crossings(job.device, *arrays), lambda: find_self_intersections(*arrays), job.pairs, job.limit_s
    )
    ours, theirs = find_crossings(job.device, *arrays), find_self_intersections(*arrays)
    return {
        "ratios": {name: found["ratio"] for name, found in sides.items()},
        "triangles": mesh.triangle_count,
        "sides": sides,
        "pairs": len(ours),
        "equal": sorted(map(sorted, ours.tolist())) == sorted(map(sorted, theirs.tolist())),
        "memory_bytes": _peak_above(lambda: find_crossings(job.device, *arrays)),
    }


@case("surface-cortex", "a surface fitted to the cortex, against the same surface at its level")
def measure_fitted(job: Job) -> dict[str, Any]:
    """Time `extract_isosurface` and `fit_cortex` beside `extract_isosurface` alone; the ratio is what the fit costs."""
    import clrecon

    volume = job.input.volume()

    def extract() -> clrecon.Mesh:
        return clrecon.extract_isosurface(volume, job.hu, device=job.device)

    def fit() -> clrecon.Mesh:
        return clrecon.fit_cortex(extract(), volume, device=job.device)

    found = fit().report["cortex"]
    sides = alternate_twice(fit, extract, job.pairs, job.limit_s)
    return {
        "ratios": {name: side["ratio"] for name, side in sides.items()},
        "sides": sides,
        "memory_bytes": _peak_above(fit),
        "result": {name: found[name] for name in ("vertices", "fitted", "kept", "outside_mm", "error_mm", "bias_mm")},
    }


def _alone(run: Callable[[], Any], job: Job) -> dict[str, Any]:
    """Time a function that has no peer, once untimed first."""
    run()
    wall: list[float] = []
    cpu: list[float] = []
    begin = time.perf_counter()
    while len(wall) < job.pairs and (not wall or time.perf_counter() - begin < job.limit_s):
        start, busy = time.perf_counter(), busy_seconds()
        run()
        wall.append(time.perf_counter() - start)
        cpu.append(busy_seconds() - busy)
    return {"seconds": spread(wall), "cpu_seconds": spread(cpu), "memory_bytes": _peak_above(run)}


def _peak_above(run: Callable[[], Any]) -> int | None:
    """Return the highest resident memory of a function above that before it, bytes; None where Linux does not tell."""
    resets, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    try:
        resets.write_text("5")
        before = _peak(status)
        run()
        return _peak(status) - before
    except OSError:
        return None


def _peak(status: Path) -> int:
    fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
    return 1024 * int(fields["VmHWM"].split()[0])
