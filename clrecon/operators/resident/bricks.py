"""Ranges of the bricks of a volume: measured once, they let later passes skip most bricks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.opencl import Device, Program, Stopwatch, allocate, kernel_constant, launch, load_program
from clrecon.operators.resident.voxel_types import voxel_variants

BRICK = kernel_constant("include/bricks.h", "BRICK")
"""Voxels along each side of a brick."""


@dataclass(frozen=True)
class BrickRanges:
    """The lowest and highest value of every brick, on the device.

    ranges_d: buffer, (bk, bj, bi, 2) of the voxels' type
    shape: (bi, bj, bk)
    """

    ranges_d: Any
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class BrickStates:
    """The result of comparing words of 32 samples with an iso value, one row of words for each row of bricks.

    states_d: buffer, (bk, bj, words) uint8
    extents_d: buffer, (bk, bj, 2) uint16
    """

    states_d: Any
    extents_d: Any


def brick_bytes(shape_ijk: tuple[int, int, int], dtype: np.dtype[Any]) -> int:
    """Return the bytes of the ranges of a volume's bricks on the device."""
    return 2 * math.prod(-(-n // BRICK) for n in shape_ijk) * int(dtype.itemsize)


def prepare_bricks(device: Device, dtype: np.dtype[Any]) -> Program:
    """Build the kernels for volumes of `dtype`."""
    return load_program(device, "resident/bricks.cl", voxel_variants(dtype))


def measure_bricks(
    device: Device,
    voxels_d: Any,
    shape_ijk: tuple[int, int, int],
    dtype: np.dtype[Any],
    *,
    stopwatch: Stopwatch | None = None,
) -> BrickRanges:
    """Find the lowest and highest value of each brick of 8 x 8 x 8 voxels.

    voxels_d: buffer, (nk, nj, ni) of `dtype`, without NaN
    shape_ijk: (ni, nj, nk)

    Returns: Bricks at the upper ends of the volume may be smaller.
    """
    ni, nj, nk = shape_ijk
    bi, bj, bk = (-(-n // BRICK) for n in shape_ijk)
    ranges_d = allocate(device, brick_bytes(shape_ijk, dtype))
    launch(
        device, prepare_bricks(device, dtype)["measure_bricks"], bi * bj * bk, stopwatch=stopwatch,
        voxels=voxels_d, ranges=ranges_d, ni=ni, nj=nj, nk=nk, bi=bi, bj=bj, bk=bk,
    )  # fmt: skip
    return BrickRanges(ranges_d, (bi, bj, bk), dtype)


def compare_bricks(
    device: Device,
    ranges: BrickRanges,
    level: Any,
    ni: int,
    border: int,
    *,
    stopwatch: Stopwatch | None = None,
) -> BrickStates:
    """Classify each word of 32 samples by its bricks: all outside (0), all inside (1) or mixed (2).

    level: Lowest inside value.
    ni: Number of voxels in a row.
    border: Word w begins at voxel ``32 * w - border``, and there are samples up to ``ni - 1 + border``. Samples beyond
        the volume are ignored.

    Returns: With the extent of each row of bricks: the first word that is not all outside, and the one after the last.
    """
    _, bj, bk = ranges.shape
    words = -(-(ni + 2 * border) // 32)
    states_d, extents_d = allocate(device, words * bj * bk), allocate(device, 4 * bj * bk)
    launch(
        device, prepare_bricks(device, ranges.dtype)["compare_bricks"], bj * bk, stopwatch=stopwatch,
        ranges=ranges.ranges_d, states=states_d, extents=extents_d, level=level, ni=ni, border=border, words=words,
        rows=bj * bk,
    )  # fmt: skip
    return BrickStates(states_d, extents_d)
