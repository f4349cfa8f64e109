"""The job of statistics: a scan and its label map in, volume and HU of each label out."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import BinaryIO

from clrecon.jobs.shared.labelled import read_with_labels
from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.outputs import check_distinct, check_kept, commit_all
from clrecon.jobs.shared.report import stage_report
from clrecon.jobs.stats.report import StatsReport, as_csv, describe_stats
from clrecon.jobs.stats.settings import StatsSettings
from clrecon.labels import read_labels, resample_labels
from clrecon.labels.statistics import measure_resampled
from clrecon.reading import read_selected
from clrecon.system.files import Staged, check_writable, stage_file
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress

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
            files.append(staged.enter_context(stage_file(csv_path, partial(_write, content))))
        if report_path is not None:
            files.append(staged.enter_context(stage_report(report_path, report)))
        commit_all(files)
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    return report


def _write(content: bytes, stream: BinaryIO) -> None:
    stream.write(content)
