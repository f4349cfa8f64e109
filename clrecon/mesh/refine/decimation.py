"""Decimation by fast-simplification within a bound in mm: what violates bound or topology is undone."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.coordinates import as_stored, rounding_step
from clrecon.mesh.intersections import FindCrossings, find_self_intersections
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.refine.clusters import Clusters
from clrecon.mesh.refine.deviation import Deviation, MakeBounds, SurfaceBounds
from clrecon.mesh.refine.shifts import Volumes, measure_volumes, move_vertices, restore_volumes
from clrecon.mesh.triangles import vertex_normals
from clrecon.system.pieces import local_origin
from clrecon.system.progress import Progress

BOUND_VOXEL = 0.25
"""Default bound in shortest voxel steps; a mean of 0.1 voxel is then kept too."""

_AGGRESSIVENESS = 3.0
"""How fast fast-simplification lets its error grow.  With the bound, 2 to 7 give the same surface, and 3 is fastest."""

_FIRST_AGGRESSIVENESS = 4.0
"""The same for the first round, with half the iterations of `_AGGRESSIVENESS` up to a tenth of the triangles."""

_LAST_ITERATION = 99
_FIRST_ERROR = 20.0
"""Largest quadric error of the first round, in squares of the bound.  The error sums the squared distances to dozens of
planes that meet in a vertex.  With 3800 twice as much has to be undone, and 2 to 3 % more triangles are left."""

_FIRST_SHARE = 0.1
"""Least share of the triangles that the first round leaves: with less of a head, 2 % more were left in the end."""

_ERROR = 4.0
"""The same for later rounds, which start from a surface that is nearly as it can be.  With 2 or 16 more is left."""

_ROUGH_TURNS = 3
"""Repairs after the first round: faults and vertices only, as the next round changes nearly all of the surface."""

_TRIES = 200
"""Most attempts to repair a round; each undoes some collapses, and CT needs 30 to 50."""

_ROUNDS = 12
_LEAST_GAIN = 0.15
"""Rounds of collapses continue while each removes more than this share of the triangles.  Where less than it would do,
there is one more: it costs little, as little changes."""

_SHARE_SLACK = 0.005
"""The wanted number of triangles counts as reached when it is exceeded by this share or less."""

_MOVES = 3
"""Most attempts to restore volumes beside vertices that cannot move as far."""

_SHARE_FOR_VOLUME = 0.1
"""Share of the bound that is kept for the shift that restores the volume of components."""


def default_deviation(mesh: Mesh) -> float:
    """Return the default bound in mm: a quarter of the shortest voxel step that the mesh was made from."""
    if mesh.voxel_mm is None:
        raise UsageError("this mesh does not say how large its voxels were: give max_deviation_mm")
    return BOUND_VOXEL * mesh.voxel_mm


def check_refinement(mesh: Mesh, max_deviation_mm: float | None) -> float:
    bound = default_deviation(mesh) if max_deviation_mm is None else float(max_deviation_mm)
    if not (math.isfinite(bound) and bound > 0.0):
        raise UsageError(f"the largest deviation is a length in mm above 0, not {bound:g}")
    check_triangles(mesh)
    return bound


def check_share(fraction: float) -> None:
    """Check a share of triangles to remove; raises UsageError."""
    if not 0.0 < fraction < 1.0:
        raise UsageError(f"the share of triangles to remove is between 0 and 1, not {fraction:g}")


def check_triangles(mesh: Mesh) -> None:
    """Check that a mesh can be refined; raises as `check_refinement` does."""
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("the surface is empty: there is nothing to refine")
    if max(mesh.vertex_count, 3 * mesh.triangle_count) >= 2**31:
        raise UsageError(f"a mesh of {mesh.triangle_count} triangles is too large to be refined, at most 715,827,882")


def carry_on(mesh: Mesh, name: str, facts: dict[str, Any]) -> dict[str, Any]:
    """Return the report of a mesh with one more entry in ``refinement``."""
    return {**mesh.report, "refinement": {**mesh.report.get("refinement", {}), name: facts}}


def decimate_mesh(
    mesh: Mesh,
    fraction: float,
    max_deviation_mm: float | None = None,
    *,
    progress: Progress | None = None,
    make_bounds: MakeBounds = SurfaceBounds,
    find_crossings: FindCrossings = find_self_intersections,
) -> Mesh:
    """Remove triangles within a bound, see `clrecon.operators.surface.decimation.decimate_mesh`.

    make_bounds, find_crossings: `SurfaceBounds` and `find_self_intersections`, or what does the same elsewhere.
    """
    check_share(fraction)
    bound = check_refinement(mesh, max_deviation_mm)
    origin = local_origin(mesh.vertices)
    clusters = Clusters(mesh.vertices - origin, mesh.triangles, origin, find_crossings)
    # Both surfaces are stored rounded, each coordinate by at most half a step.
    longest = max(_SHARE_FOR_VOLUME * bound - rounding_step(mesh.vertices), 0.0)
    deviation_bound = (1.0 - _SHARE_FOR_VOLUME) * bound
    deviation = Deviation(mesh.vertices - origin, mesh.triangles, deviation_bound, make_bounds, clusters.fans)
    wanted = (1.0 - fraction) * mesh.triangle_count

    def tell_left(left: int) -> None:
        if progress is not None:
            to_go = math.ceil(mesh.triangle_count - wanted)
            progress("decimate", min(mesh.triangle_count - left, to_go), to_go)

    rounds, taken_back = _collapse_in_rounds(clusters, deviation, wanted, bound, tell_left)
    vertices, triangles, undone = _with_volumes(clusters, deviation, mesh, origin, longest, find_crossings)
    facts = {
        "fraction": fraction,
        "reached": 1.0 - len(triangles) / mesh.triangle_count,
        "ended_by": "share" if len(triangles) <= _nearly(wanted) else "bound",
        "rounds": rounds,
        "max_deviation_mm": bound,
        "triangles_before": mesh.triangle_count,
        "vertices_taken_back": taken_back + undone,
        "topology": clusters.compare_topology(),
    }
    return Mesh(vertices, triangles, vertex_normals(vertices, triangles), carry_on(mesh, "decimate", facts))


def _nearly(wanted: float) -> float:
    return wanted * (1.0 + _SHARE_SLACK) + 2


def _collapse_in_rounds(
    clusters: Clusters, deviation: Deviation, wanted: float, bound: float, tell: Callable[[int], None]
) -> tuple[int, int]:
    """Collapse and repair until few triangles are left, or hardly any more go; return rounds and undone collapses."""
    left, is_last = len(clusters.faces()), False
    rounds, taken_back = 0, 0
    while left > _nearly(wanted) and rounds < _ROUNDS:
        tell(left)
        if rounds == 0:
            share = max(wanted / left, _FIRST_SHARE)
            _collapse(clusters, share, bound, _FIRST_ERROR, _FIRST_AGGRESSIVENESS)
            collapsed = clusters.collapsed_count
            # the rest of the faults is left to the next round
            for _ in range(_ROUGH_TURNS):
                clusters.undo(clusters.find_faults())
                if not clusters.undo(clusters.find_left_behind(deviation)):
                    break
            taken_back += collapsed - clusters.collapsed_count
            left, rounds = len(clusters.faces()), 1
        if left > wanted:
            _collapse(clusters, wanted / left, bound)
            rounds += 1
        collapsed, before = clusters.collapsed_count, left
        _mend(clusters, deviation, partial(tell, left))
        taken_back += collapsed - clusters.collapsed_count
        left = len(clusters.faces())
        is_near = wanted >= (1.0 - _LEAST_GAIN) * left
        if left > (1.0 - _LEAST_GAIN) * before and (is_last or not is_near):
            break
        is_last = is_near
    tell(left)
    return rounds, taken_back


def _with_volumes(
    clusters: Clusters,
    deviation: Deviation,
    mesh: Mesh,
    origin: NDArray[np.float64],
    longest: float,
    find_crossings: FindCrossings,
) -> tuple[NDArray[np.floating], NDArray[np.uint32], int]:
    """Return the surface with its components' volumes, and the collapses undone where that moves over `longest`."""
    count, labels, border = clusters.components()
    wanted = measure_volumes(mesh.vertices - origin, mesh.triangles, count, labels, border)
    collapsed, steps = clusters.collapsed_count, np.zeros((mesh.vertex_count, 3))
    fresh = np.zeros(count, dtype=bool)
    for _ in range(_TRIES):
        standing, triangles = clusters.take_changed()
        fresh[labels[standing]] = True
        places, step = clusters.places[standing], np.zeros((len(standing), 3))
        restore_volumes(places, step, triangles, labels[standing], wanted, longest)
        steps[standing] = step
        now = measure_volumes(places + step, triangles, count, labels[standing], border[standing])
        if not clusters.undo(standing[wanted.differ(now)[labels[standing]]]):
            vertices, triangles, stuck, spoilt = _move(clusters, wanted, origin, longest, steps, fresh, find_crossings)
            fresh[:] = False
            fresh[labels[spoilt]] = True
            if not clusters.undo(stuck) and not clusters.undo(spoilt):
                break
        _mend(clusters, deviation)
    return vertices, triangles, collapsed - clusters.collapsed_count


