"""Checks of what rays need before they start: leaps over empty bricks, and the entries of tiles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.jobs.selftest.check import Check, require_close, require_equal
from clrecon.jobs.selftest.scenes import stack
from clrecon.opencl import Device, Stopwatch, download, upload
from clrecon.operators.rays.picture_buffers import TILE, PictureBuffers, RayView
from clrecon.operators.rays.ray_pictures import MainWay, enter_tiles, look_ahead
from clrecon.operators.rays.ray_slabs import (
    BRICK_CELLS,
    FARTHEST,
    LeapMap,
    RaySlab,
    find_leaps,
    measure_cells,
    ray_slabs,
)
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import volume_box
from clrecon.rendering.views.camera import Camera

SHAPE = (185, 193, 17)
"""Voxels (k, j, i) of 46 x 48 x 4 bricks: four rows of bricks a work-item are more than 500."""

BEFORE = 5 * BRICK_CELLS
"""Slices before the first bright one within which a tile may begin: bricks around it, and rays aside of the middle."""

TYPES = ("int16", "uint8", "float32")


def _count_cells(voxels: NDArray[Any], take: np.ufunc) -> NDArray[Any]:
    """Reduce the voxels around the cells of each brick: bricks share the voxels between them."""
    for axis in range(3):
        starts = np.arange(0, voxels.shape[axis] - 1, BRICK_CELLS)
        ends = np.take(voxels, np.minimum(starts + BRICK_CELLS, voxels.shape[axis] - 1), axis=axis)
        voxels = take(take.reduceat(voxels, starts, axis=axis), ends)
    return voxels


def _spread(shown: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the Chebyshev distance of each brick to the nearest that shows, at most `FARTHEST`."""
    distances = np.where(shown, 0, FARTHEST).astype(np.uint8)
    for axis in range(3):
        lines = np.moveaxis(distances, axis, 0)
        best = lines.copy()
        for way in range(1, FARTHEST):
            for one, other in ((np.s_[way:], np.s_[:-way]), (np.s_[:-way], np.s_[way:])):
                best[one] = np.minimum(best[one], np.maximum(lines[other], way))
        distances = np.moveaxis(best, 0, axis)
    return distances


def _count_ahead(distances: NDArray[np.uint8], way: MainWay) -> NDArray[np.uint8]:
    """Return what is free ahead of each brick along the main way, with the bricks beside it that rays drift to."""
    free = distances.T > 0
    own = free
    for axis in {0, 1, 2} - {way.axis}:
        numbers = np.arange(free.shape[axis])
        offset = np.float32(0.5) + numbers - way.eye[axis] if way.eye[3] else np.full(len(numbers), way.eye[axis])
        drift = np.where(np.abs(offset) <= way.aside, 0, np.sign(offset)).astype(int)
        own = own & np.take(own, np.clip(numbers + drift, 0, len(numbers) - 1), axis=axis)
    lines = np.moveaxis(own, way.axis, 0)
    counts, count = np.zeros(lines.shape, np.uint8), np.full(lines.shape[1:], FARTHEST)
    for n in range(len(lines))[:: -way.ahead]:
        count = np.where(lines[n], np.minimum(count + 1, FARTHEST), 0)
        counts[n] = count
    return np.moveaxis(counts, 0, way.axis).T


def _open(device: Device, volume: Volume) -> tuple[DeviceVolume, RaySlab]:
    resident = DeviceVolume(volume, device=device)
    return resident, next(ray_slabs(resident, volume.shape_ijk[2], np.inf, Stopwatch()))


