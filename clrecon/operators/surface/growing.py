"""Growing of surfaces: the components of active cells that hold a seed, the host side of cl/surface/growing.cl.

All of the volume's bits are on the device while components are found, 1 / 16 of the bytes of 16-bit voxels for each of
six masks, also where the surface is then emitted slab by slab.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.opencl import Device, Program, Stopwatch, allocate, copy_buffer, download, launch, load_program, upload
from clrecon.operators.primitives.scan import exclusive_scan, prepare_scan
from clrecon.operators.primitives.union_find import join_parts, prepare_components
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cells import Classified, load_cells
from clrecon.operators.surface.seeds import AUTO_SHARE, SEED_REACH_MM, Seeds
from clrecon.operators.surface.slabs import SampleGrid, Slab

__all__ = ["Grown", "find_components", "grow", "growing_needs", "join_slabs", "keep_edges", "prepare_growing"]

FARTHEST_TOLD_MM = 50.0
"""Of a seed in air the nearest cell is looked for up to here, for the message."""

MOST_RUNS = 2**31


def prepare_growing(device: Device) -> Program:
    """Build the kernels.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    prepare_scan(device)
    prepare_components(device)
    load_cells(device, grown=True)
    return load_program(device, "surface/growing.cl", {"ATOMIC_LOADS": "1"} if device.is_simulator else {})


@dataclass(frozen=True)
class Grown:
    """The grown cells of a grid on the device, and what is told of them.

    Attributes
    ----------
    grown_d : buffer, (gk, gj, words) uint32
    extents_d : buffer, (gk, gj) ushort2
        First word of each row with a grown cell, and the one after the last.
    starts_d : buffer, (gk, gj) uint32, or None
        For open volumes: with what each row of the kept mask begins.
    classified : Classified
        The inside mask of the whole grid.
    cells : dict of str to int
        ``visited``, ``grown``, ``active``, ``all``.
    growing : dict
        What was grown from, and what was left out.
    """

    grown_d: Any
    extents_d: Any
    starts_d: Any
    classified: Classified
    cells: dict[str, int]
    growing: dict[str, Any]


