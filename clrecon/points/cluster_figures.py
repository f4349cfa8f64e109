"""Figures of the clusters of a cloud: size, place, extent, and which of them are sheets without thickness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.points.cloud import PointCloud

__all__ = ["SHEET_POINTS", "SHEET_RATIO", "ClusterFigures", "measure_clusters"]

SHEET_POINTS = 500
"""Fewest points of a cluster that may be a sheet: fewer say little about its form."""

SHEET_RATIO = 15.0
"""Ratio of the two smaller principal standard deviations above which a cluster is a sheet.  Table tops and headrests of
five scans have 27 and more, clusters among bone up to 5."""


LEAST_RUN = 4
"""Points of one cluster in a row, on the average, from which they are summed run by run."""


@dataclass(frozen=True)
class ClusterFigures:
    """The clusters of a cloud, an entry of each array for each.

    Attributes
    ----------
    points : ndarray, shape (c,), int64
        Number of points.
    centres : ndarray, shape (c, 3), float64
        Mean of the points, LPS mm.
    boxes : ndarray, shape (c, 2, 3), float64
        Lowest and highest coordinates, LPS mm.
    deviations : ndarray, shape (c, 3), float64
        Standard deviations along the principal axes, mm, ascending.
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


class _Groups:
    """The points by cluster.  Neighbours in the order of a cloud mostly are of one cluster: runs of them come first."""

    def __init__(self, labels: NDArray[np.int32]):
        begins = np.ones(len(labels), bool)
        np.not_equal(labels[1:], labels[:-1], out=begins[1:])
        self._starts: NDArray[np.intp] | None = np.flatnonzero(begins)
        if LEAST_RUN * len(self._starts) > len(labels):
            self._starts = None  # a run is a point
            lengths = None
        else:
            self._lengths = np.diff(self._starts, append=len(labels))
            lengths, labels = self._lengths, labels[self._starts]
        self._labels = np.maximum(labels, -1).astype(np.intp)
        self._labels += 1  # 0 is noise
        self.count = int(self._labels.max(initial=0))
        self.sizes: NDArray[np.int64] = np.bincount(self._labels, lengths, self.count + 1)[1:].astype(np.int64)

    def sums(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum of the values of each cluster."""
        runs = values if self._starts is None else np.add.reduceat(values, self._starts)
        return np.bincount(self._labels, runs, self.count + 1)[1:].astype(np.float64, copy=False)

    def ends(self, values: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return the lowest and the highest value of each cluster; infinite without points."""
        ends = []
        for extreme, none in ((np.minimum, np.inf), (np.maximum, -np.inf)):
            found = np.full(self.count + 1, none, values.dtype)
            extreme.at(found, self._labels, values if self._starts is None else extreme.reduceat(values, self._starts))
            ends.append(found[1:])
        return ends[0], ends[1]

    def spread(self, figures: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the figure of its cluster for each point; 0 for noise."""
        of_runs = np.append(0.0, figures).take(self._labels)
        return of_runs if self._starts is None else np.repeat(of_runs, self._lengths)


def measure_clusters(cloud: PointCloud) -> ClusterFigures:
    """Measure each cluster of a cloud with labels; noise is left out.

    Raises
    ------
    UsageError
        The cloud has no labels.
    """
    if cloud.labels is None:
        raise UsageError("the points have no labels: cluster them first")
    groups = _Groups(cloud.labels)
    count, sizes = groups.count, groups.sizes
    boxes, centres, spread = np.empty((count, 2, 3)), np.empty((count, 3)), np.zeros((count, 3, 3))
    shares = 1.0 / np.maximum(sizes, 1)
    around: list[NDArray[np.float64]] = []
    for axis in range(3):
        own = np.ascontiguousarray(cloud.points[:, axis])
        boxes[:, 0, axis], boxes[:, 1, axis] = groups.ends(own)
        values = own.astype(np.float64)
        centres[:, axis] = groups.sums(values) * shares
        around.append(values - groups.spread(centres[:, axis]))
        for other in range(axis + 1):
            spread[:, axis, other] = groups.sums(around[axis] * around[other]) * shares
    lengths = np.linalg.eigvalsh(spread) if count else np.zeros((0, 3))  # reads the lower triangles
    return ClusterFigures(sizes, centres, boxes, np.sqrt(np.maximum(lengths, 0.0)))
