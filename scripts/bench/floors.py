"""The physical floor of a surface: the time that the machine needs to move its bytes.

    bytes = 2 N f + m N / 8 + (24 V + 12 T) w

N: voxels of two bytes.  f: share of them that is read, 1 cold, and warm the share of 8^3 bricks that the surface
crosses.  m: passes over the one-bit mask, 5 on CPUs (written with write-allocate, read three times) and 3 on GPUs.
V: vertices with normal.  T: triangles.  w: 2 on CPUs (write-allocate) and 1 on GPUs.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.proof.timing import usable_cores

BRICK = 8
_COPY_BYTES = 1 << 28


def floor_bytes(voxels: int, itemsize: int, vertices: int, triangles: int, is_cpu: bool, read_share: float = 1) -> int:
    """Smallest number of bytes that must move, see the head of this file."""
    transits, writes = (5, 2) if is_cpu else (3, 1)
    output = (24 * vertices + 12 * triangles) * writes
    return round(itemsize * voxels * read_share + transits * voxels / 8 * read_share + output)


def kernel_bytes(voxels: int, itemsize: int, vertices: int, triangles: int) -> dict[str, int]:
    """Smallest number of bytes that each heavy kernel must move, with each input read once."""
    mask = voxels // 8
    return {
        "classify_samples": itemsize * voxels + mask,
        "count_rows": mask,
        "emit_vertices": 24 * vertices,
        "emit_triangles": 12 * triangles,
    }


def usable_bandwidth(bandwidth: dict[str, float], device: Any) -> float:
    """Return the bandwidth of the best copy on a CPU; on another device that of its own copy."""
    return max(bandwidth.values()) if device.type == "cpu" else bandwidth["opencl"]


def share_of_floor(moved: int, bandwidth: float, seconds: float) -> float | None:
    """Return how many per cent of a bandwidth (bytes read and written a second) a run achieves; None without a time."""
    return 100.0 * moved / bandwidth / seconds if seconds > 0 else None


def active_brick_share(voxels: NDArray[Any], lowest_inside: float) -> float:
    """Share of the 8^3 bricks with voxels inside and outside (each has 9^3 samples: neighbours share a layer)."""
    low = high = voxels
    for axis in range(3):
        starts = np.arange(0, max(voxels.shape[axis] - 1, 1), BRICK)
        last = np.minimum(starts + BRICK, voxels.shape[axis] - 1)
        low = np.minimum(np.minimum.reduceat(low, starts, axis), np.take(low, last, axis))
        high = np.maximum(np.maximum.reduceat(high, starts, axis), np.take(high, last, axis))
    return float(np.mean((low < lowest_inside) & (high >= lowest_inside)))


def copy_bandwidth(device: Any) -> dict[str, float]:
    """Measure the bandwidth of copies of 256 MiB: bytes read plus bytes written a second, the best of five.

    ``numpy_1_thread``, ``numpy_all_threads`` and ``opencl`` (clEnqueueCopyBuffer on `device`).
    """
    source = np.ones(_COPY_BYTES, dtype=np.uint8)
    target = np.ones_like(source)
    cores = usable_cores()
    parts = list(zip(np.array_split(source, cores), np.array_split(target, cores), strict=True))

    def copy_with_all() -> None:
        threads = [threading.Thread(target=np.copyto, args=(to, what)) for what, to in parts]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    return {
        "numpy_1_thread": 2 * _COPY_BYTES / _best(lambda: np.copyto(target, source)),
        "numpy_all_threads": 2 * _COPY_BYTES / _best(copy_with_all),
        "opencl": 2 * _COPY_BYTES / _best(_device_copy(device)),
    }


def _device_copy(device: Any) -> Any:
    from clrecon.opencl import allocate
    from clrecon.opencl.quirks import import_pyopencl

    cl = import_pyopencl()
    size = min(_COPY_BYTES, device.max_allocation_bytes)
    source_d, target_d = allocate(device, size), allocate(device, size)
    repeats = -(-_COPY_BYTES // size)

    def copy() -> None:
        for _ in range(repeats):
            cl.enqueue_copy(device.queue, target_d, source_d, byte_count=size)
        device.queue.finish()

    cl.enqueue_fill_buffer(device.queue, source_d, np.uint8(1), 0, size)
    copy()
    return copy


def _best(run: Any, runs: int = 5) -> float:
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
