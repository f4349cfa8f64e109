"""The export job: a CT series in, its volume out as NIfTI, NRRD or MetaImage, with affine and certificate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clrecon.geometry import Volume
from clrecon.geometry.blocks import find_extent
from clrecon.geometry.resample import resample_volume
from clrecon.jobs.inputs import crop_scan
from clrecon.jobs.preprocess import mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.run import Run, ScanReport
from clrecon.jobs.settings import ExportSettings
from clrecon.reading.grids import write_volume
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportReport(ScanReport):
    """Report of `export_volume`; its ``volume`` is the one that was written."""

    SCHEMA = "export"

    output: Mapping[str, Any]
    device: str | None


def export_volume(
    source: str | Path,
    output: str | Path,
    settings: ExportSettings | None = None,
    *,
    report_path: str | Path | None = None,
    **how: Any,
) -> ExportReport:
    """Read a CT series and write its volume: masked, cropped, preprocessed and resampled as the settings ask."""
    settings = settings or ExportSettings()
    with Run(settings, **how) as run:
        extension = write_volume.check_volume_format(output)
        run.check([("the volume", output), ("the report", report_path)], source)
        volume = run.read(source)
        run.lap("read")
        if settings.resample is None:  # no device works for what cannot be written
            write_volume.check_holds(crop_scan(volume, settings.crop, settings.space), extension)
        volume, device = _mask_volume(volume, settings, run.progress)
        run.lap("mask")
        if settings.resample is not None:
            run.progress("resample", 0, 0)
            volume = resample_volume(volume, settings.resample, progress=run.progress)
            run.lap("resample")
        shear = write_volume.describe_shear(volume)
        file = run.stage(write_volume.stage_volume(volume, output, keep_ids=settings.keep_ids, progress=run.progress))
        run.lap("write")
        region = volume.report.get("region")
        facts = {
            "format": extension[1:],
            "bytes": file.size,
            "type": write_volume.stored_values(volume.voxels[:1], volume.hu_range).dtype.name,
            "shape_ijk": list(volume.shape_ijk),
            "affine_ijk_to_lps_mm": volume.affine.tolist(),
            "space": "ras" if write_volume.FORMATS[extension].kind == "NIfTI" else "lps",
            "corners_lps_mm": [corner.tolist() for corner in find_extent(volume)],
            "outside_hu": None if region is None else region["outside_hu"],
        }
        warnings = [] if shear is None else [shear]
        report = run.report(ExportReport, warnings, volume, output=facts, device=device)
        return run.finish(report, report_path)


def _mask_volume(volume: Volume, settings: ExportSettings, progress: Progress) -> tuple[Volume, str | None]:
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
