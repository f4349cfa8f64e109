"""`StatsReport`: the figures of labels as entries of JSON, and as a table for CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from clrecon.geometry.certificate import without_ids
from clrecon.jobs.shared.report import peak_memory_bytes, platform_name
from clrecon.labels.statistics import check_percentiles, name_percentile
from clrecon.system.records import Record
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.jobs.stats.settings import StatsSettings
    from clrecon.labels.statistics import LabelFigures


@dataclass(frozen=True, eq=False, kw_only=True)
class StatsReport(Record):
    """Report of `measure_stats`.

    resampled: The map was brought to the grid of the scan, and its voxels do not all coincide with those of the scan.
    affine_ijk_to_lps_mm: nested list (4, 4)
    volume: The certificate of the volume without its warnings.
    """

    labels: list[Any]
    percentiles: list[float]
    resampled: bool
    affine_ijk_to_lps_mm: list[list[float]]
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None


def describe_stats(
    volume: Volume,
    figures: Sequence[LabelFigures],
    settings: StatsSettings,
    *,
    resampled: bool,
    warnings: Sequence[str],
    seconds: Mapping[str, float],
) -> StatsReport:
    """Compose the report of a job."""
    certificate = dict(volume.report) if settings.keep_ids else without_ids(volume.report)
    told = [str(warning) for warning in certificate.pop("warnings", [])]
    told += [*warnings, *(text for one in figures for text in one.warnings)]
    return StatsReport(
        labels=list(figures),
        percentiles=list(check_percentiles(settings.percentiles)),
        resampled=resampled,
        affine_ijk_to_lps_mm=volume.affine.tolist(),
        version=package_version(),
        platform=platform_name(),
        warnings=list(dict.fromkeys(told)),
        volume=certificate,
        seconds=seconds,
        peak_memory_bytes=peak_memory_bytes(),
    )


def as_csv(report: StatsReport) -> str:
    """Return one line a label, comma-separated, with a line of names above; empty cells where nothing was measured."""
    facts = ("number", "name", "voxels", "ml", "label_ml", "inside_share", "unmeasured")
    own = (*facts, "mean_hu", "sd_hu", "min_hu", "max_hu")
    wanted = [name_percentile(percent) for percent in report.percentiles]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*own, *(f"p{name}_hu" for name in wanted)])
    for one in report.labels:
        cells = [*(one[name] for name in own), *(one["percentiles_hu"][name] for name in wanted)]
        writer.writerow([round(cell, 6) if isinstance(cell, float) else cell for cell in cells])
    return text.getvalue()
