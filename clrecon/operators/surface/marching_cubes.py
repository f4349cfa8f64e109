"""Marching cubes: the passes of cl/surface/cells.cl, which know no voxels, and cl/surface/marching_cubes.cl on one
slab.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceError, DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import layer_margins, layer_normal_matrices, slice_normal_matrices, vertex_margin
from clrecon.geometry.vertices import find_vertex_origin
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.masks.voxel_mask import prepare_classify
from clrecon.operators.primitives.scan import enqueue_scan, prepare_scan
from clrecon.operators.resident.tables import BrickStates, voxel_variants
from clrecon.operators.surface.slabs import Slab
from clrecon.operators.surface.trilinear import CellVertices, count_cells, emit_cells
from clrecon.system.light_dataclass import dataclass


def load_cells(device: Device, *, grown: bool = False) -> Program:
    """Build the kernels, which are the same for every type of voxels; with `grown`, those for parts of a surface."""
    variants = {**device.kernel_variants, "GROWN": "1"} if grown else device.kernel_variants
    return ocl.load_program(device, "surface/cells.cl", variants)


@dataclass(frozen=True)
class Classified:
    """The results of `marching_cubes.classify` for one slab, on the device: mask_d, (gk, gj, words) uint32, whose
    crossed edges have the vertices, and row_extents_d, (gk, gj) ushort2.

    For a part of a surface `grown_d` and `grown_extents_d` are the samples of the whole grid whose edges have vertices,
    see cl/surface/growing.cl, and their extents; the slab begins with slice `first_grown` of them.
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
class OutputList:
    """For GPUs, on the device: the word, the sample and the edges of each vertex and triangle, see cl/surface/
    output_list.h."""

    vertices_d: Any
    vertex_blocks_d: Any
    triangles_d: Any
    triangle_blocks_d: Any


@dataclass(frozen=True)
class Counted:
    """Results of `count` for a slab, on the device, and totals of its own rows; `cells` of the trilinear field."""

    slab: Slab
    classified: Classified
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

    def scratch(self, device: Device) -> dict[str, int]:
        """Bytes of the buffers whose sizes are known once the slab is counted."""
        numbers = (self.vertices, self.triangles) if has_lanes(device) else ()
        return {"active words": 4 * self.active_words, "list of the output": sum(4 * (n + _blocks(n)) for n in numbers)}

    @property
    def word_arguments(self) -> dict[str, Any]:
        """Arguments about the words with work, for kernels that write a mesh."""
        return {
            "mask": self.classified.mask_d,
            "active_words": self.active_words_d,
            "row_offsets": self.row_offsets_d,
            "word_vertices": self.word_vertices_d,
            "row_shift": self.slab.grid.row_shift,
            "active": self.active_words,
            **self.classified.own,
        }

    @property
    def cell_arguments(self) -> dict[str, Any]:
        """The same, and the size of the slab, for kernels of cl/surface/cells.cl."""
        slab = self.slab
        gi, gj, _ = slab.grid.shape
        size = {"gi": gi, "gj": gj, "gk": slab.mask_slices, "words": slab.grid.words}
        return {**self.word_arguments, **size, "rows_to_count": slab.counted_rows}


BLOCK = ocl.kernel_constant("surface/output_list.h", "BLOCK")
"""Entries of the list of the output for which the place of a word is noted."""


