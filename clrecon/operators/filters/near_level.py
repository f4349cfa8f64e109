"""Groups of 16 voxels near a level: the host's side of cl/filters/near_level.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from clrecon.opencl import Device, Program, Stopwatch, allocate, kernel_constant, launch, load_program
from clrecon.operators.primitives.compact import Compacted, compact, prepare_compact
from clrecon.operators.resident.voxel_types import voxel_variants

GROUP = kernel_constant("filters/near_level.cl", "GROUP")
"""Voxels of a group."""


@dataclass(frozen=True)
class SlicesThere:
    """Slices of a volume on the device, and those of them that are worked on.

    voxels_d: buffer, (count, nj, ni). Slices `first` to ``first + count - 1``.
    core_first, core_count: The slices that are worked on.
    """

    voxels_d: Any
    ni: int
    nj: int
    first: int
    count: int
    core_first: int
    core_count: int

    @property
    def rows(self) -> int:
        """Rows that are there."""
        return self.nj * self.count

    @property
    def core_rows(self) -> int:
        """Rows that are worked on."""
        return self.nj * self.core_count


def row_words(ni: int) -> int:
    """Return the words of 32 groups for a row."""
    return -(-ni // (32 * GROUP))


def mixed_group_bytes(ni: int, rows: int, core_rows: int) -> int:
    """Return the most bytes on the device that `list_mixed_groups` takes."""
    words = row_words(ni)
    return 4 * words * (4 * rows + core_rows) + 4 * -(-ni // GROUP) * core_rows


def prepare_near_level(device: Device, dtype: DTypeLike = np.int16) -> Program:
    """Build the kernels for volumes of `dtype`."""
    prepare_compact(device)
    return load_program(device, "filters/near_level.cl", voxel_variants(dtype))


def list_mixed_groups(
    device: Device,
    there: SlicesThere,
    dtype: DTypeLike,
    level: Any,
    reach: tuple[int, int, int],
    *,
    stopwatch: Stopwatch | None = None,
) -> Compacted:
    """List the groups of which some voxel has both sides of a level in the box around it.

    there: With all slices within reach of those that are worked on, as far as the volume has them.
    level: Lowest value inside; NaN is not.
    reach: Half the size of the box along i, j, k, without the voxel in its middle; at most 16 along i.

    Returns: Numbers ``32 * row_words(ni) * (core row) + group``, ascending.
    """
    program, words = prepare_near_level(device, dtype), row_words(there.ni)
    count, core_count = words * there.rows, words * there.core_rows
    some_d, all_d, some_near_d, all_near_d = (allocate(device, 4 * count) for _ in range(4))
    mask_d = allocate(device, 4 * core_count)
    launch(
        device, program["classify_groups"], there.rows, stopwatch=stopwatch, voxels=there.voxels_d, some=some_d,
        every=all_d, level=level, ni=there.ni, rows=there.rows, words=words, reach=reach[0],
    )  # fmt: skip
    launch(
        device, program["spread_groups"], count, stopwatch=stopwatch, some=some_d, every=all_d, some_near=some_near_d,
        all_near=all_near_d, count=count, words=words, nj=there.nj, reach=reach[1],
    )  # fmt: skip
    launch(
        device, program["mark_mixed_groups"], core_count, stopwatch=stopwatch, some_near=some_near_d,
        all_near=all_near_d, mask=mask_d, count=core_count, slice_words=words * there.nj, slices=there.count,
        core_first=there.core_first - there.first, reach=reach[2],
    )  # fmt: skip
    return compact(device, mask_d, core_count, stopwatch=stopwatch)
