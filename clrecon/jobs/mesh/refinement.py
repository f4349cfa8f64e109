"""The surfaces of a job moved onto the bone, smoothed and decimated, and the gates of its meshes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import DeviceError, DeviceFailedError, NoSurfaceError
from clrecon.jobs.mesh.make import label_parts
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import VALUE_GATES, Part
from clrecon.jobs.presets import HIGHEST_BONE_HU, LOWEST_BONE_HU
from clrecon.system.arguments import name_parameter
from clrecon.system.pieces import side_by_side
from clrecon.system.progress import Progress, Steps, ignore_progress
from clrecon.system.records import Gate, failed_gates
from clrecon.system.text import format_ml

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clrecon.geometry import Volume
    from clrecon.geometry.iso_rule import IsoRule
    from clrecon.jobs.mesh.make import MadeParts
    from clrecon.mesh import Mesh
    from clrecon.mesh.components import Labelled
    from clrecon.mesh.connectivity import Topology
    from clrecon.opencl import Device


_SHIFT_SHARE, _FEWEST_TOLD = 0.1, 0.5
"""A level that changes the volume by this share is warned of, where so much of the surface has told."""


_PRINT_BOUNDS = (0.8, 0.5, 0.2)
"""Of the default bound, for decimation of prints, in turn until the distances pass their gates: how much of these the
smoothing leaves is only known once it is measured.  The first is enough for most scans.
"""

_JUDGED_AS_FAR = ("iso_distance_p95", "iso_distance_mean", "deviation_p95", "deviation_mean")


_CRUMB_ML = 0.1
_CRUMB_SHARE = 0.01
_MANY_COMPONENTS = 100
"""A mesh of more components than this below this volume, or this share of all where it is small, gets a warning."""


_FEWEST_ON_DEVICE = 50_000
"""Triangles of which a device finds the topology; of fewer the host finds it as soon."""


def refine_surface(
    mesh: Mesh, settings: MeshSettings, device: Device, progress: Progress = ignore_progress, turn: int = 0
) -> Mesh:
    """Smooth and decimate as asked; else return the mesh itself.  Where memory is limited, the host smooths.

    turn: Which of `_PRINT_BOUNDS` holds, where a print has no bound of its own.
    """
    if not settings.refines:
        return mesh
    from clrecon.mesh.compare.distances import compare_meshes
    from clrecon.mesh.refine.decimation import BOUND_VOXEL, default_deviation
    from clrecon.mesh.refine.quadric import collapse_quadric
    from clrecon.operators.surface.decimation import decimate_mesh
    from clrecon.operators.surface.smoothing import smooth_mesh

    raw, bound = mesh, settings.max_deviation_mm
    if settings.smooth is not None:
        smoother = device if settings.memory is None else None
        mesh = smooth_mesh(mesh, settings.smooth, bound, device=smoother, progress=progress)
    share = settings.decimate_used
    if share is not None and settings.method == "g-mc":
        mesh = collapse_quadric(mesh, share, progress=progress)
    elif share is not None:
        if _is_tightened(settings):
            bound = _PRINT_BOUNDS[turn] * default_deviation(raw)
        mesh = decimate_mesh(mesh, share, bound, device=device, memory=settings.memory, progress=progress)
    mesh.report["refinement"] |= {
        "deviation": compare_meshes(mesh, raw, progress=progress),
        "voxel_mm": default_deviation(raw) / BOUND_VOXEL,
    }
    return mesh


def place_on_cortex(
    result: MadeParts, settings: MeshSettings, measure: bool, progress: Progress = ignore_progress
) -> None:
    """Move the meshes onto the bone, if the settings ask for it, or say how far they lie from it: without `measure` the
    largest alone, and only where the scan has not given its level.

    Constants of the scan are measured once, in its largest mesh.  One that shows no bone gets ``{"reason": words}``
    in place of figures; that none shows any is an error where they were to be moved.
    """
    moves, parts = settings.surface == "cortex", result.parts
    if not moves:
        parts = sorted(filter(_may_be_bone, parts), key=lambda part: -part.mesh.vertex_count)
        if not measure:
            parts = [] if settings.half_way == "auto" else parts[:1]
    if not parts:
        return
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.cortex_mesh import fit_meshes, measure_outside

    with DeviceVolume(result.volume, device=result.device, memory=settings.memory) as resident:
        if moves:
            fitted = fit_meshes([part.mesh for part in parts], resident, progress=progress)
            for part, mesh in zip(parts, fitted, strict=True):
                part.mesh = mesh
            return
        constants = None
        for part in parts:
            try:
                cortex = measure_outside(part.mesh, resident, constants=constants)
                part.mesh.report["cortex"], constants = cortex, cortex.constants
            except (NoSurfaceError, DeviceError) as error:
                part.mesh.report["cortex"] = {"reason": str(error)}
                if constants is None:
                    break


def _may_be_bone(part: Part) -> bool:
    """Tell whether a mesh lies at a level of bone, which HU have placed."""
    level = part.mesh.report.get("iso_value_hu")
    if part.mesh.report.get("inside") != "above" or level is None or part.mesh.triangle_count == 0:
        return False
    return math.isfinite(level) and LOWEST_BONE_HU <= level <= HIGHEST_BONE_HU


def warn_of_crumbs(parts: Sequence[Part], settings: MeshSettings) -> list[str]:
    """Return a warning for each measured mesh of many small components, which names the option that drops them."""
    warnings = []
    for part in parts:
        ml = part.component_ml
        if ml is None or settings.min_volume_ml is not None:
            continue
        crumb_ml = float(f"{min(_CRUMB_ML, _CRUMB_SHARE * float(ml.sum())):.1g}")
        small = ml[ml < crumb_ml]
        if len(small) > _MANY_COMPONENTS:
            warnings.append(
                f"{f'{part.name}: ' if part.name else ''}{len(small):,} of {len(ml):,} components enclose less than"
                f" {format_ml(crumb_ml)} each, {format_ml(float(small.sum()))} together:"
                f" {name_parameter('min_volume_ml', f'{crumb_ml:g}')} drops them"
            )
    return warnings


def warn_of_shift(parts: Sequence[Part], settings: MeshSettings) -> list[str]:
    """Warn of closed meshes whose level, not given by the scan, lies too far outside of the bone for their volume."""
    if settings.half_way == "auto" or not settings.closed:
        return []
    by_phrase: dict[str, list[tuple[float, float, str]]] = {}
    for part in parts:
        cortex = part.mesh.report.get("cortex")
        if not cortex or not cortex.get("vertices") or cortex["moved"]:
            continue
        fitted_share, shift = cortex["fitted"] / cortex["vertices"], cortex["outside_mm"]["mean"]
        if fitted_share < _FEWEST_TOLD:
            continue
        area, volume = _measure_size(part)
        excess = shift * fitted_share * area
        if volume > 0.0 and (share := excess / max(volume - excess, 0.2 * volume)) >= _SHIFT_SHARE:
            by_phrase.setdefault(part.surface.phrase, []).append((share, shift, part.name))
    return [_describe_shifts(phrase, sorted(shifts)) for phrase, shifts in by_phrase.items()]


def _describe_shifts(phrase: str, shifts: list[tuple[float, float, str]]) -> str:
    """Describe how far meshes lie outside of the bone in one line; `shifts`: share of volume, mm and name, rising."""
    (least, _, _), (most, _, name) = shifts[0], shifts[-1]
    inner, outer = min(shift for _, shift, _ in shifts), max(shift for _, shift, _ in shifts)
    whose, volumes = f"{name}: " if name else "", "volume"
    if len(shifts) > 1:
        whose, volumes = f"{len(shifts):,} meshes, most {name}: ", "volumes"
    return (
        f"{whose}the surface {phrase} lies {_describe_range(f'{inner:.2g}', f'{outer:.2g}')} mm outside of the bone on"
        f" average, which makes the {volumes} about {_describe_range(f'{100 * least:.0f}', f'{100 * most:.0f}')} % too"
        f" large: {name_parameter('half_way', 'auto')} measures the level of this scan"
    )


def _describe_range(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"


def _measure_size(part: Part) -> tuple[float, float]:
    """Return area in mm2 and enclosed volume in mm3, as measured already or now."""
    from clrecon.mesh.quality import measure_triangles

    if part.quality is None:
        sums = measure_triangles(part.mesh.vertices, part.mesh.triangles)
        return sums.area_mm2, sums.volume_mm3
    return part.quality.area_mm2, 1000.0 * (part.quality.volume_ml or 0.0)


def refine_and_measure(
    result: MadeParts,
    settings: MeshSettings,
    measure: bool,
    lap: Callable[[str], object],
    progress: Progress = ignore_progress,
) -> None:
    """Refine the parts and, if asked, measure them: of a print those that lie too far again, within a tighter bound."""
    turns = len(_PRINT_BOUNDS) if _is_tightened(settings) else 1
    parts = result.parts
    for turn in range(turns):
        extracted = [part.mesh for part in parts] if turn + 1 < turns else []
        if settings.refines:
            for part in parts:
                part.mesh = refine_surface(part.mesh, settings, result.device, progress, turn)
            lap("refine")
        if measure:
            measure_parts(parts, result.solid([part.mesh for part in parts]), settings, result.device, progress)
            lap("measure")
        again = []
        for part, mesh in zip(parts, extracted, strict=False):
            if any(gate.ok is False for gate in _judge_part(part, settings) if gate.name in _JUDGED_AS_FAR):
                part.mesh = mesh
                again.append(part)
        if not (parts := again):
            break


def _is_tightened(settings: MeshSettings) -> bool:
    bounded = settings.decimate_used is not None and settings.method != "g-mc"
    return settings.is_for_print and bounded and settings.max_deviation_mm is None


def measure_parts(
    parts: Sequence[Part],
    volume: Volume,
    settings: MeshSettings,
    device: Device | None = None,
    progress: Progress = ignore_progress,
) -> None:
    """Measure the `quality` of each part and its distances from the scan; with `strict` triangles that cut others."""
    topologies = [part.topology or _find_topology(part.mesh, device, settings) for part in parts]
    if settings.strict:
        steps = Steps(progress, "crossings", sum(part.mesh.triangle_count for part in parts))
        _, crossings = side_by_side(
            partial(_measure_on_host, parts, topologies, volume, ignore_progress),
            lambda: [_count_crossings(part.mesh, device, steps) for part in parts],
        )
        for part, count in zip(parts, crossings, strict=True):
            assert part.quality is not None
            part.quality = part.quality.changed(self_intersections=count)
    else:
        _measure_on_host(parts, topologies, volume, progress)


def label_part(part: Part, device: Device, settings: MeshSettings, *, measure: bool = False) -> Labelled:
    """Number the components of a part; of one to measure as it is, together with the topology that this needs."""
    if not measure or settings.refines or settings.surface == "cortex":
        return label_parts(part.mesh, device, settings)
    part.topology = _find_topology(part.mesh, device, settings)
    return part.topology.labelled


def _find_topology(mesh: Mesh, device: Device | None, settings: MeshSettings) -> Topology:
    """Find it on the device or, for small meshes and where that fails, which is warned of, on the host."""
    from clrecon.mesh.connectivity import find_topology

    known = None
    if device is not None and mesh.triangle_count >= _FEWEST_ON_DEVICE:
        from clrecon.operators.primitives.union_find import label_fans

        try:
            known = label_fans(device.current, mesh.triangles, mesh.vertex_count, memory=settings.memory)
        except DeviceFailedError as error:  # the result is the same, it only takes longer
            mesh.report.setdefault("warnings", []).append(f"{error}: the mesh was measured without it")
    return find_topology(mesh.triangles, mesh.vertex_count, known)


def _measure_on_host(parts: Sequence[Part], topologies: Sequence[Topology], volume: Volume, progress: Progress) -> None:
    from clrecon.mesh.quality import measure_component_ml, survey_surface

    steps = Steps(progress, "measure", len(parts))
    twice_areas = []
    for part, topology in zip(parts, topologies, strict=True):
        mesh = part.mesh
        part.topology = None  # which has a number for each vertex
        part.quality, _, sums = survey_surface(mesh.vertices, mesh.triangles, topology, by_triangle=True)
        if part.quality.components > _MANY_COMPONENTS:
            part.component_ml = measure_component_ml(mesh.triangles, sums, topology)
        twice_areas.append(sums.twice_areas)
        steps.take()
    _measure_distances(parts, twice_areas, volume)


def _measure_distances(parts: Sequence[Part], twice_areas: Sequence[NDArray[np.float64]], volume: Volume) -> None:
    """Measure how far parts lie from the scan; None where no level of HU places one."""
    from clrecon.mesh.compare.iso_distance import measure_iso_distances, rule_of_report

    placed: dict[IsoRule, list[tuple[Part, NDArray[np.float64]]]] = {}
    for part, areas in zip(parts, twice_areas, strict=True):
        part.facts["iso_distance"] = None
        moved = (part.mesh.report.get("cortex") or {}).get("moved", False)
        rule = None if moved or part.surface.label is not None else rule_of_report(part.mesh.report)
        if rule is not None:
            placed.setdefault(rule, []).append((part, areas))
    for rule, group in placed.items():
        meshes, areas_of_meshes = [part.mesh for part, _ in group], [areas for _, areas in group]
        gaps = measure_iso_distances(meshes, volume, rule, twice_areas=areas_of_meshes)
        for (part, _), gap in zip(group, gaps, strict=True):
            part.facts["iso_distance"] = gap


def judge_parts(parts: Sequence[Part], settings: MeshSettings) -> list[dict[str, Any]]:
    """Judge the parts by the gates, each with its ``mesh``; store measures in the `facts`, where there are some."""
    if not (settings.refines or any(part.quality for part in parts)):
        for part in parts:
            part.facts |= {"iso_distance": None, "refinement": None}
        return []
    gates = []
    for part in parts:
        gates += [{"mesh": part.name or None, **gate} for gate in _judge_part(part, settings)]
        part.facts |= {"iso_distance": part.facts.get("iso_distance"), "refinement": part.mesh.report.get("refinement")}
    return gates


def _judge_part(part: Part, settings: MeshSettings) -> list[Gate]:
    from clrecon.mesh.compare.mesh_gates import judge_mesh

    refinement = part.mesh.report.get("refinement")
    return judge_mesh(
        part.quality,
        closed=settings.closed,
        outward=not settings.split,
        iso_distance=part.facts.get("iso_distance"),
        extracted=not refinement,
        deviation=refinement and refinement["deviation"],
        voxel_mm=refinement and refinement["voxel_mm"],
    )


def _count_crossings(mesh: Mesh, device: Device | None, steps: Steps) -> int:
    from clrecon.mesh.intersections import find_self_intersections
    from clrecon.opencl import with_fallback
    from clrecon.operators.surface.decimation import find_crossings

    if device is None:
        return len(find_self_intersections(mesh.vertices, mesh.triangles, steps=steps))
    for attempt in with_fallback(device):
        with attempt as (current, _):
            crossings = find_crossings(current, mesh.vertices, mesh.triangles, steps=steps)
    return len(crossings)


def warn_of_gates(gates: Sequence[dict[str, Any]]) -> list[str]:
    """Return one line for each failed gate, with the name of its mesh if there are several."""
    return [f"{gate['mesh']}: {line}" if gate["mesh"] else line for gate in gates for line in failed_gates([gate])]


_GATES_OF_AFFINE = ("grid_residual",)
"""Gates for the fit of the affine to the slices.  Meshes do not need it: they use the position of each slice."""


def find_failed(report: Mapping[str, Any], *, own_units: bool = False) -> tuple[list[str], list[str]]:
    """Return a line for each failed gate of the scan, and of the meshes of a report.

    Gates of `_GATES_OF_AFFINE` (uneven slices) are left out, and so is that the values are HU, where a print has a
    level in the values' `own_units`.
    """
    left_out = _GATES_OF_AFFINE + VALUE_GATES * own_units
    of_scan = [{"mesh": "volume", **gate} for gate in report["volume"].get("gates", ()) if gate["name"] not in left_out]
    return warn_of_gates(of_scan), warn_of_gates(report["gates"])
