"""Thinning of clouds to one point a cell: the host's side of cl/points/thin.cl."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    check_memory,
    describe_shortage,
    download,
    empty_output,
    launch,
    load_program,
    memory_limits,
    take_device,
    work_on,
)
from clrecon.operators.points.grid import GridPlan, fill_grid, plan_grid, prepare_grid
from clrecon.points import PointCloud, PointStep
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.wording import name_parameter

REASON = "thinned"


def prepare_thin(device: Device) -> Program:
    """Build the kernels of `thin_points`."""
    prepare_grid(device)
    return load_program(device, "points/thin.cl")


def choose_points(
    device: Device, plan: GridPlan, *, memory: int | None = None, stopwatch: Stopwatch | None = None
) -> NDArray[np.uint32]:
    """Return the number of the point nearest to the mean of each cell with points, in the order of the cells."""
    needs = {**plan.needs(device), "chosen points": 4 * len(plan.points)}
    shortage = describe_shortage(memory_limits(device, memory), needs)
    if shortage:
        raise DeviceMemoryError(f"the cloud cannot be thinned: {shortage}")
    grid = fill_grid(device, plan, memory=memory, stopwatch=stopwatch)
    chosen, chosen_d = empty_output(device, (grid.cells,), np.uint32)
    launch(
        device, prepare_thin(device)["choose_points"], grid.cells, stopwatch=stopwatch,
        x=grid.x_d, y=grid.y_d, z=grid.z_d, starts=grid.starts_d, order=grid.order_d, chosen=chosen_d,
        cells=grid.cells,
    )  # fmt: skip
    return download(device, chosen, chosen_d)


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
    check_memory(memory)
    made = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    if not len(made):
        raise UsageError("the cloud is empty: there is nothing to thin")
    if not (isinstance(spacing, (int, float, np.number)) and math.isfinite(spacing) and spacing > 0.0):
        raise UsageError(f"{name_parameter('spacing', spacing)}: a positive length in mm is needed")
    plan, tell = plan_grid(made.points, float(spacing)), progress or ignore_progress

    def work(current: Device, told: list[str]) -> PointStep:
        stopwatch = Stopwatch()
        tell("thin", 0, 1)
        with stopwatch.running(current):
            chosen = np.sort(choose_points(current, plan, memory=memory, stopwatch=stopwatch))
        removed = np.ones(len(made), np.uint8)
        removed[chosen] = 0
        facts = {"spacing_mm": float(spacing), "device": current.label, "kernel_seconds": dict(stopwatch.by_kernel)}
        tell("thin", 1, 1)
        return PointStep(made.select(chosen), removed, (REASON,), facts, tuple(told))

    return work_on(take_device(device), work)
