"""The vertebrae job: a CT series in, a first guess of a label map out, with a picture to judge it by."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.outputs import commit_all
from clrecon.jobs.shared.report import stage_report
from clrecon.jobs.vertebrae.files import SEGMENTATION, check_files, map_format, picture_beside
from clrecon.jobs.vertebrae.report import VertebraeReport, describe_split
from clrecon.jobs.vertebrae.settings import VertebraeSettings
from clrecon.reading import Selection, read_selected
from clrecon.system.files import Staged, StagedFile, stage_file
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.labels import LabelMap

log = get_logger(__name__)


def make_vertebrae(
    source: str | Path,
    output: str | Path,
    settings: VertebraeSettings | None = None,
    *,
    picture_path: str | Path | None = None,
    with_picture: bool = True,
    report_path: str | Path | None = None,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> VertebraeReport:
    """Read a CT series, find its vertebrae, and write a label map and a picture of the discs and labels.

    No device is needed.

    source: DICOM folder or file, or a file of another format, see `clrecon.reading.read_volume`.
    output: Label map: .nii.gz or .nii; .dcm is a DICOM SEG, for a scan in DICOM.
    picture_path: PNG; by default beside the label map, with its name.
    with_picture: False: without `picture_path` there is no picture.
    report_path: File for the report as JSON.
    no_clobber: Files that exist stay and are an `OutputError`, before any work.
    progress: ``progress(stage, done, total)``.
    """
    from clrecon.jobs.vertebrae.picture import draw_vertebrae
    from clrecon.spine import split_vertebrae

    settings = settings or VertebraeSettings()
    progress = progress or ignore_progress
    picture = picture_beside(output) if picture_path is None and with_picture else picture_path
    watch = Laps()
    with keep_existing(no_clobber):
        check_files(source, output, picture, report_path)
    volume = read_selected(source, settings, progress=progress)
    watch.lap("read")
    split = split_vertebrae(
        volume,
        level=settings.level,
        seeds=list(settings.seeds) or None,
        name_at=settings.name_at,
        first=settings.first,
        keep_unsure=settings.keep_unsure,
        progress=progress,
    )
    watch.lap("split")
    progress("write", 0, 0)
    content = _encode(split.labels, output, source, settings)
    with keep_existing(no_clobber), ExitStack() as staged:
        files: list[Staged] = [_stage(staged, output, content)]
        if picture is not None:
            files.append(_stage(staged, picture, draw_vertebrae(split)))
        watch.lap("write")
        seconds = {part: round(value, 4) for part, value in {**watch.seconds, "total": watch.total()}.items()}
        facts = {"format": map_format(output), "bytes": len(content)}
        report = describe_split(volume, split, settings, facts, seconds)
        if report_path is not None:
            files.append(staged.enter_context(stage_report(report_path, report)))
        commit_all(files)
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    return report


def _encode(labels: LabelMap, output: str | Path, source: str | Path, settings: VertebraeSettings) -> bytes:
    kind = map_format(output)
    if kind in SEGMENTATION:
        from clrecon.dicom.reader import list_slices
        from clrecon.labels.write_segmentation import encode_segmentation

        of_values = {"rescale"}  # the other fields of a selection say which slices are read
        names = {field.name for field in fields(Selection)} - of_values
        chosen = {name: getattr(settings, name) for name in names}
        return encode_segmentation(labels, list_slices(source, **chosen))
    from clrecon.labels.write_nifti import encode_nifti

    return encode_nifti(labels, packed=kind.endswith(".gz"))


def _write(content: bytes, stream: BinaryIO) -> None:
    stream.write(content)


def _stage(stack: ExitStack, path: str | Path, content: bytes) -> StagedFile:
    return stack.enter_context(stage_file(path, partial(_write, content), expected_bytes=len(content)))
