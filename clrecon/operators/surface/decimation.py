"""Decimation within a bound on a device, and triangles that cut each other."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.mesh import Mesh
from clrecon.mesh.connectivity import number_used
from clrecon.mesh.intersections import find_boxes, find_self_intersections
from clrecon.mesh.refine import decimation
from clrecon.opencl import Device
from clrecon.operators.masks.voxel_mask import zero_words
from clrecon.operators.surface.collapse import DeviceCollapser
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, Steps

_FEWEST = 20_000
"""Meshes with fewer triangles are looked at by the host alone, in less time than the device needs to begin."""

_MOST_ROWS = 1 << 22
"""Rows of the finest level; its edge is made longer until there are no more."""

_FINEST = 0.97
"""Share of the triangles in the finest level; a half takes 1.2 to 1.5 times as long, as each level is searched."""

_ROW_BOXES = 2.0
"""Width of the rows in boxes as long as `_FINEST` has them; one or three take a tenth longer."""

_MOST_LANES = 8
"""Entries that the kernel looks at together."""

_PIECE = 1 << 17
"""Triangles of a launch; progress is reported between launches."""

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class CrossingPlan:
    """Triangles in the rows of levels, as the kernel reads them.

    vertices: ndarray, shape (v, 3), float32. Scaled by a power of two, which changes no digit.
    triangles, order: ndarray, shapes (n, 3) and (n,), uint32. Of the order: the triangle of each entry.
    starts: ndarray, uint32. First entry of each row, and the number of entries.
    levels, edges: ndarray, shape (levels, 4) uint32, (levels,) float32
    """

    vertices: Float32Array
    triangles: NDArray[np.uint32]
    order: NDArray[np.uint32]
    origin: Float32Array
    starts: NDArray[np.uint32]
    levels: NDArray[np.uint32]
    edges: Float32Array

    @property
    def stride(self) -> int:
        return len(self.order) + _MOST_LANES

    def needs(self) -> dict[str, int]:
        given = self.vertices.nbytes + self.triangles.nbytes + self.order.nbytes
        return {"triangles in rows": given + 52 * self.stride + self.starts.nbytes, "marks": len(self.order) // 8}


def plan_crossings(
    vertices: Float32Array, triangles: NDArray[np.uint32], *, most_rows: int = _MOST_ROWS
) -> CrossingPlan:
    """Enter at least one triangle into rows."""
    scaled = np.ldexp(vertices, 11 - int(np.frexp(np.abs(vertices).max())[1]))
    low, high = (np.ascontiguousarray(corner.T) for corner in find_boxes(scaled, triangles))
    high -= low
    longest = np.maximum(np.maximum(high[0], high[1]), high[2])
    origin, beyond = low.min(axis=1).astype(np.float64), low.max(axis=1).astype(np.float64)
    some = longest[:: max(1, len(longest) // 10_000)].astype(np.float64)
    edge = max(1.0, _ROW_BOXES * float(np.quantile(some, _FINEST)))
    while np.prod(np.floor((beyond - origin)[1:] / edge) + 1.0) > most_rows:
        edge *= 1.25
    level = np.zeros(len(longest), np.int8)
    coarse = np.flatnonzero(longest > edge)
    level[coarse] = np.ceil(np.log2(longest[coarse].astype(np.float64) / edge))
    edges = (edge * 2.0 ** np.arange(int(level.max()) + 1)).astype(np.float32)
    size = (np.floor((beyond - origin)[1:] / edges[:, None].astype(np.float64)) + 1.0).astype(np.int64)  # y, z
    first_row = np.concatenate([[0], np.cumsum(size.prod(axis=1))])
    row, longest_of = np.empty(len(longest), np.int64), np.zeros(len(edges))
    for number, width in enumerate(edges.astype(np.float64)):
        rows = np.flatnonzero(level == number) if number else slice(None)  # coarse ones are entered anew
        y, z = (((low[axis, rows] - origin[axis]) / width).astype(np.int64) for axis in (1, 2))
        row[rows] = first_row[number] + y + size[number, 0] * z
        longest_of[number] = longest[level == number].max(initial=0.0)
    bits = low[0].view(np.int32)
    order = np.argsort(row << 32 | np.where(bits < 0, ~bits, bits ^ np.int32(-(2**31))).view(np.uint32))
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=first_row[-1]))]).astype(np.uint32)
    levels = np.column_stack([first_row[:-1], size, starts[first_row[1:]]]).astype(np.uint32)
    table = np.column_stack([edges, longest_of]).astype(np.float32)
    return CrossingPlan(scaled, triangles, order.astype(np.uint32), origin.astype(np.float32), starts, levels, table)


def mark_crossings(
    device: Device, plan: CrossingPlan, *, piece: int = _PIECE, steps: Steps | None = None
) -> NDArray[np.bool_]:
    """Mark the triangles that may cut another one, shape (n,), in the order of the mesh."""
    count = len(plan.order)
    program = ocl.load_program(device, "surface/crossings.cl", {"LANES": device.kernel_variants["LANES"]})
    places_d, names_d = (ocl.allocate(device, 4 * rows * plan.stride) for rows in (10, 3))
    ocl.launch(
        device, program["enter_triangles"], plan.stride, vertices=ocl.upload(device, plan.vertices),
        triangles=ocl.upload(device, plan.triangles), order=ocl.upload(device, plan.order), places=places_d,
        names=names_d, count=count, stride=plan.stride,
    )  # fmt: skip
    marks_d = zero_words(device, (count + 31) // 32)
    starts_d, levels_d, edges_d = (ocl.upload(device, table) for table in (plan.starts, plan.levels, plan.edges))
    for first in range(0, count, piece):
        items = min(piece, count - first)
        ocl.launch(
            device, program["mark_crossings"], items, places=places_d, names=names_d, starts=starts_d, levels=levels_d,
            edges=edges_d, marks=marks_d, origin_y=plan.origin[1], origin_z=plan.origin[2], first=first, items=items,
            level_count=len(plan.edges), stride=plan.stride,
        )  # fmt: skip
        if steps is not None:
            ocl.wait(device)
            steps.take(items)
    words = ocl.download(device, np.empty((count + 31) // 32, np.uint32), marks_d)
    marked = np.zeros(count, bool)
    marked[plan.order] = np.unpackbits(words.view(np.uint8), bitorder="little")[:count].view(bool)
    return marked


def find_crossings(
    device: Device,
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    changed: NDArray[np.bool_] | None = None,
    *,
    fewest: int = _FEWEST,
    memory: int | None = None,
    steps: Steps | None = None,
) -> NDArray[np.int64]:
    """Find the pairs of triangles that cut each other, (k, 2) int64, see
    `clrecon.mesh.intersections.find_self_intersections`.

    With `changed`, (n,) bool, only pairs with one of these.  Fewer triangles than `fewest`, float64 vertices and meshes
    without room on the device are left to the host, which finds the same pairs.  `steps` counts the triangles.
    """
    if len(triangles) < fewest or vertices.dtype != np.float32:
        return find_self_intersections(vertices, triangles, changed, steps=steps)
    plan = plan_crossings(vertices, triangles)
    if ocl.describe_shortage(ocl.memory_limits(device, memory), plan.needs()):
        return find_self_intersections(vertices, triangles, changed, steps=steps)
    marked = np.flatnonzero(mark_crossings(device, plan, steps=steps))
    used, corners = number_used(triangles[marked], len(vertices))
    return marked[find_self_intersections(vertices[used], corners, None if changed is None else changed[marked])]


@explains_arguments
def decimate_mesh(
    mesh: Mesh,
    fraction: float,
    max_deviation_mm: float | None = None,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Remove triangles by collapsing edges in order of their quadric error (Garland and Heckbert 1997).

    Each collapse is checked before it is made, and undone where the result would exceed the bound, cut itself or have
    faces without area; components, tunnels and volumes stay.  So the share is not always reached: the bound decides how
    many triangles are left.  Vertices at an open border stay.

    Parameters
    ----------
    mesh : Mesh
    fraction : float
        Share of the triangles to remove, above 0 and below 1. The bound may allow only less.
    max_deviation_mm : float, optional
        No point of either surface lies farther than this from the other one.  Default: a quarter of the shortest voxel
        step.
    device : Device, str or int, optional
        Collapses edges and finds triangles that cut each other, see `clrecon.device`.  The result is the same on all,
        bit for bit.
    memory : int, optional
        Most bytes to use on the device; all of its memory by default.
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
        The device does not exist, fails, or has no room for both surfaces, or less is allowed.
    """
    decimation.check_share(fraction)
    decimation.check_refinement(mesh, max_deviation_mm)
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, _):
            decimated = decimation.decimate_mesh(
                mesh, fraction, max_deviation_mm, progress=progress,
                make_collapser=partial(DeviceCollapser, current, memory=memory),
                find_crossings=partial(find_crossings, current, memory=memory),
            )  # fmt: skip
    return decimated
