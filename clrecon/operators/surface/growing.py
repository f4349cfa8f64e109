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

from clrecon.errors import DeviceMemoryError, NoSurfaceError
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    copy_buffer,
    download,
    launch,
    load_program,
)
from clrecon.operators.primitives.scan import enqueue_scan, exclusive_scan, prepare_scan
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cells import Classified, load_cells
from clrecon.operators.surface.choosing import (
    SUMS,
    Components,
    Runs,
    Sums,
    choose_components,
    prepare_choosing,
    sum_components,
)
from clrecon.operators.surface.seeds import Seeds
from clrecon.operators.surface.slabs import SampleGrid, Slab

MOST_RUNS = 2**31


def prepare_growing(device: Device) -> Program:
    """Build the kernels."""
    prepare_scan(device)
    load_cells(device, grown=True)
    prepare_choosing(device)
    return load_program(device, "surface/growing.cl", {"ATOMIC_LOADS": "1"} if device.is_simulator else {})


@dataclass(frozen=True)
class Grown:
    """The grown cells of a grid on the device, and what is told of them.

    grown_d: buffer, (gk, gj, words) uint32. Samples whose edges are grown, see cl/surface/growing.cl.
    extents_d: buffer, (gk, gj) ushort2. First word of each row with a grown sample, and the one after the last.
    classified: The inside mask of the whole grid.
    sums_d: buffer, uint32. Sums over all components.
    visited_d: buffer, (1,) uint64. Cells that are grown or share a face with one that is.
    names: What was grown from.
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
        sums = Sums.read(device, self.sums_d)
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

    def find_runs(self) -> Runs:
        """Find the runs of all rows."""
        bits = 4 * self.rows * self.grid.words
        active_d, starts_d, words_d = (allocate(self.device, size) for size in (bits, bits, bits // 2))
        counts_d, extents_d = allocate(self.device, 4 * self.rows), allocate(self.device, 4 * self.rows)
        self.run(
            "find_cell_runs", self.rows, mask=self.classified.mask_d,
            row_extents=self.classified.row_extents_d, active_cells=active_d, run_starts=starts_d,
            word_runs=words_d, row_runs=counts_d, run_extents=extents_d,
            **self.sizes,
        )  # fmt: skip
        scanned = exclusive_scan(self.device, counts_d, self.rows, in_place=True, stopwatch=self.stopwatch)
        if scanned.total >= MOST_RUNS:
            raise DeviceMemoryError(f"the surface has {scanned.total:,} runs of cells: {MOST_RUNS:,} can be numbered")
        return Runs(active_d, starts_d, words_d, extents_d, scanned.offsets_d, scanned.total)

    def join(self, runs: Runs) -> Components:
        """Join runs to components, none of which is chosen."""
        device, n = self.device, runs.total
        parents_d, cells_d, chosen_d, roots_d = (allocate(device, 4 * n) for _ in range(4))
        sums_d = allocate(device, 4 * SUMS["SUMS"])
        self.run(
            "begin_cell_runs", n, parents=parents_d, run_cells=cells_d, chosen=chosen_d, sums=sums_d,
            runs=n,
        )  # fmt: skip
        self.run(
            "join_cell_runs", self.rows, mask=self.classified.mask_d, active_cells=runs.active_d,
            word_runs=runs.words_d, parents=parents_d, **runs.places, **self.sizes,
        )  # fmt: skip
        self.run(
            "find_run_roots", self.rows, active_cells=runs.active_d, parents=parents_d, roots=roots_d,
            run_cells=cells_d, **runs.places, **self.row_sizes,
        )  # fmt: skip
        return Components(roots_d, cells_d, chosen_d, sums_d)

    def mark(self, runs: Runs, components: Components) -> tuple[Any, Any, Any]:
        """Return the grown samples of chosen components, their extents, and how many cells growing visits."""
        device = self.device
        grown_d = allocate(device, 4 * self.rows * self.grid.words)
        extents_d, counts_d = allocate(device, 4 * self.rows), allocate(device, 4 * self.rows)
        self.run(
            "mark_grown", self.rows, active_cells=runs.active_d, grown=grown_d, grown_extents=extents_d,
            **runs.places, **components.places, **self.sizes,
        )  # fmt: skip
        self.run(
            "count_visited", self.rows, grown=grown_d, grown_extents=extents_d, counts=counts_d,
            **self.sizes,
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

    classified: Inside mask of the whole grid.
    stopwatch: Runs already: the last kernels are not waited for.
    """
    search = _Search(resident, grid, classified, stopwatch)
    runs = search.find_runs()
    if runs.total == 0:
        raise NoSurfaceError(f"no surface {grid.rule.phrase()} to grow")
    components = search.join(runs)
    choose_components(resident.device, grid, classified, runs, components, seeds, stopwatch)
    grown_d, extents_d, visited_d = search.mark(runs, components)
    return Grown(grown_d, extents_d, classified, components.sums_d, visited_d, seeds.names)


def find_components(
    resident: DeviceVolume, grid: SampleGrid, classified: Classified, stopwatch: Stopwatch
) -> tuple[int, int]:
    """Find all components of active cells.

    classified: Inside mask of the whole grid.

    Returns:
    count, cells: Components, and active cells.
    """
    search = _Search(resident, grid, classified, stopwatch)
    with stopwatch.running(resident.device):
        runs = search.find_runs()
        if runs.total == 0:
            return 0, 0
        components = search.join(runs)
        sum_components(resident.device, runs, components, stopwatch)
    sums = Sums.read(resident.device, components.sums_d)
    return sums.components, sums.active_cells
