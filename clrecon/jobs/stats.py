"""The job of statistics: a scan and its label map in, volume and HU of each label out, as a report and a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.run import Run, ScanReport
from clrecon.jobs.settings import FITTED_FROM_HU, StatsSettings
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.statistics import PERCENTILES, LabelFigures, check_percentiles, measure_resampled, name_percentile
from clrecon.system.light_dataclass import dataclass

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.opencl import Device


@dataclass(frozen=True, eq=False, kw_only=True)
class StatsReport(ScanReport):
    SCHEMA = "stats"

    labels: list[LabelFigures]
    percentiles: list[float]
    resampled: bool
    affine_ijk_to_lps_mm: list[list[float]]
    device: str | None


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
        placed = resample_labels(labels, volume)
        percentiles = check_percentiles(PERCENTILES if settings.percentiles is None else settings.percentiles)
        figures = measure_resampled(volume, labels, placed, label, percentiles=percentiles, progress=run.progress)
        run.lap("measure")
        device = None
        if settings.surface is not None:
            from clrecon.operators import take_device

            device = take_device(settings.device)
            figures = _measure_surfaces(run, volume, labels, figures, device)
            run.lap("surface")
        report = run.report(
            StatsReport,
            [*placed.warnings, *chain(*(label.warnings for label in figures))],
            volume,
            labels=list(figures),
            percentiles=list(percentiles),
            resampled=not placed.exact,
            affine_ijk_to_lps_mm=volume.affine.tolist(),
            device=None if device is None else device.current.label,
        )
        if csv_path is not None:
            run.write(csv_path, as_csv(report).encode("utf-8"))
        return run.finish(report, report_path)


def _measure_surfaces(
    run: Run, volume: Volume, labels: LabelMap, figures: Sequence[LabelFigures], device: Device
) -> list[LabelFigures]:
    """Return the figures with those of the filled surface of each label: at its level, or moved onto the bone."""
    from clrecon.mesh.quality import measure_triangles
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.cortex_mesh import fit_labels
    from clrecon.operators.surface.labels import extract_labels

    settings: StatsSettings = run.settings
    level = FITTED_FROM_HU if settings.iso_value is None else settings.iso_value
    with DeviceVolume(volume, device=device, memory=settings.memory) as resident:
        if settings.surface == "cortex":
            meshes = fit_labels(resident, labels, level, progress=run.progress)
        else:
            meshes = extract_labels(resident, labels, level, solid=True, progress=run.progress)
    measured = []
    for row in figures:
        surface: dict[str, Any] = {"kind": settings.surface, "iso_value_hu": level, "area_mm2": None, "ml": None}
        mesh = meshes.get(row.number) if row.max_hu is not None and row.max_hu >= level else None  # not filled alone
        if mesh is not None:
            sums = measure_triangles(mesh.vertices, mesh.triangles)
            surface |= {"area_mm2": sums.area_mm2, "ml": sums.volume_mm3 / 1000.0}
        measured.append(row.changed(surface=surface | {"cortex": mesh and mesh.report.get("cortex")}))
    return measured


_SURFACE_CELLS = ("area_mm2", "ml", "thickness_p5_mm", "thickness_p50_mm", "thickness_p95_mm", "error_p50_mm", "fitted")
"""Columns of the table of a surface, before which stands ``surface_``."""


def surface_cells(surface: Mapping[str, Any]) -> list[Any]:
    """Return the figures of a surface by `_SURFACE_CELLS`; None for what was not measured."""
    cortex = surface["cortex"] or {}
    if not cortex.get("vertices"):
        return [surface["area_mm2"], surface["ml"], *[None] * (len(_SURFACE_CELLS) - 2)]
    walls = cortex["thickness_mm"]
    error, fitted = cortex["error_mm"]["p50"], cortex["fitted"] / cortex["vertices"]
    return [surface["area_mm2"], surface["ml"], walls["p5"], walls["p50"], walls["p95"], error, fitted]


def as_csv(report: StatsReport) -> str:
    """Return one line a label, comma-separated, with a line of names above; empty cells where nothing was measured."""
    facts = ("number", "name", "voxels", "ml", "label_ml", "inside_share", "unmeasured")
    columns = (*facts, "mean_hu", "sd_hu", "min_hu", "max_hu")
    wanted = [name_percentile(percent) for percent in report.percentiles]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    of_surface = [f"surface_{name}" for name in _SURFACE_CELLS] if any(one.surface for one in report.labels) else []
    writer.writerow([*columns, *(f"p{name}_hu" for name in wanted), *of_surface])
    for label in report.labels:
        cells = [*(label[name] for name in columns), *(label["percentiles_hu"][name] for name in wanted)]
        cells += surface_cells(label.surface) if label.surface else []
        writer.writerow([round(cell, 6) if isinstance(cell, float) else cell for cell in cells])
    return text.getvalue()
