"""Figures of the clusters of a cloud: size, place, extent, and which of them are sheets without thickness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.points.cloud import PointCloud
from clrecon.system.pieces import chunks

SHEET_POINTS = 500
"""Fewest points of a cluster that may be a sheet: fewer say little about its form."""

SHEET_RATIO = 15.0
"""Ratio of the two smaller principal standard deviations above which a cluster is a sheet.  Table tops and headrests of
five scans have 27 and more, clusters among bone up to 5."""


PIECE = 1 << 16
"""Points that are measured at a time: the caches of a core hold what is made of them."""

LEAST_RUN = 4
"""Points of one cluster in a row, on the average, from which they are summed run by run."""


@dataclass(frozen=True)
class ClusterFigures:
    """The clusters of a cloud, an entry of each array for each.

    points: ndarray, shape (c,), int64. Number of points.
    centres: ndarray, shape (c, 3), float64. Mean of the points, LPS mm.
    boxes: ndarray, shape (c, 2, 3), float64. Lowest and highest coordinates, LPS mm.
    deviations: ndarray, shape (c, 3), float64. Standard deviations along the principal axes, mm, ascending.
    """

    points: NDArray[np.int64]
    centres: NDArray[np.float64]
    boxes: NDArray[np.float64]
    deviations: NDArray[np.float64]

    @property
    def sheets(self) -> NDArray[np.bool_]:
        """True for clusters without thickness: at least 500 points, second deviation over 15 times the first."""
        thin: NDArray[np.bool_] = self.deviations[:, 1] > SHEET_RATIO * self.deviations[:, 0]
        return thin & (self.points >= SHEET_POINTS)

    def order(self) -> NDArray[np.int64]:
        """Return the numbers of the clusters, those with most points first, ties by number."""
        return np.argsort(-self.points, kind="stable")

    def as_dicts(self, most: int) -> list[dict[str, Any]]:
        """Return the entries of a report: the `most` largest clusters, and all that are sheets."""
        order, sheets = self.order(), self.sheets
        chosen = [*order[:most].tolist(), *(number for number in order[most:].tolist() if sheets[number])]
        return [
            {
                "cluster": int(number),
                "points": int(self.points[number]),
                "center_lps_mm": np.round(self.centres[number], 3).tolist(),
                "box_lps_mm": np.round(self.boxes[number], 3).tolist(),
                "principal_sd_mm": np.round(self.deviations[number], 4).tolist(),
                "is_sheet": bool(sheets[number]),
            }
            for number in chosen
        ]


class _Runs:
    """A piece of a cloud by runs of points of one cluster, which neighbours in the order of a cloud mostly are."""

    def __init__(self, labels: NDArray[np.int32]):
        begins = np.ones(len(labels), bool)
        np.not_equal(labels[1:], labels[:-1], out=begins[1:])
        self._starts: NDArray[np.intp] | None = np.flatnonzero(begins)
        if LEAST_RUN * len(self._starts) > len(labels):
            self._starts = None  # a run is a point
        else:
            self._lengths = np.diff(self._starts, append=len(labels))
            labels = labels[self._starts]
        self._labels = np.maximum(labels, -1).astype(np.intp)
        self._labels += 1  # 0 is noise
        self.clusters = int(self._labels.max(initial=0))

    def count(self, sizes: NDArray[np.int64]) -> None:
        """Add the number of points to that of their clusters; entry 0 of these and further figures is noise."""
        np.add.at(sizes, self._labels, 1 if self._starts is None else self._lengths)

    def add(self, sums: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """Add values of points to the sums of their clusters."""
        np.add.at(sums, self._labels, values if self._starts is None else np.add.reduceat(values, self._starts))

    def widen(self, low: NDArray[np.floating], high: NDArray[np.floating], values: NDArray[np.floating]) -> None:
        """Take values of points into the range of their clusters."""
        for extreme, ends in ((np.minimum, low), (np.maximum, high)):
            extreme.at(ends, self._labels, values if self._starts is None else extreme.reduceat(values, self._starts))

    def spread(self, figures: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return for each point the figure of its cluster."""
        of_runs = figures.take(self._labels)
        return of_runs if self._starts is None else np.repeat(of_runs, self._lengths)


def measure_clusters(cloud: PointCloud) -> ClusterFigures:
    """Measure each cluster of a cloud with labels; noise is left out."""
    if cloud.labels is None:
        raise UsageError("the points have no labels: cluster them first")
    points = cloud.points
    pieces = [(where, _Runs(cloud.labels[where])) for where in chunks(len(cloud), PIECE)]
    entries = max((runs.clusters for _, runs in pieces), default=0) + 1
    sizes, sums, squares = np.zeros(entries, np.int64), np.zeros((3, entries)), np.zeros((3, 3, entries))
    low, high = np.full((3, entries), np.inf, points.dtype), np.full((3, entries), -np.inf, points.dtype)
    for where, runs in pieces:
        runs.count(sizes)
        for axis in range(3):
            own = np.ascontiguousarray(points[where, axis])
            runs.widen(low[axis], high[axis], own)
            runs.add(sums[axis], own.astype(np.float64))
    shares = 1.0 / np.maximum(sizes, 1)
    centres = sums * shares
    for where, runs in pieces:
        around = [points[where, axis] - runs.spread(centres[axis]) for axis in range(3)]
        for axis in range(3):
            for other in range(axis + 1):
                runs.add(squares[axis, other], around[axis] * around[other])
    spread = np.moveaxis(squares * shares, 2, 0)[1:]  # eigvalsh reads the lower triangles
    lengths = np.linalg.eigvalsh(spread) if len(spread) else np.zeros((0, 3))
    boxes = np.stack([low.T, high.T], axis=1)[1:].astype(np.float64)
    return ClusterFigures(sizes[1:], centres.T[1:], boxes, np.sqrt(np.maximum(lengths, 0.0)))
