"""Decimation within a bound on a device, and triangles that cut each other."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.mesh import Mesh
from clrecon.mesh.connectivity import find_used, number_used
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
IntArray = NDArray[np.integer]


@dataclass(frozen=True)
class CrossingPlan:
    """Triangles in the rows of levels, as the kernel reads them.

    vertices: ndarray, shape (v, 3), float32. Scaled by two to the power of `exponent`, which changes no digit.
    triangles, order: ndarray, shapes (n, 3) and (n,), uint32. Of the order: the triangle of each entry.
    starts: ndarray, uint32. First entry of each row, and the number of entries.
    levels, edges: ndarray, shape (levels, 4) uint32, (levels, 4) float32
    """

    vertices: Float32Array
    exponent: int
    triangles: NDArray[np.uint32]
    order: NDArray[np.uint32]
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
    vertices: Float32Array, triangles: NDArray[np.uint32], rows: IntArray | None = None, *, most_rows: int = _MOST_ROWS
) -> CrossingPlan:
    """Enter at least one triangle into rows; those of `rows` alone where they are given."""
    exponent = 11 - int(np.frexp(np.abs(vertices).max())[1])
    entered = triangles if rows is None else triangles[rows]
    plan = _enter_into_rows(np.ldexp(vertices, exponent), exponent, entered, most_rows)
    return plan if rows is None else replace(plan, triangles=triangles, order=rows.astype(np.uint32)[plan.order])


def _enter_into_rows(
    scaled: Float32Array, exponent: int, triangles: NDArray[np.uint32], most_rows: int = _MOST_ROWS
) -> CrossingPlan:
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
    table = np.column_stack([edges, longest_of, *(np.full(len(edges), at) for at in origin[1:])]).astype(np.float32)
    return CrossingPlan(scaled, exponent, triangles, order.astype(np.uint32), starts, levels, table)


class CrossingMarks:
    """Triangles of a surface that may cut another one, marked on a device: of a plan, and of what has changed since.

    spare: Most triangles that are entered after those of the plan.
    """

    def __init__(self, device: Device, plan: CrossingPlan, *, spare: int = 0):
        self._device = device
        self._program = ocl.load_program(device, "surface/crossings.cl", {"LANES": device.kernel_variants["LANES"]})
        self._spare = spare
        self._forget(plan)

    def _forget(self, plan: CrossingPlan) -> None:
        self._stride = plan.stride + self._spare
        self._places_d, self._names_d = (ocl.allocate(self._device, 4 * rows * self._stride) for rows in (10, 3))
        self._plan = plan
        self._rows = self._starts = np.zeros(0, np.uint32)
        self._levels, self._edges = np.zeros((0, 4), np.uint32), np.zeros((0, 4), np.float32)

    def look(self, *, piece: int = _PIECE, steps: Steps | None = None) -> IntArray:
        """Return the triangles of the plan without area, and those that may cut another one."""
        return self._mark(self._plan, self._plan.order, piece=piece, steps=steps)

    def look_again(self, vertices: Float32Array, changed: IntArray) -> IntArray:
        """Return the same of triangles that have changed, and what they may cut; of all where there is no room left."""
        plan, triangles = self._plan, self._plan.triangles[changed]
        if len(self._rows) + len(changed) + _MOST_LANES > self._stride:
            rows = find_used(np.concatenate([self._rows, changed]), len(plan.triangles))
            self._forget(plan_crossings(vertices, plan.triangles, rows))
            return self.look()
        used = find_used(triangles, len(vertices))
        plan.vertices[used] = np.ldexp(vertices[used], plan.exponent)
        again = _enter_into_rows(plan.vertices, plan.exponent, triangles)
        return self._mark(again, changed.astype(np.uint32)[again.order])

    def _mark(
        self, plan: CrossingPlan, rows: NDArray[np.uint32], *, piece: int = _PIECE, steps: Steps | None = None
    ) -> IntArray:
        device = self._device
        first, older = len(self._rows), len(self._edges)
        levels = plan.levels + np.array([len(self._starts), 0, 0, first], np.uint32)
        self._starts = np.concatenate([self._starts, plan.starts + np.uint32(first)])
        self._levels, self._edges = np.vstack([self._levels, levels]), np.vstack([self._edges, plan.edges])
        self._rows = np.concatenate([self._rows, rows])
        tables = {"starts": self._starts, "levels": self._levels, "edges": self._edges}
        tables_d = {name: ocl.upload(device, table) for name, table in tables.items()}
        marks_d = zero_words(device, (self._stride + 31) // 32)
        shared = {"places": self._places_d, "names": self._names_d, "marks": marks_d, "stride": self._stride}
        ocl.launch(
            device, self._program["enter_triangles"], plan.stride, vertices=ocl.upload(device, plan.vertices),
            triangles=ocl.upload(device, plan.triangles), order=ocl.upload(device, plan.order), **shared,
            first=first, items=plan.stride, count=len(rows),
        )  # fmt: skip
        for begin in range(first, len(self._rows), piece):
            items = min(piece, len(self._rows) - begin)
            ocl.launch(
                device, self._program["mark_crossings"], items, **shared, **tables_d, first=begin, items=items,
                level_count=len(self._edges), older=older,
            )  # fmt: skip
            if steps is not None:
                ocl.wait(device)
                steps.take(items)
        words = ocl.download(device, np.empty((self._stride + 31) // 32, np.uint32), marks_d)
        entries = np.flatnonzero(np.unpackbits(words.view(np.uint8), bitorder="little"))
        return find_used(self._rows[entries], len(self._plan.triangles))


def follow_crossings(
    device: Device, vertices: NDArray[np.floating], triangles: NDArray[np.uint32], rows: IntArray | None = None, *,
    fewest: int = _FEWEST, memory: int | None = None,
) -> CrossingMarks | None:  # fmt: skip
    """Return marks of triangles, or of some rows of these, of a surface that is about to change; None where
    `find_crossings` asks the host.
    """
    count = len(triangles if rows is None else rows)
    if count < fewest or vertices.dtype != np.float32:
        return None
    plan, spare = plan_crossings(vertices, triangles, rows), count // 8
    needs = {**plan.needs(), "changed triangles": 52 * spare}
    has_room = not ocl.describe_shortage(ocl.memory_limits(device, memory), needs)
    return CrossingMarks(device, plan, spare=spare) if has_room else None


def find_crossings(
    device: Device,
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    *,
    fewest: int = _FEWEST,
    memory: int | None = None,
    steps: Steps | None = None,
) -> NDArray[np.int64]:
    """Find the pairs of triangles that cut each other, (k, 2) int64, see
    `clrecon.mesh.intersections.find_self_intersections`.

    Fewer triangles than `fewest`, float64 vertices and meshes
    without room on the device are left to the host, which finds the same pairs.  `steps` counts the triangles.
    """
    if len(triangles) < fewest or vertices.dtype != np.float32:
        return find_self_intersections(vertices, triangles, steps=steps)
    plan = plan_crossings(vertices, triangles)
    if ocl.describe_shortage(ocl.memory_limits(device, memory), plan.needs()):
        return find_self_intersections(vertices, triangles, steps=steps)
    marked = CrossingMarks(device, plan).look(steps=steps).astype(np.int64)
    used, corners = number_used(triangles[marked], len(vertices))
    return marked[find_self_intersections(vertices[used], corners)]


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
                follow=partial(follow_crossings, current, memory=memory),
            )  # fmt: skip
    return decimated
