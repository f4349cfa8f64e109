"""Masks joined, inverted and counted, and voxels outside of one replaced: the host side of cl/masks/logic.cl."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    download,
    empty_output,
    kernel_constant,
    launch,
    load_program,
)
from clrecon.operators.masks.band_mask import VoxelMask
from clrecon.operators.resident.voxel_types import voxel_variants

OPERATIONS = {
    "and": kernel_constant("masks/logic.cl", "OPERATION_AND"),
    "or": kernel_constant("masks/logic.cl", "OPERATION_OR"),
    "xor": kernel_constant("masks/logic.cl", "OPERATION_XOR"),
    "and not": kernel_constant("masks/logic.cl", "OPERATION_AND_NOT"),
}
"""Words of an operation, and its number in the kernel."""


def prepare_logic(device: Device, dtype: DTypeLike = np.int16) -> Program:
    """Build the kernels; `dtype` is that of voxels."""
    return load_program(device, "masks/logic.cl", voxel_variants(dtype))


def combine(
    device: Device,
    a_d: Any,
    b_d: Any,
    shape_ijk: tuple[int, int, int],
    operation: str,
    stopwatch: Stopwatch | None = None,
) -> Any:
    """Return the words of two masks of one shape joined; `operation` is one of `OPERATIONS`."""
    words, rows = _words(shape_ijk)
    combined_d = allocate(device, 4 * words * rows)
    launch(
        device, prepare_logic(device)["combine_masks"], words * rows, stopwatch=stopwatch, a=a_d, b=b_d,
        combined=combined_d, n=words * rows, operation=OPERATIONS[operation],
    )  # fmt: skip
    return combined_d


def invert(device: Device, mask_d: Any, shape_ijk: tuple[int, int, int], stopwatch: Stopwatch | None = None) -> Any:
    """Return the words of the voxels that are not set."""
    words, rows = _words(shape_ijk)
    inverted_d = allocate(device, 4 * words * rows)
    launch(
        device, prepare_logic(device)["invert_mask"], words * rows, stopwatch=stopwatch, mask=mask_d,
        inverted=inverted_d, n=words * rows, ni=shape_ijk[0], words=words,
    )  # fmt: skip
    return inverted_d


def count_bits(device: Device, mask_d: Any, shape_ijk: tuple[int, int, int], stopwatch: Stopwatch | None = None) -> int:
    """Return the number of set voxels."""
    words, rows = _words(shape_ijk)
    counts, counts_d = empty_output(device, (rows,), np.uint32)
    launch(
        device, prepare_logic(device)["count_row_bits"], rows, stopwatch=stopwatch, mask=mask_d, counts=counts_d,
        rows=rows, words=words,
    )  # fmt: skip
    return int(download(device, counts, counts_d).sum(dtype=np.int64))


def find_extents(
    device: Device, mask_d: Any, shape_ijk: tuple[int, int, int], stopwatch: Stopwatch | None = None
) -> VoxelMask:
    """Return the mask with the extents of its rows."""
    words, rows = _words(shape_ijk)
    extents_d = allocate(device, 4 * rows)
    launch(
        device, load_program(device, "masks/band_mask.cl")["find_extents"], rows, stopwatch=stopwatch, mask=mask_d,
        row_extents=extents_d, rows=rows, words=words,
    )  # fmt: skip
    return VoxelMask(mask_d, extents_d, shape_ijk, words, 0)


def replace_outside(
    device: Device, voxels_d: Any, dtype: np.dtype[Any], mask_d: Any, shape_ijk: tuple[int, int, int], outside: float,
    stopwatch: Stopwatch | None = None,
) -> tuple[NDArray[Any], Any]:  # fmt: skip
    """Return voxels with `outside` where the mask is not set: a host array, (nk, nj, ni), and a buffer."""
    ni, nj, nk = shape_ijk
    words, rows = _words(shape_ijk)
    replaced, replaced_d = empty_output(device, (nk, nj, ni), dtype)
    launch(
        device, prepare_logic(device, dtype)["replace_outside"], rows, stopwatch=stopwatch, voxels=voxels_d,
        mask=mask_d, replaced=replaced_d, outside=dtype.type(outside), rows=rows, words=words, ni=ni,
    )  # fmt: skip
    return download(device, replaced, replaced_d), replaced_d


def _words(shape_ijk: tuple[int, int, int]) -> tuple[int, int]:
    """Return the words of a row, and the rows."""
    ni, nj, nk = shape_ijk
    return -(-ni // 32), nj * nk
