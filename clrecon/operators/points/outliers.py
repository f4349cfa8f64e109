"""Statistical outliers of a cloud: the host's side of cl/points/outliers.cl."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    check_memory,
    download,
    empty_output,
    launch,
    load_program,
    take_device,
    work_on,
)
from clrecon.operators.points.neighbours import NeighbourSearch, Part, check_neighbours, take_points
from clrecon.points import PointCloud, PointStep
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress


def prepare_outliers(device: Device) -> Program:
    """Build the kernel of `remove_outliers`, but for those that search neighbours."""
    return load_program(device, "points/outliers.cl", {"LANES": device.kernel_variants["LANES"]})


class DistanceMeasure:
    """Mean and nearest distance of each point to its neighbours, filled by one part after another."""

    def __init__(self, search: NeighbourSearch, stopwatch: Stopwatch):
        self._search, self._stopwatch = search, stopwatch
        with stopwatch.timed("build"):
            self._kernel = prepare_outliers(search.device)["measure_distances"]
        n = search.grid.n
        self._means, self._means_d = empty_output(search.device, (n,), np.float32)
        self._nearest, self._nearest_d = empty_output(search.device, (n,), np.float32)

    @staticmethod
    def needs(points: int) -> dict[str, int]:
        """Return the bytes for a cloud of so many points."""
        return {"mean distances": 8 * points}

    def measure(self, part: Part, neighbours_d: Any) -> None:
        """Measure a part, whose neighbours are listed by place."""
        search = self._search
        launch(
            search.device, self._kernel, -(-part.place_count // int(search.device.kernel_variants["LANES"])),
            stopwatch=self._stopwatch, **search.coordinates, order=search.grid.order_d, neighbours=neighbours_d,
            means=self._means_d, nearest=self._nearest_d, k=search.k, first_place=part.first_place,
            place_count=part.place_count,
        )  # fmt: skip

    def read(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return mean and nearest distances, (n,) mm each, by the points' numbers."""
        device = self._search.device
        return download(device, self._means, self._means_d), download(device, self._nearest, self._nearest_d)


@explains_arguments
def remove_outliers(
    cloud: PointCloud,
    k: int = 16,
    deviations: float = 2.0,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> PointStep:
    """Remove points that lie far from their neighbours: statistical outliers.

    The mean distance of each point to its k - 1 nearest others is compared with that of all points.  A point goes where
    it exceeds their mean by more than ``deviations`` standard deviations.  It is the rule of Rusu et al. 2008, as PCL
    and Open3D have it.

    Parameters
    ----------
    cloud : PointCloud
    k : int
        Neighbours of each point, itself among them; 2 to 128.
    deviations : float
        Standard deviations (of a sample) above the mean; not negative.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Most bytes taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("outliers", points done, all points)``.

    Returns
    -------
    PointStep
        The reason of removed points is "outlier".  Its facts: ``neighbours``, ``deviations``, ``mean_distance_mm`` and
        ``deviation_mm`` over all points, ``largest_kept_mm`` (the bound), ``seconds`` and ``device``.

    Raises
    ------
    UsageError
        The cloud is empty, ``k`` is out of range, or ``deviations`` is negative or no number.
    DeviceMemoryError
        The device has no room for the cloud.
    DeviceError
        The device fails.
    """
    check_memory(memory)
    points = take_points(cloud)
    k, warnings = check_neighbours(k, len(points), 2)
    if isinstance(deviations, bool) or not isinstance(deviations, (int, float)) or not 0.0 <= deviations < math.inf:
        raise UsageError(f"deviations are a number from 0 on, usually 1 to 3, not {deviations!r}")

    def work(device: Device, told: list[str]) -> PointStep:
        stopwatch = Stopwatch()
        search = NeighbourSearch(device, points, k, DistanceMeasure.needs(len(points)), memory, stopwatch)
        distances = DistanceMeasure(search, stopwatch)
        neighbours_d = allocate(device, 4 * k * search.most_places)
        for part in search.each_part("outliers", progress):
            search.list_places(part, neighbours_d)
            distances.measure(part, neighbours_d)
        means = distances.read()[0].astype(np.float64)
        mean = float(means.mean())
        deviation = float(means.std(ddof=1)) if len(means) > 1 else 0.0
        bound = mean + deviations * deviation
        removed = (means > bound).astype(np.uint8)
        facts = {
            "neighbours": k,
            "deviations": float(deviations),
            "mean_distance_mm": mean,
            "deviation_mm": deviation,
            "largest_kept_mm": bound,
            "seconds": dict(stopwatch.seconds),
            "device": device.label,
        }
        return PointStep(cloud.select(removed == 0), removed, ("outlier",), facts, (*warnings, *told))

    return work_on(take_device(device), work)
