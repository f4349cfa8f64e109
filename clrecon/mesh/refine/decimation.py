"""Fewer triangles, within a bound in mm of the surface as it was.

fast-simplification chooses which edges are collapsed.  What is added here is the bound and the topology: where the
result would leave either, the place is taken back, and what is left is tried again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.coordinates import as_stored, rounding_step
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.normals import vertex_normals
from clrecon.mesh.refine.clusters import Clusters
from clrecon.mesh.refine.deviation import Deviation
from clrecon.mesh.refine.shifts import measure_volumes, move_vertices, restore_volumes
from clrecon.system.pieces import local_origin
from clrecon.system.progress import Progress

__all__ = ["BOUND_VOXEL", "carry_on", "check_refinement", "decimate_mesh", "default_deviation"]

BOUND_VOXEL = 0.25
"""Bound where none is given, in the shortest voxel step: with it a mean of 0.1 voxel is kept as well."""

_AGGRESSIVENESS = 3.0
"""How fast fast-simplification lets its error grow.  With the bound 2 to 7 give the same surface, 3 is fastest."""

_LAST_ITERATION = 99
_ERROR_OVER_BOUND = 4.0
"""Largest quadric error of a round, in squares of the bound.  It sums the squared distances to all planes that meet in
a vertex, dozens of them: with 16 as much is taken away in the end, but three times as much has to be taken back."""

_TRIES = 200
"""Of mending, at most; each undoes something, on CT 3 to 8 are needed."""

_ROUNDS = 12
_LEAST_GAIN = 0.15
"""Rounds of collapses go on while one takes away more than this share of the triangles that are left."""

_SHARE_SLACK = 0.005
"""Of the triangles that are to be left: so many more count as reached."""

_SHARE_FOR_VOLUME = 0.1
"""Of the bound, kept for the shift that gives components their volume back."""


def default_deviation(mesh: Mesh) -> float:
    """The bound in mm where none is given: a quarter of the shortest voxel step that the mesh was made from.

    Raises
    ------
    UsageError
        The report of the mesh has no ``affine_ijk_to_lps_mm``.
    """
    affine = mesh.report.get("affine_ijk_to_lps_mm")
    if affine is None:
        raise UsageError("this mesh does not say how large its voxels were: give max_deviation_mm")
    steps = np.linalg.norm(np.array(affine, dtype=np.float64)[:3, :3], axis=0)
    return BOUND_VOXEL * float(steps.min())


def check_refinement(mesh: Mesh, max_deviation_mm: float | None) -> float:
    """Check a mesh that is to be refined; returns the bound in mm.

    Raises
    ------
    UsageError
        The bound is no length, or the mesh is too large or fails its check.
    NoSurfaceError
        The mesh is empty.
    """
    bound = default_deviation(mesh) if max_deviation_mm is None else float(max_deviation_mm)
    if not (math.isfinite(bound) and bound > 0.0):
        raise UsageError(f"the largest deviation is a length in mm above 0, not {bound:g}")
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("the surface is empty: there is nothing to refine")
    if max(mesh.vertex_count, 3 * mesh.triangle_count) >= 2**31:
        raise UsageError(f"a mesh of {mesh.triangle_count} triangles is too large to be refined, at most 715,827,882")
    return bound


def carry_on(mesh: Mesh, name: str, said: dict[str, Any]) -> dict[str, Any]:
    """The report of a mesh with one more entry in ``refinement``."""
    return {**mesh.report, "refinement": {**mesh.report.get("refinement", {}), name: said}}


def decimate_mesh(
    mesh: Mesh, fraction: float, max_deviation_mm: float | None = None, *, progress: Progress | None = None
) -> Mesh:
    """Take triangles away by collapsing edges in order of their quadric error (Garland and Heckbert 1997).

    fast-simplification chooses the collapses and stops where the error reaches the bound.  Collapses whose result
    lies further away than the bound, is not manifold, has faces without area, cuts itself or has lost a component are
    then undone, so that a closed and manifold surface stays one and keeps all its components.  What that leaves is
    tried again in more rounds, until the share is reached or hardly anything more is won within the bound.

    Parameters
    ----------
    mesh : Mesh
    fraction : float
        Share of the triangles to take away, above 0 and below 1.  Less goes where the bound says so.
    max_deviation_mm : float, optional
        No vertex and no middle of an edge or a triangle of either surface lies further from the other.  Default:
        `default_deviation`.
    progress : callable, optional
        Called as ``progress("decimate", triangles taken away, all that are to go)``, several times a round.

    Returns
    -------
    Mesh
        Normals from the faces; the report goes on, with ``refinement["decimate"]``: ``fraction`` (asked for),
        ``reached``, ``ended_by`` (``"share"`` or ``"bound"``), ``rounds``, ``max_deviation_mm``, ``triangles_before``,
        ``vertices_taken_back``.

    Raises
    ------
    UsageError
        A value that cannot be used, or no bound and a mesh that does not say its voxel size.
    NoSurfaceError
        The mesh is empty.
    """
    if not 0.0 < fraction < 1.0:
        raise UsageError(f"the share of triangles to take away lies between 0 and 1, {fraction:g} does not")
    bound = check_refinement(mesh, max_deviation_mm)
    origin = local_origin(mesh.vertices)
    clusters = Clusters(mesh.vertices - origin, mesh.triangles, origin)
    # Both surfaces are kept rounded, each coordinate by half a step at most.
    longest = max(_SHARE_FOR_VOLUME * bound - rounding_step(mesh.vertices), 0.0)
    deviation = Deviation(mesh.vertices - origin, mesh.triangles, (1.0 - _SHARE_FOR_VOLUME) * bound)
    wanted = (1.0 - fraction) * mesh.triangle_count
    nearly = wanted * (1.0 + _SHARE_SLACK) + 2
    left, rounds, taken_back = mesh.triangle_count, 0, 0

    def tell() -> None:
        if progress is not None:
            to_go = math.ceil(mesh.triangle_count - wanted)
            progress("decimate", min(mesh.triangle_count - left, to_go), to_go)

    while left > nearly and rounds < _ROUNDS:
        tell()
        _collapse(clusters, wanted / left, bound)
        collapsed = clusters.collapsed_count
        _mend(clusters, deviation, tell)
        taken_back += collapsed - clusters.collapsed_count
        rounds += 1
        before, left = left, len(clusters.faces())
        if left > (1.0 - _LEAST_GAIN) * before:
            break
    tell()
    vertices, triangles = _with_volumes(clusters, mesh, origin, longest)
    said = {
        "fraction": fraction,
        "reached": 1.0 - len(triangles) / mesh.triangle_count,
        "ended_by": "share" if left <= nearly else "bound",
        "rounds": rounds,
        "max_deviation_mm": bound,
        "triangles_before": mesh.triangle_count,
        "vertices_taken_back": taken_back,
    }
    return Mesh(vertices, triangles, vertex_normals(vertices, triangles), carry_on(mesh, "decimate", said))


def _with_volumes(
    clusters: Clusters, mesh: Mesh, origin: NDArray[np.float64], longest: float
) -> tuple[NDArray[np.floating], NDArray[np.uint32]]:
    """The surface of clusters as it is stored, each closed component with the volume it had in the mesh."""
    places, triangles = clusters.surface()
    wanted = measure_volumes(mesh.vertices - origin, mesh.triangles)
    step = np.zeros_like(places)
    restore_volumes(places, step, triangles, wanted.labels[clusters.standing()], wanted, longest)
    return move_vertices(as_stored(places + origin), triangles, step)[0], triangles


def _mend(clusters: Clusters, deviation: Deviation, tell: Callable[[], None] = lambda: None) -> None:
    """Undo clusters until the surface is sound and within the bound; what is cheap and changes most comes first."""
    for _ in range(_TRIES):
        tell()
        if clusters.undo(clusters.find_faults()):
            continue
        if clusters.undo(clusters.find_far(deviation)):
            continue
        if not clusters.undo(clusters.find_crossing()):
            break


def _collapse(clusters: Clusters, left_share: float, bound: float) -> None:
    """One round of fast-simplification on the present surface, of whose triangles `left_share` is to be left."""
    from fast_simplification import simplify

    # In iteration i it collapses edges of an error up to 1e-9 * (i + 3)**agg: scaled, the last is the bound's.
    largest_error = 1e-9 * (_LAST_ITERATION + 3) ** _AGGRESSIVENESS
    scale = math.sqrt(largest_error / _ERROR_OVER_BOUND) / bound
    vertices, triangles = clusters.surface()
    points, faces, collapses = simplify(
        vertices * scale,
        triangles.view(np.int32),
        target_reduction=1.0 - left_share,
        agg=_AGGRESSIVENESS,
        return_collapses=True,
    )
    clusters.collapse(collapses, points / scale, faces)
