"""Growing of surfaces: the components of active cells that hold a seed.

All of the volume's bits are on the device while components are found, 1 / 16 of the bytes of 16-bit voxels for each of
four masks and half of one, also where the surface is then emitted slab by slab.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.geometry import slice_normal
from clrecon.geometry.iso_rule import data_range, describe_range
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.primitives.scan import enqueue_scan, exclusive_scan, prepare_scan
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.marching_cubes import Classified, load_cells
from clrecon.operators.surface.seeds import AUTO_SHARE, SEED_REACH_MM, Seeds
from clrecon.operators.surface.slabs import SampleGrid, Slab
from clrecon.system.light_dataclass import dataclass

FARTHEST_TOLD_MM = 50.0
"""The message about a seed in air states the distance of the nearest cell up to this limit."""

_NEAR_MM = 2.0
"""Most seeds lie on the surface: it is looked for as near as this first, among few cells."""


def find_cell_near(
    device: Device, grid: SampleGrid, classified: Classified, point: NDArray[np.float64]
) -> tuple[int, int, int]:
    """Return the active cell (k, j, i), by the mask of the whole grid, whose centre is nearest to a point, LPS mm."""
    for reach in (_NEAR_MM, SEED_REACH_MM):
        nearest = _look_for_cell(device, grid, classified, point, reach)
        if nearest is not None and nearest[1] <= reach:
            return nearest[0]
    farther = _look_for_cell(device, grid, classified, point, FARTHEST_TOLD_MM)
    raise UsageError(_describe_lone(grid, point, None if farther is None else farther[1]))


def _look_for_cell(
    device: Device, grid: SampleGrid, classified: Classified, point: NDArray[np.float64], reach: float
) -> tuple[tuple[int, int, int], float] | None:
    """Return the cell and how far it is; cells farther than `reach` may be missed."""
    volume, (gi, gj, gk) = grid.volume, grid.shape
    border = grid.rule.border
    heights = np.abs((volume.slice_origins(border) - point) @ slice_normal(volume.affine))
    near = np.flatnonzero(heights <= reach)
    if not len(near):
        return None
    first, end = max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, gk)
    (begin_j, end_j), (begin_word, end_word) = _rows_near(grid, point, reach, first, end)
    mask = ocl.download(
        device, np.empty((end - first, gj, grid.words), np.uint32), classified.mask_d, 4 * first * gj * grid.words
    )[:, begin_j:end_j, begin_word:end_word]
    bits = np.unpackbits(np.ascontiguousarray(mask).view(np.uint8), axis=2, bitorder="little")
    inside = bits[..., : gi - 32 * begin_word].view(bool)
    some, every = inside[:-1] | inside[1:], inside[:-1] & inside[1:]
    some, every = some[:, :-1] | some[:, 1:], every[:, :-1] & every[:, 1:]
    cells = np.argwhere((some[..., :-1] | some[..., 1:]) & ~(every[..., :-1] & every[..., 1:]))
    if not len(cells):
        return None
    cells += (first, begin_j, 32 * begin_word)
    away = np.linalg.norm(volume.ijk_to_lps(cells[:, ::-1] + 0.5 - border) - point, axis=1)
    best = int(np.argmin(away))
    k, j, i = (int(n) for n in cells[best])
    return (k, j, i), float(away[best])


def _rows_near(
    grid: SampleGrid, point: NDArray[np.float64], reach: float, first: int, end: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return begin and end of the rows, and of the words in them, that cells within `reach` have in some slices."""
    volume, border = grid.volume, grid.rule.border
    steps = np.linalg.pinv(volume.affine[:3, :2])  # to i and j of the nearest point of a slice
    places = (point - volume.slice_origins(border)[first:end]) @ steps.T + border
    around = reach * np.linalg.norm(steps, axis=1) + 2
    (low_i, low_j), (high_i, high_j) = places.min(axis=0) - around, places.max(axis=0) + around
    begin_j, begin_word = max(0, int(low_j)), max(0, int(low_i)) // 32
    return (begin_j, min(grid.shape[1], int(high_j) + 2)), (begin_word, min(grid.words, int(high_i) // 32 + 1))


def _describe_lone(grid: SampleGrid, point: NDArray[np.float64], away: float | None) -> str:
    volume = grid.volume
    i, j, k = np.minimum(np.rint(volume.lps_to_ijk(point[None])[0]).astype(int), np.array(volume.shape_ijk) - 1)
    far = f"more than {FARTHEST_TOLD_MM:g}" if away is None or away > FARTHEST_TOLD_MM else f"{away:.1f}"
    return (
        f"seed {','.join(f'{n:g}' for n in point)} has {float(volume.voxels[k, j, i]):g} HU and is {far} mm away"
        f" from the surface {grid.rule.phrase()}: a seed lies within {SEED_REACH_MM:g} mm of it"
    )


SUMS = {
    name: ocl.kernel_constant("surface/component_sums.h", name)
    for name in ("COMPONENTS", "CHOSEN", "ACTIVE_CELLS", "CHOSEN_CELLS", "LARGEST_LEFT_OUT", "SUMS")
}
"""Places of what is summed up over components, and their number."""


def prepare_choosing(device: Device) -> Program:
    return ocl.load_program(device, "surface/choosing.cl")


@dataclass(frozen=True)
class Sums:
    """Sums over all components, see cl/surface/component_sums.h."""

    components: int
    chosen: int
    active_cells: int
    chosen_cells: int
    largest_left_out: int

    @classmethod
    def read(cls, device: Device, sums_d: Any) -> Sums:
        sums = ocl.download(device, np.empty(SUMS["SUMS"], np.uint32), sums_d)

        def cells(which: str) -> int:
            return int(sums[SUMS[which]]) + (int(sums[SUMS[which] + 1]) << 32)

        return cls(
            int(sums[SUMS["COMPONENTS"]]), int(sums[SUMS["CHOSEN"]]), cells("ACTIVE_CELLS"), cells("CHOSEN_CELLS"),
            int(sums[SUMS["LARGEST_LEFT_OUT"]]),
        )  # fmt: skip


@dataclass(frozen=True)
class Runs:
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
class Components:
    """Components of runs on the device: the root of each run; at roots their cells, and 1 if chosen; and all sums."""

    roots_d: Any
    cells_d: Any
    chosen_d: Any
    sums_d: Any

    @property
    def places(self) -> dict[str, Any]:
        """Arguments of kernels that look up the components of runs."""
        return {"roots": self.roots_d, "chosen": self.chosen_d}


def choose_components(
    device: Device, grid: SampleGrid, classified: Classified, runs: Runs, components: Components, seeds: Seeds
) -> None:
    program, (gi, gj, gk) = prepare_choosing(device), grid.shape
    sizes = {"gi": gi, "gj": gj, "gk": gk, "words": grid.words}
    run = ocl.launcher(device, program)
    n = runs.total
    if seeds.auto:
        sized = {"roots": components.roots_d, "run_cells": components.cells_d, "sums": components.sums_d}
        run("find_largest", n, runs=n, **sized)
        run("choose_largest", n, chosen=components.chosen_d, parts=round(1 / AUTO_SHARE), runs=n, **sized)
    if len(seeds.points):
        near = [find_cell_near(device, grid, classified, point) for point in seeds.points]
        cells = np.array([(i, j, k, 0) for k, j, i in near], np.uint32)
        run(
            "choose_cells", len(cells), run_starts=runs.starts_d, word_runs=runs.words_d, row_offsets=runs.offsets_d,
            cells=ocl.upload(device, cells), n=len(cells), gj=gj, words=grid.words, **components.places,
        )  # fmt: skip
    if seeds.voxels is not None:
        run(
            "choose_seeded", gj * gk, mask=classified.mask_d, word_runs=runs.words_d, border=grid.rule.border,
            seeds=ocl.upload(device, seeds.voxels), enclosed_set=grid.rule.inside != "below",
            voxel_words=seeds.voxels.shape[2], **runs.places, **components.places, **sizes,
        )  # fmt: skip
    sum_components(device, runs, components)
    if seeds.auto or len(seeds.points):
        return
    sums = Sums.read(device, components.sums_d)
    if not sums.chosen:
        raise UsageError(
            f"no part of the surface {grid.rule.phrase()} touches {', '.join(seeds.names)}:"
            f" {sums.components:,} components, none of them has a seed"
        )


def sum_components(device: Device, runs: Runs, components: Components) -> None:
    ocl.launch(
        device, prepare_choosing(device)["sum_components"], runs.total,
        run_cells=components.cells_d, sums=components.sums_d, runs=runs.total, **components.places,
    )  # fmt: skip


MOST_RUNS = 2**31


def prepare_growing(device: Device) -> Program:
    prepare_scan(device)
    load_cells(device, grown=True)
    prepare_choosing(device)
    return ocl.load_program(device, "surface/growing.cl", {"ATOMIC_LOADS": "1"} if device.is_simulator else {})


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
        visited = int(ocl.download(device, np.empty(1, np.uint64), self.visited_d)[0])
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

    def __init__(self, resident: DeviceVolume, grid: SampleGrid, classified: Classified):
        self.resident, self.grid = resident, grid
        self.classified = classified
        self.device = resident.device
        self.program = prepare_growing(self.device)
        gi, gj, gk = grid.shape
        self.rows = gj * gk
        self.row_sizes = {"gj": gj, "gk": gk, "words": grid.words}
        self.sizes = {"gi": gi, **self.row_sizes}

    def run(self, kernel: str, items: int, **arguments: Any) -> None:
        ocl.launch(self.device, self.program[kernel], items, **arguments)

    def find_runs(self) -> Runs:
        bits = 4 * self.rows * self.grid.words
        active_d, starts_d, words_d = (ocl.allocate(self.device, size) for size in (bits, bits, bits // 2))
        counts_d, extents_d = ocl.allocate(self.device, 4 * self.rows), ocl.allocate(self.device, 4 * self.rows)
        self.run(
            "find_cell_runs", self.rows, mask=self.classified.mask_d,
            row_extents=self.classified.row_extents_d, active_cells=active_d, run_starts=starts_d,
            word_runs=words_d, row_runs=counts_d, run_extents=extents_d,
            **self.sizes,
        )  # fmt: skip
        scanned = exclusive_scan(self.device, counts_d, self.rows, in_place=True)
        if scanned.total >= MOST_RUNS:
            raise DeviceMemoryError(f"the surface has {scanned.total:,} runs of cells: {MOST_RUNS:,} can be numbered")
        return Runs(active_d, starts_d, words_d, extents_d, scanned.offsets_d, scanned.total)

    def join(self, runs: Runs) -> Components:
        device, n = self.device, runs.total
        parents_d, cells_d, chosen_d, roots_d = (ocl.allocate(device, 4 * n) for _ in range(4))
        sums_d = ocl.allocate(device, 4 * SUMS["SUMS"])
        self.run("begin_cell_runs", n, parents=parents_d, run_cells=cells_d, chosen=chosen_d, sums=sums_d, runs=n)
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
        grown_d = ocl.allocate(device, 4 * self.rows * self.grid.words)
        extents_d, counts_d = ocl.allocate(device, 4 * self.rows), ocl.allocate(device, 4 * self.rows)
        self.run(
            "mark_grown", self.rows, active_cells=runs.active_d, grown=grown_d, grown_extents=extents_d,
            **runs.places, **components.places, **self.sizes,
        )  # fmt: skip
        self.run("count_visited", self.rows, grown=grown_d, grown_extents=extents_d, counts=counts_d, **self.sizes)
        return grown_d, extents_d, enqueue_scan(device, counts_d, counts_d, self.rows)


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


def join_slabs(resident: DeviceVolume, grid: SampleGrid, slabs: Iterator[tuple[Slab, Classified]]) -> Classified:
    """Return the inside mask of the whole grid, from those of slabs that follow each other."""
    device, (_, gj, gk) = resident.device, grid.shape
    mask_d, extents_d = ocl.allocate(device, 4 * gj * gk * grid.words), ocl.allocate(device, 4 * gj * gk)
    for slab, classified in slabs:
        ocl.copy_buffer(device, classified.mask_d, mask_d, 4 * slab.rows * grid.words, 4 * slab.first * gj * grid.words)
        ocl.copy_buffer(device, classified.row_extents_d, extents_d, 4 * slab.rows, 4 * slab.first * gj)
    return Classified(mask_d, extents_d)


def grow_runs(resident: DeviceVolume, grid: SampleGrid, classified: Classified, seeds: Seeds) -> Grown:
    """Find the components of active cells that hold a seed, from the inside mask of the whole grid, without waiting."""
    search = _Search(resident, grid, classified)
    runs = search.find_runs()
    if runs.total == 0:
        runs_from = describe_range(resident.volume, *data_range(resident.volume))
        raise NoSurfaceError(f"no surface {grid.rule.phrase()} to grow: {runs_from}")
    components = search.join(runs)
    choose_components(resident.device, grid, classified, runs, components, seeds)
    grown_d, extents_d, visited_d = search.mark(runs, components)
    return Grown(grown_d, extents_d, classified, components.sums_d, visited_d, seeds.names)


def find_components(
    resident: DeviceVolume, grid: SampleGrid, classified: Classified, stopwatch: Stopwatch
) -> tuple[int, int]:
    """Count all components of active cells of the inside mask of the whole grid, and these cells."""
    search = _Search(resident, grid, classified)
    with stopwatch.running(resident.device):
        runs = search.find_runs()
        if runs.total == 0:
            return 0, 0
        components = search.join(runs)
        sum_components(resident.device, runs, components)
    sums = Sums.read(resident.device, components.sums_d)
    return sums.components, sums.active_cells
