"""The k nearest points of every point, exactly, and the edge of cells with which they are found soonest."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.opencl import Device, Stopwatch
from clrecon.operators.points.grid import (
    MOST_CELLS_ALONG,
    MOST_PAIRS,
    PointGrid,
    fill_grid,
    find_box,
    plan_grid,
    prepare_grid,
)
from clrecon.points.cloud import PointCloud
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import list_distinct
from clrecon.system.progress import Progress, ignore_progress

_CANDIDATES = 5.6
"""Points in 27 cells for each neighbour that is searched: fewer send points to farther cells, more are compared in
vain."""

_FEWEST_CANDIDATES = 40
"""Points in 27 cells for few neighbours."""

_ALONE = 0.5
"""Share of the points of a thinned cloud that are alone in their block, at the edge that is searched."""

_SAMPLED = 4096
"""Points that are looked at: the share is then right to 0.01, the edge to 2 %."""

STEPS = 8
"""Halvings of the interval of the edge's logarithm, which is 12 wide at most."""

_CELLS_A_POINT = 256
_MANY_CELLS = 2**24
"""Most cells of a grid: so many for each point, or this number if that is more."""


_MIXERS = np.array([0x1E3779B97F4A7C15, 0x2545F4914F6CDD1D, 0x369DEA0F31A53F85, 0x1B873593CC9E2D51], np.int64)
"""Odd numbers that make one key of cell and group; that two cells share one is as unlikely as 2^-40."""


def choose_cell_edge(points: NDArray[np.floating], k: int) -> float:
    """Choose the edge, in mm, so that the 27 cells around a typical point hold some `_CANDIDATES` times `k` points.

    A cloud that is thinned to a share f at random leaves a point with c others in its block alone there with
    probability (1 - f)^c.  So a small sample tells the density of the whole cloud, in points of any dimension, and a
    dense spot does not outweigh the rest.  Results do not depend on it.
    """
    n = len(points)
    low, high = find_box(points).astype(np.float64)
    extent = float((high - low).max())
    if extent == 0.0:
        return 1.0
    wanted = max(_FEWEST_CANDIDATES, _CANDIDATES * k)
    share = min(-math.log(_ALONE) / wanted, 1.0)
    groups = max(1, min(round(1.0 / share), round(_SAMPLED / max(share * n, 1.0))))
    rng = np.random.default_rng(0)
    chosen = list_distinct(rng.integers(0, n, min(n, round(groups * share * n) + 1)))
    places = np.asarray(points[chosen], dtype=np.float64) - low
    group = rng.integers(0, groups, len(chosen))
    shortest = max(extent / (0.99 * MOST_CELLS_ALONG), _edge_of_box(high - low, max(_MANY_CELLS, _CELLS_A_POINT * n)))
    small, large = math.log(shortest), math.log(max(extent, shortest))
    for _ in range(STEPS):
        middle = 0.5 * (small + large)
        if _share_alone(places, group, 3.0 * math.exp(middle)) > _ALONE:
            small = middle
        else:
            large = middle
    return math.exp(0.5 * (small + large))


def _edge_of_box(size: NDArray[np.float64], cells: int) -> float:
    low, high = 0.0, float(size.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.prod(np.floor(size / middle) + 1.0) <= cells else (middle, high)
    return high


def _share_alone(places: NDArray[np.float64], group: NDArray[np.int64], block: float) -> float:
    """Return the share of points without another of their group in the same block."""
    cells = np.floor(places / block).astype(np.int64)
    keys = np.sort(np.column_stack([cells, group]) @ _MIXERS)
    new = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1], [True]]))
    return float(np.count_nonzero(np.diff(new) == 1)) / len(keys)


BATCH_CELLS = ocl.kernel_constant("points/neighbours.cl", "BATCH_CELLS")
"""Cells a work-item on a CPU."""

MOST_NEIGHBOURS = ocl.kernel_constant("points/near_rows.h", "MOST_NEIGHBOURS")
"""Most neighbours of a point: three times as many candidates have room in the kernel."""

_PART_POINTS = 1 << 16
"""Points of a launch on a CPU: their neighbours stay in its caches until the next kernel reads them."""

_PART_POINTS_OF_GPU = 1 << 20
"""Points of a launch on a GPU, which needs many work-items and keeps each launch short."""

_CROWDED = 4096
"""Points in a cell from which on pairs are counted before the search."""

