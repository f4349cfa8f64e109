"""The main job: a CT series in, calibrated meshes out, with the report of the whole job and of each mesh."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.exchange.formats import check_assembly, check_in_pieces, check_triangles, describe_rounding
from clrecon.geometry import Volume, frame_from_lps
from clrecon.jobs.mesh.bone import judge_surfaces, warn_of_walls
from clrecon.jobs.mesh.labels import describe_label, judge_label_volumes, name_label_files
from clrecon.jobs.mesh.make import MadeParts, first_names, make_parts
from clrecon.jobs.mesh.purposes import describe_purposes
from clrecon.jobs.mesh.refinement import (
    judge_parts,
    label_part,
    place_on_cortex,
    refine_and_measure,
    warn_of_crumbs,
    warn_of_gates,
    warn_of_shift,
)
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface, describe_level, plan_surfaces, warn_of_contrast
from clrecon.jobs.outputs import check_kept, check_outputs, count_leftovers, name_outputs, refuse_files, refuse_numbered
from clrecon.jobs.presets import find_iso_preset
from clrecon.jobs.run import ArchiveTarget, Run, RunReport
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger
from clrecon.system.paths import extension_of
from clrecon.system.pieces import find_bounds, side_by_side
from clrecon.system.text import count_of

if TYPE_CHECKING:
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.spans import MakeSpans
    from clrecon.system.files import StagedFile


_OF_ONE = ("quality", "walls", "iso_distance", "cortex", "refinement", "print", "cells", "growing")
"""Entries of a mesh that are also at the top of the report if there is only one mesh."""

_OF_LEVEL = ("iso_value_hu", "iso_level_hu", "inside", "inside_hu", "inside_levels_hu")
"""Entries of a mesh that are also at the top where all meshes have them in common."""

_SAID_ABOVE = ("vertices", "triangles", "closed", "manifold", "components", "area_mm2", "volume_ml", "bounds_mm")


def describe_part(part: Part, file: StagedFile, output: str | os.PathLike[str], space: str) -> dict[str, Any]:
    """Return one object of ``meshes``, bounds in the frame `space`; entries that were not measured are None."""
    quality: dict[str, Any] = part.quality or {}
    origin = part.mesh.report
    return {
        "name": part.name or None,
        "label": part.surface.label,
        **{name: origin.get(name) for name in _OF_LEVEL},
        "vertices": part.mesh.vertex_count,
        "triangles": part.mesh.triangle_count,
        **{name: quality.get(name) for name in ("closed", "manifold", "components")},
        **{name: origin.get(name) for name in ("components_found", "components_kept", "seed_distances_mm")},
        "area_mm2": quality.get("area_mm2"),
        "volume_ml": quality.get("volume_ml") if quality.get("closed") else None,
        "bounds_mm": _bounds(part.mesh, space),
        "output": {"format": extension_of(output)[1:], "bytes": file.size},
        "quality": {name: value for name, value in quality.items() if name not in _SAID_ABOVE} or None,
        "cortex": origin.get("cortex"),
        "cells": origin.get("cells"),
        "growing": origin.get("growing"),
        **({} if part.surface.label is None else describe_label(origin)),
        **part.facts,
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshReport(RunReport):
    """The report of a mesh job; docs/contract.md explains its entries.

    With one mesh, its entries are here too.  With several, counts and sizes are sums (components of one surface that
    are written one by one were found together, and count once), `bounds_mm` is the box around all, `closed` and
    `manifold` are true if they are for each mesh, and entries that differ or cannot be summed are None.
    """

    SCHEMA = "mesh"

    _LEFT_OUT = ("preset_reason", "stored")
    _LAST = (
        *("device", "driver", "memory_allowed_bytes", "slabs", "device_bytes", "version", "platform", "warnings"),
        *("volume", *_OF_ONE, "meshes", "output", "preset_reason", "gates", "seconds", "peak_memory_bytes"),
    )
    PARTS = (
        *("device", "read", "upload", "build", "kernels", "download"),
        *("mask", "choose", "solid", "select", "cortex", "refine", "measure", "write"),
    )

    iso_value_hu: float | None
    iso_level_hu: float | None
    inside: str | None
    inside_hu: list[float | None] | None
    inside_levels_hu: list[float | None] | None
    outside_hu: float | None
    iso_value_reason: str
    iso_value_choice: Mapping[str, Any] | None
    preset: str | None
    space: str
    unit: str = "mm"
    vertices: int
    triangles: int
    closed: bool | None
    manifold: bool | None
    components: int | None
    components_found: int | None
    components_kept: int | None
    area_mm2: float | None
    volume_ml: float | None
    bounds_mm: list[list[float]] | None
    closed_at_border: bool
    topology: str
    method: str
    grow_from: list[str | list[float]]
    vertex_rule: str
    keep: str | None
    keep_largest: int | None
    min_volume_ml: float | None
    seeds_mm: list[list[float]]
    all_parts: bool
    split: bool
    purpose: str | None
    slabs: int
    device_bytes: Mapping[str, int]
    quality: Mapping[str, Any] | None
    walls: Mapping[str, Any] | None
    iso_distance: Mapping[str, Any] | None
    cortex: Mapping[str, Any] | None
    refinement: Mapping[str, Any] | None
    print: Mapping[str, Any] | None
    cells: Mapping[str, int] | None
    growing: Mapping[str, Any] | None
    meshes: list[dict[str, Any]]
    output: Mapping[str, Any]
    preset_reason: str | None
    gates: list[dict[str, Any]]
    stored: Mapping[str, int] | None = None


_DEVICE_PARTS = ("upload", "build", "kernels", "download")
"""Parts whose seconds are those of the surfaces as they were extracted."""


def report_of(
    run: Run,
    result: MadeParts,
    meshes: Sequence[dict[str, Any]],
    gates: list[dict[str, Any]],
    warnings: Sequence[str],
    stored: Mapping[str, int] | None = None,
) -> MeshReport:
    """Make the report of a job; its `warnings` come after those of the volume and the meshes."""
    settings: MeshSettings = run.settings
    parts = result.parts
    level, level_warnings = describe_level(result.volume, settings, result.choice)
    preset = settings.preset_used
    of_one: dict[str, Any] = {name: meshes[0][name] if len(meshes) == 1 else None for name in _OF_ONE}
    for part in _DEVICE_PARTS:
        run.seconds[part] = sum(float(origin.get("seconds", {}).get(part, 0.0)) for origin in result.origins)
    largest: dict[str, int] = {}
    for sizes in (part.mesh.report.get("device_bytes", {}) for part in parts):
        largest.update({what: max(size, largest.get(what, 0)) for what, size in sizes.items()})
    report = run.report(
        MeshReport,
        [*_warn_of_meshes(parts, meshes), *level_warnings, *warnings],
        result.volume,
        on=result.device.current,
        **{name: result.origins[0][name] for name in ("device", "driver") if settings.is_shared_out},
        affine_ijk_to_lps_mm=result.volume.affine.tolist(),
        **{name: _common(mesh[name] for mesh in meshes) for name in _OF_LEVEL},
        outside_hu=_common(part.mesh.report.get("outside_hu") for part in parts),
        **level,
        preset=preset,
        space=settings.space,
        **_describe_all(parts, meshes),
        closed_at_border=settings.closed,
        topology=settings.topology,
        method=settings.method_used,
        grow_from=[seed if isinstance(seed, str) else [float(value) for value in seed] for seed in settings.grow_from],
        vertex_rule=settings.vertex_rule,
        keep=settings.keep,
        keep_largest=settings.keep_largest,
        min_volume_ml=settings.min_volume_ml,
        seeds_mm=[[float(value) for value in seed] for seed in settings.seeds],
        all_parts=settings.all_parts,
        split=settings.split,
        purpose=settings.purpose,
        slabs=max((part.mesh.report.get("slabs", 1) for part in parts), default=1),
        device_bytes=largest,
        **of_one,
        meshes=list(meshes),
        output={"format": meshes[0]["output"]["format"], "bytes": sum(file.size for file in run.files)},
        preset_reason=None if preset is None else find_iso_preset(preset).source,
        gates=gates,
        stored=stored,
    )
    run.logged = result.volume.report.get("warnings", ())
    return report


def _warn_of_meshes(parts: Sequence[Part], meshes: Sequence[dict[str, Any]]) -> list[str]:
    warnings = []
    for part, mesh in zip(parts, meshes, strict=True):
        warnings += part.mesh.report.get("warnings", [])
        warnings += describe_rounding(part.mesh, f".{mesh['output']['format']}")
    return warnings


def _describe_all(parts: Sequence[Part], meshes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return sums over all meshes, and properties that are true for each."""
    of_surface = {part.surface: mesh for part, mesh in zip(parts, meshes, strict=True)}.values()
    sums = ("vertices", "triangles", "components", "area_mm2", "volume_ml")
    return {
        **{name: _unless_unknown(sum, (mesh[name] for mesh in meshes)) for name in sums},
        **{name: _unless_unknown(all, (mesh[name] for mesh in meshes)) for name in ("closed", "manifold")},
        "components_found": _unless_unknown(sum, (mesh["components_found"] for mesh in of_surface)),
        "components_kept": _unless_unknown(sum, (mesh["components_kept"] for mesh in of_surface)),
        "bounds_mm": _unless_unknown(_around, (mesh["bounds_mm"] for mesh in meshes)),
    }