def _move(
    clusters: Clusters,
    wanted: Volumes,
    origin: NDArray[np.float64],
    longest: float,
    steps: NDArray[np.float64],
    fresh: NDArray[np.bool_],
    find_crossings: FindCrossings,
) -> tuple[NDArray[np.floating], NDArray[np.uint32], NDArray[np.integer], NDArray[np.integer]]:
    """Move the surface by the steps; what one of a component is held back by, the others make up for.

    steps: Of each vertex of the given surface, mm; changed in place to those that were made, but where volume is lost.
    fresh: Components whose steps have not been made.
    Returns the surface; of components that have still lost their volume so the vertices held back, and all.
    """
    standing, triangles = clusters.numbered()
    count, labels, border = clusters.components()
    labels, places = labels[standing], clusters.places[standing]
    step = steps[standing]
    stuck, look_at = np.zeros(len(standing), dtype=bool), fresh[labels[triangles[:, 0]]]
    for _ in range(_MOVES):
        vertices = move_vertices(as_stored(places + origin), triangles, step, find_crossings, look_at=look_at)[0]
        moved = vertices - origin - places
        stuck |= np.abs(moved - step).max(axis=1) > rounding_step(vertices)
        now = measure_volumes(places + moved, triangles, count, labels, border[standing])
        spoilt = wanted.differ(now) & (np.bincount(labels[stuck], minlength=count) > 0)
        if not spoilt.any():
            break
        step, look_at = moved, spoilt[labels[triangles[:, 0]]]
        restore_volumes(places, step, triangles[look_at], labels, wanted, longest, stuck | ~spoilt[labels])
    is_sound = ~spoilt[labels]
    steps[standing[is_sound]] = moved[is_sound]
    return vertices, triangles, standing[~is_sound & stuck], standing[~is_sound]


