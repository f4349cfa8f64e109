"""The job of statistics: a scan and its label map in, volume and HU of each label out, as a report and a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from clrecon.geometry.certificate import without_ids
from clrecon.jobs.inputs import read_with_labels
from clrecon.jobs.outputs import check_distinct, check_kept, commit_all
from clrecon.jobs.run import Laps, peak_memory_bytes, platform_name, stage_report
from clrecon.labels import read_labels, resample_labels
from clrecon.labels.statistics import PERCENTILES, check_percentiles, measure_resampled, name_percentile
from clrecon.reading import Selection, read_selected
from clrecon.system.files import Staged, check_writable, stage_file
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels.statistics import LabelFigures


@dataclass(frozen=True, kw_only=True)
class StatsSettings(Selection):
    """Settings of the job.

    series, phase, allow_gaps, force, follow_links, rescale: See `clrecon.reading.Selection`.
    labels: Label map: NIfTI, NRRD, MetaImage, DICOM SEG or RTSTRUCT.
    only: Labels that are measured; none: all.
    percentiles: From 0 to 100.
    keep_ids: Write the hashes of the UIDs of series and frame of reference into the report.
    """

    labels: str | Path
    only: Sequence[str | int] = ()
    percentiles: Sequence[float] = PERCENTILES
    keep_ids: bool = False

    def __post_init__(self) -> None:
        check_percentiles(self.percentiles)


log = get_logger(__name__)


def measure_stats(
    source: str | Path,
    settings: StatsSettings,
    *,
    report_path: str | Path | None = None,
    csv_path: str | Path | None = None,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> StatsReport:
    """Read a scan and its label map, and measure each label.

    No device is needed.

    source: DICOM folder or file, or a file of another format, see `clrecon.read_volume`.
    report_path: File for the report as JSON.
    csv_path: File for the figures, one line a label.
    no_clobber: Files that exist stay and are an `OutputError`, before any work.
    progress: ``progress(stage, done, total)``.
    """
    progress = progress or ignore_progress
    watch = Laps()
    named = [("the report", report_path), ("the table", csv_path)]
    outputs: list[tuple[str, str | Path]] = [(what, path) for what, path in named if path is not None]
    with keep_existing(no_clobber):
        check_distinct(outputs)
        for _, path in outputs:
            check_writable(path)
    check_kept(outputs, source, settings.labels)
    only = tuple(settings.only) or None
    volume, labels = read_with_labels(
        partial(read_selected, source, settings, progress=progress),
        settings.labels,
        lambda volume: read_labels(settings.labels, only, volume=volume),
    )
    assert labels is not None
    watch.lap("read")
    taken = resample_labels(labels, volume)
    figures = measure_resampled(volume, labels, taken, only, percentiles=settings.percentiles, progress=progress)
    watch.lap("measure")
    seconds = {part: round(value, 4) for part, value in {**watch.seconds, "total": watch.total()}.items()}
    report = describe_stats(
        volume, figures, settings, resampled=not taken.exact, warnings=taken.warnings, seconds=seconds
    )  # fmt: skip
    with keep_existing(no_clobber), ExitStack() as staged:
        files: list[Staged] = []
        if csv_path is not None:
            content = as_csv(report).encode("utf-8")
            files.append(staged.enter_context(stage_file(csv_path, partial(_write_table, content))))
        if report_path is not None:
            files.append(staged.enter_context(stage_report(report_path, report)))
        commit_all(files)
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    return report


def _write_table(content: bytes, stream: BinaryIO) -> None:
    stream.write(content)


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
