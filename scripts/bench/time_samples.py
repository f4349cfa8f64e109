"""Time `Volume.sample` of a million points, beside scipy and beside a kernel that would do it on a device.

    python scripts/bench/time_samples.py [DEVICE]

Processor seconds and wall seconds, the best of five, of points anywhere in a volume of 400 slices and of points on a
surface.  The kernel gets cells and fractions of a cell as float32, which the host makes in float64 as `sample` does:
float32 coordinates alone would be off by 0.1 HU.  Its volume is on the device already.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import clrecon
from clrecon.system.pieces import chunks

SHAPE = (400, 512, 512)
COUNT = 1000
SOURCE = """
__kernel void sample(__global const short *hu, __global const int *cells, __global const float *parts, int ni, int nij,
                     __global float *values) {
    int n = get_global_id(0);
    float x = parts[3 * n], y = parts[3 * n + 1], z = parts[3 * n + 2], corner[8];
    for (int c = 0; c < 8; ++c) corner[c] = hu[cells[n] + (c & 1) + (c >> 1 & 1) * ni + (c >> 2) * nij];
    for (int c = 0; c < 8; c += 2) corner[c] = corner[c] * (1.0f - x) + corner[c + 1] * x;
    float low = corner[0] * (1.0f - y) + corner[2] * y, high = corner[4] * (1.0f - y) + corner[6] * y;
    values[n] = low * (1.0f - z) + high * z;
}
"""


def best(work: Callable[[], Any]) -> str:
    found = []
    for _ in range(5):
        before, began = os.times(), time.perf_counter()
        work()
        after = os.times()
        found.append((after.user + after.system - before.user - before.system, time.perf_counter() - began))
    return "{:.2f} s of processors, {:.2f} s".format(*min(found))


def make_points() -> dict[str, np.ndarray]:
    along = np.linspace(0.0, np.pi, COUNT)
    down, round_ = np.meshgrid(along, 2.0 * along, indexing="ij")
    ball = [np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down)]
    anywhere = np.random.default_rng(1).uniform(-120.0, 120.0, (COUNT * COUNT, 3))
    return {"anywhere": anywhere, "on a surface": 100.0 * np.stack(ball, axis=-1).reshape(-1, 3)}


def main() -> None:
    import pyopencl as cl
    from scipy import ndimage

    device = clrecon.device(sys.argv[1] if len(sys.argv) > 1 else None)
    voxels = np.random.default_rng(1).integers(-1000, 2000, SHAPE, dtype=np.int16)
    affine = np.diag([0.5, 0.5, 0.7, 1.0])
    affine[:3, 3] = -128.0, -128.0, -140.0
    volume = clrecon.Volume(voxels, affine)
    nk, nj, ni = SHAPE
    queue, flags = cl.CommandQueue(device.context), cl.mem_flags
    kernel = cl.Program(device.context, SOURCE).build().sample
    hu_d = cl.Buffer(device.context, flags.READ_ONLY | flags.USE_HOST_PTR, hostbuf=voxels)

    def by_kernel(points: np.ndarray) -> np.ndarray:
        cells, parts = np.empty(len(points), np.int32), np.empty((len(points), 3), np.float32)
        for where in chunks(len(points)):
            places = np.clip(volume.lps_to_ijk(points[where]), 0.0, np.array(volume.shape_ijk) - 1.0)
            low = np.minimum(np.floor(places), np.array(volume.shape_ijk) - 2.0)
            parts[where], cells[where] = places - low, low @ np.array((1.0, ni, nj * ni))
        values = np.empty(len(points), np.float32)
        cells_d, parts_d = (
            cl.Buffer(device.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=each) for each in (cells, parts)
        )
        values_d = cl.Buffer(device.context, flags.WRITE_ONLY, values.nbytes)
        kernel(queue, (len(points),), None, hu_d, cells_d, parts_d, np.int32(ni), np.int32(nj * ni), values_d)
        cl.enqueue_copy(queue, values, values_d)
        return values

    for name, points in make_points().items():
        at = volume.lps_to_ijk(points)[:, ::-1].T
        off = float(np.abs(by_kernel(points) - volume.sample(points)).max())
        print(f"{len(points):,} points {name}")
        print(f"    sample            {best(lambda: volume.sample(points))}")  # noqa: B023
        print(f"    sample, nearest   {best(lambda: volume.sample(points, order=0))}")  # noqa: B023
        print(f"    scipy, from ijk   {best(lambda: ndimage.map_coordinates(voxels, at, np.float64, order=1))}")  # noqa: B023
        print(f"    kernel on {device.label}: {best(lambda: by_kernel(points))}, up to {off:.1g} HU off")  # noqa: B023


if __name__ == "__main__":
    main()