@dataclass(frozen=True)
class _Runs:
    """Runs of active cells on the device."""

    active_d: Any
    starts_d: Any
    words_d: Any
    extents_d: Any
    offsets_d: Any
    total: int


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

    def join(self, runs: _Runs) -> tuple[int, Any, NDArray[np.uint32]]:
        """Join runs to components.

        Returns
        -------
        count : int
        numbers_d : buffer, (runs,) int32
            Component of each run, in the order of their first runs.
        cells : ndarray, shape (runs,), uint32
            Cells of each run.
        """
        device, n = self.device, runs.total
        parents_d, cells_d, roots_d = (allocate(device, 4 * n) for _ in range(3))
        common = {"run_starts": runs.starts_d, "run_extents": runs.extents_d, "row_offsets": runs.offsets_d}
        self.run(
            "begin_cell_runs", self.rows, active_cells=runs.active_d, parents=parents_d, run_cells=cells_d, **common,
            **self.row_sizes,
        )  # fmt: skip
        self.run(
            "join_cell_runs", self.rows, mask=self.classified.mask_d, word_runs=runs.words_d, parents=parents_d,
            **common, **self.sizes,
        )  # fmt: skip
        self.run("find_run_roots", n, parents=parents_d, roots=roots_d, runs=n)
        count, numbers_d = join_parts(device, roots_d, parents_d, n, None, 0, stopwatch=self.stopwatch)
        return count, numbers_d, download(device, np.empty(n, np.uint32), cells_d)

    def find_seeded(self, runs: _Runs, voxels: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Mark the runs whose cells have an enclosed corner among the voxels."""
        seeded_d = allocate(self.device, 4 * runs.total)
        self.run(
            "seed_cell_runs", self.rows, mask=self.classified.mask_d, run_starts=runs.starts_d, word_runs=runs.words_d,
            run_extents=runs.extents_d, row_offsets=runs.offsets_d, seeds=upload(self.device, voxels),
            seeded=seeded_d, enclosed_set=self.grid.rule.inside != "below", border=self.grid.rule.border,
            voxel_words=voxels.shape[2], **self.sizes,
        )  # fmt: skip
        return download(self.device, np.empty(runs.total, np.uint32), seeded_d).astype(bool)

    def find_run_near(self, runs: _Runs, point: NDArray[np.float64]) -> int:
        """Return the run of the active cell nearest to a point.

        Raises
        ------
        UsageError
            None is within `SEED_REACH_MM`.
        """
        found = self._nearest_cell(point, SEED_REACH_MM)
        if found is None or found[1] > SEED_REACH_MM:
            raise UsageError(self._describe_lone(point, self._nearest_cell(point, FARTHEST_TOLD_MM)))
        (k, j, i), _ = found
        row, words = k * self.grid.shape[1] + j, self.grid.words
        starts = download(self.device, np.empty(words, np.uint32), runs.starts_d, 4 * row * words)
        begin, _ = download(self.device, np.empty(2, np.uint16), runs.extents_d, 4 * row)
        offset = download(self.device, np.empty(1, np.uint32), runs.offsets_d, 4 * row)
        bits = np.unpackbits(starts.view(np.uint8), bitorder="little")
        return int(offset[0]) + int(bits[32 * int(begin) : i + 1].sum()) - 1

    def _nearest_cell(self, point: NDArray[np.float64], reach: float) -> tuple[tuple[int, int, int], float] | None:
        """Return the active cell (k, j, i) whose centre is nearest, and how far it is, among slices within `reach`."""
        volume, (gi, gj, gk), border = self.grid.volume, self.grid.shape, self.grid.rule.border
        normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
        heights = np.abs((volume.slice_origins(border) - point) @ (normal / np.linalg.norm(normal)))
        near = np.flatnonzero(heights <= reach)
        if not len(near):
            return None
        first, end = max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, gk)
        words = self.grid.words
        mask = download(
            self.device, np.empty((end - first, gj, words), np.uint32), self.classified.mask_d, 4 * first * gj * words
        )
        inside = np.unpackbits(mask.view(np.uint8), axis=2, count=gi, bitorder="little").view(bool)
        some, every = inside[:-1] | inside[1:], inside[:-1] & inside[1:]
        some, every = some[:, :-1] | some[:, 1:], every[:, :-1] & every[:, 1:]
        active = (some[..., :-1] | some[..., 1:]) & ~(every[..., :-1] & every[..., 1:])
        cells = np.argwhere(active)
        if not len(cells):
            return None
        cells[:, 0] += first
        centres = volume.ijk_to_lps(cells[:, ::-1] + 0.5 - border)
        away = np.linalg.norm(centres - point, axis=1)
        best = int(np.argmin(away))
        k, j, i = (int(n) for n in cells[best])
        return (k, j, i), float(away[best])

    def _describe_lone(self, point: NDArray[np.float64], found: tuple[tuple[int, int, int], float] | None) -> str:
        volume = self.grid.volume
        i, j, k = np.clip(np.rint(volume.lps_to_ijk(point[None])[0]).astype(int), 0, np.array(volume.shape_ijk) - 1)
        far = f"more than {FARTHEST_TOLD_MM:g}" if found is None or found[1] > FARTHEST_TOLD_MM else f"{found[1]:.1f}"
        return (
            f"seed {','.join(f'{n:g}' for n in point)} has {float(volume.voxels[k, j, i]):g} HU and is {far} mm away"
            f" from the surface {self.grid.rule.describe_place()}: a seed lies within {SEED_REACH_MM:g} mm of it"
        )

    def mark(self, runs: _Runs, numbers_d: Any, chosen: NDArray[np.bool_]) -> tuple[Any, Any, int]:
        """Return the bits of the cells of chosen components, their extents, and how many cells growing visits."""
        device = self.device
        grown_d = allocate(device, 4 * self.rows * self.grid.words)
        extents_d, counts_d = allocate(device, 4 * self.rows), allocate(device, 4 * self.rows)
        self.run(
            "mark_grown", self.rows, active_cells=runs.active_d, run_starts=runs.starts_d,
            run_extents=runs.extents_d, row_offsets=runs.offsets_d, numbers=numbers_d,
            chosen=upload(device, chosen.astype(np.uint8)), grown=grown_d, grown_extents=extents_d, **self.row_sizes,
        )  # fmt: skip
        self.run(
            "count_visited", self.rows, grown=grown_d, grown_extents=extents_d, counts=counts_d, **self.sizes
        )  # fmt: skip
        counts = download(device, np.empty(self.rows, np.uint32), counts_d)
        return grown_d, extents_d, int(counts.sum(dtype=np.int64))


def growing_needs(grid: SampleGrid) -> dict[str, int]:
    """Return the bytes of the masks of a whole grid while components are found; those of runs come on top."""
    rows = grid.shape[1] * grid.shape[2]
    bits = 4 * rows * grid.words
    return {
        "inside mask": bits,
        "active cells": bits,
        "begins of runs": bits + bits // 2,
        "grown cells": bits,
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
    device, (gi, gj, gk) = resident.device, grid.shape
    with stopwatch.running(device):
        runs = search.find_runs()
        if runs.total == 0:
            raise NoSurfaceError(f"no surface {grid.rule.describe_place()} to grow")
        count, numbers_d, run_cells = search.join(runs)
        numbers = download(device, np.empty(runs.total, np.int32), numbers_d)
        sizes = np.bincount(numbers, weights=run_cells, minlength=count).astype(np.int64)
        chosen = _choose(search, runs, numbers, sizes, seeds)
        grown_d, extents_d, visited = search.mark(runs, numbers_d, chosen)
        starts_d = None
        if not grid.rule.closed:
            starts_d = allocate(device, 4 * search.rows)
            search.run(
                "start_rows", gk, mask=classified.mask_d, grown=grown_d, starts=starts_d, gj=gj, gk=gk,
                words=grid.words,
            )  # fmt: skip
    active, grown = int(sizes.sum()), int(sizes[chosen].sum())
    cells = {"visited": visited, "grown": grown, "active": active, "all": (gi - 1) * (gj - 1) * (gk - 1)}
    growing = {
        "from": list(seeds.names),
        "components": count,
        "components_taken": int(chosen.sum()),
        "cells_left_out_share": 1.0 - grown / active,
        "largest_left_out_cells": int(sizes[~chosen].max(initial=0)),
    }
    return Grown(grown_d, extents_d, starts_d, classified, cells, growing)


def _choose(
    search: _Search, runs: _Runs, numbers: NDArray[np.int32], sizes: NDArray[np.int64], seeds: Seeds
) -> NDArray[np.bool_]:
    """Mark the components that hold a seed."""
    chosen = np.zeros(len(sizes), bool)
    if seeds.auto:
        chosen |= sizes >= AUTO_SHARE * sizes.max()
    for point in seeds.points:
        chosen[numbers[search.find_run_near(runs, point)]] = True
    if seeds.voxels is not None:
        chosen[numbers[search.find_seeded(runs, seeds.voxels)]] = True
    if not chosen.any():
        raise UsageError(
            f"no part of the surface {search.grid.rule.describe_place()} touches {', '.join(seeds.names)}:"
            f" {len(sizes):,} components, none of them has a seed"
        )
    return chosen


def keep_edges(device: Device, slab: Slab, grown: Grown, classified: Classified, stopwatch: Stopwatch) -> Classified:
    """Return the mask of a slab whose crossed edges are those of grown cells, with its inside mask beside it."""
    gi, gj, gk = slab.grid.shape
    kept_d, extents_d = allocate(device, 4 * slab.mask_rows * slab.grid.words), allocate(device, 4 * slab.mask_rows)
    launch(
        device, prepare_growing(device)["keep_edges"], slab.mask_rows, stopwatch=stopwatch,
        mask=classified.mask_d, grown=grown.grown_d, grown_extents=grown.extents_d,
        starts=grown.grown_d if grown.starts_d is None else grown.starts_d, kept=kept_d, kept_extents=extents_d,
        rows_start=grown.starts_d is not None, gi=gi, gj=gj, gk=slab.mask_slices, words=slab.grid.words,
        first=slab.first, whole_gk=gk,
    )  # fmt: skip
    return Classified(kept_d, extents_d, classified.mask_d)


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
        count, _, run_cells = search.join(runs)
    return count, int(run_cells.sum(dtype=np.int64))
