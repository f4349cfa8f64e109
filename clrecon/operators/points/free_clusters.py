"""DBSCAN of free points on the device: the host's side of cl/points/free_clusters.cl."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.points.grid import (
    MOST_PAIRS,
    PADDING,
    GridPlan,
    PointGrid,
    fill_grid,
    find_box,
    plan_grid,
    prepare_grid,
)
from clrecon.operators.primitives.scan import exclusive_scan
from clrecon.operators.primitives.union_find import hook_in_rounds
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress

_EPS_TOLERANCE = 1e-6
"""Distances up to eps times one more than this are within eps."""

LEAST_EPS_MM = 1e-9
"""Smallest eps: the squares of smaller values leave the range of float32."""

_UNSURE_SHARE = 1e-6
"""Part of the limit's square within which kernels decide in sums of two floats; both ends are given to them."""

_CELL_SLACK = 1e-3
"""Part by which cells are smaller than they could be, besides the rounding of the grid."""

FORWARD_ROWS = ocl.kernel_constant("points/cell_links.h", "FORWARD_ROWS")
NEAR_ROWS = ocl.kernel_constant("points/cell_links.h", "NEAR_ROWS")

CHUNKS_A_CORE = 2
"""Chunks for each core of a CPU: few, since links between chunks take more time than those within."""

CELLS_A_CHUNK = 32
"""Cells of a chunk on other devices, and fewest on a CPU."""

_CELLS_AN_ITEM = 32
"""Neighbouring cells of a work-item of hook_cells and find_firsts on a CPU."""


@dataclass(frozen=True, eq=False)
class FreeClusters:
    """Result of `cluster_free_points`: clusters, by their first core point, -1 for noise, and facts for a report."""

    labels: NDArray[np.int32]
    cores: NDArray[np.bool_]
    count: int
    facts: dict[str, Any]
    warnings: tuple[str, ...] = ()


def _check_numbers(eps: float, min_samples: int) -> None:
    if not (isinstance(eps, (int, float, np.floating, np.integer)) and math.isfinite(eps) and eps >= LEAST_EPS_MM):
        raise UsageError(f"{name_parameter('eps', eps)}: a distance in mm is needed, at least {LEAST_EPS_MM:g}")
    if isinstance(min_samples, bool) or not isinstance(min_samples, (int, np.integer)) or min_samples < 1:
        raise UsageError(f"{name_parameter('min_samples', min_samples)}: a whole number from 1 on is needed")


def plan_cells(points: ArrayLike, eps: float) -> GridPlan:
    """Lay a grid over points whose cells are so small that all points of one are within eps of each other."""
    places = np.asarray(points)
    low, high = find_box(places).astype(np.float64)
    extent = high - low
    if not np.isfinite(extent).all():
        return plan_grid(places, eps)  # refuses them
    if float(np.sqrt((extent**2).sum())) <= eps:  # one cell, whatever the number of points
        return plan_grid(places, 1.01 * float(extent.max()) if extent.any() else 1.0)
    edge = eps / math.sqrt(3.0)
    return plan_grid(places, edge * (1.0 - _CELL_SLACK - min(4e-7 * (float(extent.max()) / edge), 0.1)))


def cluster_free_points(
    points: ArrayLike,
    eps: float,
    min_samples: int = 6,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress = ignore_progress,
) -> FreeClusters:
    """Cluster points anywhere in space by density (DBSCAN, Ester, Kriegel, Sander and Xu 1996), equal to scikit-learn
    label for label.

    Points are core points when at least `min_samples` points lie within `eps`, themselves included.  Core points within
    `eps` of each other belong to one cluster.  Clusters are numbered by their first core point in the order of the
    points; other points near core points take the lowest number among these; all others are noise, -1.

    points: Finite.  Distances are those of the points as float32, of far clouds relative to whole millimetres near
        their centre, and are compared as in exact arithmetic.
    eps: mm.  Distances up to ``eps * (1 + 1e-6)`` are within.
    min_samples: From 1 on; 1 gives connected components.
    """
    _check_numbers(eps, min_samples)
    ocl.check_memory(memory)
    places = np.asarray(points)
    if places.ndim != 2 or places.shape[1] != 3:
        raise UsageError(f"points have shape (n, 3), these have {places.shape}")
    n = len(places)
    facts: dict[str, Any] = {"eps_mm": float(eps), "min_samples": int(min_samples)}
    if n < min_samples:
        warning = f"{n:,} points are fewer than min_samples {min_samples}: all are noise"
        facts |= {"clusters": 0, "core_points": 0, "noise_points": n}
        return FreeClusters(np.full(n, -1, np.int32), np.zeros(n, bool), 0, facts, (warning,))
    plan = plan_cells(places, eps)
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, notes):
            stopwatch = Stopwatch()
            with stopwatch.running(current):
                search = find_clusters(current, plan, eps, min_samples, memory=memory, progress=progress)
            labels, cores, count, cells = search
            free_facts = {
                "clusters": count,
                "core_points": int(cores.sum()),
                "noise_points": int((labels < 0).sum()),
                "cell_edge_mm": float(plan.edge),
                "cells": cells,
                "device": current.label,
                "kernel_seconds": dict(stopwatch.by_kernel),
            }
            free_clusters = FreeClusters(labels, cores, count, facts | free_facts, tuple(notes))
    return free_clusters


