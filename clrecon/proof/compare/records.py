"""Records of methods and the report, composed from what the processes tell."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from clrecon.geometry import Volume
from clrecon.geometry.certificate import without_ids
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.jobs.run import Laps, peak_memory_bytes, platform_name
from clrecon.opencl import Device
from clrecon.proof.compare.figures import SIZE, VIEW, Figures
from clrecon.proof.compare.findings import CompareReport, MethodRecord, find_findings
from clrecon.proof.compare.makers import PARTS, TWIN_SIZE
from clrecon.proof.compare.methods import Compared, CompareSettings
from clrecon.proof.timing import free_cores, processor_name, usable_cores
from clrecon.system.packages import package_of
from clrecon.version import package_version

ALL_PARTS = ("read", *PARTS)

_LIBRARIES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "scikit-image": "scikit-image",
    "VTK": "vtk",
    "fast-simplification": "fast-simplification",
    "pyopencl": "pyopencl",
}

BUSY_SHARE = 0.5
"""Smallest share of free cores without a warning, as of the bench."""


def make_record(
    method: Compared, result: Mapping[str, Any], measured: Mapping[str, Any], read_s: Mapping[str, float]
) -> MethodRecord:
    """Compose the row of a method from `run_method`, `Judge.measure`, and both seconds of reading."""
    done = result["state"] == "done"
    first, runs = (result["first"], result["warm"]) if done else ({}, [])
    warm = {part: statistics.median(run[part] for run in runs) for part in PARTS} if done else {}
    cells = result.get("cells") or {}
    peak, before = result.get("memory_bytes"), result.get("memory_before_bytes")
    kernels = result.get("kernel_seconds") or {}
    return MethodRecord(
        name=method.name,
        title=method.title,
        what=method.what,
        makes=method.makes,
        peer=package_of(method.module),
        state=result["state"],
        error=result["error"],
        triangles=result.get("triangles"),
        vertices=result.get("vertices"),
        points=result.get("points"),
        first_s=_sum_work(first) if done else None,
        warm_s=statistics.median(map(_sum_work, runs)) if done else None,
        warm_runs=len(runs),
        first_parts_s={"read": read_s["first"], **first} if done else {},
        warm_parts_s={"read": read_s["warm"], **warm} if done else {},
        kernels_ms=1e3 * sum(kernels.values()) if kernels else None,
        memory_bytes=peak,
        memory_own_bytes=None if peak is None or before is None else max(0, peak - before),
        cells_visited=cells.get("visited"),
        cells_all=cells.get("all"),
        growing=result.get("growing"),
        points_mm=measured.get("points"),
        **{name: measured.get(name) for name in ("quality", "cells", "slices", "surfaces", "truth")},
        reasons=measured.get("reasons", {}),
        small=_facts_of_small(method, result),
    )


def _sum_work(parts: Mapping[str, float]) -> float:
    return sum(parts.values()) - parts.get("draw", 0.0)


def _facts_of_small(method: Compared, result: Mapping[str, Any]) -> dict[str, Any] | None:
    """Describe ray casting at the size of the twin; its time at the full size is reckoned from the pixels."""
    small = result.get("small")
    if not small:
        return None
    pixels = SIZE[0] * SIZE[1] / (TWIN_SIZE[0] * TWIN_SIZE[1])
    return {
        "size": list(TWIN_SIZE),
        "first_s": small[0],
        "warm_s": small[1],
        "scaled_s": None if method.on_device else pixels * small[1],
    }


class Given(NamedTuple):
    """What all methods get: the volume, a level in HU, and why it is that; and warnings."""

    volume: Volume
    level: float
    reason: str
    warnings: Sequence[str]


def compose_report(
    given: Given,
    settings: CompareSettings,
    device: Device,
    records: Sequence[MethodRecord],
    figures: Figures,
    read_s: Mapping[str, float],
    watch: Laps,
) -> CompareReport:
    volume, level = given.volume, given.level
    certificate = dict(volume.report) if settings.keep_ids else dict(without_ids(volume.report))
    notes = [str(text) for text in certificate.pop("warnings", [])]
    cores, free = usable_cores(), free_cores()
    if free < BUSY_SHARE * cores:
        notes.append(f"only {free:.1f} of {cores} cores are free: times are of a busy computer, their ratios count")
    watch.lap("report")
    versions = {"Python": platform.python_version(), "clrecon": package_version()}
    for title, name in _LIBRARIES.items():
        try:
            versions[title] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return CompareReport(
        affine_ijk_to_lps_mm=volume.affine.tolist(),
        date=datetime.date.today().isoformat(),
        shape_ijk=list(volume.shape_ijk),
        spacing_mm=[float(step) for step in volume.spacing],
        iso_value_hu=level,
        iso_level_hu=float(choose_iso_rule(volume, level, closed=settings.closed).iso_level),
        iso_value_reason=given.reason,
        closed_at_border=settings.closed,
        reference=settings.reference,
        repeat=settings.repeat,
        with_truth=settings.truth is not None,
        processor=processor_name(),
        cores=cores,
        free_cores=round(free, 2),
        versions=versions,
        read_s=dict(read_s),
        findings=find_findings(records, settings.reference, with_truth=settings.truth is not None),
        methods=list(records),
        view=VIEW,
        size=list(SIZE),
        slices=figures.slice_entries(),
        paper=figures.paper,
        device=device.label,
        driver=device.driver,
        memory_allowed_bytes=settings.memory,
        version=package_version(),
        platform=platform_name(),
        warnings=list(dict.fromkeys([*notes, *given.warnings, *device.warnings])),
        volume=certificate,
        seconds={part: round(spent, 4) for part, spent in {**watch.seconds, "total": watch.total()}.items()},
        peak_memory_bytes=peak_memory_bytes(),
    )
