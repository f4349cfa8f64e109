"""Leaps of rays: which bricks of a slab show something, and the distance of the next one from each brick."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import Stopwatch, allocate, download, kernel_constant, launch, upload
from clrecon.operators.rays.slabs import LeapMap, RaySlab
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.frame import BOX_BORDER, enclose

ROWS_AT_ONCE = kernel_constant("rays/leaps.cl", "ROWS_AT_ONCE")
"""Rows of bricks for each work-item."""


def measure_cells(resident: DeviceVolume, slab: RaySlab, stopwatch: Stopwatch) -> Any:
    """Return the lowest and highest value that samples in each brick of a slab can have, (bk, bj, bi, 2), on the
    device.
    """
    if slab.ranges_d is None:
        bricks, (ni, nj, nk) = math.prod(slab.bricks), slab.shape_ijk
        slab.ranges_d = allocate(resident.device, 2 * bricks * resident.dtype.itemsize)
        launch(
            resident.device, resident.program("rays/leaps.cl")["measure_cells"], bricks, stopwatch=stopwatch,
            voxels=slab.voxels_d, ranges=slab.ranges_d, ni=ni, nj=nj, nk=nk, **slab.brick_arguments,
        )  # fmt: skip
    return slab.ranges_d


def find_leaps(
    resident: DeviceVolume,
    slab: RaySlab,
    key: Any,
    shown: NDArray[np.bool_],
    low: float,
    scale: float,
    stopwatch: Stopwatch,
) -> LeapMap:
    """Return the leap map for visible values, or the map that was made for `key` before.

    key: Identifies the source of `shown`.
    shown: ndarray, shape (nodes,), bool. Which nodes of a table of values are visible.
    low, scale: Nearest node to a value v: ``floor((v - low) * scale + 0.5)``, within the table.
    """
    known = slab.maps.get(key)
    if known is not None:
        return known
    ranges_d = measure_cells(resident, slab, stopwatch)
    device, program = resident.device, resident.program("rays/leaps.cl")
    bi, bj, bk = slab.bricks
    bricks = bi * bj * bk
    counts_d = upload(device, np.concatenate([[0], np.cumsum(shown)]).astype(np.int32))
    from_d, to_d = allocate(device, bricks), allocate(device, bricks)
    launch(
        device, program["mark_bricks"], bricks, stopwatch=stopwatch,
        ranges=ranges_d, shown=counts_d, distances=from_d, bins_low=low, bins_scale=scale, bins=len(shown),
        bricks=bricks,
    )  # fmt: skip
    launch(
        device, program["spread_in_rows"], -(-bj * bk // ROWS_AT_ONCE), stopwatch=stopwatch,
        distances=from_d, spread=to_d, bi=bi, rows=bj * bk,
    )  # fmt: skip
    for outer, count, stride in ((bk, bj, bi), (1, bk, bi * bj)):
        from_d, to_d = to_d, from_d
        chunks = -(-stride // 16)
        items = outer * count * chunks
        launch(
            device, program["spread_along"], items, stopwatch=stopwatch,
            distances=from_d, spread=to_d, count=count, stride=stride, chunks=chunks, items=items,
        )  # fmt: skip
    from_d = to_d
    slab.maps.clear()  # one map for a slab: making it takes some milliseconds
    marked = download(device, np.empty((bk, bj, bi), np.uint8), from_d) == 0
    made = slab.maps[key] = LeapMap(from_d, _find_box(resident.volume, marked, slab))
    return made


def _find_box(volume: Volume, marked: NDArray[np.bool_], slab: RaySlab) -> tuple[Float64Array, Float64Array] | None:
    ends = []
    across = np.any(marked, axis=0)
    each = np.any(across, axis=0), np.any(across, axis=1), np.any(marked, axis=(1, 2))
    for along, cells in zip(each, slab.brick_cells, strict=True):
        where = np.flatnonzero(along)
        if not len(where):
            return None
        ends.append((where[0] * cells, (where[-1] + 1) * cells))
    low, high = np.array(ends, dtype=np.float64).T
    low[2] += slab.first_k
    high[2] += slab.first_k
    # Bricks at the ends extend to the border of the volume.
    return enclose(volume, low - BOX_BORDER, high + BOX_BORDER)
