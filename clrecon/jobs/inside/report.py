"""The report of the job that looks into vertebrae."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.geometry.certificate import without_ids
from clrecon.jobs.inside.settings import InsideSettings
from clrecon.jobs.shared.report import peak_memory_bytes, platform_name
from clrecon.jobs.shared.run_report import RunReport
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device


@dataclass(frozen=True, eq=False, kw_only=True)
class InsideReport(RunReport):
    """The report of the job: a `RunReport` with further entries, which docs/contract.md explains.

    vertebrae: One for each label, see `clrecon.VertebraInside.as_dict`, with ``meshes`` beside: ``part``, ``vertices``,
        ``triangles``, ``format`` and ``bytes`` of each file, and ``pictures``.
    """

    affine_ijk_to_lps_mm: list[list[float]]
    vertebrae: list[dict[str, Any]]
    close_mm: float
    space: str
    unit: str = "mm"
    device: str
    driver: str
    memory_allowed_bytes: int | None
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None


def describe_mesh_file(part: str, mesh: Mesh, path: str | Path, size: int) -> dict[str, Any]:
    """Return one object of ``meshes``."""
    kind = os.path.splitext(os.fspath(path))[1].lower().lstrip(".")
    return {
        "part": part,
        "vertices": mesh.vertex_count,
        "triangles": mesh.triangle_count,
        "format": kind,
        "bytes": size,
    }


def describe_job(
    volume: Volume,
    vertebrae: Sequence[dict[str, Any]],
    settings: InsideSettings,
    device: Device,
    *,
    close_mm: float,
    seconds: Mapping[str, float],
) -> InsideReport:
    """Compose the report of a job.

    vertebrae: Entries of each vertebra; their warnings become those of the job.
    """
    certificate = dict(volume.report) if settings.keep_ids else without_ids(volume.report)
    told = [*certificate.pop("warnings", []), *device.warnings]
    several = len(vertebrae) > 1
    told += [
        f"{vertebra['name']}: {warning}" if several else warning
        for vertebra in vertebrae
        for warning in vertebra["warnings"]
    ]
    return InsideReport(
        affine_ijk_to_lps_mm=volume.affine.tolist(),
        vertebrae=[dict(vertebra) for vertebra in vertebrae],
        close_mm=close_mm,
        space=settings.space.lower(),
        device=device.label,
        driver=device.driver,
        memory_allowed_bytes=settings.memory,
        version=package_version(),
        platform=platform_name(),
        warnings=list(dict.fromkeys(map(str, told))),
        volume=certificate,
        seconds=seconds,
        peak_memory_bytes=peak_memory_bytes(),
    )
