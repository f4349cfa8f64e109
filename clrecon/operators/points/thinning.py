"""Clouds by the cells of a grid: thinned to one point a cell, or without sparse cells as in paper B, which grow over
the others.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.points.grid import GridPlan, PointGrid, fill_grid, plan_grid
from clrecon.operators.points.neighbours import find_neighbours
from clrecon.operators.primitives.union_find import hook_in_rounds
from clrecon.points.cloud import PointCloud, PointStep
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_share

REASON = "thinned"


def choose_points(device: Device, plan: GridPlan, *, memory: int | None = None) -> NDArray[np.uint32]:
    """Return the number of the point nearest to the mean of each cell with points, in the order of the cells."""
    needs = {**plan.needs(device), "chosen points": 4 * len(plan.points)}
    ocl.require_room(ocl.memory_limits(device, memory), needs, "the cloud cannot be thinned")
    grid = fill_grid(device, plan, memory=memory)
    chosen, chosen_d = ocl.empty_output(device, (grid.cells,), np.uint32)
    program = ocl.load_program(device, "points/thin.cl")
    ocl.launch(
        device, program["choose_points"], grid.cells, x=grid.x_d, y=grid.y_d, z=grid.z_d, starts=grid.starts_d,
        order=grid.order_d, chosen=chosen_d, cells=grid.cells,
    )  # fmt: skip
    return ocl.download(device, chosen, chosen_d)


@explains_arguments
def thin_points(
    cloud: PointCloud | ArrayLike,
    spacing: float,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> PointStep:
    """Keep one point in each cube of a grid: the one nearest to the mean of the points there.

    Parameters
    ----------
    cloud : PointCloud, or array_like of shape (n, 3)
        LPS mm; at least one point.
    spacing : float
        Edge of the cubes in mm.  The grid begins at the lowest coordinates less a thousandth of the edge.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("thin", done, 1)``.

    Returns
    -------
    PointStep
        Points keep their order and all that is known of them.  Of several that are equally near the first stays.

    Raises
    ------
    UsageError
        The cloud is empty, ``spacing`` is not a positive length, or the grid would have more than 2^31 cubes.
    DeviceError
        No device, no room for the points, or the device fails.
    """
    ocl.check_memory(memory)
    source = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    if not len(source):
        raise UsageError("the cloud is empty: there is nothing to thin")
    if not (isinstance(spacing, (int, float, np.number)) and math.isfinite(spacing) and spacing > 0.0):
        raise UsageError(f"{name_parameter('spacing', spacing)}: a positive length in mm is needed")
    plan, tell = plan_grid(source.points, float(spacing)), progress or ignore_progress
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, notes):
            stopwatch = Stopwatch()
            tell("thin", 0, 1)
            with stopwatch.running(current):
                chosen = np.sort(choose_points(current, plan, memory=memory))
            removed = np.ones(len(source), np.uint8)
            removed[chosen] = 0
            facts = {"spacing_mm": float(spacing), "device": current.label, "kernel_seconds": dict(stopwatch.by_kernel)}
            tell("thin", 1, 1)
            step = PointStep(source.select(chosen), removed, (REASON,), facts, tuple(notes))
    return step


REASONS = ("sparse cell", "not reached by growth", "smaller component")

_NEIGHBOURS = 16
"""Neighbours of a point, itself among them, the farthest of which gives the default edge."""

_EDGE_FACTOR = 2.0
"""Default edge of the cells in distances to the farthest of these neighbours: about 15 points a cell on bone."""

SPARSE = 2**32 - 1
"""The label of a sparse cell."""


def choose_edge(cloud: PointCloud, *, device: Device | str | int | None = None, memory: int | None = None) -> float:
    """Return twice the median distance from a point to the 16th of its nearest points, itself counted, in mm."""
    if len(cloud) == 1:
        raise UsageError("the cloud has one point, so that no edge of cells can be chosen: leave it as it is")
    neighbours = find_neighbours(cloud, _NEIGHBOURS, device=device, memory=memory)
    edge = _EDGE_FACTOR * float(np.median(neighbours.distances[:, -1]))
    if edge == 0.0:
        raise UsageError(
            f"over half of the {len(cloud):,} points have {neighbours.distances.shape[1] - 1} others at the same"
            " place, so that no edge of cells can be chosen: remove double points first (clrecon.thin_points with a"
            " small spacing), or give an edge in mm"
        )
    return edge


@dataclass(frozen=True, eq=False)
class _Grown:
    removed: NDArray[np.uint8]
    facts: dict[str, Any]


def grow_cells(
    device: Device, plan: GridPlan, fewest: int, threshold: int, largest: bool, *, memory: int | None = None
) -> _Grown:
    """Find the cells that stay; parameters are those of `remove_sparse_cells`."""
    needs = {**plan.needs(device), "labels of cells": 9 * len(plan.points), "marks of points": len(plan.points)}
    ocl.require_room(ocl.memory_limits(device, memory), needs, "sparse cells cannot be found")
    program = ocl.load_program(device, "points/sparse_cells.cl")
    grid = fill_grid(device, plan, memory=memory)
    labels = _label_cells(device, program, grid, fewest)
    starts = ocl.download(device, np.empty(grid.cells + 1, np.uint32), grid.starts_d).astype(np.int64)
    kinds, facts = _judge_cells(labels, starts[1:] - starts[:-1], threshold, largest)
    removed, removed_d = ocl.empty_output(device, (grid.n,), np.uint8)
    ocl.launch(
        device, program["mark_places"], grid.cells,
        starts=grid.starts_d, order=grid.order_d, kinds=ocl.upload(device, kinds), marks=removed_d, cells=grid.cells,
    )  # fmt: skip
    return _Grown(ocl.download(device, removed, removed_d), facts)


def _label_cells(device: Device, program: Program, grid: PointGrid, fewest: int) -> NDArray[np.uint32]:
    """Return the first cell of the component of each cell, `SPARSE` for sparse ones."""
    cells, (nx, ny, nz) = grid.cells, grid.shape
    labels_d, other_d = ocl.allocate(device, 4 * cells), ocl.allocate(device, 4 * cells)
    ocl.launch(
        device, program["label_crowded"], cells, starts=grid.starts_d, labels=labels_d, cells=cells, fewest=fewest
    )

    def hook(roots_d: Any, hooked_d: Any, flags_d: Any, number: int) -> None:
        ocl.launch(
            device, program["hook_touching"], cells, x=grid.x_d, y=grid.y_d, z=grid.z_d, starts=grid.starts_d,
            mask=grid.mask_d, ranks=grid.ranks_d, labels=roots_d, hooked=hooked_d, flags=flags_d,
            origin=grid.origin_and_scale, nx=nx, ny=ny, nz=nz, words=grid.words, cells=cells, pass_number=number,
        )  # fmt: skip

    roots_d = hook_in_rounds(device, labels_d, other_d, cells, hook)[0]
    return ocl.download(device, np.empty(cells, np.uint32), roots_d)


def _judge_cells(
    labels: NDArray[np.uint32], counts: NDArray[np.int64], threshold: int, largest: bool
) -> tuple[NDArray[np.uint8], dict[str, Any]]:
    """Return the number of the reason for which each cell goes, 0 for those that stay, and figures."""
    crowded = labels != SPARSE
    cells = labels[crowded]
    cells_of = np.bincount(cells, minlength=len(labels))
    points_of = np.bincount(cells, weights=counts[crowded], minlength=len(labels))
    reached = np.zeros(len(labels), bool)
    reached[labels[crowded & (counts >= threshold)]] = True
    roots = np.flatnonzero(reached)
    facts: dict[str, Any] = {"cells": len(labels), "sparse_cells": int((~crowded).sum()), "components": len(roots)}
    kinds = np.ones(len(labels), np.uint8)
    kinds[crowded] = np.where(reached[cells], 0, 2)
    if len(roots):
        best = roots[np.lexsort((roots, -points_of[roots], -cells_of[roots]))[0]]
        facts["largest_component"] = {"cells": int(cells_of[best]), "points": int(points_of[best])}
        if largest:
            kinds[crowded] = np.where((cells != best) & (kinds[crowded] == 0), 3, kinds[crowded])
    return kinds, facts


@explains_arguments
def remove_sparse_cells(
    cloud: PointCloud | ArrayLike,
    edge: float | None = None,
    fewest: int = 2,
    threshold: int = 2,
    *,
    keep_largest: bool = False,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> PointStep:
    """Remove points in grid cells with few points, and those that growth over the other cells does not reach.

    Parameters
    ----------
    cloud : PointCloud, or array_like of shape (n, 3)
        LPS mm; at least one point.
    edge : float, optional
        Edge of the cells in mm.  By default twice the median distance from a point to the 16th of its nearest points,
        itself counted: about 15 points a cell.  The grid begins at the lowest coordinates less a thousandth of it.
    fewest : int
        Cells with fewer points lose them.
    threshold : int
        Growth begins in cells with at least so many points, and goes on over neighbours by faces, edges and corners.
    keep_largest : bool
        True: keep the component with the most cells alone; of several the one with the most points, then the first.
        It takes real bone too, since ribs and vertebrae stand apart: ``facts`` and a warning say how much.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("cells", done, 2)`` after the choice of the edge and at the end.

    Returns
    -------
    PointStep
        Reasons: "sparse cell", "not reached by growth", "smaller component".

    Raises
    ------
    UsageError
        The cloud is empty, a parameter cannot be used, the grid would have too many cells, or the cells are so small
        that all points would go.
    DeviceError
        No device, no room for the points, or the device fails.

    References
    ----------
    Liu et al. 2019, section 2.2.
    """
    ocl.check_memory(memory)
    source = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    _check_input(source, edge, fewest, threshold)
    tell, chosen_device = progress or ignore_progress, ocl.take_device(device)
    length = choose_edge(source, device=chosen_device, memory=memory) if edge is None else float(edge)
    tell("cells", 1, 2)
    plan = plan_grid(source.points, length)
    for attempt in ocl.with_fallback(chosen_device):
        with attempt as (current, notes):
            stopwatch = Stopwatch()
            with stopwatch.running(current):
                grown = grow_cells(current, plan, int(fewest), int(threshold), keep_largest, memory=memory)
            asked = {"edge_is_default": edge is None, "fewest": int(fewest), "threshold": int(threshold)}
            made_on = {"device": current.label, "kernel_seconds": dict(stopwatch.by_kernel)}
            facts = {"edge_mm": float(plan.edge), **asked, **grown.facts, **made_on}
            step = _finish_step(source, grown, facts, keep_largest, notes)
    tell("cells", 2, 2)
    return step


def _check_input(cloud: PointCloud, edge: float | None, fewest: int, threshold: int) -> None:
    if not len(cloud):
        raise UsageError("the cloud is empty: it has no cells")
    for name, value in (("fewest", fewest), ("threshold", threshold)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise UsageError(f"{name_parameter(name, value)}: a whole number of points from 1 on is needed")
    if edge is not None and not (isinstance(edge, (int, float, np.number)) and math.isfinite(edge) and edge > 0.0):
        raise UsageError(f"an edge of {edge!r}: a positive length in mm is needed")


def _finish_step(
    cloud: PointCloud, grown: _Grown, facts: dict[str, Any], keep_largest: bool, notes: list[str]
) -> PointStep:
    """Put the step together, and refuse one that leaves nothing."""
    removed = grown.removed
    if removed.all():
        raise UsageError(
            f"all {len(cloud):,} points would go: {grown.facts['sparse_cells']:,} of {grown.facts['cells']:,} cells of"
            f" {facts['edge_mm']:.4g} mm have fewer than {facts['fewest']} points, and no other has"
            f" {facts['threshold']}.  Take larger cells, or none for the default"
        )
    warnings = list(notes)
    smaller = int((removed == 3).sum())
    if keep_largest and smaller:
        components, points = grown.facts["components"], int((removed == 0).sum())
        warnings.append(
            f"the largest component keeps {points:,} points; {smaller:,} in {components - 1:,} other components went"
            f" ({format_share(smaller / len(cloud), 1)} of the cloud), bone that stands apart among them"
        )
    facts["points_a_cell"] = len(cloud) / grown.facts["cells"]
    return PointStep(cloud.select(removed == 0), removed, REASONS, facts, tuple(warnings))
