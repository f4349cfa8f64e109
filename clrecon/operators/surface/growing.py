"""Growing of surfaces: the components of active cells that hold a seed, the host side of cl/surface/growing.cl.

All of the volume's bits are on the device while components are found, 1 / 16 of the bytes of 16-bit voxels for each of
four masks and half of one, also where the surface is then emitted slab by slab.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    copy_buffer,
    download,
    kernel_constant,
    launch,
    load_program,
    upload,
)
from clrecon.operators.primitives.scan import enqueue_scan, exclusive_scan, prepare_scan
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cells import Classified, load_cells
from clrecon.operators.surface.nearest_cell import find_cell_near
from clrecon.operators.surface.seeds import AUTO_SHARE, Seeds
from clrecon.operators.surface.slabs import SampleGrid, Slab

__all__ = ["Grown", "find_components", "grow", "growing_needs", "join_slabs", "prepare_growing"]

MOST_RUNS = 2**31

SUMS = {
    name: kernel_constant("surface/growing.cl", name)
    for name in ("COMPONENTS", "CHOSEN", "ACTIVE_CELLS", "CHOSEN_CELLS", "LARGEST_LEFT_OUT", "SUMS")
}
"""Places of what is summed up over components, and their number."""


def prepare_growing(device: Device) -> Program:
    """Build the kernels.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    prepare_scan(device)
    load_cells(device, grown=True)
    return load_program(device, "surface/growing.cl", {"ATOMIC_LOADS": "1"} if device.is_simulator else {})


@dataclass(frozen=True)
class Grown:
    """The grown cells of a grid on the device, and what is told of them.

    Attributes
    ----------
    grown_d : buffer, (gk, gj, words) uint32
        Samples whose edges are grown, see cl/surface/growing.cl.
    extents_d : buffer, (gk, gj) ushort2
        First word of each row with a grown sample, and the one after the last.
    classified : Classified
        The inside mask of the whole grid.
    sums_d : buffer, uint32
        Sums over all components.
    visited_d : buffer, (1,) uint64
        Cells that are grown or share a face with one that is.
    names : tuple of str
        What was grown from.
    """

    grown_d: Any
    extents_d: Any
    classified: Classified
    sums_d: Any
    visited_d: Any
    names: tuple[str, ...]

    def part(self, classified: Classified, first: int) -> Classified:
        """Return the inside mask of a slab that begins with slice `first`, with the grown samples beside it."""
        return Classified(classified.mask_d, classified.row_extents_d, self.grown_d, self.extents_d, first)

    def report(self, device: Device, grid: SampleGrid) -> tuple[dict[str, int], dict[str, Any]]:
        """Return the numbers of cells, and what was grown and left out; the device may have to be waited for."""
        sums = _Sums.read(device, self.sums_d)
        visited = int(download(device, np.empty(1, np.uint64), self.visited_d)[0])
        cells = {
            "visited": visited, "grown": sums.chosen_cells, "active": sums.active_cells,
            "all": math.prod(n - 1 for n in grid.shape),
        }  # fmt: skip
        growing = {
            "from": list(self.names),
            "components": sums.components,
            "components_taken": sums.chosen,
            "cells_left_out_share": 1.0 - sums.chosen_cells / sums.active_cells,
            "largest_left_out_cells": sums.largest_left_out,
        }
        return cells, growing


@dataclass(frozen=True)
class _Sums:
    """Sums over all components, see cl/surface/growing.cl."""

    components: int
    chosen: int
    active_cells: int
    chosen_cells: int
    largest_left_out: int

    @classmethod
    def read(cls, device: Device, sums_d: Any) -> _Sums:
        sums = download(device, np.empty(SUMS["SUMS"], np.uint32), sums_d)

        def cells(which: str) -> int:
            return int(sums[SUMS[which]]) + (int(sums[SUMS[which] + 1]) << 32)

        return cls(
            int(sums[SUMS["COMPONENTS"]]), int(sums[SUMS["CHOSEN"]]), cells("ACTIVE_CELLS"), cells("CHOSEN_CELLS"),
            int(sums[SUMS["LARGEST_LEFT_OUT"]]),
        )  # fmt: skip


@dataclass(frozen=True)
class _Runs:
    """Runs of active cells on the device."""

    active_d: Any
    starts_d: Any
    words_d: Any
    extents_d: Any
    offsets_d: Any
    total: int

    @property
    def places(self) -> dict[str, Any]:
        """Arguments of kernels that walk along the runs of a row."""
        return {"run_starts": self.starts_d, "run_extents": self.extents_d, "row_offsets": self.offsets_d}