ROUNDING = 1e-6
"""Share of the largest distance and coordinate that the place of a cell's face may be wrong by: several roundings of
float32."""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The nearest points of each point.

    Attributes
    ----------
    indices : ndarray, shape (n, k), int32
        Numbers of the nearest points, ascending by (distance, number).  The point itself is the first one, unless a
        point with a lower number is at the same place.
    distances : ndarray, shape (n, k), float32
        mm.
    warnings : tuple of str
        A line for fewer neighbours than were asked for.
    """

    indices: NDArray[np.int32]
    distances: NDArray[np.float32]
    warnings: tuple[str, ...] = ()


class Part(NamedTuple):
    """Cells that one launch takes, and the sorted points in them."""

    first_cell: int
    cell_count: int
    first_place: int
    place_count: int


def _has_one_lane(device: Device) -> bool:
    """True where the form for GPUs is taken: there, and where the loops of a work-item must be short."""
    return not device.has_long_items


def take_points(points: PointCloud | ArrayLike) -> NDArray[np.floating]:
    """Return the points of a cloud, or an array of points after the checks of a cloud; not empty."""
    cloud = points if isinstance(points, PointCloud) else PointCloud(points)
    if len(cloud) == 0:
        raise UsageError("the cloud is empty: there is no point whose neighbours could be found")
    return cloud.points


def check_neighbours(k: int, points: int, fewest: int = 1) -> tuple[int, tuple[str, ...]]:
    """Return the number of neighbours, the point itself among them, that a cloud has, and a warning if fewer than k."""
    if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or not fewest <= k <= MOST_NEIGHBOURS:
        raise UsageError(
            f"k, the number of neighbours with the point itself, is a whole number from {fewest} to {MOST_NEIGHBOURS},"
            f" not {k!r}"
        )
    if k <= points:
        return int(k), ()
    return points, (f"the cloud has {points:,} points: each has {points:,} neighbours, itself among them, not {k}",)


class NeighbourSearch:
    """A grid over at least `k` points, and the kernel that lists neighbours in parts of some `_PART_POINTS` points."""

    def __init__(
        self,
        device: Device,
        points: NDArray[np.floating],
        k: int,
        needs: dict[str, int],
        memory: int | None,
        stopwatch: Stopwatch,
    ):
        self.device, self.k = device, k
        self._stopwatch = stopwatch
        plan = plan_grid(points, choose_cell_edge(points, k))
        self.forecast = {
            **plan.needs(device),
            "neighbours of a part": 4 * k * min(self._part_points, len(points)),
            **needs,
        }
        shortage = ocl.describe_shortage(ocl.memory_limits(device, memory), self.forecast)
        if shortage:
            raise DeviceMemoryError(
                f"the neighbours of {len(points):,} points cannot be found: {shortage}; fewer points need less"
            )
        with stopwatch.timed("build"):
            prepare_grid(device)
            lanes = "1" if _has_one_lane(device) else "8"
            self._program = ocl.load_program(device, "points/neighbours.cl", {"LANES": lanes})
        with stopwatch.running(device):
            self.grid = fill_grid(device, plan, memory=memory)
        # beyond the rounding of a cell's faces and of distances to them
        extent = np.abs(plan.corner).max() + float(plan.edge) * max(plan.shape)
        self._margin = ROUNDING * float(extent)
        starts = ocl.download(device, np.empty(self.grid.cells + 1, np.uint32), self.grid.starts_d)
        check_pairs(self.grid, starts)
        self.parts = _split_cells(starts, self._part_points)

    @property
    def _part_points(self) -> int:
        return _PART_POINTS_OF_GPU if _has_one_lane(self.device) else _PART_POINTS

    @property
    def most_places(self) -> int:
        return max(part.place_count for part in self.parts)

    @property
    def coordinates(self) -> dict[str, Any]:
        return {"x": self.grid.x_d, "y": self.grid.y_d, "z": self.grid.z_d}

    def find(self, part: Part, neighbours_d: Any, distances_d: Any = None) -> None:
        """Write the neighbours of the points of a part, (place_count, k), as places in the sorted order; with their
        distances as numbers, both to the rows of these points in (n, k).
        """
        grid, by_place = self.grid, distances_d is None
        one_lane = _has_one_lane(self.device)
        distances_d = neighbours_d if by_place else distances_d
        (nx, ny, nz), (x, y, z) = grid.shape, (float(value) for value in grid.origin - grid.base)
        ocl.launch(
            self.device, self._program["list_neighbours"],
            part.place_count if one_lane else -(-part.cell_count // BATCH_CELLS), mask=grid.mask_d, ranks=grid.ranks_d,
            starts=grid.starts_d, order=grid.order_d, **self.coordinates, neighbours=neighbours_d,
            distances=distances_d, nx=nx, ny=ny, nz=nz, words=grid.words, cells=grid.cells, points=grid.n,
            origin=(x, y, z, grid.edge), margin=self._margin, k=self.k, by_place=by_place, **part._asdict(),
        )  # fmt: skip

    def each_part(self, stage: str, progress: Progress) -> Iterator[Part]:
        """Yield the parts, and tell how many points are done."""
        done = 0
        for part in self.parts:
            with self._stopwatch.running(self.device):
                yield part
            done += part.place_count
            progress(stage, done, self.grid.n)


def _split_cells(starts: NDArray[np.uint32], points: int) -> list[Part]:
    """Split cells in parts of about `points` points; a single cell is never split."""
    cells, total = len(starts) - 1, int(starts[-1])
    wanted = np.arange(points, total, points)
    borders = np.unique(np.concatenate([[0], np.searchsorted(starts, wanted), [cells]])).astype(np.int64)
    return [
        Part(int(first), int(end - first), int(starts[first]), int(starts[end]) - int(starts[first]))
        for first, end in zip(borders[:-1], borders[1:], strict=True)
    ]


def check_pairs(grid: PointGrid, starts: NDArray[np.uint32], crowded: int = _CROWDED, most: int = MOST_PAIRS) -> None:
    """Refuse clouds of which too many points lie in one cell of more than `crowded`, but not at one place."""
    counts = np.diff(starts).astype(np.int64)
    cells = np.flatnonzero(counts > crowded)
    pairs = int((counts[cells] ** 2).sum())
    if pairs <= most:
        return
    axes = [
        ocl.download(grid.device, np.empty(grid.n, np.float32), axis_d) for axis_d in (grid.x_d, grid.y_d, grid.z_d)
    ]
    for cell in cells:
        rows = slice(int(starts[cell]), int(starts[cell + 1]))
        if all(np.ptp(axis[rows]) == 0.0 for axis in axes):
            pairs -= int(counts[cell]) ** 2
    if pairs > most:
        raise UsageError(
            f"{int(counts.max()):,} of {grid.n:,} points lie in one cell of {grid.edge:.3g} mm: {pairs:.1e} pairs would"
            f" be compared, possible are {most:.0e}; remove points far from all others, or thin the cloud"
        )


@explains_arguments
def find_neighbours(
    points: PointCloud | ArrayLike,
    k: int = 16,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Neighbours:
    """Find the k nearest points of every point of a cloud.

    Exact: the order is that of the distances in float32, and of the points' numbers where distances are equal.
    Distances are ``sqrt(dx dx + dy dy + dz dz)`` of float32 coordinates; points from 4096 mm on are taken relative to a
    whole number of mm near their centre.  The result has the same bits on every device.

    Parameters
    ----------
    points : PointCloud or array_like, shape (n, 3)
        mm; at least one point, all finite.
    k : int
        Number of neighbours, the point itself among them; 1 to 128.  A cloud of fewer points has as many, with a
        warning.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Most bytes taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("neighbours", points done, all points)``.

    Returns
    -------
    Neighbours

    Raises
    ------
    UsageError
        The cloud is empty or has coordinates that are not finite, ``k`` is out of range, or more than 1e12 pairs of
        points of single cells would have to be compared.
    DeviceError
        The device has no room for the cloud and 8 k bytes a point, or it fails.

    Examples
    --------
    >>> near = clrecon.find_neighbours(cloud, k=8)  # doctest: +SKIP
    >>> spacing = np.median(near.distances[:, 1])  # doctest: +SKIP
    """
    ocl.check_memory(memory)
    places = take_points(points)
    k, warnings = check_neighbours(k, len(places))
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, notes):
            results = {"neighbours": 4 * k * len(places), "distances": 4 * k * len(places)}
            search = NeighbourSearch(current, places, k, results, memory, Stopwatch())
            indices, indices_d = ocl.empty_output(current, (len(places), k), np.int32)
            distances, distances_d = ocl.empty_output(current, (len(places), k), np.float32)
            for part in search.each_part("neighbours", progress or ignore_progress):
                search.find(part, indices_d, distances_d)
            indices = ocl.download(current, indices, indices_d)
            distances = ocl.download(current, distances, distances_d)
            neighbours = Neighbours(indices, distances, (*warnings, *notes))
    return neighbours
