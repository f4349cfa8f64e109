"""The export job: a CT series in, its volume out as NIfTI, NRRD or MetaImage, with affine and certificate."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.geometry.blocks import find_extent
from clrecon.geometry.certificate import without_ids
from clrecon.geometry.resample import resample_volume
from clrecon.jobs.inputs import crop_scan
from clrecon.jobs.options import InputSettings
from clrecon.jobs.outputs import check_distinct, check_kept, commit_all
from clrecon.jobs.preprocess import mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.run import Laps, peak_memory_bytes, platform_name, stage_report
from clrecon.reading import read_selected
from clrecon.reading.grids.write_volume import (
    FORMATS,
    check_holds,
    check_volume_format,
    describe_shear,
    stage_volume,
    stored_values,
)
from clrecon.system.files import Staged, check_writable
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing, refuse_existing, resolve_target
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume


@dataclass(frozen=True, kw_only=True)
class ExportSettings(InputSettings):
    """Settings of the export job.

    resample: Resample to a regular grid with this step in mm, see `clrecon.geometry.resample.resample_volume`; None:
        voxels stay as they are.
    space: {"lps", "ras"}. Patient frame of the numbers of crop and region.  The frame of the file is that of its
        format.
    **shared: See `clrecon.jobs.options.InputSettings`.
    """

    resample: float | None = None
    space: str = "lps"

    def __post_init__(self) -> None:
        super().__post_init__()
        from clrecon.geometry.affine import frame_from_lps
        from clrecon.geometry.resample import check_step

        frame_from_lps(self.space)
        if self.resample is not None:
            check_step(self.resample)

    @property
    def needs_device(self) -> bool:
        """True where the region or a step of preprocessing runs on a device."""
        return bool(self.region) or self.preprocess is not None


log = get_logger(__name__)


def export_volume(
    source: str | Path,
    output: str | Path,
    settings: ExportSettings | None = None,
    *,
    report_path: str | Path | None = None,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Read a CT series and write its volume: masked, cropped, preprocessed and resampled as the settings ask for it.

    A device is opened for a region and for preprocessing only.  Where the format cannot hold the volume and it is not
    resampled, that is refused before the device works.

    source: DICOM folder or file, or a file of another format, see `clrecon.reading.read_volume`.
    output: .nii.gz, .nii, .nrrd or .mha, see `clrecon.write_volume`.
    report_path: File for the report as JSON.
    no_clobber: Files that exist stay and are an `OutputError`, before any work.
    progress: ``progress(stage, done, total)``.
    """
    settings = settings or ExportSettings()
    progress = progress or ignore_progress
    watch = Laps()
    with keep_existing(no_clobber):
        extension = _check_files(source, output, report_path)
    volume = read_selected(source, settings, progress=progress)
    watch.lap("read")
    if settings.resample is None:  # no device works for what cannot be written
        check_holds(crop_scan(volume, settings.crop, settings.space), extension)
    volume, device = _mask_and_resample(volume, settings, progress)
    watch.lap("mask")
    if settings.resample is not None:
        progress("resample", 0, 0)
        volume = resample_volume(volume, settings.resample, progress=progress)
        watch.lap("resample")
    shear = describe_shear(volume)
    with keep_existing(no_clobber), ExitStack() as staged:
        files: list[Staged] = [
            staged.enter_context(stage_volume(volume, output, keep_ids=settings.keep_ids, progress=progress))
        ]
        watch.lap("write")
        region = volume.report.get("region")
        facts = {
            "format": extension[1:],
            "bytes": files[0].size,
            "type": stored_values(volume.voxels[:1], volume.hu_range).dtype.name,
            "shape_ijk": list(volume.shape_ijk),
            "affine_ijk_to_lps_mm": volume.affine.tolist(),
            "space": "ras" if FORMATS[extension].kind == "NIfTI" else "lps",
            "corners_lps_mm": [corner.tolist() for corner in find_extent(volume)],
            "outside_hu": None if region is None else region["outside_hu"],
        }
        seconds = {part: round(value, 4) for part, value in {**watch.seconds, "total": watch.total()}.items()}
        report = describe_export(volume, settings, facts, device, [] if shear is None else [shear], seconds)
        if report_path is not None:
            files.append(staged.enter_context(stage_report(report_path, report)))
        commit_all(files)
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    return report


def _check_files(source: str | Path, output: str | Path, report_path: str | Path | None) -> str:
    """Refuse outputs that cannot be written, before any work; return the extension of the volume file."""
    extension = check_volume_format(output)
    outputs: list[tuple[str, str | Path]] = [("the volume", output)]
    if report_path is not None:
        outputs.append(("the report", report_path))
    check_distinct(outputs)
    for _, path in outputs:
        check_writable(path)
        refuse_existing(path, resolve_target(path))
    check_kept(outputs, source)
    return extension


def _mask_and_resample(volume: Volume, settings: ExportSettings, progress: Progress) -> tuple[Volume, str | None]:
    """Mask, crop and preprocess the volume; return it and the device that was needed for it."""
    volume = mask_volume(volume, settings, progress)
    if not settings.needs_device:
        return crop_scan(volume, settings.crop, settings.space), None
    from clrecon.operators import take_device

    progress("device", 0, 0)
    device = take_device(settings.device)
    volume = restrict_volume(volume, settings, device, [], progress)
    volume = preprocess_volume(volume, settings, device, [], progress)
    return volume, device.current.label


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
