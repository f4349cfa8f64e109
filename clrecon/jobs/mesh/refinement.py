"""Smoothing and decimation of the surfaces of a job, and the gates of its meshes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part
from clrecon.system.progress import Progress, Steps, ignore_progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device

__all__ = ["describe_purposes", "judge_parts", "refine_surface", "warn_of_gates"]


def refine_surface(mesh: Mesh, settings: MeshSettings, device: Device, progress: Progress = ignore_progress) -> Mesh:
    """Smooth and decimate as the settings say; return the mesh itself if they ask for neither.

    Distances are bounded on the device, unless the settings limit its memory: what they allow is for the surface.

    Returns
    -------
    Mesh
        Its report: ``refinement``: ``smooth``, ``decimate`` (see `clrecon.mesh.refine.decimation`), ``deviation``,
        which is `clrecon.mesh.compare_meshes` with the surface before, and ``voxel_mm``.
    """
    if not settings.refines:
        return mesh
    from clrecon.mesh.compare.distances import compare_meshes
    from clrecon.mesh.refine.decimation import BOUND_VOXEL, default_deviation
    from clrecon.mesh.refine.quadric import collapse_quadric
    from clrecon.mesh.refine.smoothing import smooth_mesh
    from clrecon.operators.surface.decimation import decimate_mesh

    raw = mesh
    if settings.smooth is not None:
        mesh = smooth_mesh(mesh, settings.smooth, settings.max_deviation_mm, progress=progress)
    share = settings.decimate_used
    if share is not None and settings.method == "g-mc":
        mesh = collapse_quadric(mesh, share, progress=progress)
    elif share is not None:
        where = device if settings.memory is None else None
        mesh = decimate_mesh(mesh, share, settings.max_deviation_mm, device=where, progress=progress)
    mesh.report["refinement"] |= {
        "deviation": compare_meshes(mesh, raw, progress=progress),
        "voxel_mm": default_deviation(raw) / BOUND_VOXEL,
    }
    return mesh


def judge_parts(
    parts: Sequence[Part],
    volume: Volume,
    settings: MeshSettings,
    device: Device | None = None,
    progress: Progress = ignore_progress,
) -> list[dict[str, Any]]:
    """Judge the parts of a job by the gates; the measures are stored in the `facts` of each.

    Parameters
    ----------
    parts : sequence of Part
        Parts as they are written, with the result of `Mesh.quality`. A part that was not measured has only the gates of
        refinement.
    volume : Volume
        The volume that they were made from.
    settings : MeshSettings
        With `strict`, triangles that cut each other are searched.
    device : Device, optional
        Helps with the search; without one the host finds the same.
    progress : callable, optional
        Called as ``progress("distance", parts done, parts)`` and ``progress("crossings", triangles done, triangles)``.

    Returns
    -------
    list of dict
        All gates, see `clrecon.mesh.compare.gates.judge_mesh`, each with ``mesh``, the name of its part or None.
    """
    if not (settings.refines or any(part.quality for part in parts)):
        for part in parts:
            part.facts |= {"iso_distance": None, "refinement": None}
        return []
    from clrecon.mesh.compare.gates import judge_mesh
    from clrecon.mesh.compare.iso_distance import measure_iso_distance, rule_of_report

    gates = []
    if settings.strict:
        _count_crossings([part for part in parts if part.quality is not None], device, progress)
    steps = Steps(progress, "distance", len(parts))
    for part in parts:
        mesh, refinement = part.mesh, part.mesh.report.get("refinement")
        iso_distance = None
        if part.quality is not None:
            rule = None if part.surface.label is not None else rule_of_report(mesh.report)
            iso_distance = None if rule is None else measure_iso_distance(mesh, volume, rule)
        found = judge_mesh(
            part.quality,
            closed=settings.closed,
            outward=not settings.split,
            iso_distance=iso_distance,
            deviation=refinement and refinement["deviation"],
            voxel_mm=refinement and refinement["voxel_mm"],
        )
        part.facts |= {"iso_distance": iso_distance, "refinement": refinement}
        gates += [{"mesh": part.name or None, **gate} for gate in found]
        steps.take()
    return gates


def _count_crossings(parts: Sequence[Part], device: Device | None, progress: Progress) -> None:
    """Store in the quality of each part how many pairs of its triangles cut each other."""
    from clrecon.mesh.intersections import find_self_intersections
    from clrecon.opencl import work_on
    from clrecon.operators.surface.crossings import find_crossings

    steps = Steps(progress, "crossings", sum(part.mesh.triangle_count for part in parts))
    for part in parts:
        vertices, triangles = part.mesh.vertices, part.mesh.triangles

        def look(
            current: Device,
            _: list[str],
            vertices: NDArray[np.floating] = vertices,
            triangles: NDArray[np.uint32] = triangles,
        ) -> NDArray[np.int64]:
            return find_crossings(current, vertices, triangles, steps=steps)

        if device is None:
            found = find_self_intersections(vertices, triangles, steps=steps)
        else:
            found = work_on(device, look)
        assert part.quality is not None
        part.quality = part.quality.changed(self_intersections=len(found))


def describe_purposes(parts: Sequence[Part]) -> list[str]:
    """Measure what the purpose of the meshes needs, as ``print`` in the `facts` of each; return warnings."""
    from clrecon.jobs.mesh.print_facts import describe_print, warn_of_print

    warnings = []
    for part in parts:
        part.facts["print"] = None if part.pieces is None else describe_print(part.mesh, *part.pieces)
        if part.facts["print"] is not None:
            name = f"{part.name}: " if part.name else ""
            warnings += [name + text for text in warn_of_print(part.facts["print"])]
    return warnings


def warn_of_gates(gates: Sequence[dict[str, Any]]) -> list[str]:
    """Return one line for each failed gate, with the name of its mesh if there are several."""
    from clrecon.system.gates import failed_gates

    return [f"{gate['mesh']}: {line}" if gate["mesh"] else line for gate in gates for line in failed_gates([gate])]