def _mend(clusters: Clusters, deviation: Deviation, tell: Callable[[], None] = lambda: None) -> None:
    """Undo collapses until the surface is sound and within the bound; cheap checks with large effect come first."""
    for _ in range(_TRIES):
        tell()
        if clusters.undo(clusters.find_faults()):
            continue
        if clusters.undo(clusters.find_far(deviation)):
            continue
        if clusters.undo(clusters.find_crossing()):
            continue
        if not clusters.undo(clusters.find_faults(everywhere=True)):
            break


def _collapse(
    clusters: Clusters, left_share: float, bound: float, error: float = _ERROR, aggressiveness: float = _AGGRESSIVENESS
) -> None:
    """Make one round of fast-simplification, to `left_share` of the triangles or an `error` of squares of the bound."""
    from fast_simplification import simplify

    # In iteration i it collapses edges of an error up to 1e-9 * (i + 3)**agg.  Coordinates are scaled so that the last
    # iteration reaches the bound's error.
    largest_error = 1e-9 * (_LAST_ITERATION + 3) ** aggressiveness
    scale = math.sqrt(largest_error / error) / bound
    standing, triangles = clusters.numbered()
    points, faces, collapses = simplify(
        clusters.places[standing] * scale,
        triangles.view(np.int32),
        target_reduction=1.0 - left_share,
        agg=aggressiveness,
        return_collapses=True,
    )
    clusters.collapse(collapses, points / scale, faces)
