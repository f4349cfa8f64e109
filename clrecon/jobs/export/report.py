"""`ExportReport`: what an export job wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from clrecon.geometry.certificate import without_ids
from clrecon.jobs.shared.report import peak_memory_bytes, platform_name
from clrecon.system.records import Record
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.jobs.export.settings import ExportSettings


@dataclass(frozen=True, eq=False)
class ExportReport(Record):
    """Report of `export_volume`.

    output: ``format``, ``bytes``, ``type`` of the values, ``shape_ijk``, ``affine_ijk_to_lps_mm``, ``corners_lps_mm``
        (lowest and highest centre of a voxel), ``space`` of the file and ``outside_hu``: HU of what lies outside of the
        region, None without one.
    device: None where the job needed none.
    volume: The certificate of the volume that was written, without its warnings.
    """

    output: Mapping[str, Any]
    device: str | None
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None


def describe_export(
    volume: Volume,
    settings: ExportSettings,
    output: Mapping[str, Any],
    device: str | None,
    warnings: list[str],
    seconds: Mapping[str, float],
) -> ExportReport:
    """Describe the result of a job."""
    certificate = dict(volume.report) if settings.keep_ids else without_ids(volume.report)
    told = [str(warning) for warning in certificate.pop("warnings", [])]
    return ExportReport(
        output=dict(output),
        device=device,
        version=package_version(),
        platform=platform_name(),
        warnings=[*told, *warnings],
        volume=certificate,
        seconds=dict(seconds),
        peak_memory_bytes=peak_memory_bytes(),
    )