def _bounds(mesh: Mesh, space: str) -> list[list[float]] | None:
    if mesh.vertex_count == 0:
        return None
    frame = frame_from_lps(space)
    corners = [frame @ corner for corner in find_bounds(mesh.vertices)]
    return [[float(pick(a, b)) for a, b in zip(*corners, strict=True)] for pick in (min, max)]


def _around(boxes: list[list[list[float]]]) -> list[list[float]]:
    lows, highs = zip(*boxes, strict=True)
    return [[min(axis) for axis in zip(*lows, strict=True)], [max(axis) for axis in zip(*highs, strict=True)]]


def _common(values: Iterable[Any]) -> Any:
    collected = list(values)
    return collected[0] if all(value == collected[0] for value in collected) else None


def _unless_unknown(combine: Callable[[list[Any]], Any], values: Iterable[Any]) -> Any:
    collected = list(values)
    return None if any(value is None for value in collected) else combine(collected)


log = get_logger(__name__)


def make_mesh(
    source: str | Path,
    output: str | Path,
    settings: MeshSettings | None = None,
    *,
    report_path: str | Path | None = None,
    measure: bool | None = None,
    store: str | None = None,
    **how: Any,
) -> MeshReport:
    """Read a CT series, extract its surfaces, select components, measure them and write them.

    Several meshes, of several iso values or split into components, get a name between stem and extension:
    ``bone_200hu.stl``, ``bone_001.stl``, ``bone_200hu_001.stl``, ``bone_T12.stl``.

    measure: Measure the meshes, which costs time; without it those entries are None.  Default: with a `report_path`.
    store: URL of a DICOMweb archive that gets the meshes too, before any file is in its place.
    """
    settings = settings or MeshSettings()
    if settings.by_slabs:
        return _pass_meshes(source, output, settings, report_path, store, **how)
    if settings.all_parts and makes_objects(output):
        settings = replace(settings, split=True, one_file=True)
    with Run(settings, **how) as run:
        surfaces = plan_surfaces(settings.levels, below=settings.below is not None)
        with run.keeping():
            if settings.one_file:
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

        target = None if store is None else ArchiveTarget(store, source, run)
        result = make_parts(source if target is None else target.source, run, check_map)
        parts = result.parts
        paths = [output] * len(parts)
        if not settings.one_file:
            paths = name_outputs(output, [part.name for part in parts], report_path)
        if not settings.refines:  # which may take triangles away
            for part, path in zip(parts, paths, strict=True):
                check_triangles(part.mesh.triangle_count, path)
        is_measured = settings.strict or (report_path is not None if measure is None else measure)
        judge = partial(_judge_parts, run, result, is_measured)
        write = partial(_write_parts, run, parts, output, paths)
        if (len(parts) > 1 and not settings.one_file) or settings.refines or settings.surface == "cortex":
            gates, warnings = judge()
            files = write()
        else:  # beside, since one file of final meshes tells no progress
            files, (gates, warnings) = side_by_side(write, judge)
        run.lap("write")
        walls = warn_of_walls(parts, settings, result.choice)
        left = _warn_of_leftovers(output, paths) if settings.split else []
        entries = [describe_part(*each, settings.space) for each in zip(parts, files, paths, strict=True)]
        is_modified = settings.refines or settings.solid or settings.surface == "cortex"
        stored = None if target is None else target.store_meshes([part.mesh for part in parts], is_modified=is_modified)
        report = report_of(run, result, entries, gates, [*left, *walls, *warnings], stored)
        run.finish(report, report_path)
    return _log_report(report)


