"""Runs of set voxels along the rows of a mask, and their components: the host side of cl/masks/runs.cl."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.opencl import Device, Program, allocate, check_budget, download, launch, load_program, upload
from clrecon.operators.masks.voxel_mask import VoxelMask, zero_words
from clrecon.operators.primitives.scan import exclusive_scan, prepare_scan
from clrecon.operators.primitives.union_find import join_parts, prepare_components
from clrecon.points.stencil import Stencil
from clrecon.system.light_dataclass import dataclass

PARTS_PER_CORE = 4
"""Parts of the rows for each core of a CPU device, so that all cores are busy to the end."""


def prepare_runs(device: Device) -> Program:
    prepare_scan(device)
    prepare_components(device)
    return load_program(device, "masks/runs.cl")


@dataclass(frozen=True)
class StencilTable:
    rows_d: Any
    tables_d: Any

    @classmethod
    def of(cls, device: Device, stencil: Stencil) -> StencilTable:
        rows = stencil.rows if len(stencil.rows) else np.zeros((1, 4), np.int32)  # OpenCL has no empty buffers
        return cls(upload(device, rows), upload(device, stencil.tables))

    @property
    def arguments(self) -> dict[str, Any]:
        return {"stencil": self.rows_d, "tables": self.tables_d}


@dataclass(frozen=True)
class RowRuns:
    """Runs of set voxels along i, on a device; with `lone` each voxel is a run of its own.

    `runs_d`, (count, 2) uint16, are first and last columns, None before `list_runs`; `row_counts_d`, (2, rows + 1)
    uint32, the first run of each row, and the voxels of all rows before, with both totals.
    """

    runs_d: Any
    row_counts_d: Any
    count: int
    voxels: int
    lone: bool


def count_runs(device: Device, mask: VoxelMask, bits_d: Any, *, lone: bool = False) -> RowRuns:
    """Count the runs of each row of `bits_d`, (nk, nj, words) uint32: voxels of the mask, or all of them."""
    rows = mask.rows
    counts_d = allocate(device, 8 * (rows + 1))
    launch(
        device, prepare_runs(device)["count_row_runs"], rows + 1, mask=mask.mask_d, bits=bits_d,
        row_extents=mask.row_extents_d, row_counts=counts_d, rows=rows, words=mask.words, lone=int(lone),
    )  # fmt: skip
    # One scan of both: the second half begins with the number of all runs.
    both = exclusive_scan(device, counts_d, 2 * (rows + 1), in_place=True).total
    count = int(download(device, np.empty(1, np.uint32), counts_d, 4 * rows)[0])
    if both >= 2**32:
        raise DeviceMemoryError(f"{both - count:,} voxels are set: components are found among up to 2^31")
    return RowRuns(None, counts_d, count, both - count, lone)


def list_runs(device: Device, mask: VoxelMask, bits_d: Any, counted: RowRuns) -> RowRuns:
    runs_d = allocate(device, 4 * counted.count)
    launch(
        device, prepare_runs(device)["list_row_runs"], mask.rows, bits=bits_d, row_extents=mask.row_extents_d,
        row_counts=counted.row_counts_d, runs=runs_d, rows=mask.rows, words=mask.words, lone=int(counted.lone),
    )  # fmt: skip
    return RowRuns(runs_d, counted.row_counts_d, counted.count, counted.voxels, counted.lone)


def join_runs(
    device: Device,
    listed: RowRuns,
    shape_ijk: tuple[int, int, int],
    forward: StencilTable,
    *,
    check: Callable[[int], None],
    parts_per_core: int = PARTS_PER_CORE,
) -> tuple[int, Any]:
    """Number the components of runs, one at least, that are neighbours by a stencil: (runs,) int32, in their order.

    forward: Rows behind the voxel, see `Stencil.forward`.
    check: Called with the number of pairs of runs in different parts before 12 bytes a pair and 5 a run are taken.
    parts_per_core: Of CPU devices; the numbers do not depend on it.
    """
    program = prepare_runs(device)
    _, nj, nk = shape_ijk
    rows, runs = nj * nk, listed.count
    # A CPU's cores take groups; a part is a group's work.  Elsewhere each item has a row of its own.
    is_cpu = device.has_long_items
    part_rows = -(-rows // (parts_per_core * device.compute_units)) if is_cpu else 1
    spread = device.group_size if is_cpu else 1
    labels_d, roots_d, row_links_d = (allocate(device, 4 * n) for n in (runs, runs, rows))
    given = {"runs": listed.runs_d, "row_counts": listed.row_counts_d, **forward.arguments, "nj": nj, "nk": nk}
    given |= {"labels": labels_d, "part_rows": part_rows}
    launch(device, program["join_runs"], -(-rows // part_rows) * spread, roots=roots_d, spread=spread, **given)
    given |= {"row_links": row_links_d}
    launch(device, program["count_links"], rows, **given)
    links = exclusive_scan(device, row_links_d, rows, in_place=True).total
    if links >= 2**32:
        raise DeviceMemoryError(f"{links:,} pairs of runs are neighbours: fewer than 2^32 can be joined")
    check(links)
    links_d = allocate(device, 12 * links)
    if links:
        launch(device, program["list_links"], rows, links=links_d, **given)
    return join_parts(device, labels_d, roots_d, runs, links_d, links)


@dataclass(frozen=True)
class Components:
    """Components of the set voxels of a mask by the faces of voxels, on a device: the number of each run, (runs.count,)
    int32, in the order of their first runs.
    """

    runs: RowRuns
    count: int
    numbers_d: Any


def write_runs(
    device: Device, parts: Components, marks_d: Any, mask_d: Any, shape_ijk: tuple[int, int, int], *, wanted: int = 1
) -> None:
    """Set the bits of runs whose component has the mark `wanted`, 0 or 1; the other bits stay as they are."""
    ni, nj, nk = shape_ijk
    launch(
        device, prepare_runs(device)["write_runs"], nj * nk, runs=parts.runs.runs_d, row_counts=parts.runs.row_counts_d,
        numbers=parts.numbers_d, marks=marks_d, mask=mask_d, wanted=wanted, rows=nj * nk, words=-(-ni // 32),
    )  # fmt: skip


@dataclass(frozen=True)
class RunList:
    """Runs of voxels on the host: j, k, first and last i and component of each, shapes (n,), row by row."""

    j: NDArray[np.int32]
    k: NDArray[np.int32]
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    numbers: NDArray[np.int32]

    @classmethod
    def read(cls, device: Device, components: Components, shape_ijk: tuple[int, int, int]) -> RunList:
        count, (_, nj, nk) = components.runs.count, shape_ijk
        ends = download(device, np.empty((count, 2), np.uint16), components.runs.runs_d)
        starts = download(device, np.empty(nj * nk + 1, np.uint32), components.runs.row_counts_d)
        numbers = download(device, np.empty(count, np.int32), components.numbers_d)
        rows = np.repeat(np.arange(nj * nk, dtype=np.int32), np.diff(starts))
        first, last = (ends[:, side].astype(np.int32) for side in (0, 1))
        return cls(rows % nj, rows // nj, first, last, numbers)

    @property
    def lengths(self) -> NDArray[np.int32]:
        return self.last - self.first + 1

    def where(self, which: NDArray[np.bool_]) -> RunList:
        return RunList(self.j[which], self.k[which], self.first[which], self.last[which], self.numbers[which])

    def of(self, number: int) -> RunList:
        return self.where(self.numbers == number)

    def sum_ml(self, volume: Volume, count: int) -> NDArray[np.float64]:
        return np.bincount(self.numbers, self.lengths * slice_voxel_ml(volume)[self.k], count).astype(np.float64)


def find_components(
    device: Device, mask: VoxelMask, *, by_slice: bool = False, beside: int = 0, memory: int | None = None
) -> Components:
    """Find the components of voxels that share a face; `beside` are bytes on the device for other masks."""
    needs = {"masks of the voxels": sum(mask.needs().values()) + beside, "counts of rows": 12 * (mask.rows + 1)}
    check_budget(device, needs, memory)
    counted = count_runs(device, mask, mask.mask_d)
    if not counted.count:
        return Components(counted, 0, None)
    needs |= {"runs of voxels": 16 * counted.count}
    check_budget(device, needs, memory)
    listed = list_runs(device, mask, mask.mask_d, counted)
    faces = [(1, 0, 0, 0)] if by_slice else [(1, 0, 0, 0), (0, 1, 0, 0)]
    nk = mask.shape_ijk[2]
    table = StencilTable(
        upload(device, np.array(faces, np.int32)),
        upload(device, np.tile(np.array([[0, len(faces)]], np.int32), (nk, 1))),
    )

    def check_links(links: int) -> None:
        check_budget(device, {**needs, "pairs of runs": 12 * links, "roots": 5 * counted.count}, memory)

    count, numbers_d = join_runs(device, listed, mask.shape_ijk, table, check=check_links)
    return Components(listed, count, numbers_d)


def mark_at_border(
    device: Device, components: Components, shape_ijk: tuple[int, int, int], *, by_slice: bool = False
) -> Any:
    """Return a buffer with a mark, 0 or 1, for each component: 1 where it reaches the border of the volume or slice."""
    ni, nj, nk = shape_ijk
    marks_d = zero_words(device, -(-components.count // 4))
    launch(
        device, prepare_runs(device)["mark_border_runs"], nj * nk, runs=components.runs.runs_d,
        row_counts=components.runs.row_counts_d, numbers=components.numbers_d, marks=marks_d, ni=ni, nj=nj, nk=nk,
        by_slice=int(by_slice),
    )  # fmt: skip
    return marks_d


def mark_with_voxels(
    device: Device, components: Components, shape_ijk: tuple[int, int, int], voxels: NDArray[np.int32]
) -> tuple[Any, NDArray[np.int32]]:
    """Mark the components, (components,) uint8, that hold one of `voxels`, i, j, k, and find that of each, or -1."""
    n = len(voxels)
    marks_d = zero_words(device, -(-components.count // 4))
    which, which_d = np.empty(n, np.int32), allocate(device, 4 * n)
    launch(
        device, prepare_runs(device)["mark_voxel_runs"], n,
        voxels=upload(device, np.ascontiguousarray(voxels, np.int32)), runs=components.runs.runs_d,
        row_counts=components.runs.row_counts_d, numbers=components.numbers_d, marks=marks_d, found=which_d,
        n=n, nj=shape_ijk[1],
    )  # fmt: skip
    return marks_d, download(device, which, which_d)
