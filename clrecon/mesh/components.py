"""Keep the large parts of a surface and drop the crumbs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh.connectivity import label_components
from clrecon.mesh.measures import cross_products, local_origin
from clrecon.mesh.mesh import Mesh

__all__ = ["select_components"]


def select_components(mesh: Mesh, keep_largest: int | None = None, min_volume_ml: float | None = None) -> Mesh:
    """Keep the largest components of a surface.

    Components are ranked by area, not by volume: a part that is open at the border of the scan encloses nothing,
    and the wall of a cavity has a negative volume.  The wall of a cavity is a component of its own; where it is
    dropped, the cavity is filled.

    Parameters
    ----------
    mesh : Mesh
    keep_largest : int, optional
        Keep so many components, those of largest area (of equal ones the first), of those that are large enough.
    min_volume_ml : float, optional
        Keep components that enclose at least so much, whatever the sign.  What an open component encloses is
        measured as if its rim were joined to the mean of its corners.

    Returns
    -------
    Mesh
        Vertices and triangles keep their order, normals and report come along; the mesh itself when nothing is
        dropped.  Its report has ``components_found`` and ``components_kept``.

    Raises
    ------
    UsageError
        `keep_largest` below 1, or `min_volume_ml` negative or not a number.
    NoSurfaceError
        The mesh is empty or no component is large enough; the message has the largest.
    """
    if keep_largest is not None and (isinstance(keep_largest, float) or keep_largest < 1):
        raise UsageError(f"keep_largest is a whole number from 1, not {keep_largest}")
    if min_volume_ml is not None and not (math.isfinite(min_volume_ml) and min_volume_ml >= 0):
        raise UsageError(f"min_volume_ml is a volume in ml from 0, not {min_volume_ml}")
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("the surface is empty: there is no component to keep")

    count, labels = label_components(mesh.triangles, mesh.vertex_count)
    label_of_triangle = labels[mesh.triangles[:, 0]]
    areas, volumes = _measure_components(mesh, label_of_triangle, count)
    keep = np.ones(count, dtype=bool)
    if min_volume_ml is not None:
        keep = volumes >= min_volume_ml
        if not keep.any():
            raise NoSurfaceError(
                f"none of the {count} components encloses {min_volume_ml:g} ml: "
                f"the largest has {volumes.max():.4g} ml, ask for less"
            )
    if keep_largest is not None:
        ranked = np.argsort(-areas, kind="stable")
        keep[ranked[keep[ranked]][keep_largest:]] = False

    found = {"components_found": count, "components_kept": int(np.count_nonzero(keep))}
    if keep.all():
        mesh.report.update(found)
        return mesh
    return _take(mesh, keep[label_of_triangle], {**mesh.report, **found})


def _measure_components(
    mesh: Mesh, label_of_triangle: NDArray[np.int64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Area in mm2 and enclosed volume in ml, without sign, of each component."""
    twice_area = np.zeros(count)
    six_volumes = np.zeros(count)
    cross_sum = np.zeros((3, count))
    corner_sum = np.zeros((3, count))
    for where, corner, cross in cross_products(mesh.vertices, mesh.triangles, local_origin(mesh.vertices)):
        label = label_of_triangle[where]
        twice_area += np.bincount(label, np.sqrt(np.einsum("ij,ij->j", cross, cross)), count)
        six_volumes += np.bincount(label, np.einsum("ij,ij->j", corner, cross), count)
        for axis in range(3):
            cross_sum[axis] += np.bincount(label, cross[axis], count)
            corner_sum[axis] += np.bincount(label, corner[axis], count)
    # From the common origin to one within each component: of no effect on closed ones, where the sum of the cross
    # products is zero.
    centre = corner_sum / np.bincount(label_of_triangle, minlength=count)
    six_volumes -= np.einsum("ij,ij->j", centre, cross_sum)
    return twice_area / 2.0, np.abs(six_volumes) / 6000.0


def _take(mesh: Mesh, keep_triangle: NDArray[np.bool_], report: dict[str, object]) -> Mesh:
    triangles = mesh.triangles[keep_triangle]
    keep_vertex = np.zeros(mesh.vertex_count, dtype=bool)
    keep_vertex[triangles.reshape(-1)] = True
    number = np.cumsum(keep_vertex, dtype=np.int64) - 1
    normals = None if mesh.normals is None else mesh.normals[keep_vertex]
    return Mesh(mesh.vertices[keep_vertex], number[triangles].astype(np.uint32), normals, report)
