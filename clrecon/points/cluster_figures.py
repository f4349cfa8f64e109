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


def measure_clusters(cloud: PointCloud) -> ClusterFigures:
    """Measure each cluster of a cloud with labels; noise is left out.

    Raises
    ------
    UsageError
        The cloud has no labels.
    """
    if cloud.labels is None:
        raise UsageError("the points have no labels: cluster them first")
    labels, points = cloud.labels.astype(np.intp), cloud.points
    kept: NDArray[np.intp] | None = None
    if labels.size and labels.min() < 0:
        kept = np.flatnonzero(labels >= 0)
        labels = labels[kept]
    count = int(labels.max(initial=-1)) + 1
    sizes = np.bincount(labels, minlength=count)
    boxes = np.stack([np.full((count, 3), np.inf), np.full((count, 3), -np.inf)], axis=1)
    centres, spread = np.zeros((count, 3)), np.zeros((count, 3, 3))
    shares = 1.0 / np.maximum(sizes, 1)
    around: list[NDArray[np.float64]] = []
    for axis in range(3):
        own = np.ascontiguousarray(points[:, axis] if kept is None else points[:, axis][kept])
        low, high = np.full(count, np.inf, own.dtype), np.full(count, -np.inf, own.dtype)
        np.minimum.at(low, labels, own)
        np.maximum.at(high, labels, own)
        boxes[:, 0, axis], boxes[:, 1, axis] = low, high
        values = own.astype(np.float64)
        centres[:, axis] = np.bincount(labels, values, count) * shares
        around.append(values - centres[labels, axis])
        for other in range(axis + 1):
            spread[:, axis, other] = np.bincount(labels, around[axis] * around[other], count) * shares
    lengths = np.linalg.eigvalsh(spread) if count else np.zeros((0, 3))  # reads the lower triangles
    return ClusterFigures(sizes, centres, boxes, np.sqrt(np.maximum(lengths, 0.0)))