@dataclass(frozen=True)
class _Components:
    """Components of runs on the device: the root of each run; at roots the cells of the component, and 1 where it is
    chosen; and sums over all of them.
    """

    roots_d: Any
    cells_d: Any
    chosen_d: Any
    sums_d: Any

    @property
    def places(self) -> dict[str, Any]:
        """Arguments of kernels that look up the components of runs."""
        return {"roots": self.roots_d, "chosen": self.chosen_d}


class _Search:
    """Components of the active cells of one grid."""

    def __init__(self, resident: DeviceVolume, grid: SampleGrid, classified: Classified, stopwatch: Stopwatch):
        self.resident, self.grid, self.classified, self.stopwatch = resident, grid, classified, stopwatch
        self.device = resident.device
        self.program = prepare_growing(self.device)
        gi, gj, gk = grid.shape
        self.rows = gj * gk
        self.row_sizes = {"gj": gj, "gk": gk, "words": grid.words}
        self.sizes = {"gi": gi, **self.row_sizes}

    def run(self, kernel: str, items: int, **arguments: Any) -> None:
        launch(self.device, self.program[kernel], items, stopwatch=self.stopwatch, **arguments)

    def find_runs(self) -> _Runs:
        """Find the runs of all rows."""
        bits = 4 * self.rows * self.grid.words
        active_d, starts_d, words_d = (allocate(self.device, size) for size in (bits, bits, bits // 2))
        counts_d, extents_d = allocate(self.device, 4 * self.rows), allocate(self.device, 4 * self.rows)
        self.run(
            "find_cell_runs", self.rows, mask=self.classified.mask_d, row_extents=self.classified.row_extents_d,
            active_cells=active_d, run_starts=starts_d, word_runs=words_d, row_runs=counts_d, run_extents=extents_d,
            **self.sizes,
        )  # fmt: skip
        scanned = exclusive_scan(self.device, counts_d, self.rows, in_place=True, stopwatch=self.stopwatch)
        if scanned.total >= MOST_RUNS:
            raise DeviceMemoryError(f"the surface has {scanned.total:,} runs of cells: {MOST_RUNS:,} can be numbered")
        return _Runs(active_d, starts_d, words_d, extents_d, scanned.offsets_d, scanned.total)

    def join(self, runs: _Runs) -> _Components:
        """Join runs to components, none of which is chosen."""
        device, n = self.device, runs.total
        parents_d, cells_d, chosen_d, roots_d = (allocate(device, 4 * n) for _ in range(4))
        sums_d = allocate(device, 4 * SUMS["SUMS"])
        self.run(
            "begin_cell_runs", n, parents=parents_d, run_cells=cells_d, chosen=chosen_d, sums=sums_d, runs=n
        )  # fmt: skip
        self.run(
            "join_cell_runs", self.rows, mask=self.classified.mask_d, active_cells=runs.active_d,
            word_runs=runs.words_d, parents=parents_d, **runs.places, **self.sizes,
        )  # fmt: skip
        self.run(
            "find_run_roots", self.rows, active_cells=runs.active_d, parents=parents_d, roots=roots_d,
            run_cells=cells_d, **runs.places, **self.row_sizes,
        )  # fmt: skip
        return _Components(roots_d, cells_d, chosen_d, sums_d)

    def choose(self, runs: _Runs, components: _Components, seeds: Seeds) -> None:
        """Choose the components that hold a seed."""
        n = runs.total
        if seeds.auto:
            sized = {"roots": components.roots_d, "run_cells": components.cells_d, "sums": components.sums_d}
            self.run("find_largest", n, runs=n, **sized)
            self.run("choose_largest", n, chosen=components.chosen_d, parts=round(1 / AUTO_SHARE), runs=n, **sized)
        one_d = upload(self.device, np.ones(1, np.uint32))
        for point in seeds.points:
            run = self.find_run_near(runs, point)
            root = download(self.device, np.empty(1, np.uint32), components.roots_d, 4 * run)
            copy_buffer(self.device, one_d, components.chosen_d, 4, 4 * int(root[0]))
        if seeds.voxels is not None:
            self.run(
                "choose_seeded", self.rows, mask=self.classified.mask_d, word_runs=runs.words_d,
                seeds=upload(self.device, seeds.voxels), enclosed_set=self.grid.rule.inside != "below",
                border=self.grid.rule.border, voxel_words=seeds.voxels.shape[2], **runs.places, **components.places,
                **self.sizes,
            )  # fmt: skip
        self.sum_up(runs, components)
        if seeds.auto or len(seeds.points):
            return
        sums = _Sums.read(self.device, components.sums_d)
        if not sums.chosen:
            raise UsageError(
                f"no part of the surface {self.grid.rule.describe_place()} touches {', '.join(seeds.names)}:"
                f" {sums.components:,} components, none of them has a seed"
            )

    def sum_up(self, runs: _Runs, components: _Components) -> None:
        """Sum up the components."""
        self.run(
            "sum_components", runs.total, run_cells=components.cells_d, sums=components.sums_d, runs=runs.total,
            **components.places,
        )  # fmt: skip

    def find_run_near(self, runs: _Runs, point: NDArray[np.float64]) -> int:
        """Return the run of the active cell nearest to a point.

        Raises
        ------
        UsageError
            None is within `SEED_REACH_MM`.
        """
        k, j, i = find_cell_near(self.device, self.grid, self.classified, point)
        row, words = k * self.grid.shape[1] + j, self.grid.words
        starts = download(self.device, np.empty(words, np.uint32), runs.starts_d, 4 * row * words)
        begin, _ = download(self.device, np.empty(2, np.uint16), runs.extents_d, 4 * row)
        offset = download(self.device, np.empty(1, np.uint32), runs.offsets_d, 4 * row)
        bits = np.unpackbits(starts.view(np.uint8), bitorder="little")
        return int(offset[0]) + int(bits[32 * int(begin) : i + 1].sum()) - 1

    def mark(self, runs: _Runs, components: _Components) -> tuple[Any, Any, Any]:
        """Return the grown samples of chosen components, their extents, and how many cells growing visits."""
        device = self.device
        grown_d = allocate(device, 4 * self.rows * self.grid.words)
        extents_d, counts_d = allocate(device, 4 * self.rows), allocate(device, 4 * self.rows)
        self.run(
            "mark_grown", self.rows, active_cells=runs.active_d, grown=grown_d, grown_extents=extents_d,
            **runs.places, **components.places, **self.sizes,
        )  # fmt: skip
        self.run(
            "count_visited", self.rows, grown=grown_d, grown_extents=extents_d, counts=counts_d, **self.sizes
        )  # fmt: skip
        return grown_d, extents_d, enqueue_scan(device, counts_d, counts_d, self.rows, stopwatch=self.stopwatch)


def growing_needs(grid: SampleGrid) -> dict[str, int]:
    """Return the bytes of the masks of a whole grid while components are found; those of runs come on top."""
    rows = grid.shape[1] * grid.shape[2]
    bits = 4 * rows * grid.words
    return {
        "inside mask": bits,
        "active cells": bits,
        "begins of runs": bits + bits // 2,
        "grown samples": bits,
        "rows of cells": 20 * rows,
    }


def join_slabs(
    resident: DeviceVolume, grid: SampleGrid, slabs: Iterator[tuple[Slab, Classified]]
) -> Classified:  # fmt: skip
    """Return the inside mask of the whole grid, from those of slabs that follow each other."""
    device, (_, gj, gk) = resident.device, grid.shape
    mask_d, extents_d = allocate(device, 4 * gj * gk * grid.words), allocate(device, 4 * gj * gk)
    for slab, classified in slabs:
        copy_buffer(device, classified.mask_d, mask_d, 4 * slab.rows * grid.words, 4 * slab.first * gj * grid.words)
        copy_buffer(device, classified.row_extents_d, extents_d, 4 * slab.rows, 4 * slab.first * gj)
    return Classified(mask_d, extents_d)


def grow(resident: DeviceVolume, grid: SampleGrid, classified: Classified, seeds: Seeds, stopwatch: Stopwatch) -> Grown:
    """Find the components of active cells that hold a seed.

    Parameters
    ----------
    classified : Classified
        Inside mask of the whole grid.
    stopwatch : Stopwatch
        Runs already: the last kernels are not waited for.

    Raises
    ------
    UsageError
        A seed is not near the surface, or no component holds one.
    NoSurfaceError
        No cell is active.
    DeviceError
        The device fails.
    """
    search = _Search(resident, grid, classified, stopwatch)
    runs = search.find_runs()
    if runs.total == 0:
        raise NoSurfaceError(f"no surface {grid.rule.describe_place()} to grow")
    components = search.join(runs)
    search.choose(runs, components, seeds)
    grown_d, extents_d, visited_d = search.mark(runs, components)
    return Grown(grown_d, extents_d, classified, components.sums_d, visited_d, seeds.names)


def find_components(
    resident: DeviceVolume, grid: SampleGrid, classified: Classified, stopwatch: Stopwatch
) -> tuple[int, int]:
    """Find all components of active cells.

    Parameters
    ----------
    classified : Classified
        Inside mask of the whole grid.

    Returns
    -------
    count, cells : int
        Components, and active cells.

    Raises
    ------
    DeviceError
        The device fails.
    """
    search = _Search(resident, grid, classified, stopwatch)
    with stopwatch.running(resident.device):
        runs = search.find_runs()
        if runs.total == 0:
            return 0, 0
        components = search.join(runs)
        search.sum_up(runs, components)
    sums = _Sums.read(resident.device, components.sums_d)
    return sums.components, sums.active_cells
