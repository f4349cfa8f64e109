"""Decimation within a bound, with distances and crossings on a device if one is named."""

from __future__ import annotations

from functools import partial

from clrecon.mesh import Mesh
from clrecon.mesh.refine import decimation
from clrecon.opencl import Device, take_device, work_on
from clrecon.operators.surface.crossings import find_crossings
from clrecon.operators.surface.near_faces import DeviceBounds
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress


@explains_arguments
def decimate_mesh(
    mesh: Mesh,
    fraction: float,
    max_deviation_mm: float | None = None,
    *,
    device: Device | str | int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Remove triangles by collapsing edges in order of their quadric error (Garland and Heckbert 1997).

    Collapses are undone where the result would exceed the bound, not be manifold, have faces without area, cut itself,
    or lose a component or a tunnel.  So the share is not always reached: the bound decides how many triangles are left.

    Parameters
    ----------
    mesh : Mesh
    fraction : float
        Share of the triangles to remove, above 0 and below 1. The bound may allow only less.
    max_deviation_mm : float, optional
        No vertex and no middle of an edge or a triangle of either surface lies farther than this from the other; a
        point between them can.
        Default: a quarter of the shortest voxel step.
    device : Device, str or int, optional
        Bounds distances and finds triangles that cut each other, see `clrecon.device`.  None: numpy does it, which
        takes longer and needs no device.  The
        result is the same but for rounding: another triangle may have been found to be near enough first.
    progress : callable, optional
        Called as ``progress("decimate", triangles removed, triangles to remove)``, several times in a round.

    Returns
    -------
    Mesh
        Normals from the faces; the report is taken over, with ``refinement["decimate"]``: ``fraction`` (asked for),
        ``reached``, ``ended_by`` (``"share"`` or ``"bound"``), ``rounds``, ``max_deviation_mm``, ``triangles_before``,
        ``vertices_taken_back`` (collapses that were undone) and ``topology`` (Euler numbers and components before and
        after).

    Raises
    ------
    UsageError
        A value cannot be used, or there is neither a bound nor a voxel size in the report of the mesh.
    NoSurfaceError
        The mesh is empty.
    DeviceError
        The device does not exist, has no room for both surfaces, or fails.
    """
    decimation.check_share(fraction)
    decimation.check_refinement(mesh, max_deviation_mm)
    if device is None:
        return decimation.decimate_mesh(mesh, fraction, max_deviation_mm, progress=progress)
    return work_on(
        take_device(device),
        lambda device, told: decimation.decimate_mesh(
            mesh,
            fraction,
            max_deviation_mm,
            progress=progress,
            make_bounds=partial(DeviceBounds, device),
            find_crossings=partial(find_crossings, device),
        ),  # fmt: skip
    )