def _blocks(entries: int) -> int:
    return -(-entries // BLOCK)


def has_lanes(device: Device) -> bool:
    """True where each work-item is a lane of its own, on GPUs: it writes one vertex or one triangle."""
    return device.kernel_variants["LANES"] == "1"


def list_output(device: Device, counted: Counted) -> OutputList:
    """Find what each work-item of a GPU writes; no triangles where cl/surface/trilinear.cl writes them."""
    vertices, triangles = counted.vertices, counted.triangles if counted.cells is None else 0
    vertices_d, vertex_blocks_d, triangles_d, triangle_blocks_d = (
        ocl.allocate(device, 4 * entries) for entries in (vertices, _blocks(vertices), triangles, _blocks(triangles))
    )
    ocl.launch(
        device, load_cells(device, grown=counted.classified.is_part)["list_output"], counted.active_words,
        word_triangles=counted.word_triangles_d, vertex_list=vertices_d, vertex_blocks=vertex_blocks_d,
        triangle_list=triangles_d, triangle_blocks=triangle_blocks_d, vertices=vertices, triangles=triangles,
        **counted.cell_arguments,
    )  # fmt: skip
    return OutputList(vertices_d, vertex_blocks_d, triangles_d, triangle_blocks_d)


def count_output(device: Device, slab: Slab, classified: Classified, voxels_d: Any = None) -> Counted:
    """Passes 2 to 4: count vertices and triangles, find where those of each word begin, and which words have any.

    The topology of the trilinear field needs slices ``slab.voxel_slices`` of the volume.
    """
    grid, rows = slab.grid, slab.counted_rows
    program = load_cells(device, grown=classified.is_part)
    gi, gj, _ = grid.shape
    row_counts_d = ocl.allocate(device, 12 * rows)
    word_vertices_d, word_triangles_d = (ocl.allocate(device, 2 * rows * grid.words) for _ in range(2))
    flags_d = ocl.allocate(device, 4 * rows * grid.flag_words)
    ocl.launch(
        device, program["count_rows"], rows,
        mask=classified.mask_d, row_extents=classified.row_extents_d, row_counts=row_counts_d,
        words_with_work=flags_d, word_vertices=word_vertices_d, word_triangles=word_triangles_d,
        gi=gi, gj=gj, gk=slab.mask_slices, words=grid.words, flag_words=grid.flag_words, rows_to_count=rows,
        **({"grown_extents": classified.grown_extents_d} if classified.is_part else {}), **classified.own,
    )  # fmt: skip
    cells = None
    if grid.rule.topology == "trilinear":
        cells = count_cells(device, slab, voxels_d, classified.mask_d, flags_d, row_counts_d, word_triangles_d)
    total_d = enqueue_scan(device, row_counts_d, row_counts_d, 3 * rows)
    totals_d = ocl.allocate(device, 12)
    ocl.launch(
        device, program["total_counts"], 1,
        row_offsets=row_counts_d, total=total_d, totals=totals_d, rows=slab.rows, rows_to_count=rows,
    )  # fmt: skip
    totals, total = np.empty(3, np.uint32), np.empty(1, np.uint64)
    ocl.download_all(device, (totals, totals_d, 0), (total, total_d, 0))
    if total[0] >= 2**32:
        raise DeviceMemoryError(
            f"a slab of {slab.slices} slices has {total[0]:,} vertices and triangles: more than 32 bits can number"
        )
    vertices, triangles, active = (int(n) for n in totals)
    active_words_d = ocl.allocate(device, 4 * active)
    ocl.launch(
        device, program["list_words"], slab.rows,
        words_with_work=flags_d, row_offsets=row_counts_d, active_words=active_words_d, rows=slab.rows,
        rows_to_count=rows, flag_words=grid.flag_words, row_shift=grid.row_shift,
    )  # fmt: skip
    return Counted(
        slab, classified, row_counts_d, word_vertices_d, word_triangles_d, active_words_d, vertices, triangles, active,
        cells,
    )  # fmt: skip


LONGEST_ROW = 13_000
"""Most samples in a row: indices in a row have 16 bits, and a cell has up to 5 triangles."""


def check_row(ni: int) -> None:
    """Refuse rows that are too long."""
    if ni + 2 > LONGEST_ROW:
        raise UsageError(f"the volume has {ni:,} columns, {LONGEST_ROW - 2:,} are supported")


def prepare_marching_cubes(
    device: Device,
    dtype: DTypeLike,
    labels: Mapping[str, str] | None = None,
    *,
    uneven: bool = False,
    inside: str = "above",
    vertex_rule: str = "linear",
    grown: bool = False,
) -> Program:
    """Build the kernels for `dtype`; return emit_vertices, which for labels has their variants, a macro of cl/surface/
    marching_cubes.cl among them."""
    variants = {**voxel_variants(dtype), **device.kernel_variants}
    if inside == "between":
        variants["RANGE"] = "1"
    if labels is not None:
        variants.update(labels)
    if grown:
        variants["GROWN"] = "1"
    if uneven:
        variants["UNEVEN"] = "1"
    if vertex_rule != "linear":
        variants[vertex_rule.upper().replace("-", "_")] = "1"
    with ocl.building_together(device):
        prepare_scan(device)
        load_cells(device, grown=grown)
        if labels is None:
            prepare_classify(device, dtype, inside)
        ocl.load_program(device, "surface/marching_cubes.cl", variants)
    return ocl.load_program(device, "surface/marching_cubes.cl", variants)


def pad4(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    padded = np.zeros((*rows.shape[:-1], 4), dtype=np.float32)
    padded[..., :3] = rows
    return padded


def split_steps(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split numbers into 12 significant bits and the rest: 12-bit parts times whole numbers < 4096 are exact."""
    mantissa, exponent = np.frexp(values)
    head = np.ldexp(np.round(np.ldexp(mantissa, 12)), exponent - 12)
    return head, values - head


@dataclass(frozen=True)
class Placement:
    """The places of the samples of a grid in mm, in the form for emit_vertices: slice_frames (gk, 9, 4), steps (4, 4),
    margin (4,), float32; `origin` is that of the device's positions, see `find_vertex_origin`.
    """

    slice_frames: NDArray[np.float32]
    steps: NDArray[np.float32]
    margin: NDArray[np.float32]
    origin: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, volume: Volume, border: int) -> Placement:
        """Make the tables for a volume with `border` layers of outside."""
        origins = volume.slice_origins(border + 1)[1:]
        origin = find_vertex_origin(volume)
        if origin is not None:
            origins = origins - origin
        head, rest = origins[:-1].astype(np.float32), origins[:-1] - origins[:-1].astype(np.float32)
        parts = [head.astype(np.float64)[:, None], rest[:, None], np.diff(origins, axis=0)[:, None]]
        normals = slice_normal_matrices(volume, border), layer_normal_matrices(volume, border)
        frames = pad4(np.concatenate([*parts, *normals], axis=1))
        frames[:, 2, 3] = layer_margins(volume, border)
        steps = pad4(np.concatenate([split_steps(volume.affine[:3, step]) for step in (0, 1)]))
        return cls(frames, steps, pad4(vertex_margin(volume, border)), origin)

    def to_lps(self, positions: NDArray[np.float32]) -> NDArray[np.floating]:
        """Convert positions of the device to LPS mm: unchanged, but float64 in a volume far from the origin."""
        return positions if self.origin is None else positions + self.origin


_LANDED_BYTES = 1 << 24
"""Bytes that come between two launches of the first pass, which take the host little time beside their copies."""


class Classifier:
    """Pass 1: marks the samples of the slab that are inside; for a rule that encloses values below, those that are not.

    levels: Lowest inside value and, of a range, the highest.
    """

    def __init__(self, device: Device, slab: Slab, levels: Sequence[Any]):
        self.slab, self._device = slab, device
        self._levels = levels
        self._program = prepare_classify(device, slab.grid.volume.voxels.dtype, slab.grid.rule.inside)
        self._marked_rows = self._landed_bytes = 0

    @cached_property
    def _marked(self) -> Classified:
        rows = self.slab.mask_rows
        return Classified(*(ocl.allocate(self._device, 4 * size) for size in (rows * self.slab.grid.words, rows)))

    def mark_landed(self, voxels_d: Any, size: int) -> None:
        """Mark the rows of slices that are within the first `size` bytes of the voxels, which are on the device."""
        if size - self._landed_bytes < _LANDED_BYTES:
            return
        self._landed_bytes = size
        grid, (first, _) = self.slab.grid, self.slab.voxel_slices
        (ni, nj, _), border = grid.volume.shape_ijk, grid.rule.border
        sample_slice = first + size // (ni * nj * grid.volume.voxels.itemsize) + border
        rows = (sample_slice - self.slab.first) * grid.shape[1]
        group = self._device.group_size
        self._mark_rows(voxels_d, min(rows, self.slab.mask_rows) // group * group)

    def _mark_rows(self, voxels_d: Any, end: int) -> None:
        """Mark the rows before `end` that are not marked yet."""
        begin = self._marked_rows
        if end <= begin:
            return
        levels = self._levels
        bounds = {"level": levels[0]} if len(levels) == 1 else {"level": levels[0], "highest": levels[1]}
        ocl.launch(
            self._device, self._program["classify_samples"], end - begin, None, begin, voxels=voxels_d,
            mask=self._marked.mask_d, row_extents=self._marked.row_extents_d, **bounds, **self.slab.arguments,
        )  # fmt: skip
        self._marked_rows = end

    def mark_rest(self, voxels_d: Any, bricks: BrickStates | None = None) -> Classified:
        """Mark all rows that are not marked yet.

        voxels_d: Slices ``slab.voxel_slices`` of the volume.
        bricks: The comparison of the volume's bricks with the only level, if the slab is the whole volume.
        """
        slab, marked = self.slab, self._marked
        if bricks is None:
            self._mark_rows(voxels_d, slab.mask_rows)
        else:
            (ni, nj, nk), border = slab.grid.volume.shape_ijk, slab.grid.rule.border
            ocl.launch(
                self._device, self._program["classify_bricks"], slab.mask_rows,
                word_states=bricks.states_d, word_extents=bricks.extents_d, voxels=voxels_d, mask=marked.mask_d,
                row_extents=marked.row_extents_d, level=self._levels[0], ni=ni, nj=nj, nk=nk, border=border,
                words=slab.grid.words,
            )  # fmt: skip
        return marked


def too_many(vertices: int, triangles: int) -> DeviceError:
    return DeviceError(
        f"the surface has {vertices:,} vertices and {triangles:,} triangles:"
        " more than 32 bits can number; choose another iso value or a part of the volume"
    )


class Emission:
    """Passes 3 and 4: the mesh of a slab, on the device until it is downloaded, from slices ``slab.voxel_slices``."""

    def __init__(
        self, device: Device, program: Program, voxels_d: Any, counted: Counted, placement: Placement,
        stopwatch: Stopwatch,
    ):  # fmt: skip
        self._device, self._stopwatch = device, stopwatch
        self._program, self._voxels_d = program, voxels_d
        self._counted, self._placement = counted, placement
        self._slab = slab = counted.slab
        self.frames_d = ocl.upload(device, placement.slice_frames[slab.first : slab.first + slab.mask_slices])
        self.steps_d = ocl.upload(device, placement.steps)
        self._positions, self.positions_d = ocl.empty_output(device, (counted.vertices, 3), np.float32)
        self._normals, self.normals_d = ocl.empty_output(device, (counted.vertices, 3), np.float32)
        self._triangles, self.triangles_d = ocl.empty_output(device, (counted.triangles, 3), np.uint32)

    @cached_property
    def _listed(self) -> OutputList | None:
        return list_output(self._device, self._counted) if has_lanes(self._device) else None

    @property
    def _shares(self) -> int:
        """Work-items that have some words each, on a CPU."""
        return -(-self._counted.active_words // int(self._device.kernel_variants["WORDS_PER_ITEM"]))

    def vertices(self, iso_level: float, **label_arguments: Any) -> None:
        """Launch the writing of positions and normals, with those of labels; it may be repeated at another level."""
        counted = self._counted
        if not counted.vertices:
            return
        rule = self._slab.grid.rule
        upper = {} if rule.upper_level is None else {"upper_level": rule.upper_level, "highest": rule.highest_inside}
        items, lists = self._shares, {}
        if (listed := self._listed) is not None:
            items = counted.vertices
            lists = {"vertex_list": listed.vertices_d, "vertex_blocks": listed.vertex_blocks_d, "vertices": items}
        ocl.launch(
            self._device, self._program["emit_vertices"], items,
            voxels=self._voxels_d, **self.tables, positions=self.positions_d, normals=self.normals_d,
            iso_level=iso_level, outside=rule.outside, value_scale=rule.value_scale,
            **self._slab.arguments, **counted.word_arguments, **lists, **label_arguments, **upper,
        )  # fmt: skip

    @property
    def tables(self) -> dict[str, Any]:
        """Arguments with the places of samples in mm, for kernels that write vertices."""
        return {"slice_frames": self.frames_d, "steps": self.steps_d, "margin": self._placement.margin}

    def triangles(self, first_vertex: int = 0) -> None:
        """Launch the writing of triangles; `first_vertex` is the number of vertices of all earlier slabs."""
        counted = self._counted
        if not counted.triangles:
            return
        items, lists = self._shares, {"word_triangles": counted.word_triangles_d}
        if (listed := self._listed) is not None:
            items = counted.triangles
            lists = {"triangle_list": listed.triangles_d, "triangle_blocks": listed.triangle_blocks_d}
            lists["triangle_count"] = items
        ocl.launch(
            self._device, load_cells(self._device, grown=counted.classified.is_part)["emit_triangles"], items,
            triangles=self.triangles_d, first_vertex=first_vertex, mirrored=self._slab.grid.winds_backwards,
            **lists, **counted.cell_arguments,
        )  # fmt: skip

    def run(
        self, first_vertex: int = 0, **label_arguments: Any
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]:
        """Run both passes together: positions, normals and triangles of the slab."""
        with self._stopwatch.running(self._device):
            self.vertices(self._slab.grid.rule.iso_level, **label_arguments)
            if self._counted.cells is None:
                self.triangles(first_vertex)
            else:
                output = {"positions": self.positions_d, "normals": self.normals_d, "triangles": self.triangles_d}
                field = {"voxels": self._voxels_d, "mask": self._counted.classified.mask_d}
                emit_cells(self._device, self._slab, field, self._counted, self.tables, output, first_vertex)
        return self.download()

    def download(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]:
        with self._stopwatch.timed("download"):
            ocl.download_all(
                self._device, (self._positions, self.positions_d, 0), (self._normals, self.normals_d, 0),
                (self._triangles, self.triangles_d, 0),
            )  # fmt: skip
        if self._slab.grid.rule.inside == "below":
            np.negative(self._normals, out=self._normals)
        return self._positions, self._normals, self._triangles
