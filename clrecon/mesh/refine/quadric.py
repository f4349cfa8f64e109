"""Quadric collapse without a bound: the fastest way to fewer triangles, and a measure of what it cost.

Edges are collapsed in order of their quadric error until the share is reached.  Nothing keeps the surface closed, its
tunnels open or its small parts there: the report says what became of them, and `decimate_mesh` is for everything else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError
from clrecon.exchange.coordinates import as_stored
from clrecon.mesh.compare.distances import SAMPLES, NearDistance, SurfaceDistance, sample_surface
from clrecon.mesh.connectivity import find_edges, find_used, label_components
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.refine.decimation import carry_on, check_share, check_triangles
from clrecon.mesh.refine.topology import TopologyChange, compare_topology, measure_topology
from clrecon.system.arguments import explains_arguments
from clrecon.system.pieces import local_origin
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Gate, none_of

_EXACT = 64
"""Points at a time that are measured exactly."""

_NEAREST = 3
"""Vertices near a point around which distances are measured first."""

Points = NDArray[np.float64]


@explains_arguments
def collapse_quadric(mesh: Mesh, fraction: float, *, progress: Progress | None = None) -> Mesh:
    """Remove triangles by collapsing edges in order of their quadric error, with no bound (Garland and Heckbert 1997).

    This is the method of fast-simplification.  It takes whole small parts away, closes and tears tunnels and leaves
    edges in one or in more than two triangles.  What it did is measured; `decimate_mesh` keeps a bound and the
    topology.

    Parameters
    ----------
    mesh : Mesh
    fraction : float
        Share of the triangles to remove, above 0 and below 1.
    progress : callable, optional
        Called as ``progress("decimate", steps done, 3)``.

    Returns
    -------
    Mesh
        Normals from the faces; the report is taken over, with ``refinement["quadric"]``: ``fraction`` (asked for),
        ``reached``, ``triangles_before``, ``farthest_mm`` (the largest distance found between the surfaces, from
        points that cover each evenly, and from all vertices of the parts that were lost), ``samples``, ``topology``
        (``clrecon.mesh.refine.topology.TopologyChange``) and ``gates`` (no components lost, no edge more that is not in
        two triangles); a gate that fails is a warning in ``warnings`` too.

    Raises
    ------
    UsageError
        The share cannot be used, or the mesh fails its check.
    NoSurfaceError
        The mesh is empty, or nothing is left of it.
    """
    from fast_simplification import simplify

    check_share(fraction)
    check_triangles(mesh)
    progress = progress or ignore_progress
    progress("decimate", 0, 3)
    origin = local_origin(mesh.vertices)
    points, triangles, collapses = simplify(
        mesh.vertices - origin, mesh.triangles.view(np.int32), target_reduction=fraction, return_collapses=True
    )
    if len(triangles) == 0:
        raise NoSurfaceError(
            f"nothing is left of {mesh.triangle_count} triangles: take a smaller share than {fraction:g}"
        )
    progress("decimate", 1, 3)
    vertices, triangles = as_stored(points + origin), triangles.astype(np.uint32)
    topology, lost = _compare_topology(mesh, triangles, last_of_collapses(collapses, mesh.vertex_count))
    progress("decimate", 2, 3)
    gates = _gates_of_topology(topology)
    facts: dict[str, Any] = {
        "fraction": fraction,
        "reached": 1.0 - len(triangles) / mesh.triangle_count,
        "triangles_before": mesh.triangle_count,
        "farthest_mm": measure_farthest(mesh, vertices, triangles, lost),
        "samples": SAMPLES,
        "topology": topology,
        "gates": gates,
    }
    progress("decimate", 3, 3)
    refined = carry_on(mesh, vertices, triangles, "quadric", facts)
    failed = [gate.text for gate in gates if not gate.ok]
    if failed:
        refined.report["warnings"] = [*refined.report.get("warnings", []), *failed]
    return refined


def last_of_collapses(collapses: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """Return for each vertex the one that it was merged into in the end; the second of a pair goes into the first."""
    into = np.arange(count)
    into[collapses[:, 1]] = collapses[:, 0]
    while True:
        further = into[into]
        if np.array_equal(further, into):
            return into
        into = further


def _compare_topology(
    mesh: Mesh, triangles: NDArray[np.uint32], names: NDArray[np.int64]
) -> tuple[TopologyChange, NDArray[np.int64]]:
    """Compare the topology with that before; return also the vertices of components that were lost."""
    edges = find_edges(mesh.triangles, mesh.vertex_count)
    count, labels = label_components(mesh.triangles, mesh.vertex_count, edges)
    before = measure_topology(mesh.triangles, labels, count, edges)
    # The vertices that are left are those with faces, in their order.
    named = names[mesh.triangles]
    a, b, c = named.T
    standing = find_used(named[(a != b) & (b != c) & (c != a)], mesh.vertex_count)
    after = measure_topology(triangles, labels[standing], count)
    gone = np.append((before.faces > 0) & (after.faces == 0), False)  # unused vertices have the label -1
    return compare_topology(before, after), np.flatnonzero(gone[labels])


def _gates_of_topology(change: TopologyChange) -> list[Gate]:
    lost = f"components of {change.components_before:,} that collapsing edges by their quadric error has lost"
    opened = max(change.loose_edges_after - change.loose_edges_before, 0)
    return [
        none_of("components_lost", change.components_lost, lost),
        none_of("edges_opened", opened, "edges that collapsing has made, in one triangle or in more than two"),
    ]


def measure_farthest(
    mesh: Mesh, vertices: NDArray[np.floating], triangles: NDArray[np.uint32], also: NDArray[np.integer] | None = None
) -> float:
    """Return the largest distance in mm, from vertices `also` (default: all) and points that cover both surfaces."""
    origin = local_origin(mesh.vertices)
    before, after = mesh.vertices - origin, vertices - origin
    seen = np.concatenate([sample_surface(before, mesh.triangles), before if also is None else before[also]])
    there = _farthest_point(seen, after, triangles)
    return max(there, _farthest_point(sample_surface(after, triangles), before, mesh.triangles))


def _farthest_point(points: Points, vertices: Points, triangles: NDArray[np.uint32]) -> float:
    """Return the distance of the farthest of some points, measured exactly where that to near triangles is large."""
    from scipy.spatial import cKDTree

    used = find_used(triangles, len(vertices))
    near = used[cKDTree(vertices[used]).query(points, k=min(_NEAREST, len(used)), workers=-1)[1]]
    at_most = NearDistance(vertices, triangles).find_around(points, near.reshape(len(points), -1))[0]
    order = np.argsort(-at_most)
    exact, farthest = SurfaceDistance(vertices, triangles), 0.0
    for first in range(0, len(order), _EXACT):
        some = order[first : first + _EXACT]
        if at_most[some[0]] <= farthest:
            break
        farthest = max(farthest, float(exact(points[some]).max()))
    return farthest