def _log_report(report: MeshReport) -> MeshReport:
    log.info(
        "%d meshes made, %d triangles, %d slabs, on %s in %.3f s",
        *(len(report.meshes), report.triangles, report.slabs, report.device, report.seconds["total"]),
    )
    return report


class _PassingMeshes:
    """Surfaces that are written slab by slab as they are made, and never lie whole in memory."""

    def __init__(self, run: Run, output: str | Path):
        self._run, self._output = run, output
        self._facts: list[dict[str, Any]] = []
        self.paths: list[str | Path] = []
        self.files: list[StagedFile] = []

    def extract(self, volume: Volume, surfaces: Sequence[Surface], device: Device) -> list[Mesh]:
        """Write all surfaces; return for each a mesh without triangles, with its report."""
        from clrecon.jobs.mesh.workers import open_spans_in_order
        from clrecon.operators.resident.device_volume import DeviceVolume

        self.paths = name_outputs(self._output, [surface.name for surface in surfaces])
        with (
            DeviceVolume(volume, device=device, memory=self._run.settings.memory) as resident,
            open_spans_in_order(volume, self._run.settings, self._run.progress) as spans,
        ):
            return [self._write(resident, spans, *each) for each in zip(surfaces, self.paths, strict=True)]

    def _write(self, resident: DeviceVolume, spans: MakeSpans | None, surface: Surface, path: str | Path) -> Mesh:
        from clrecon.mesh import Mesh
        from clrecon.mesh.written_parts import PartsFile
        from clrecon.operators.surface.spans import PassingSurface

        run, settings = self._run, self._run.settings
        passing = PassingSurface(
            resident, surface.iso_value, spans, closed=settings.closed, topology=settings.topology, below=surface.below,
            vertex_rule=settings.vertex_rule, progress=run.progress,
        )  # fmt: skip

        def timed_parts() -> Iterator[Any]:
            for part in passing.parts(run.progress):
                run.lap("surface")
                yield part
                run.lap("write")

        counts, frame = (passing.vertices, passing.triangles), frame_from_lps(settings.space)
        file = PartsFile(path, settings.space, keep_ids=settings.keep_ids)
        self.files.append(run.stage(file.stage(timed_parts(), counts, passing.describe())))
        ends = passing.bounds @ frame.T
        self._facts.append(
            {
                "vertices": passing.vertices,
                "triangles": passing.triangles,
                "bounds_mm": [ends.min(axis=0).tolist(), ends.max(axis=0).tolist()],
                **dict.fromkeys(("iso_distance", "refinement", "walls", "print")),
            }
        )
        none = np.empty((0, 3), np.float32)
        return Mesh(none, none.astype(np.uint32), none, passing.describe())

    def complete(self, parts: Sequence[Part]) -> None:
        """Give the parts what their meshes without triangles do not tell, for their entries in the report."""
        for part, facts in zip(parts, self._facts, strict=True):
            part.facts |= facts


