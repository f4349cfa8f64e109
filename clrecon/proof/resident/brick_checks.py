"""Checks of what stays on the device with a volume: the ranges of its bricks."""

from __future__ import annotations

import numpy as np

from clrecon.opencl import Device, download, upload
from clrecon.operators.resident.tables import compare_bricks, measure_bricks
from clrecon.proof.checking.check import Check, require_equal
from clrecon.proof.checking.scenes import noise
from clrecon.proof.resident import bricks as twin

SHAPE = (221, 196, 21)
"""Voxels (k, j, i) of 28 x 25 x 3 bricks: 700 rows."""


def _check_bricks(device: Device) -> str:
    for dtype in ("int8", "uint8", "int16", "uint16", "int32", "float32"):
        voxels = noise(SHAPE, dtype, 120)
        rows = np.arange(-(-SHAPE[0] // 8) * -(-SHAPE[1] // 8)).reshape(-(-SHAPE[0] // 8), -1)
        shift = (rows % 5).repeat(8, 0).repeat(8, 1)[: SHAPE[0], : SHAPE[1], None]  # some rows are all outside
        voxels = np.where(shift == 4, 0, voxels // 4 + 20 * shift).astype(dtype)
        measured = measure_bricks(device, upload(device, voxels), SHAPE[::-1], voxels.dtype)
        shape = (*measured.shape[::-1], 2)
        ranges = download(device, np.empty(shape, voxels.dtype), measured.ranges_d)
        expected = twin.measure_bricks(voxels)
        require_equal(ranges, expected, f"ranges of bricks of {dtype} voxels")
        level = voxels.dtype.type(45)
        compared = compare_bricks(device, measured, level, SHAPE[2], 1)
        states, extents = twin.compare_bricks(expected, float(level), SHAPE[2], 1)
        found = download(device, np.empty_like(states), compared.states_d)
        require_equal(found, states, f"states of bricks of {dtype} voxels")
        found = download(device, np.empty_like(extents), compared.extents_d)
        require_equal(found, extents, f"extents of bricks of {dtype} voxels")
    return "2,100 bricks of 6 types of voxels equal"


CHECKS = (Check("bricks", ("measure_bricks", "compare_bricks"), _check_bricks),)
