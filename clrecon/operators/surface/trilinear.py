"""The passes of cl/isosurface/trilinear.cl on one slab: ambiguous cells resolved as the trilinear field has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    launch,
    load_program,
)
from clrecon.operators.primitives.compaction import exclusive_scan
from clrecon.operators.resident.voxel_types import voxel_variants
from clrecon.operators.surface.slabs import Slab

__all__ = ["LONGEST_ROW", "CellVertices", "check_row", "count_cells", "emit_cells", "prepare_trilinear"]

LONGEST_ROW = 2_970
"""Samples a row: places in a row are 16-bit numbers, and a cell has at most 22 triangles."""


@dataclass(frozen=True)
class CellVertices:
    """What `count_cells` leaves on the device: vertices inside cells before each row and word, and their total."""

    offsets_d: Any
    word_places_d: Any
    total: int


def prepare_trilinear(device: Device, dtype: DTypeLike) -> Program:
    """Build the kernels for volumes of `dtype`.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    return load_program(device, "isosurface/trilinear.cl", voxel_variants(dtype))


def check_row(volume: Volume) -> None:
    """Refuse a volume with rows that are too long.

    Raises
    ------
    UsageError
    """
    ni = volume.shape_ijk[0]
    if ni + 2 > LONGEST_ROW:
        raise UsageError(
            f"the volume has {ni:,} columns: the topology trilinear supports {LONGEST_ROW - 2:,}, separated has more"
        )


def _field_scalars(slab: Slab) -> tuple[Any, ...]:
    """Level, outside, and where the slab lies: how every pass is told about the field."""
    volume, rule = slab.grid.volume, slab.grid.rule
    value = np.float32 if volume.voxels.dtype.kind == "f" else np.int32
    place = (*volume.shape_ijk, rule.border, slab.voxel_slices[0], slab.first)
    sizes = (np.uint32(slab.mask_slices), np.uint32(slab.grid.words))
    return (np.float32(rule.iso_level), value(rule.outside), *(np.int32(n) for n in place), *sizes)


def count_cells(
    device: Device,
    slab: Slab,
    voxels_d: Any,
    mask_d: Any,
    flags_d: Any,
    row_counts_d: Any,
    word_triangles_d: Any,
    stopwatch: Stopwatch,
) -> CellVertices:
    """Count the triangles of the slab anew, in place, and the vertices inside cells, which follow those of each slice.

    Parameters
    ----------
    flags_d, row_counts_d, word_triangles_d : buffers
        What count_rows wrote: words with work, counts of each row, triangles of the row before each word.
    """
    grid, rows = slab.grid, slab.counted_rows
    row_vertices_d = allocate(device, 4 * rows)
    word_places_d = allocate(device, 2 * slab.rows * grid.words)
    program = prepare_trilinear(device, grid.volume.voxels.dtype)
    launch(
        device, program["count_cells"], rows,
        voxels_d, mask_d, flags_d, row_counts_d, word_triangles_d, row_vertices_d, word_places_d,
        *_field_scalars(slab), np.uint32(grid.flag_words), np.uint32(slab.rows), np.uint32(rows),
        stopwatch=stopwatch,
    )  # fmt: skip
    scanned = exclusive_scan(device, row_vertices_d, rows, stopwatch=stopwatch)
    slices = rows // grid.shape[1]
    launch(
        device, program["make_room"], slices,
        row_counts_d, scanned.offsets_d, np.uint32(grid.shape[1]), np.uint32(slices), stopwatch=stopwatch,
    )  # fmt: skip
    return CellVertices(scanned.offsets_d, word_places_d, scanned.total)


def emit_cells(
    device: Device,
    slab: Slab,
    voxels_d: Any,
    mask_d: Any,
    counted: Any,
    tables: tuple[Any, Any, Any],
    output: tuple[Any, Any, Any],
    first_vertex: int,
    stopwatch: Stopwatch,
) -> None:
    """Write the triangles of the slab and the vertices inside its cells.

    Parameters
    ----------
    counted : marching_cubes.Counted
        With `cells`.
    tables : slice frames (buffer), steps (buffer), margin (float4)
        As emit_vertices takes them.
    output : positions, normals, triangles (buffers)
    first_vertex : int
        Vertices of all slabs before.
    """
    program = prepare_trilinear(device, slab.grid.volume.voxels.dtype)
    cells: CellVertices = counted.cells
    positions_d, normals_d, triangles_d = output
    active = counted.active_words
    mirrored = np.int32(slab.grid.winds_backwards)
    packing = (*_field_scalars(slab), np.uint32(slab.grid.row_shift), np.uint32(active))
    common = (voxels_d, mask_d, counted.active_words_d, counted.row_offsets_d)
    if counted.triangles:
        launch(
            device, program["emit_cell_triangles"], active,
            *common, cells.offsets_d,
            counted.word_vertices_d, counted.word_triangles_d, cells.word_places_d,
            triangles_d, np.uint32(first_vertex), np.uint32(slab.counted_rows), mirrored, *packing,
            stopwatch=stopwatch,
        )  # fmt: skip
    if cells.total:
        launch(
            device, program["emit_cell_vertices"], active,
            *common, cells.offsets_d, cells.word_places_d, *tables, positions_d, normals_d, *packing,
            stopwatch=stopwatch,
        )  # fmt: skip
