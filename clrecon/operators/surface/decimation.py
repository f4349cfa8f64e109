"""Decimation within a bound on a device, and triangles that cut each other."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.mesh import Mesh
from clrecon.mesh.connectivity import find_used, list_runs, number_used, order_by_number
from clrecon.mesh.intersections import find_boxes, find_self_intersections
from clrecon.mesh.refine import decimation
from clrecon.opencl import Device
from clrecon.operators.masks.voxel_mask import zero_words
from clrecon.operators.surface.collapse import DeviceCollapser
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import find_bounds
from clrecon.system.progress import Progress, Steps

_FEWEST = 20_000
"""Meshes with fewer triangles are looked at by the host alone, in less time than the device needs to begin."""

_MOST_ROWS = 1 << 18
"""Their edge is made longer until there are no more."""

_MORE_ENTRIES = 0.5
"""Entries for each triangle beside its first; wider rows have less of them, but longer ways to go in each."""

_BINS = 1 << 13
"""Steps of x by which the entries of a row are sorted: with `_MOST_ROWS` rows their number fits 31 bits."""

_PLACES, _NAMES = 9, 5
_ENTRY_BYTES = 4 * (_PLACES + _NAMES)
"""Rows of the tables of entries, as the kernels have them."""

_MOST_LANES = 8
"""Entries that the kernel looks at together."""

_PIECE = 1 << 17
"""Triangles of a launch; progress is reported between launches."""

Float32Array = NDArray[np.float32]
IntArray = NDArray[np.integer]


@dataclass(frozen=True)
class RowGrid:
    """Rows along x, and the steps of x by which their entries are sorted: floor((coordinate - origin) * per_step).

    origin, per_step, last: ndarray, shape (3,), float32. Of the last step along each axis, beyond which none is.
    """

    origin: Float32Array
    per_step: Float32Array
    last: Float32Array

    @property
    def rows(self) -> int:
        return int((self.last[1] + 1.0) * (self.last[2] + 1.0))

    def steps(self, coordinates: Float32Array, axis: int) -> NDArray[np.int32]:
        """Return the steps of coordinates along an axis, as the kernel counts them."""
        steps = (coordinates - self.origin[axis]) * self.per_step[axis]
        return np.clip(steps, np.float32(0.0), self.last[axis]).astype(np.int32)


@dataclass(frozen=True)
class CrossingPlan:
    """Triangles in all rows that their boxes touch, as the kernel reads them.

    vertices: ndarray, shape (v, 3), float32. Scaled by two to the power of `exponent`, which changes no digit.
    triangles: ndarray, shape (n, 3), uint32
    order, rows: ndarray, shape (e,), uint32. Triangle and row of each entry, those of a row by their lowest x.
    """

    vertices: Float32Array
    exponent: int
    triangles: NDArray[np.uint32]
    grid: RowGrid
    order: NDArray[np.uint32]
    rows: NDArray[np.uint32]

    @property
    def stride(self) -> int:
        return len(self.order) + _MOST_LANES

    def needs(self) -> dict[str, int]:
        given = self.vertices.nbytes + self.triangles.nbytes + 2 * self.order.nbytes
        return {"triangles in rows": given + _ENTRY_BYTES * self.stride, "marks": self.stride // 8}


def plan_crossings(
    vertices: Float32Array, triangles: NDArray[np.uint32], rows: IntArray | None = None, *, most_rows: int = _MOST_ROWS
) -> CrossingPlan:
    """Enter at least one triangle into rows; those of `rows` alone where they are given."""
    exponent = 11 - int(np.frexp(np.abs(vertices).max())[1])
    scaled, entered = np.ldexp(vertices, exponent), triangles if rows is None else triangles[rows]
    low, high = find_boxes(scaled, entered)
    across, deep = (high[:, axis] - low[:, axis] for axis in (1, 2))
    # Of rows so wide a box of these sides touches (1 + across / edge) * (1 + deep / edge), on average.
    both, square = (float(np.mean(terms, dtype=np.float64)) / _MORE_ENTRIES for terms in (across + deep, across * deep))
    edge = max(1.0, 0.5 * (both + np.sqrt(both * both + 4.0 * square)))
    origin, end = find_bounds(low)
    while True:
        per_step = np.array([_BINS / max(end[0] - origin[0], 8.0), 1.0 / edge, 1.0 / edge], np.float32)
        grid = RowGrid(origin, per_step, np.append(np.float32(_BINS - 1), np.floor((end - origin)[1:] * per_step[1:])))
        if grid.rows <= most_rows:
            break
        edge *= 1.25
    plan = _enter_into_rows(scaled, exponent, entered, grid, low, high)
    return plan if rows is None else replace(plan, triangles=triangles, order=rows.astype(np.uint32)[plan.order])


def _enter_into_rows(
    scaled: Float32Array, exponent: int, triangles: NDArray[np.uint32], grid: RowGrid, *boxes: Float32Array
) -> CrossingPlan:
    by_x = np.argsort(grid.steps(boxes[0][:, 0], 0).astype(np.uint16), kind="stable")
    (first_y, first_z), (last_y, last_z) = ([grid.steps(corner[:, n], n) for n in (1, 2)] for corner in boxes)
    along_y = np.int32(grid.last[1] + 1.0)
    of_triangles = (first_y + along_y * first_z, last_y - first_y + 1, last_z - first_z + 1)
    first, wide, deep = (numbers.take(by_x) for numbers in of_triangles)
    rows = list_runs(list_runs(first, deep, along_y), wide.repeat(deep))
    order = order_by_number(rows, grid.rows)
    entries = by_x.astype(np.uint32).repeat(wide * deep).take(order)
    return CrossingPlan(scaled, exponent, triangles, grid, entries, rows.take(order).astype(np.uint32))


class CrossingMarks:
    """Triangles of a surface that may cut another one, marked on a device: of a plan, and of what has changed since.

    spare: Most entries that are made after those of the plan.
    """

    def __init__(self, device: Device, plan: CrossingPlan, *, spare: int = 0):
        self._device = device
        self._program = ocl.load_program(device, "surface/crossings.cl", {"LANES": device.kernel_variants["LANES"]})
        self._spare = spare
        self._forget(plan)

    def _forget(self, plan: CrossingPlan) -> None:
        stride = self._stride = plan.stride + self._spare
        self._places_d, self._names_d = (ocl.allocate(self._device, 4 * n * stride) for n in (_PLACES, _NAMES))
        self._plan = plan
        self._triangles, self._starts = np.zeros(0, np.uint32), np.zeros(0, np.uint32)
        grid = plan.grid
        self._grid_d = ocl.upload(self._device, np.concatenate([grid.origin, grid.per_step, grid.last]))
        self._reaches_d = zero_words(self._device, grid.rows)

    def look(self, *, piece: int = _PIECE, steps: Steps | None = None) -> tuple[IntArray, IntArray]:
        """Return the triangles of the plan that may cut another one, or have no area, and those that surely cut one."""
        return self._mark(self._plan, self._plan.order, piece=piece, steps=steps)

    def look_again(self, vertices: Float32Array, changed: IntArray) -> tuple[IntArray, IntArray]:
        """Return the same of triangles that have changed, and what they may cut; of all where there is no room left."""
        plan, triangles = self._plan, self._plan.triangles[changed]
        used = find_used(triangles, len(vertices))
        plan.vertices[used] = np.ldexp(vertices[used], plan.exponent)
        boxes = find_boxes(plan.vertices, triangles)
        again = _enter_into_rows(plan.vertices, plan.exponent, triangles, plan.grid, *boxes)
        if len(self._triangles) + again.stride > self._stride:
            rows = find_used(np.concatenate([self._triangles, changed]), len(plan.triangles))
            self._forget(plan_crossings(vertices, plan.triangles, rows))
            return self.look()
        return self._mark(again, changed.astype(np.uint32)[again.order])

    def _mark(
        self, plan: CrossingPlan, triangles: NDArray[np.uint32], *, piece: int = _PIECE, steps: Steps | None = None
    ) -> tuple[IntArray, IntArray]:
        device, rows = self._device, plan.grid.rows
        first, older = len(self._triangles), len(self._starts) // (rows + 1)
        ends = first + np.cumsum(np.bincount(plan.rows, minlength=rows))
        starts_d = ocl.upload(device, np.append(self._starts, np.uint32(first)))
        self._starts = np.concatenate([self._starts, [first], ends]).astype(np.uint32)
        self._triangles = np.concatenate([self._triangles, triangles])
        marks = np.empty((2, (self._stride + 31) // 32), np.uint32)
        marks_d = zero_words(device, marks.size)
        shared = {
            "vertices": ocl.upload(device, plan.vertices), "places": self._places_d, "names": self._names_d,
            "marks": marks_d, "grid": self._grid_d, "reaches": self._reaches_d, "stride": self._stride,
        }  # fmt: skip
        ocl.launch(
            device, self._program["enter_triangles"], plan.stride, triangles=ocl.upload(device, plan.triangles),
            order=ocl.upload(device, plan.order), rows=ocl.upload(device, plan.rows), **shared, first=first,
            items=plan.stride, count=len(triangles),
        )  # fmt: skip
        for begin in range(first, len(self._triangles), piece):
            items = min(piece, len(self._triangles) - begin)
            ocl.launch(
                device, self._program["mark_crossings"], items, **shared, starts=starts_d, first=begin, items=items,
                older=older,
            )  # fmt: skip
            if steps is not None:
                ocl.wait(device)
                done = (begin + np.array([0, items])) * len(plan.triangles) // len(triangles)
                steps.take(int(done[1] - done[0]))
        bits = np.unpackbits(ocl.download(device, marks, marks_d).view(np.uint8), axis=1, bitorder="little")
        unsure, cut = (find_used(self._triangles[np.flatnonzero(row)], len(self._plan.triangles)) for row in bits)
        return unsure, cut


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
    plan = plan_crossings(vertices, triangles, rows)
    spare = plan.stride // 4
    needs = {**plan.needs(), "changed triangles": _ENTRY_BYTES * spare}
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

    Fewer triangles than `fewest`, float64 vertices and meshes without room on the device are left to the host, which
    finds the same pairs.  `steps` counts the triangles.
    """
    if len(triangles) < fewest or vertices.dtype != np.float32:
        return find_self_intersections(vertices, triangles, steps=steps)
    plan = plan_crossings(vertices, triangles)
    if ocl.describe_shortage(ocl.memory_limits(device, memory), plan.needs()):
        return find_self_intersections(vertices, triangles, steps=steps)
    looked_at = np.concatenate(CrossingMarks(device, plan).look(steps=steps))
    marked = find_used(looked_at, len(triangles)).astype(np.int64)
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
