"""Decimation within a bound on a device, and triangles that cut each other."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.mesh import Mesh
from clrecon.mesh.connectivity import find_used, list_runs, number_used, pack_numbers
from clrecon.mesh.intersections import find_boxes, find_self_intersections
from clrecon.mesh.refine import decimation
from clrecon.opencl import Device
from clrecon.operators.masks.voxel_mask import zero_words
from clrecon.operators.surface.collapse import DeviceCollapser
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks, find_bounds, in_threads, list_distinct
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
"""Most entries of a launch."""

_PART = 1 << 19
"""Triangles that are entered at once, while the device looks at those before; progress is reported after each."""

_LOOKED_AT = 1 << 16
"""About as many triangles tell how large boxes are."""

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
    """Triangles, and the rows that their boxes touch.

    vertices: ndarray, shape (v, 3), float32. Scaled by two to the power of `exponent`, which changes no digit.
    triangles: ndarray, shape (n, 3), uint32
    numbers: ndarray, shape (m,), uint32. Those of them that are entered.
    steps: ndarray, shape (m,), uint16. Lowest step of x of each.
    rows: ndarray, shape (3, m), int32. First row of each, and how many rows along y and z it touches.
    """

    vertices: Float32Array
    exponent: int
    triangles: NDArray[np.uint32]
    grid: RowGrid
    numbers: NDArray[np.uint32]
    steps: NDArray[np.uint16]
    rows: NDArray[np.int32]

    @property
    def entries(self) -> int:
        """Number of entries: of each triangle one for each row."""
        return int(np.sum(self.rows[1] * self.rows[2], dtype=np.int64))

    @property
    def stride(self) -> int:
        return self.entries + _MOST_LANES

    def needs(self) -> dict[str, int]:
        given = self.vertices.nbytes + self.triangles.nbytes + 8 * self.entries
        return {"triangles in rows": given + _ENTRY_BYTES * self.stride, "marks": self.stride // 8}

    def enter(self, part: slice) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Return triangle and row of each entry of a part of the triangles: those of a row by their lowest x."""
        first, wide, deep = self.rows[:, part]
        rows = list_runs(list_runs(first, deep, np.int32(self.grid.last[1] + 1.0)), wide.repeat(deep))
        packed = pack_numbers(self.steps[part], self.numbers[part]).repeat(wide * deep)
        behind = np.uint64(31 + _BINS.bit_length())  # bits of a step and a triangle
        packed |= rows.astype(np.uint64) << behind
        packed.sort()
        return packed.astype(np.uint32), (packed >> behind).astype(np.uint32)


def plan_crossings(
    vertices: Float32Array, triangles: NDArray[np.uint32], rows: IntArray | None = None, *, most_rows: int = _MOST_ROWS
) -> CrossingPlan:
    """Enter at least one triangle into rows; those of `rows` alone where they are given."""
    exponent = 11 - int(np.frexp(np.abs(vertices).max())[1])
    scaled, numbers = np.ldexp(vertices, exponent), np.arange(len(triangles)) if rows is None else rows
    low, high = find_boxes(scaled, triangles[numbers[:: max(len(numbers) // _LOOKED_AT, 1)]])
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
    return _plan_rows(scaled, exponent, triangles, grid, numbers.astype(np.uint32))


def _plan_rows(
    scaled: Float32Array, exponent: int, triangles: NDArray[np.uint32], grid: RowGrid, numbers: NDArray[np.uint32]
) -> CrossingPlan:
    along_y = np.int32(grid.last[1] + 1.0)
    steps, rows = np.empty(len(numbers), np.uint16), np.empty((3, len(numbers)), np.int32)

    def find_rows(piece: slice) -> None:
        low, high = find_boxes(scaled, triangles[numbers[piece]])
        steps[piece] = grid.steps(low[:, 0], 0)
        (first_y, first_z), (last_y, last_z) = ([grid.steps(corner[:, n], n) for n in (1, 2)] for corner in (low, high))
        rows[:, piece] = first_y + along_y * first_z, last_y - first_y + 1, last_z - first_z + 1

    in_threads(find_rows, len(numbers))
    return CrossingPlan(scaled, exponent, triangles, grid, numbers, steps, rows)


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

    def look(self, *, part: int = _PART, steps: Steps | None = None) -> tuple[IntArray, IntArray]:
        """Return the triangles of the plan that may cut another one, or have no area, and those that surely cut one."""
        return self._mark(self._plan, part, steps)

    def look_again(self, vertices: Float32Array, changed: IntArray) -> tuple[IntArray, IntArray]:
        """Return the same of triangles that have changed, and what they may cut; of all where there is no room left."""
        plan = self._plan
        used = find_used(plan.triangles[changed], len(vertices))
        plan.vertices[used] = np.ldexp(vertices[used], plan.exponent)
        again = _plan_rows(plan.vertices, plan.exponent, plan.triangles, plan.grid, changed.astype(np.uint32))
        if len(self._triangles) + again.stride > self._stride:
            rows = find_used(np.concatenate([self._triangles, changed]), len(plan.triangles))
            self._forget(plan_crossings(vertices, plan.triangles, rows))
            return self.look()
        return self._mark(again)

    def _mark(self, plan: CrossingPlan, part: int = _PART, steps: Steps | None = None) -> tuple[IntArray, IntArray]:
        device, rows = self._device, plan.grid.rows
        marks = np.empty((2, (self._stride + 31) // 32), np.uint32)
        marks_d = zero_words(device, marks.size)
        shared = {
            "vertices": ocl.upload(device, plan.vertices), "places": self._places_d, "names": self._names_d,
            "marks": marks_d, "grid": self._grid_d, "reaches": self._reaches_d, "stride": self._stride,
        }  # fmt: skip
        triangles_d = ocl.upload(device, plan.triangles)
        for span in chunks(len(plan.numbers), part):  # the device looks at one part while the next is entered
            order, row_of_each = plan.enter(span)
            first, count = len(self._triangles), len(order)
            ends = first + np.cumsum(np.bincount(row_of_each, minlength=rows))
            starts_d = ocl.upload(device, np.append(self._starts, np.uint32(first)))
            self._starts = np.concatenate([self._starts, [first], ends]).astype(np.uint32)
            self._triangles = np.concatenate([self._triangles, order])
            ocl.launch(
                device, self._program["enter_triangles"], count + _MOST_LANES, triangles=triangles_d,
                order=ocl.upload(device, order), rows=ocl.upload(device, row_of_each), **shared, first=first,
                items=count + _MOST_LANES, count=count,
            )  # fmt: skip
            ocl.launch(
                device, self._program["mark_crossings"], count, _PIECE, **shared, starts=starts_d, first=first,
                items=count, older=len(self._starts) // (rows + 1) - 1,
            )  # fmt: skip
            if steps is not None:
                ocl.wait(device)
                steps.take(span.stop - span.start)
        marked = []
        for words in ocl.download(device, marks, marks_d):
            used = np.flatnonzero(words)
            word, bit = np.nonzero(np.unpackbits(words[used].view(np.uint8), bitorder="little").reshape(-1, 32))
            marked.append(list_distinct(self._triangles[32 * used[word] + bit]).astype(np.intp))
        return marked[0], marked[1]


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