def _check_leaps(device: Device) -> str:
    rng, stopwatch = np.random.default_rng(24), Stopwatch()
    for dtype in TYPES:
        voxels = rng.integers(0, 40, SHAPE).astype(dtype)
        for _ in range(60):
            voxels[tuple(rng.integers(0, SHAPE))] = 100
        resident, slab = _open(device, stack(voxels, np.eye(4)))
        counts = slab.bricks[::-1]
        with stopwatch.running(device):
            ranges = np.empty((*counts, 2), dtype)
            download(device, ranges, measure_cells(resident, slab, stopwatch))
            leaps = find_leaps(resident, slab, "key", np.arange(100) > 50, 0.0, 1.0, stopwatch)
            distances = download(device, np.empty(counts, np.uint8), leaps.distances_d)
        low, high = _count_cells(voxels, np.minimum), _count_cells(voxels, np.maximum)
        require_equal(ranges, np.stack([low, high], axis=-1), f"ranges of bricks of {dtype} voxels")
        expected = _spread(high > 50)
        require_equal(distances, expected, f"distances of bricks of {dtype} voxels")
        for eye, aside in (((0.01, -0.5, 0.7, 0.0), 0.02), ((-3.0, 20.0, 10.0, 1.0), 0.5)):
            for axis in range(3):
                way = MainWay(axis, 1 if axis else -1, np.array(eye, np.float32), aside)
                with stopwatch.running(device):
                    known = LeapMap(upload(device, expected), None)
                    ways_d = look_ahead(resident, slab, way, known, stopwatch)
                    ways = download(device, np.empty(counts, np.uint8), ways_d)
                require_equal(ways >> 4, _count_ahead(expected, way), f"free bricks ahead along axis {axis}")
                require_equal(ways & FARTHEST, expected, "distances of bricks, copied")
    return f"{np.prod(counts):,} bricks of {len(TYPES)} types of voxels equal"


def _check_tiles(device: Device) -> str:
    """Look at a stair of bright voxels, straight on: each tile begins before it, at most a few bricks."""
    nk, nj, ni = 90, 64, 80
    stair = 30 + np.arange(ni) // 2
    voxels = np.where(np.arange(nk)[:, None, None] >= stair, 1000, np.zeros((nk, nj, ni))).astype(np.int16)
    size, distance, stopwatch = (ni * TILE, nj * TILE), 50.0, Stopwatch()
    for uneven in (False, True):
        volume = stack(voxels, np.eye(4), uneven)
        resident, slab = _open(device, volume)
        middle = np.array([(ni - 1) / 2, (nj - 1) / 2, 0.0])
        camera = Camera(tuple(middle - (0.0, 0.0, distance)), tuple(middle), (0.0, -1.0, 0.0), parallel_scale=nj / 2)
        box = volume_box(volume)
        view = RayView.of(volume, camera, size, 0.5, box=box, focus=box)
        output = PictureBuffers(device, size, None, False)
        with stopwatch.running(device):
            leaps = find_leaps(resident, slab, "key", np.arange(100) > 50, 0.0, 0.1, stopwatch)
            entries_d = enter_tiles(resident, slab, view, leaps, output, stopwatch)
            entries = download(device, np.empty((nj, ni), np.float32), entries_d) + view.table[-1, 0]
        heights = volume.slice_origins()[:, 2]
        first, last = (heights[np.maximum(stair - n, 0)] + distance for n in (BEFORE, 0))

        allowed = 0.5 * (last - first)
        what = f"entries of tiles{' of uneven slices' if uneven else ''}"
        require_close((entries - 0.5 * (first + last)) / allowed, np.zeros_like(entries), 1.0, what)
    return f"{2 * ni * nj:,} tiles begin up to {BEFORE} slices before the first that shows"


CHECKS = (
    Check(
        "leaps of rays",
        ("measure_cells", "mark_bricks", "spread_in_rows", "spread_along", "look_ahead"),
        _check_leaps,
    ),
    Check(
        "entries of tiles",
        ("measure_cells", "mark_bricks", "spread_in_rows", "spread_along", "enter_tiles"),
        _check_tiles,
        {"rays/leaps.cl": ("UNEVEN",), "rays/tiles.cl": ("UNEVEN",)},
    ),
)  # fmt: skip
