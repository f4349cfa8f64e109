"""The main job: a CT series in, calibrated meshes out, with their report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.mesh.bone import judge_surfaces, warn_of_walls
from clrecon.jobs.mesh.labels import judge_label_volumes, name_label_files
from clrecon.jobs.mesh.make import MadeParts, first_names, label_parts, make_parts, warn_of_crumbs
from clrecon.jobs.mesh.purposes import describe_purposes
from clrecon.jobs.mesh.refinement import (
    judge_parts,
    measure_parts,
    place_on_cortex,
    refine_surface,
    warn_of_gates,
    warn_of_shift,
)
from clrecon.jobs.mesh.report import MeshReport, describe_part, report_of
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import plan_surfaces
from clrecon.jobs.outputs import check_kept, check_outputs, count_leftovers, name_outputs, refuse_files, refuse_numbered
from clrecon.jobs.run import Run
from clrecon.system.log import get_logger
from clrecon.system.paths import extension_of
from clrecon.system.text import count_of

if TYPE_CHECKING:
    from clrecon.labels import LabelMap

log = get_logger(__name__)


def make_mesh(
    source: str | Path,
    output: str | Path,
    settings: MeshSettings | None = None,
    *,
    report_path: str | Path | None = None,
    measure: bool | None = None,
    **how: Any,
) -> MeshReport:
    """Read a CT series, extract its surfaces, select components, measure them and write them.

    Several meshes, of several iso values or split into components, get a name between stem and extension:
    ``bone_200hu.stl``, ``bone_001.stl``, ``bone_200hu_001.stl``, ``bone_T12.stl``.

    measure: Measure the meshes, which costs time; without it those entries are None.  Default: with a `report_path`.
    """
    settings = settings or MeshSettings()
    if settings.all_parts and makes_objects(output):
        settings = replace(settings, split=True, one_file=True)
    with Run(settings, **how) as run:
        surfaces = plan_surfaces(settings.levels, below=settings.below is not None)
        with run.keeping():
            if settings.one_file:
                from clrecon.exchange.formats import check_assembly

                check_assembly(output)
            outputs = check_outputs(
                output, report_path, [""] if settings.one_file else first_names(surfaces, settings.split)
            )
            if settings.split and not settings.one_file:
                refuse_numbered(output)
            check_kept(outputs, source, None if settings.labels is None else settings.labels.path)

        def check_map(labels: LabelMap) -> None:
            if settings.labels is not None and run.no_clobber and not settings.one_file:
                refuse_files(name_outputs(output, name_label_files(labels, settings.labels, surfaces)))

        made = make_parts(source, run, check_map)
        parts = made.parts
        paths = [output] * len(parts)
        if not settings.one_file:
            paths = name_outputs(output, [part.name for part in parts], report_path)
        is_measured = settings.strict or (report_path is not None if measure is None else measure)
        judge_surfaces(parts, made.volume, settings, partial(label_parts, device=made.device, settings=settings))
        run.lap("select")
        gates = _refine_and_measure(run, made, is_measured)
        warnings = [
            *warn_of_crumbs(parts, settings, made.device),
            *warn_of_shift(parts, settings),
            *describe_purposes(parts, settings),
            *warn_of_gates(gates),
        ]
        run.lap("measure")
        meshes = [part.mesh for part in parts]
        if settings.one_file:
            from clrecon.rendering.pictures.label_style import distinct_colors

            for part, color in zip(parts, distinct_colors(len(parts)), strict=True):
                given = part.mesh.report
                given["part_name"] = part.name or given.get("part_name")
                given.setdefault("color", [float(value) for value in color])
            files = [run.write_together(meshes, output)] * len(parts)
        else:
            files = run.write_meshes(meshes, paths)
        run.lap("write")
        walls = warn_of_walls(parts, settings, made.choice)
        left = _warn_of_leftovers(output, paths) if settings.split else []
        entries = [describe_part(*each, settings.space) for each in zip(parts, files, paths, strict=True)]
        report = report_of(run, made, entries, gates, [*left, *walls, *warnings])
        run.finish(report, report_path)
    log.info(
        "%d meshes made, %d triangles, %d slabs, on %s in %.3f s",
        *(len(report.meshes), report.triangles, report.slabs, report.device, report.seconds["total"]),
    )
    return report


def makes_objects(output: str | Path) -> bool:
    """Tell whether all parts of a print become objects of a file of this name."""
    return extension_of(output) == ".3mf"


def _refine_and_measure(run: Run, made: MadeParts, measure: bool) -> list[dict[str, Any]]:
    settings: MeshSettings = run.settings
    place_on_cortex(made, settings, measure, run.progress)
    run.lap("cortex")
    if settings.refines:
        for part in made.parts:
            part.mesh = refine_surface(part.mesh, settings, made.device, run.progress)
        run.lap("refine")
    if measure:
        measure_parts(made.parts, made.solid([part.mesh for part in made.parts]), settings, made.device, run.progress)
    gates = judge_parts(made.parts, settings)
    return gates + (judge_label_volumes(made.parts, settings.closed) if settings.labels_pick else [])


def _warn_of_leftovers(output: str | Path, paths: Sequence[str | Path]) -> list[str]:
    leftovers = count_leftovers(output, paths)
    if not leftovers:
        return []
    return [
        f"{count_of(leftovers, 'more numbered file')} of this name lie{'s' * (leftovers == 1)}"
        f" beside the new ones, from an earlier run"
    ]
