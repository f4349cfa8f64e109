"""Triangles that cut each other, found on the device: the host's side of cl/surface/crossings.cl.

The device marks the triangles that may cut another one, in float32; `clrecon.mesh.intersections` then looks at these
alone, in float64.  The pairs are those that it finds among all triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.intersections import find_self_intersections
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    describe_shortage,
    download,
    launch,
    load_program,
    memory_limits,
    upload,
    wait,
)
from clrecon.operators.masks.band_mask import zero_words
from clrecon.system.pieces import in_threads
from clrecon.system.progress import Steps

FEWEST = 20_000
"""Meshes with fewer triangles are looked at by the host alone, in less time than the device needs to begin."""

MOST_ROWS = 1 << 22
"""Rows of the finest level; its edge is made longer until there are no more."""

FINEST = 0.97
"""Share of the triangles that belong to the finest level.  With a half, extracted and decimated surfaces took 1.2 to
1.5 times the time: each level is looked through by itself."""

LONGEST = 1.0 / 0.998
"""Edge of a level for the longest box in it: what the kernel needs for the rounding of rows."""

PIECE = 1 << 17
"""Triangles of a launch; progress is reported between launches."""

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class CrossingPlan:
    """Triangles in the rows of levels, as the kernel reads them.

    vertices: ndarray, shape (v, 3), float32. Scaled by a power of two, which changes no digit.
    order: ndarray, shape (n,), int64. Triangle of each entry.
    corners: ndarray, shape (n, 3), uint32
    low, high: ndarray, shape (n, 3), float32. Boxes of the entries.
    starts: ndarray, uint32. First entry of each row, and the number of entries.
    levels: ndarray, shape (levels, 4), uint32
    edges: ndarray, shape (levels,), float32
    """

    vertices: Float32Array
    order: NDArray[np.int64]
    corners: NDArray[np.uint32]
    low: Float32Array
    high: Float32Array
    starts: NDArray[np.uint32]
    levels: NDArray[np.uint32]
    edges: Float32Array

    def needs(self) -> dict[str, int]:
        """Return the bytes on the device by what they are for."""
        tables = ("vertices", "corners", "low", "high", "starts", "levels", "edges")
        return {"triangles in rows": sum(getattr(self, name).nbytes for name in tables), "marks": len(self.order) // 8}


def prepare_crossings(device: Device) -> Program:
    """Build the kernels of `find_crossings`."""
    load_program(device, "masks/band_mask.cl")
    return load_program(device, "surface/crossings.cl")


def plan_crossings(vertices: Float32Array, triangles: NDArray[np.uint32]) -> CrossingPlan:
    """Enter the triangles into rows.

    vertices: ndarray, shape (v, 3), float32
    triangles: ndarray, shape (n, 3), uint32. At least one.
    """
    scaled = np.ldexp(vertices, 11 - int(np.frexp(np.abs(vertices).max())[1]))
    low, high = _find_boxes(scaled, triangles)
    box = (high - low).T
    longest = LONGEST * np.maximum(np.maximum(box[0], box[1]), box[2]).astype(np.float64)
    origin, beyond = low.min(axis=0).astype(np.float64), low.max(axis=0).astype(np.float64)
    edge = max(1.0, float(np.quantile(longest[:: max(1, len(longest) // 10_000)], FINEST)))
    while np.prod(np.floor((beyond - origin)[1:] / edge) + 1.0) > MOST_ROWS:
        edge *= 1.25
    level = np.ceil(np.log2(np.maximum(longest / edge, 1.0))).astype(np.int64)
    edges = (edge * 2.0 ** np.arange(int(level.max()) + 1)).astype(np.float32)
    # An edge rounded to float32 is far nearer to the edge than the longest box.
    size = (np.floor((beyond - origin)[1:] / edges[:, None].astype(np.float64)) + 1.0).astype(np.int64)  # y, z
    first_row = np.concatenate([[0], np.cumsum(size.prod(axis=1))])
    row = first_row.take(level)
    width = edges.astype(np.float64).take(level)
    row += ((low[:, 1] - origin[1]) / width).astype(np.int64)
    row += size[:, 0].take(level) * ((low[:, 2] - origin[2]) / width).astype(np.int64)
    bits = np.ascontiguousarray(low[:, 0]).view(np.int32)
    along = np.where(bits < 0, bits ^ 0x7FFFFFFF, bits).astype(np.int64) + (1 << 31)  # in the order of the numbers
    order = np.argsort(row << 32 | along)
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=first_row[-1]))]).astype(np.uint32)
    levels = np.column_stack([first_row[:-1], size, starts[first_row[1:]]]).astype(np.uint32)
    low, high = low.take(order, axis=0), high.take(order, axis=0)
    return CrossingPlan(scaled, order, triangles.take(order, axis=0), low, high, starts, levels, edges)


def _find_boxes(vertices: Float32Array, triangles: NDArray[np.uint32]) -> tuple[Float32Array, Float32Array]:
    """Return the lowest and the highest coordinates of each triangle."""
    low, high = np.empty((len(triangles), 3), np.float32), np.empty((len(triangles), 3), np.float32)

    def work(where: slice) -> None:
        one, two, three = (vertices[triangles[where, corner]] for corner in range(3))
        np.minimum(np.minimum(one, two), three, out=low[where])
        np.maximum(np.maximum(one, two), three, out=high[where])

    in_threads(work, len(triangles))
    return low, high


def mark_crossings(
    device: Device, plan: CrossingPlan, *, steps: Steps | None = None, stopwatch: Stopwatch | None = None
) -> NDArray[np.bool_]:
    """Mark the triangles that may cut another one, shape (n,), in the order of the mesh."""
    count = len(plan.order)
    kernel = prepare_crossings(device)["mark_crossings"]
    marks_d = zero_words(device, (count + 31) // 32, stopwatch=stopwatch)
    buffers = {
        name: upload(device, getattr(plan, name))
        for name in ("vertices", "corners", "low", "high", "starts", "levels", "edges")
    }
    origin = plan.low.min(axis=0)
    for first in range(0, count, PIECE):
        items = min(PIECE, count - first)
        launch(
            device, kernel, items, stopwatch=stopwatch, **buffers, marks=marks_d, origin_y=origin[1],
            origin_z=origin[2], first=first, items=items, level_count=len(plan.edges),
        )  # fmt: skip
        if steps is not None:
            wait(device)
            steps.take(items)
    words = download(device, np.empty((count + 31) // 32, np.uint32), marks_d)
    marked = np.zeros(count, bool)
    marked[plan.order] = np.unpackbits(words.view(np.uint8), bitorder="little")[:count].view(bool)
    return marked


def find_crossings(
    device: Device,
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    changed: NDArray[np.bool_] | None = None,
    *,
    memory: int | None = None,
    steps: Steps | None = None,
) -> NDArray[np.int64]:
    """Find the pairs of triangles that cut each other, see `clrecon.mesh.intersections.find_self_intersections`.

    Small meshes, vertices in float64 and meshes for which the device has no room are looked at by the host alone, which
    finds the same pairs.

    vertices: ndarray, shape (v, 3), mm
    triangles: ndarray, shape (n, 3), uint32
    changed: ndarray, shape (n,), bool. Only pairs with one of these are found.
    memory: Bytes that may be taken on the device; None is all that it has.
    steps: Counts the triangles.

    Returns: ndarray, shape (k, 2), int64. Numbers of triangles.
    """
    if len(triangles) < FEWEST or vertices.dtype != np.float32:
        return find_self_intersections(vertices, triangles, changed, steps=steps)
    plan = plan_crossings(vertices, triangles)
    if describe_shortage(memory_limits(device, memory), plan.needs()):
        return find_self_intersections(vertices, triangles, changed, steps=steps)
    marked = np.flatnonzero(mark_crossings(device, plan, steps=steps))
    return marked[find_self_intersections(vertices, triangles[marked], None if changed is None else changed[marked])]
