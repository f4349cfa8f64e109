"""Choosing of the components of active cells that are grown, the host side of cl/surface/choosing.cl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch, download, kernel_constant, launch, load_program, upload
from clrecon.operators.surface.cells import Classified
from clrecon.operators.surface.nearest_cell import find_cell_near
from clrecon.operators.surface.seeds import AUTO_SHARE, Seeds
from clrecon.operators.surface.slabs import SampleGrid

SUMS = {
    name: kernel_constant("surface/component_sums.h", name)
    for name in ("COMPONENTS", "CHOSEN", "ACTIVE_CELLS", "CHOSEN_CELLS", "LARGEST_LEFT_OUT", "SUMS")
}
"""Places of what is summed up over components, and their number."""


def prepare_choosing(device: Device) -> Program:
    """Build the kernels."""
    return load_program(device, "surface/choosing.cl")


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
        sums = download(device, np.empty(SUMS["SUMS"], np.uint32), sums_d)

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


def choose_components(
    device: Device, grid: SampleGrid, classified: Classified, runs: Runs, components: Components, seeds: Seeds,
    stopwatch: Stopwatch,
) -> None:  # fmt: skip
    """Choose the components that hold a seed, and sum up all."""
    program, (gi, gj, gk) = prepare_choosing(device), grid.shape
    sizes = {"gi": gi, "gj": gj, "gk": gk, "words": grid.words}

    def run(kernel: str, items: int, **arguments: Any) -> None:
        launch(device, program[kernel], items, stopwatch=stopwatch, **arguments)

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
            cells=upload(device, cells), n=len(cells), gj=gj, words=grid.words, **components.places,
        )  # fmt: skip
    if seeds.voxels is not None:
        run(
            "choose_seeded", gj * gk, mask=classified.mask_d, word_runs=runs.words_d, border=grid.rule.border,
            seeds=upload(device, seeds.voxels), enclosed_set=grid.rule.inside != "below",
            voxel_words=seeds.voxels.shape[2], **runs.places, **components.places, **sizes,
        )  # fmt: skip
    sum_components(device, runs, components, stopwatch)
    if seeds.auto or len(seeds.points):
        return
    sums = Sums.read(device, components.sums_d)
    if not sums.chosen:
        raise UsageError(
            f"no part of the surface {grid.rule.phrase()} touches {', '.join(seeds.names)}:"
            f" {sums.components:,} components, none of them has a seed"
        )


def sum_components(device: Device, runs: Runs, components: Components, stopwatch: Stopwatch) -> None:
    """Sum up the components."""
    launch(
        device, prepare_choosing(device)["sum_components"], runs.total, stopwatch=stopwatch,
        run_cells=components.cells_d, sums=components.sums_d, runs=runs.total, **components.places,
    )  # fmt: skip