def find_clusters(
    device: Device,
    plan: GridPlan,
    eps: float,
    min_samples: int,
    *,
    per_chunk: int | None = None,
    memory: int | None = None,
    progress: Progress = ignore_progress,
) -> tuple[NDArray[np.int32], NDArray[np.bool_], int, int]:
    """Return labels, cores, numbers of clusters and cells of a plan; equal for any `per_chunk` of `_CELLS_AN_ITEM`."""
    needs = {**plan.needs(device), "clusters": 23 * len(plan.points)}
    ocl.require_room(ocl.memory_limits(device, memory), needs, "the clusters of the points cannot be found")
    grid = fill_grid(device, plan, memory=memory)
    progress("clusters", 1, 4)
    search = ClusterSearch(device, grid, eps, min_samples, per_chunk)
    search.check_pairs()
    search.find_cores()
    progress("clusters", 2, 4)
    search.join()
    progress("clusters", 3, 4)
    labels, cores = search.label()
    progress("clusters", 4, 4)
    return labels, cores, search.count, grid.cells


class ClusterSearch:
    """The passes of cl/points/free_clusters.cl, in their order.

    core_x_d: buffer, (n + PADDING,) float32. x of core points, NaN for others.
    labels_d: buffer, (cells,) uint32. After each step the cells' labels, all of them roots.
    roots_d: buffer, (nz, ny, words) uint32. Roots of words, as the search noted them last.
    count: Number of clusters, once `label` has run.
    """

    def __init__(self, device: Device, grid: PointGrid, eps: float, min_samples: int, per_chunk: int | None = None):
        self._device, self._grid = device, grid
        self._is_cpu = device.has_long_items
        lanes = device.kernel_variants["LANES"] if self._is_cpu else "1"
        self._program = ocl.load_program(device, "points/free_clusters.cl", {"LANES": lanes})
        self._of_grid = prepare_grid(device)
        self._samples = min_samples
        nx, ny, nz = grid.shape
        self._total_words = grid.words * ny * nz
        limit = min(eps, 2.0 * grid.edge * math.hypot(nx, ny, nz)) * (1.0 + _EPS_TOLERANCE)
        self._reach_squared = (limit / grid.edge * (1.0 + 1e-5) + 1e-5 + 4e-7 * max(grid.shape)) ** 2
        self._where: dict[str, Any] = {
            "x": grid.x_d, "y": grid.y_d, "z": grid.z_d, "starts": grid.starts_d, "mask": grid.mask_d,
            "ranks": grid.ranks_d, "origin": grid.origin_and_scale, "bounds": _bounds(limit), "nx": nx, "ny": ny,
            "nz": nz, "words": grid.words, "cells": grid.cells,
        }  # fmt: skip
        self._per_chunk = self._plan_chunk() if per_chunk is None else per_chunk
        self._per_item = _CELLS_AN_ITEM if self._is_cpu else 1
        self.core_x_d = ocl.allocate(device, 4 * (grid.n + PADDING))
        self.labels_d, self._other_d, self._firsts_d = (ocl.allocate(device, 4 * grid.cells) for _ in range(3))
        self.roots_d = ocl.allocate(device, 4 * self._total_words)
        self.count = 0

    def _plan_chunk(self) -> int:
        if not self._is_cpu:
            return CELLS_A_CHUNK
        share = -(-self._grid.cells // (CHUNKS_A_CORE * self._device.compute_units))
        return max(-(-share // CELLS_A_CHUNK), 1) * CELLS_A_CHUNK

    def _run(self, kernel: str, items: int, program: Program | None = None, **arguments: Any) -> None:
        ocl.launch(self._device, (program or self._program)[kernel], items, **arguments)

    def check_pairs(self) -> None:
        """Refuse clouds that are so dense that comparing their points would take many minutes."""
        n, cells = self._grid.n, self._grid.cells
        if float(n) * n <= MOST_PAIRS:
            return
        counts = np.diff(ocl.download(self._device, np.empty(cells + 1, np.uint32), self._grid.starts_d)).astype(
            np.float64
        )
        if float(counts @ counts) * 187 <= MOST_PAIRS:  # 125 cells around, 62 after each
            return
        pairs = float(self.count_pairs().sum(dtype=np.float64))
        if pairs > MOST_PAIRS:
            raise UsageError(
                f"up to {pairs:.2g} pairs of points would have to be compared, {MOST_PAIRS:.0g} at most are:"
                f" {n:,} points lie in {cells:,} cells of {self._grid.edge:.4g} mm, up to {int(counts.max()):,} in one."
                f"  Take a smaller {name_parameter('eps')}, or thin the cloud"
            )

    def count_pairs(self) -> NDArray[np.float32]:
        """Return the most pairs that may have to be compared for each cell with points."""
        cells = self._grid.cells
        pairs, pairs_d = ocl.empty_output(self._device, (cells,), np.float32)
        self._run("count_pairs", cells, pairs=pairs_d, min_samples=self._samples, **self._where)
        return ocl.download(self._device, pairs, pairs_d)

    def find_cores(self) -> None:
        """Find the core points, and label each core cell with itself."""
        self._run(
            "find_core_points", self._grid.cells,
            core_x=self.core_x_d, labels=self.labels_d, firsts=self._firsts_d, min_samples=self._samples,
            reach_squared=self._reach_squared, **self._where,
        )  # fmt: skip

    def join(self) -> None:
        """Give all cells of a cluster one label."""
        self.join_within()
        if self._per_chunk < self._grid.cells:
            self.note_words()
            self.hook_chunks()

    def join_within(self) -> None:
        """Join all cells within each chunk: the own rows first, then the nearest, then all others."""
        self.join_chunks(0, 1)
        self.join_chunks(1, NEAR_ROWS)
        self.note_words()
        self.join_chunks(NEAR_ROWS, FORWARD_ROWS)

    def join_chunks(self, first_row: int, end_row: int) -> None:
        """Join the cells within each chunk along some of the rows."""
        chunks = -(-self._grid.cells // self._per_chunk)
        items = chunks * self._device.group_size if self._is_cpu else chunks
        self._run(
            "join_chunks", items,
            core_x=self.core_x_d, roots=self.roots_d, labels=self.labels_d, per_chunk=self._per_chunk,
            first_row=first_row, end_row=end_row, **self._where,
        )  # fmt: skip

    def note_words(self) -> None:
        """Note for each word of the mask whether its core cells have one root."""
        grid = self._grid
        self._run(
            "note_words", self._total_words,
            mask=grid.mask_d, ranks=grid.ranks_d, labels=self.labels_d, roots=self.roots_d, total=self._total_words,
        )  # fmt: skip

    def hook_chunks(self) -> None:
        """Join the clusters of all chunks, in rounds."""

        def hook(labels_d: Any, hooked_d: Any, flags_d: Any, number: int) -> None:
            self._run(
                "hook_cells", -(-self._grid.cells // self._per_item),
                core_x=self.core_x_d, roots=self.roots_d, labels=labels_d, hooked=hooked_d, flags=flags_d,
                per_chunk=self._per_chunk, per_item=self._per_item, pass_number=number, **self._where,
            )  # fmt: skip

        self.labels_d, self._other_d = hook_in_rounds(
            self._device, self.labels_d, self._other_d, self._grid.cells, hook
        )

    def label(self) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Number the clusters, and return labels and core points in the order of the input."""
        grid, words = self._grid, -(-self._grid.n // 32)
        self._run(
            "find_firsts", -(-grid.cells // self._per_item),
            core_x=self.core_x_d, starts=grid.starts_d, order=grid.order_d, labels=self.labels_d,
            firsts=self._firsts_d, cells=grid.cells, per_item=self._per_item,
        )  # fmt: skip
        marks_d, before_d = ocl.allocate(self._device, 4 * words), ocl.allocate(self._device, 4 * words)
        self._run("clear_cells", words, self._of_grid, mask=marks_d, total=words)
        self._run(
            "mark_firsts", grid.cells, labels=self.labels_d, firsts=self._firsts_d, marks=marks_d, cells=grid.cells
        )
        self._run("count_marked", words, self._of_grid, mask=marks_d, counts=before_d, total=words)
        self.count = exclusive_scan(self._device, before_d, words, in_place=True).total
        numbers_d = self._other_d
        self._run(
            "number_cells", grid.cells,
            labels=self.labels_d, firsts=self._firsts_d, marks=marks_d, before=before_d, numbers=numbers_d,
            cells=grid.cells,
        )  # fmt: skip
        labels, labels_d = ocl.empty_output(self._device, (grid.n,), np.int32)
        cores, cores_d = ocl.empty_output(self._device, (grid.n,), np.uint8)
        self._run(
            "label_free_points", grid.cells,
            core_x=self.core_x_d, order=grid.order_d, numbers=numbers_d, clusters=labels_d, cores=cores_d,
            reach_squared=self._reach_squared, **self._where,
        )  # fmt: skip
        ocl.download(self._device, labels, labels_d)
        return labels, ocl.download(self._device, cores, cores_d).view(np.bool_)


def _bounds(limit: float) -> tuple[float, float, float, float]:
    """Return the float4 of cl/points/pair_distance.h for the largest distance of neighbours in mm."""
    square = limit * limit
    high = np.float32(square)
    near = np.nextafter(np.float32(square * (1.0 - _UNSURE_SHARE)), np.float32(0.0))
    far = np.nextafter(np.float32(square * (1.0 + _UNSURE_SHARE)), np.float32(np.inf))
    return float(near), float(far), float(high), float(np.float32(square - float(high)))
