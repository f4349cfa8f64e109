"""Noise of clouds: statistical outliers are removed, the others move along their normals in the bilateral filter."""

from __future__ import annotations

import math
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.points.grid import fill_grid, plan_grid
from clrecon.operators.points.neighbours import NeighbourSearch, Part, check_neighbours, take_points
from clrecon.operators.points.normals import FEWEST_NEIGHBOURS, PlaneFits
from clrecon.points.cloud import PointCloud, PointStep
from clrecon.points.spacing import VARIATION_OF_FEATURES, distance_ratios, find_features, ratio_threshold
from clrecon.system.arguments import Features, explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress


class DistanceMeasure:
    """Mean and nearest distance of each point to its neighbours, filled by one part after another."""

    def __init__(self, search: NeighbourSearch, stopwatch: Stopwatch):
        self._search, self._stopwatch = search, stopwatch
        with stopwatch.timed("build"):
            lanes = search.device.kernel_variants["LANES"]
            program = ocl.load_program(search.device, "points/outliers.cl", {"LANES": lanes})
        self._kernel = program["measure_distances"]
        n = search.grid.n
        self._means, self._means_d = ocl.empty_output(search.device, (n,), np.float32)
        self._nearest, self._nearest_d = ocl.empty_output(search.device, (n,), np.float32)

    @staticmethod
    def needs(points: int) -> dict[str, int]:
        return {"mean distances": 8 * points}

    def measure(self, part: Part, neighbours_d: Any) -> None:
        """Measure a part, whose neighbours are listed by place."""
        search = self._search
        ocl.launch(
            search.device, self._kernel, -(-part.place_count // int(search.device.kernel_variants["LANES"])),
            **search.coordinates, order=search.grid.order_d, neighbours=neighbours_d, means=self._means_d,
            nearest=self._nearest_d, k=search.k, first_place=part.first_place, place_count=part.place_count,
        )  # fmt: skip

    def read(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return mean and nearest distances, (n,) mm each, by the points' numbers."""
        device = self._search.device
        return ocl.download(device, self._means, self._means_d), ocl.download(device, self._nearest, self._nearest_d)


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
    DeviceError
        The device has no room for the cloud, or it fails.
    """
    ocl.check_memory(memory)
    points = take_points(cloud)
    k, warnings = check_neighbours(k, len(points), 2)
    if isinstance(deviations, bool) or not isinstance(deviations, (int, float)) or not 0.0 <= deviations < math.inf:
        raise UsageError(f"deviations are a number from 0 on, usually 1 to 3, not {deviations!r}")
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, notes):
            stopwatch = Stopwatch()
            search = NeighbourSearch(current, points, k, DistanceMeasure.needs(len(points)), memory, stopwatch)
            distances = DistanceMeasure(search, stopwatch)
            neighbours_d = ocl.allocate(current, 4 * k * search.most_places)
            for part in search.each_part("outliers", progress or ignore_progress):
                search.find(part, neighbours_d)
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
                "device": current.label,
            }
            step = PointStep(cloud.select(removed == 0), removed, ("outlier",), facts, (*warnings, *notes))
    return step


_FEATURES: tuple[str, ...] = get_args(Features)
"""Ways to tell features: paper B's ratio of distances, and the surface variation."""

PLANE_NUMBERS = ocl.kernel_constant("points/bilateral.cl", "PLANE_NUMBERS")
"""Numbers that filter_points leaves for each point."""

_MOST_ITERATIONS = 100

_CELL_OF_SPACING = 2.0
"""Edge of the cells of paper B over the median distance to the kth neighbour: about 15 points a cell for k = 16."""


@explains_arguments
def denoise_points(
    cloud: PointCloud,
    k: int = 16,
    range_factor: float = 2.0,
    iterations: int = 1,
    features: Features | None = None,
    *,
    paper: bool = False,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> PointStep:
    """Smooth a cloud: move each point along its normal to the bilaterally weighted mean of its neighbours' heights.

    Paper B, eq. 3 to 5: p' = p - beta n with Gaussian weights of the distance (sigma_c: the distance to the kth
    neighbour) and of the height over the neighbour (sigma_s: ``range_factor`` times the standard deviation of the
    heights).  The paper prints p + beta n, which makes noise worse; the sign of the normal cancels.  Neighbours and
    normals are those before each iteration.  How far points moved is part of the result: a filter that smooths also
    shrinks.

    Parameters
    ----------
    cloud : PointCloud
    k : int
        Neighbours of each point, itself among them; 3 to 128.
    range_factor : float
        Positive; 2 once does what 1 does three times, and shrinks less.
    iterations : int
        1 to 100.
    features : {None, "paper", "variation"}
        None: the mean runs over the k neighbours everywhere.  Else only for features, and for all other points over
        their whole cell of twice the median distance to the kth neighbour, which shrinks more.  "paper": features have
        D_i > D0, with D0 = 1.2 times the median D_i; this ratio of distances does not see edges.  "variation": features
        have a surface variation above 0.05.
    paper : bool
        True: as the paper has it, ``range_factor`` 1 and ``features`` "paper".
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Most bytes taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("denoise", points done, all points)`` for each iteration.

    Returns
    -------
    PointStep
        The cloud with moved points, their HU and labels; normals and voxel indices no longer hold and are left out.
        Its facts: ``rms_move_mm`` and ``largest_move_mm`` over all iterations, ``neighbours``, ``range_factor``,
        ``iterations``, ``features``, ``feature_points`` and ``cell_mm`` of the last iteration, ``seconds``,
        ``kernel_seconds``, ``device``.

    Raises
    ------
    UsageError
        The cloud is empty, or a parameter is out of range.
    DeviceError
        The device has no room for the cloud, or it fails.
    """
    ocl.check_memory(memory)
    points = take_points(cloud)
    k, warnings = check_neighbours(k, len(points), FEWEST_NEIGHBOURS)
    settings = _Settings.checked(k, range_factor, iterations, features, paper)
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, notes):
            run = _Run(settings, current, memory, progress or ignore_progress)
            moved = points
            for _ in range(settings.iterations):
                moved = moved + run.moves(moved)
            step = run.describe(cloud, moved, (*warnings, *notes))
    return step


@dataclass(frozen=True)
class _Settings:
    k: int
    range_factor: float
    iterations: int
    features: str | None

    @classmethod
    def checked(cls, k: int, range_factor: float, iterations: int, features: str | None, paper: bool) -> _Settings:
        if isinstance(range_factor, bool) or not isinstance(range_factor, (int, float)):
            raise UsageError(f"range_factor is a positive number, not {range_factor!r}")
        if not 0.0 < range_factor < math.inf:
            raise UsageError(f"range_factor is a positive number, not {range_factor:g}")
        if isinstance(iterations, bool) or not isinstance(iterations, int) or not 1 <= iterations <= _MOST_ITERATIONS:
            raise UsageError(f"iterations are a whole number from 1 to {_MOST_ITERATIONS}, not {iterations!r}")
        if features is not None and features not in _FEATURES:
            raise UsageError(f"features are told by one of {', '.join(_FEATURES)} or not at all, not {features!r}")
        if paper:
            return cls(k, 1.0, iterations, "paper")
        return cls(k, float(range_factor), iterations, features)


class _Run:
    def __init__(self, settings: _Settings, device: Device, memory: int | None, progress: Progress):
        self.settings, self.device = settings, device
        self.memory, self.progress = memory, progress
        self.stopwatch = Stopwatch()
        self.feature_points: int | None = None
        self.cell_mm: float | None = None

    def moves(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the moves of one iteration, (n, 3) mm."""
        device, stopwatch = self.device, self.stopwatch
        settings = self.settings
        n = len(points)
        split = settings.features is not None
        results = {"moves": 12 * n, **PlaneFits.needs(n), **(DistanceMeasure.needs(n) if split else {})}
        if split:
            results |= {"planes": 4 * PLANE_NUMBERS * n, "grid of the paper": 40 * n}
        search = NeighbourSearch(device, points, settings.k, results, self.memory, stopwatch)
        fits = PlaneFits(search, stopwatch)
        with stopwatch.timed("build"):
            program = ocl.load_program(device, "points/bilateral.cl", {"LANES": device.kernel_variants["LANES"]})
        distances = DistanceMeasure(search, stopwatch) if split else None
        moves, moves_d = ocl.empty_output(device, (n, 3), np.float32)
        planes, planes_d = ocl.empty_output(device, (n if split else 1, PLANE_NUMBERS), np.float32)
        lanes = int(device.kernel_variants["LANES"])
        for part in search.each_part("denoise", self.progress):
            fits.fit(part)
            ocl.launch(
                device, program["filter_points"], -(-part.place_count // lanes),
                **search.coordinates, order=search.grid.order_d, neighbours=fits.neighbours_d, normals=fits.normals_d,
                variations=fits.variations_d, moves=moves_d, planes=planes_d, range_factor=settings.range_factor,
                keep_planes=split, k=settings.k, first_place=part.first_place, place_count=part.place_count,
            )  # fmt: skip
            if distances is not None:
                distances.measure(part, fits.neighbours_d)
        if distances is not None:
            self._filter_cells(points, distances, ocl.download(device, planes, planes_d), planes_d, moves_d, program)
        return ocl.download(device, moves, moves_d)

    def _filter_cells(
        self,
        points: NDArray[np.floating],
        distances: DistanceMeasure,
        planes: NDArray[np.float32],
        planes_d: Any,
        moves_d: Any,
        program: Program,
    ) -> None:
        """Let points that are no features take the mean over their whole cell."""
        device, stopwatch = self.device, self.stopwatch
        n = len(points)
        spacing = float(np.median(planes[:, 3]))
        if spacing == 0.0:  # most points coincide: every cell would have one place
            self.feature_points = n
            return
        self.cell_mm = _CELL_OF_SPACING * spacing
        with stopwatch.running(device):
            grid = fill_grid(device, plan_grid(points, self.cell_mm), memory=self.memory)
        if self.settings.features == "paper":
            means, nearest = distances.read()
            starts = ocl.download(device, np.empty(grid.cells + 1, np.uint32), grid.starts_d)
            order = ocl.download(device, np.empty(n, np.uint32), grid.order_d)
            cells = np.empty(n, np.int64)
            cells[order] = np.searchsorted(starts, np.arange(n), side="right") - 1
            ratios = distance_ratios(means, nearest, cells)
            features = find_features(ratios, ratio_threshold(ratios))
        else:
            features = planes[:, 5] > VARIATION_OF_FEATURES
        self.feature_points = int(np.count_nonzero(features))
        with stopwatch.running(device):
            ocl.launch(
                device, program["filter_cells"], n, x=grid.x_d, y=grid.y_d, z=grid.z_d,
                order=grid.order_d, starts=grid.starts_d, planes=planes_d,
                features=ocl.upload(device, features.astype(np.uint8)), moves=moves_d, cells=grid.cells, points=n,
            )  # fmt: skip

    def describe(self, cloud: PointCloud, moved: NDArray[np.floating], warnings: tuple[str, ...]) -> PointStep:
        settings = self.settings
        away = moved - cloud.points
        squares = np.einsum("ni,ni->n", away, away)
        facts = {
            "rms_move_mm": float(np.sqrt(squares.mean(dtype=np.float64))),
            "largest_move_mm": float(np.sqrt(squares.max())),
            "neighbours": settings.k,
            "range_factor": settings.range_factor,
            "iterations": settings.iterations,
            "features": settings.features,
            "feature_points": self.feature_points,
            "cell_mm": self.cell_mm,
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "device": self.device.label,
        }
        changed = cloud.changed(points=moved, normals=None, ijk=None)
        return PointStep(changed, np.zeros(len(cloud), np.uint8), (), facts, warnings)
