"""Marching cubes: the passes of cl/surface/cells.cl on one slab of a volume, which know bits and no voxels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.errors import DeviceMemoryError
from clrecon.opencl import Device, Program, Stopwatch, allocate, download, launch, load_program
from clrecon.operators.primitives.scan import exclusive_scan
from clrecon.operators.surface.slabs import Slab
from clrecon.operators.surface.trilinear import CellVertices, count_cells


def load_cells(device: Device, grown: bool = False) -> Program:
    """Build the kernels, which are the same for every type of voxels; with `grown`, those for parts of a surface."""
    variants = {**device.kernel_variants, "GROWN": "1"} if grown else device.kernel_variants
    return load_program(device, "surface/cells.cl", variants)


@dataclass(frozen=True)
class Classified:
    """The results of `marching_cubes.classify` for one slab, on the device.

    mask_d: buffer, (gk, gj, words) uint32. Its crossed edges have the vertices.
    row_extents_d: buffer, (gk, gj) ushort2
    grown_d, grown_extents_d: For a part of a surface: the samples of the whole grid whose edges have vertices, see
        cl/surface/growing.cl, and their extents.
    first_grown: Slice of them that the slab begins with.
    """

    mask_d: Any
    row_extents_d: Any
    grown_d: Any = None
    grown_extents_d: Any = None
    first_grown: int = 0

    @property
    def is_part(self) -> bool:
        """True where only grown samples have vertices."""
        return self.grown_d is not None

    @property
    def own(self) -> dict[str, Any]:
        """Arguments of kernels for parts of a surface."""
        return {"grown": self.grown_d, "first_grown": self.first_grown} if self.is_part else {}


@dataclass(frozen=True)
class Counted:
    """The results of `count` for one slab, on the device, and the totals of the slab's own rows.

    `cells` exists if the topology is that of the trilinear field.
    """

    row_offsets_d: Any
    word_vertices_d: Any
    word_triangles_d: Any
    active_words_d: Any
    vertices: int
    triangles: int
    active_words: int
    cells: CellVertices | None = None

    def output(self) -> dict[str, int]:
        """Bytes of the slab's mesh."""
        return {"vertices": 24 * self.vertices, "triangles": 12 * self.triangles}


def count(
    device: Device,
    slab: Slab,
    classified: Classified,
    stopwatch: Stopwatch,
    voxels_d: Any = None,
) -> Counted:
    """Passes 2 to 4: count vertices and triangles, find where those of each word begin, and which words have any.

    voxels_d: Slices ``slab.voxel_slices`` of the volume; needed for the topology of the trilinear field.
    """
    grid, rows = slab.grid, slab.counted_rows
    program = load_cells(device, classified.is_part)
    gi, gj, _ = grid.shape
    row_counts_d = allocate(device, 12 * rows)
    word_vertices_d, word_triangles_d = (allocate(device, 2 * rows * grid.words) for _ in range(2))
    flags_d = allocate(device, 4 * rows * grid.flag_words)
    launch(
        device, program["count_rows"], rows, stopwatch=stopwatch,
        mask=classified.mask_d, row_extents=classified.row_extents_d, row_counts=row_counts_d,
        words_with_work=flags_d, word_vertices=word_vertices_d, word_triangles=word_triangles_d,
        gi=gi, gj=gj, gk=slab.mask_slices, words=grid.words, flag_words=grid.flag_words, rows_to_count=rows,
        **({"grown_extents": classified.grown_extents_d} if classified.is_part else {}), **classified.own,
    )  # fmt: skip
    cells = None
    if grid.rule.topology == "trilinear":
        cells = count_cells(
            device, slab, voxels_d, classified.mask_d, flags_d, row_counts_d, word_triangles_d, stopwatch
        )
    scanned = exclusive_scan(device, row_counts_d, 3 * rows, in_place=True, stopwatch=stopwatch)
    if scanned.total >= 2**32:
        raise DeviceMemoryError(
            f"a slab of {slab.slices} slices has {scanned.total:,} vertices and triangles: more than 32 bits can number"
        )
    totals_d = allocate(device, 12)
    launch(
        device, program["total_counts"], 1, stopwatch=stopwatch,
        row_offsets=scanned.offsets_d, total=scanned.total_d, totals=totals_d, rows=slab.rows, rows_to_count=rows,
    )  # fmt: skip
    vertices, triangles, active = (int(n) for n in download(device, np.empty(3, np.uint32), totals_d))
    active_words_d = allocate(device, 4 * active)
    launch(
        device, program["list_words"], slab.rows, stopwatch=stopwatch,
        words_with_work=flags_d, row_offsets=scanned.offsets_d, active_words=active_words_d, rows=slab.rows,
        rows_to_count=rows, flag_words=grid.flag_words, row_shift=grid.row_shift,
    )  # fmt: skip
    offsets_d = scanned.offsets_d
    return Counted(offsets_d, word_vertices_d, word_triangles_d, active_words_d, vertices, triangles, active, cells)
