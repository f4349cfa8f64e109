"""Trilinear topology: the passes of cl/surface/trilinear.cl on one slab, which resolve ambiguous cells by the trilinear
field.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import DTypeLike

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Device, Program, allocate, launch, load_program
from clrecon.operators.primitives.scan import exclusive_scan
from clrecon.operators.resident.tables import voxel_variants
from clrecon.operators.surface.slabs import Slab
from clrecon.system.light_dataclass import dataclass

LONGEST_ROW = 2_970
"""Most samples in a row: indices in a row have 16 bits, and a cell has up to 22 triangles."""


@dataclass(frozen=True)
class CellVertices:
    """The results of `count_cells` on the device: vertices inside cells before each row and word, and their total."""

    offsets_d: Any
    word_places_d: Any
    total: int


def prepare_trilinear(device: Device, dtype: DTypeLike) -> Program:
    return load_program(device, "surface/trilinear.cl", voxel_variants(dtype))


def check_row(volume: Volume) -> None:
    """Refuse a volume whose rows are too long."""
    ni = volume.shape_ijk[0]
    if ni + 2 > LONGEST_ROW:
        raise UsageError(
            f"the volume has {ni:,} columns: the topology trilinear supports {LONGEST_ROW - 2:,}, separated has more"
        )


def _field_arguments(slab: Slab) -> dict[str, Any]:
    """Return level, outside and place of the slab: the arguments about the field for every pass."""
    rule = slab.grid.rule
    return {"iso_level": rule.iso_level, "outside": rule.outside, **slab.arguments}


def count_cells(
    device: Device, slab: Slab, voxels_d: Any, mask_d: Any, flags_d: Any, row_counts_d: Any, word_triangles_d: Any
) -> CellVertices:
    """Count triangles again, in place, and vertices inside cells; of count_rows: words, counts, triangles before."""
    grid, rows = slab.grid, slab.counted_rows
    row_vertices_d = allocate(device, 4 * rows)
    word_places_d = allocate(device, 2 * slab.rows * grid.words)
    program = prepare_trilinear(device, grid.volume.voxels.dtype)
    launch(
        device, program["count_cells"], rows,
        voxels=voxels_d, mask=mask_d, words_with_work=flags_d, row_counts=row_counts_d,
        word_triangles=word_triangles_d, row_cell_vertices=row_vertices_d, word_cell_vertices=word_places_d,
        flag_words=grid.flag_words, own_rows=slab.rows, rows_to_count=rows, **_field_arguments(slab),
    )  # fmt: skip
    scanned = exclusive_scan(device, row_vertices_d, rows)
    slices = rows // grid.shape[1]
    launch(
        device, program["make_room"], slices,
        row_counts=row_counts_d, cell_vertex_offsets=scanned.offsets_d, gj=grid.shape[1], slices=slices,
    )  # fmt: skip
    return CellVertices(scanned.offsets_d, word_places_d, scanned.total)


def emit_cells(
    device: Device, slab: Slab, field: dict[str, Any], counted: Any, tables: dict[str, Any], output: dict[str, Any],
    first_vertex: int,
) -> None:  # fmt: skip
    """Write triangles and vertices inside cells after `first_vertex`; `tables` are those of emit_vertices.

    field: Buffers ``voxels`` and ``mask`` of the slab.
    """
    program = prepare_trilinear(device, slab.grid.volume.voxels.dtype)
    cells: CellVertices = counted.cells
    active = counted.active_words
    common = {
        **field,
        "active_words": counted.active_words_d,
        "row_offsets": counted.row_offsets_d,
        "cell_vertex_offsets": cells.offsets_d,
        "word_cell_vertices": cells.word_places_d,
        "row_shift": slab.grid.row_shift,
        "active": active,
        **_field_arguments(slab),
    }
    if counted.triangles:
        launch(
            device, program["emit_cell_triangles"], active, word_vertices=counted.word_vertices_d,
            word_triangles=counted.word_triangles_d, triangles=output["triangles"], first_vertex=first_vertex,
            rows_to_count=slab.counted_rows, mirrored=slab.grid.winds_backwards, **common,
        )  # fmt: skip
    if cells.total:
        launch(
            device, program["emit_cell_vertices"], active,
            positions=output["positions"], normals=output["normals"], **tables, **common,
        )  # fmt: skip
