"""The main job: a CT series in, calibrated meshes out, with their report."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.mesh.bone import judge_surfaces, warn_of_walls
from clrecon.jobs.mesh.labels import judge_label_volumes, name_label_files
from clrecon.jobs.mesh.make import make_parts
from clrecon.jobs.mesh.mesh_parts import first_names, warn_of_crumbs
from clrecon.jobs.mesh.refinement import describe_purposes, judge_parts, measure_parts, refine_surface, warn_of_gates
from clrecon.jobs.mesh.report import MeshReport, describe_job, describe_part
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface, plan_surfaces
from clrecon.jobs.outputs import (
    check_kept,
    check_outputs,
    commit_all,
    count_leftovers,
    name_outputs,
    refuse_files,
    refuse_numbered,
    stage_meshes,
    stage_together,
)
from clrecon.jobs.run import Laps, stage_report
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import count_of

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.opencl import Device

log = get_logger(__name__)

_DEVICE_PARTS = ("upload", "build", "kernels", "download")


def make_mesh(
    source: str | Path,
    output: str | Path,
    settings: MeshSettings | None = None,
    *,
    report_path: str | Path | None = None,
    measure: bool | None = None,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> MeshReport:
    """Read a CT series, extract its surfaces, select components, measure them and write them.

    One mesh is written to `output`.  Several, of several iso values or split into components, get a name between
    stem and extension: ``bone_200hu.stl``, ``bone_001.stl``, ``bone_200hu_001.stl``, ``bone_T12.stl``.

    Outputs that cannot be written are refused first, then a missing device, then the input.  The device is opened and
    its kernels are built while the input is read.  All files are written under temporary names, then renamed; the
    report comes last, as the commit mark.

    source: DICOM folder or file, or a file of another format, see `clrecon.reading.read_volume`.
    output: Mesh file; its extension gives the format.
    report_path: File for the report as JSON.
    measure: Measure the meshes, which costs time; without it those entries are None.  Default: with a `report_path`.
    no_clobber: Files that exist stay and are an `OutputError`, before any work where their names are known then.
    progress: ``progress(stage, done, total)``.
    """
    settings, progress = _combine_parts(settings or MeshSettings(), output), progress or ignore_progress
    measure = report_path is not None if measure is None else measure
    watch = Laps()
    surfaces = plan_surfaces(settings.levels, below=settings.below is not None)
    with keep_existing(no_clobber):
        _check_files(source, output, report_path, surfaces, settings)

    def check_map(labels: LabelMap) -> None:
        if settings.labels is not None and no_clobber and not settings.one_file:
            refuse_files(name_outputs(output, name_label_files(labels, settings.labels, surfaces)))

    made = make_parts(source, settings, progress, watch, check_map)
    volume, solid, parts, device, choice = made.volume, made.solid, made.parts, made.device, made.choice
    paths = _name_files(output, parts, report_path, settings)
    judge_surfaces(parts, volume, settings)
    watch.lap("select")
    gates = _refine_and_measure(parts, solid, settings, device, measure or settings.strict, progress, watch)
    more_warnings = warn_of_crumbs(parts, settings) + describe_purposes(parts)
    watch.lap("measure")

    def compose(meshes: Sequence[dict[str, Any]]) -> MeshReport:
        warnings = _warn_of_leftovers(output, paths) if settings.split else []
        warnings += warn_of_walls(parts, settings, choice) + more_warnings + warn_of_gates(gates)
        seconds = _seconds(watch, made.origins)
        return describe_job(
            solid, parts, meshes, settings, device.current, choice, gates=gates, warnings=warnings, seconds=seconds
        )

    with keep_existing(no_clobber):
        report = _write_meshes(parts, paths, report_path, settings, compose, watch, progress)
    _log_report(report, volume)
    return report


def _combine_parts(settings: MeshSettings, output: str | Path) -> MeshSettings:
    """Return the settings by which all parts of a print become objects of one file, where its format has objects."""
    if not (settings.all_parts and makes_objects(output)):
        return settings
    return replace(settings, split=True, one_file=True)


def makes_objects(output: str | Path) -> bool:
    """Tell whether all parts of a print become objects of a file of this name."""
    return os.path.splitext(output)[1].lower() == ".3mf"


def _check_files(
    source: str | Path,
    output: str | Path,
    report_path: str | Path | None,
    surfaces: Sequence[Surface],
    settings: MeshSettings,
) -> None:
    """Refuse outputs that cannot be written or would replace an input."""
    if settings.one_file:
        from clrecon.exchange.formats import check_assembly

        check_assembly(output)
    outputs = check_outputs(output, report_path, [""] if settings.one_file else first_names(surfaces, settings.split))
    if settings.split and not settings.one_file:
        refuse_numbered(output)
    check_kept(outputs, source, None if settings.labels is None else settings.labels.path)


def _name_files(
    output: str | Path, parts: Sequence[Part], report_path: str | Path | None, settings: MeshSettings
) -> list[str | Path]:
    """Return the file of each part."""
    if settings.one_file:
        return [output] * len(parts)
    return name_outputs(output, [part.name for part in parts], report_path)


def _log_report(report: MeshReport, volume: Volume) -> None:
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    log.info(
        "%d meshes made, %d triangles, %d slabs, on %s in %.3f s",
        *(len(report.meshes), report.triangles, report.slabs, report.device, report.seconds["total"]),
    )


def _write_meshes(
    parts: Sequence[Part],
    paths: Sequence[str | Path],
    report_path: str | Path | None,
    settings: MeshSettings,
    compose: Callable[[Sequence[dict[str, Any]]], MeshReport],
    watch: Laps,
    progress: Progress,
) -> MeshReport:
    """Write all files, with `one_file` all meshes into one, and the report of all as the last; return the report."""
    with ExitStack() as staged:  # all files are on the disk before the first replaces an older one
        meshes = [part.mesh for part in parts]
        if settings.one_file:
            _name_objects(parts)
            files = [stage_together(staged, meshes, paths[0], settings.space, progress, keep_ids=settings.keep_ids)]
        else:
            files = stage_meshes(staged, meshes, paths, settings.space, progress, keep_ids=settings.keep_ids)
        watch.lap("write")
        of_parts = files * len(parts) if settings.one_file else files
        report = compose([describe_part(*each, settings.space) for each in zip(parts, of_parts, paths, strict=True)])
        if settings.one_file:
            report = report.changed(output={**report["output"], "bytes": files[0].size})
        if report_path is not None:
            files.append(staged.enter_context(stage_report(report_path, report)))
        commit_all(files)
    return report


def _name_objects(parts: Sequence[Part]) -> None:
    """Give each mesh the name and the colour that it has as an object of a file; those of labels stay."""
    from clrecon.rendering.pictures.label_style import distinct_colors

    for part, color in zip(parts, distinct_colors(len(parts)), strict=True):
        given = part.mesh.report
        given["part_name"] = part.name or given.get("part_name")
        given.setdefault("color", [float(value) for value in color])


def _refine_and_measure(
    parts: Sequence[Part],
    volume: Volume,
    settings: MeshSettings,
    device: Device,
    measure: bool,
    progress: Progress,
    watch: Laps,
) -> list[dict[str, Any]]:
    """Refine and measure each part as far as wanted; return the gates."""
    if settings.refines:
        for part in parts:
            part.mesh = refine_surface(part.mesh, settings, device, progress)
        watch.lap("refine")
    if measure:
        measure_parts(parts, volume, settings, device, progress)
    return judge_parts(parts, volume, settings, progress) + judge_label_volumes(parts, settings.closed)


def _warn_of_leftovers(output: str | Path, paths: Sequence[str | Path]) -> list[str]:
    leftovers = count_leftovers(output, paths)
    if not leftovers:
        return []
    return [
        f"{count_of(leftovers, 'more numbered file')} of this name lie{'s' * (leftovers == 1)}"
        f" beside the new ones, from an earlier run"
    ]


def _seconds(watch: Laps, origins: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return seconds by part of the job; `origins` are the reports of the surfaces."""
    measured = [origin.get("seconds", {}) for origin in origins]
    seconds = {"device": watch.seconds.get("device", 0.0), "read": watch.seconds.get("read", 0.0)}
    seconds.update({part: sum(float(own.get(part, 0.0)) for own in measured) for part in _DEVICE_PARTS})
    later = ("mask", "choose", "solid", "select", "refine", "measure", "write")
    seconds.update({part: watch.seconds.get(part, 0.0) for part in later})
    seconds["other"] = max(0.0, watch.total() - sum(seconds.values()))
    seconds["total"] = watch.total()
    return {part: round(value, 4) for part, value in seconds.items()}
