"""Fewer triangles and less noise, within a bound in mm of the surface as it was extracted.

The work is done by libraries: VTK's windowed sinc filter and fast-simplification.  What is added here is the bound
and the topology: where the result would leave either, the place is taken back.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.clusters import Clusters
from clrecon.mesh.connectivity import find_edges
from clrecon.mesh.coordinates import as_stored
from clrecon.mesh.distances import NearDistance
from clrecon.mesh.measures import cross_products, local_origin
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.normals import vertex_normals

__all__ = ["BOUND_VOXEL", "decimate_mesh", "default_deviation", "smooth_mesh"]

BOUND_VOXEL = 0.25
"""Bound where none is given, in the shortest voxel step: with it a mean of 0.1 voxel is kept as well."""

_PASS_BAND = 0.1
"""Of the windowed sinc filter.  On CT at 0.7 mm and 20 iterations the surface moves 0.05 voxel in the mean and 0.15
at the 95th percentile; half as wide a band loses more than 0.5 % of volume."""

_AGGRESSIVENESS = 3.0
"""How fast fast-simplification lets its error grow.  With the bound 2 to 7 give the same surface, 3 is fastest."""

_LAST_ITERATION = 99
_ERROR_OVER_BOUND = 16.0
"""Largest quadric error in squares of the bound.  It sums the squared distances to all planes that meet in a vertex,
dozens of them: at 4 a quarter of the bound is used, at 16 half of it (95 % of the surface), beyond more places have
to be taken back than are won."""

_ROUNDS = 200
"""At most; each undoes something, on CT about 30 are needed."""


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


def _checked(mesh: Mesh, max_deviation_mm: float | None) -> float:
    bound = default_deviation(mesh) if max_deviation_mm is None else float(max_deviation_mm)
    if not (math.isfinite(bound) and bound > 0.0):
        raise UsageError(f"the largest deviation is a length in mm above 0, not {bound:g}")
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("the surface is empty: there is nothing to refine")
    if max(mesh.vertex_count, 3 * mesh.triangle_count) >= 2**31:
        raise UsageError(f"a mesh of {mesh.triangle_count} triangles is too large to be refined, at most 715,827,882")
    return bound


def smooth_mesh(mesh: Mesh, iterations: int = 20, max_deviation_mm: float | None = None) -> Mesh:
    """Smooth a surface with a windowed sinc filter (Taubin, Zhang and Golub 1996), which hardly shrinks it.

    A vertex that would come to lie further than the bound from the surface as it was goes only so far along its way.
    Vertices at an open border stay.

    Parameters
    ----------
    mesh : Mesh
    iterations : int
        Degree of the filter; more smooth more.
    max_deviation_mm : float, optional
        No vertex comes to lie further from the given surface, and none of the given ones further from the result.
        Default: `default_deviation`.

    Returns
    -------
    Mesh
        The same triangles; normals from the faces; the report goes on, with ``refinement["smooth"]``:
        ``iterations``, ``max_deviation_mm``, ``vertices_held_back``.

    Raises
    ------
    UsageError
        A value that cannot be used, or no bound and a mesh that does not say its voxel size.
    NoSurfaceError
        The mesh is empty.
    """
    if isinstance(iterations, float) or not 1 <= iterations <= 1000:
        raise UsageError(f"smoothing takes from 1 to 1000 iterations, not {iterations}")
    bound = _checked(mesh, max_deviation_mm)
    origin = local_origin(mesh.vertices)
    before = mesh.vertices - origin
    step = _windowed_sinc(before.astype(np.float32), mesh.triangles, iterations) - before

    edges = find_edges(mesh.triangles, mesh.vertex_count)
    step[edges.ends[:, edges.uses == 1]] = 0.0  # VTK smooths along the border all the same
    held = _hold_back(before, step, mesh.triangles, bound)

    vertices = as_stored(origin + before + step)
    for _ in range(_ROUNDS):
        flat = _flat_corners(vertices, mesh.triangles)
        flat = flat[(vertices[flat] != mesh.vertices[flat]).any(axis=1)]
        if len(flat) == 0:
            break
        vertices[flat] = mesh.vertices[flat]
        held = np.union1d(held, flat)
    said = {"iterations": iterations, "max_deviation_mm": bound, "vertices_held_back": len(held)}
    return Mesh(vertices, mesh.triangles, vertex_normals(vertices, mesh.triangles), _carry_on(mesh, "smooth", said))


def _hold_back(
    before: NDArray[np.float64], step: NDArray[np.float64], triangles: NDArray[np.uint32], bound: float
) -> NDArray[np.integer]:
    """Shorten steps to `bound` where either surface has a vertex further than that from the other; says which.

    A vertex may go further than the bound along the surface.
    """
    length = np.sqrt(np.einsum("na,na->n", step, step))
    looked_at = np.flatnonzero(length > bound)
    is_held = np.zeros(len(before), dtype=bool)
    from_before = NearDistance(before, triangles)
    for _ in range(_ROUNDS):
        after = before + step
        far = from_before(after[looked_at], looked_at, bound) > bound
        far |= NearDistance(after, triangles)(before[looked_at], looked_at, bound) > bound
        held = looked_at[far]
        if len(held) == 0:
            break
        step[held] *= (bound / length[held])[:, None]
        is_held[held] = True
        moved = np.zeros(len(before), dtype=bool)
        moved[held] = True
        beside = np.zeros(len(before), dtype=bool)  # the triangles around these have changed
        beside[triangles[moved[triangles].any(axis=1)]] = True
        looked_at = looked_at[beside[looked_at] & ~is_held[looked_at]]
    return np.flatnonzero(is_held)


def _windowed_sinc(
    vertices: NDArray[np.float32], triangles: NDArray[np.uint32], iterations: int
) -> NDArray[np.floating]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkWindowedSincPolyDataFilter

    from clrecon.mesh.vtk_bridge import make_polydata

    smoother = vtkWindowedSincPolyDataFilter()
    smoother.SetInputData(make_polydata(vertices, triangles, None))
    smoother.SetNumberOfIterations(iterations)
    smoother.SetPassBand(_PASS_BAND)
    smoother.NormalizeCoordinatesOn()
    smoother.NonManifoldSmoothingOn()
    smoother.BoundarySmoothingOff()
    smoother.FeatureEdgeSmoothingOff()
    smoother.Update()
    return vtk_to_numpy(smoother.GetOutput().GetPoints().GetData()).astype(np.float64)


def _flat_corners(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> NDArray[np.integer]:
    """Vertices of triangles without area."""
    flat = [
        where.start + np.flatnonzero(~cross.any(axis=0))
        for where, _, cross in cross_products(vertices, triangles, np.zeros(3))
    ]
    return np.unique(triangles[np.concatenate(flat)])


def _carry_on(mesh: Mesh, name: str, said: dict[str, Any]) -> dict[str, Any]:
    return {**mesh.report, "refinement": {**mesh.report.get("refinement", {}), name: said}}


def decimate_mesh(mesh: Mesh, fraction: float, max_deviation_mm: float | None = None) -> Mesh:
    """Take triangles away by collapsing edges in order of their quadric error (Garland and Heckbert 1997).

    fast-simplification chooses the collapses and stops where the error reaches the bound.  Collapses whose result
    lies further away than the bound, is not manifold, has faces without area, cuts itself or has lost a component are
    then undone, so that a closed and manifold surface stays one and keeps all its components.

    Parameters
    ----------
    mesh : Mesh
    fraction : float
        Share of the triangles to take away, above 0 and below 1.  Less goes where the bound says so.
    max_deviation_mm : float, optional
        No vertex of the given surface lies further from the result, and no vertex and no centre of a triangle of the
        result further from the given surface.  Default: `default_deviation`.

    Returns
    -------
    Mesh
        Normals from the faces; the report goes on, with ``refinement["decimate"]``: ``fraction`` (asked for),
        ``reached``, ``max_deviation_mm``, ``triangles_before``, ``vertices_taken_back``.

    Raises
    ------
    UsageError
        A value that cannot be used, or no bound and a mesh that does not say its voxel size.
    NoSurfaceError
        The mesh is empty.
    """
    if not 0.0 < fraction < 1.0:
        raise UsageError(f"the share of triangles to take away lies between 0 and 1, {fraction:g} does not")
    bound = _checked(mesh, max_deviation_mm)
    origin = local_origin(mesh.vertices)
    clusters = _collapse(mesh.vertices - origin, mesh.triangles, fraction, bound)
    collapsed = clusters.collapsed_count
    _mend(clusters, origin, bound)
    vertices, triangles = clusters.surface(origin)
    said = {
        "fraction": fraction,
        "reached": 1.0 - len(triangles) / mesh.triangle_count,
        "max_deviation_mm": bound,
        "triangles_before": mesh.triangle_count,
        "vertices_taken_back": collapsed - clusters.collapsed_count,
    }
    return Mesh(vertices, triangles, vertex_normals(vertices, triangles), _carry_on(mesh, "decimate", said))


def _mend(clusters: Clusters, origin: NDArray[np.float64], bound: float) -> None:
    """Undo clusters until the surface is sound and within the bound; what is cheap and changes most comes first."""
    whole, uncut = True, False
    for _ in range(_ROUNDS):
        if clusters.undo(clusters.find_faults(origin)):
            uncut = False
        elif clusters.undo(clusters.find_far(bound, all_vertices=whole)):
            whole = uncut = False
        elif not uncut and clusters.undo(clusters.find_crossing(origin)):
            whole = False
        elif whole:
            break
        else:
            whole = uncut = True


def _collapse(vertices: NDArray[np.float64], triangles: NDArray[np.uint32], fraction: float, bound: float) -> Clusters:
    """Run fast-simplification and read off which vertices it has brought together, and where."""
    from fast_simplification import simplify

    # In iteration i it collapses edges of an error up to 1e-9 * (i + 3)**agg: scaled, the last is the bound's.
    largest_error = 1e-9 * (_LAST_ITERATION + 3) ** _AGGRESSIVENESS
    scale = math.sqrt(largest_error / _ERROR_OVER_BOUND) / bound
    points, faces, collapses = simplify(
        vertices * scale,
        triangles.view(np.int32),
        target_reduction=fraction,
        agg=_AGGRESSIVENESS,
        return_collapses=True,
    )
    return Clusters.from_collapses(vertices, triangles, collapses, points / scale, faces)