def _pass_meshes(
    source: str | Path,
    output: str | Path,
    settings: MeshSettings,
    report_path: str | Path | None,
    store: str | None,
    **how: Any,
) -> MeshReport:
    """Do what `make_mesh` does with surfaces that are written slab by slab, and never measured."""
    if store is not None:
        raise UsageError(f"an archive takes whole meshes: leave {name_parameter('by_slabs', True)} out")
    check_in_pieces(output)
    with Run(settings, **how) as run:
        surfaces = plan_surfaces(settings.levels, below=settings.below is not None)
        with run.keeping():
            check_kept(check_outputs(output, report_path, first_names(surfaces, split=False)), source)
        passing = _PassingMeshes(run, output)
        result = make_parts(source, run, extract=passing.extract)
        passing.complete(result.parts)
        written = zip(result.parts, passing.files, passing.paths, strict=True)
        entries = [describe_part(*each, settings.space) for each in written]
        report = report_of(run, result, entries, [], [] if result.choice is None else warn_of_contrast(result.choice))
        run.finish(report, report_path)
    return _log_report(report)


def makes_objects(output: str | Path) -> bool:
    """Tell whether all parts of a print become objects of a file of this name."""
    return extension_of(output) == ".3mf"


def _judge_parts(run: Run, result: MadeParts, measure: bool) -> tuple[list[dict[str, Any]], list[str]]:
    """Judge the parts as they are, refine and measure them; return gates and warnings."""
    parts, settings = result.parts, run.settings
    label = partial(label_part, device=result.device, settings=settings, measure=measure)
    judge_surfaces(parts, result.volume, settings, label)
    run.lap("select")
    place_on_cortex(result, settings, measure, run.progress)
    run.lap("cortex")
    refine_and_measure(result, settings, measure, run.lap, run.progress)
    gates = judge_parts(parts, settings)
    if settings.labels_pick:
        gates += judge_label_volumes(parts, settings.closed)
    warnings = [
        *warn_of_crumbs(parts, settings),
        *warn_of_shift(parts, settings),
        *describe_purposes(parts, settings, result.volume, result.device),
        *warn_of_gates(gates),
    ]
    run.lap("measure")
    run.progress("write", 0, 0)
    return gates, warnings


def _write_parts(run: Run, parts: Sequence[Part], output: str | Path, paths: Sequence[str | Path]) -> list[StagedFile]:
    """Write the parts, with ``one_file`` together; return the file of each."""
    meshes = [part.mesh for part in parts]
    if not run.settings.one_file:
        return run.write_meshes(meshes, paths)
    from clrecon.rendering.pictures.label_style import distinct_colors

    for part, color in zip(parts, distinct_colors(len(parts)), strict=True):
        given = part.mesh.report
        given["part_name"] = part.name or given.get("part_name")
        given.setdefault("color", [float(value) for value in color])
    return [run.write_together(meshes, output)] * len(parts)


def _warn_of_leftovers(output: str | Path, paths: Sequence[str | Path]) -> list[str]:
    leftovers = count_leftovers(output, paths)
    if not leftovers:
        return []
    return [
        f"{count_of(leftovers, 'more numbered file')} of this name lie{'s' * (leftovers == 1)}"
        f" beside the new ones, from an earlier run"
    ]
