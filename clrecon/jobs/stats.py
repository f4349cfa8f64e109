"""The job of statistics: a scan and its label map in, volume and HU of each label out, as a report and a table."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.run import Run, ScanReport
from clrecon.jobs.settings import StatsSettings
from clrecon.labels import resample_labels
from clrecon.labels.statistics import PERCENTILES, check_percentiles, measure_resampled, name_percentile
from clrecon.system.light_dataclass import dataclass

if TYPE_CHECKING:
    from clrecon.labels.statistics import LabelFigures


@dataclass(frozen=True, eq=False, kw_only=True)
class StatsReport(ScanReport):
    """Report of `measure_stats`.

    resampled: The map was brought to the grid of the scan, and its voxels do not all coincide with those of the scan.
    """

    labels: list[LabelFigures]
    percentiles: list[float]
    resampled: bool
    affine_ijk_to_lps_mm: list[list[float]]


def measure_stats(
    source: str | Path,
    settings: StatsSettings,
    *,
    report_path: str | Path | None = None,
    csv_path: str | Path | None = None,
    **how: Any,
) -> StatsReport:
    with Run(settings, **how) as run:
        run.check([("the report", report_path), ("the table", csv_path)], source, settings.labels)
        label = tuple(settings.label) or None
        volume, labels = run.read_labelled(source, label)
        run.lap("read")
        taken = resample_labels(labels, volume)
        percentiles = check_percentiles(PERCENTILES if settings.percentiles is None else settings.percentiles)
        figures = measure_resampled(volume, labels, taken, label, percentiles=percentiles, progress=run.progress)
        run.lap("measure")
        report = run.report(
            StatsReport,
            [*taken.warnings, *(text for one in figures for text in one.warnings)],
            volume,
            labels=list(figures),
            percentiles=list(percentiles),
            resampled=not taken.exact,
            affine_ijk_to_lps_mm=volume.affine.tolist(),
        )
        if csv_path is not None:
            run.write(csv_path, as_csv(report).encode("utf-8"))
        return run.finish(report, report_path)


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
