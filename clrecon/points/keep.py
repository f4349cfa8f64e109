"""Which clusters of a cloud are kept, and the figures that tell: size, place, extent, and sheets without thickness."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.points.cloud import PointCloud, PointStep
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks

_SHEET_POINTS = 500
"""Fewest points of a cluster that may be a sheet: fewer say little about its form."""

_SHEET_RATIO = 15.0
"""Ratio of the two smaller principal standard deviations above which a cluster is a sheet.  Table tops and headrests of
five scans have 27 and more, clusters among bone up to 5."""


PIECE = 1 << 16
"""Points that are measured at a time: the caches of a core hold what is made of them."""

_LEAST_RUN = 4
"""Points of one cluster in a row, on the average, from which they are summed run by run."""


@dataclass(frozen=True)
class ClusterFigures:
    """The clusters of a cloud, an entry of each array for each: points, centres (c, 3), boxes (c, 2, 3) in LPS mm,
    standard deviations along the principal axes (c, 3), mm, ascending.
    """

    points: NDArray[np.int64]
    centres: NDArray[np.float64]
    boxes: NDArray[np.float64]
    deviations: NDArray[np.float64]

    @property
    def sheets(self) -> NDArray[np.bool_]:
        """True for clusters without thickness: at least 500 points, second deviation over 15 times the first."""
        thin: NDArray[np.bool_] = self.deviations[:, 1] > _SHEET_RATIO * self.deviations[:, 0]
        return thin & (self.points >= _SHEET_POINTS)

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
        if _LEAST_RUN * len(self._starts) > len(labels):
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
        np.add.at(sums, self._labels, values if self._starts is None else np.add.reduceat(values, self._starts))

    def widen(self, low: NDArray[np.floating], high: NDArray[np.floating], values: NDArray[np.floating]) -> None:
        """Take values of points into the range of their clusters."""
        for extreme, ends in ((np.minimum, low), (np.maximum, high)):
            extreme.at(ends, self._labels, values if self._starts is None else extreme.reduceat(values, self._starts))

    def spread(self, figures: NDArray[np.float64]) -> NDArray[np.float64]:
        of_runs = figures.take(self._labels)
        return of_runs if self._starts is None else np.repeat(of_runs, self._lengths)


def measure_clusters(cloud: PointCloud) -> ClusterFigures:
    """Measure each cluster of a cloud with labels; noise is left out."""
    if cloud.labels is None:
        raise UsageError("the points have no labels: cluster them first")
    points = cloud.points
    pieces = [(where, _Runs(cloud.labels[where])) for where in chunks(len(cloud), PIECE)]
    entries = max((runs.clusters for _, runs in pieces), default=0) + 1
    sizes, sums = np.zeros(entries, np.int64), np.zeros((3, entries))
    squares = np.zeros((3, 3, entries))
    low, high = np.full((3, entries), np.inf, points.dtype), np.full((3, entries), -np.inf, points.dtype)
    for piece, runs in pieces:
        runs.count(sizes)
        for axis in range(3):
            column = np.ascontiguousarray(points[piece, axis])
            runs.widen(low[axis], high[axis], column)
            runs.add(sums[axis], column.astype(np.float64))
    shares = 1.0 / np.maximum(sizes, 1)
    centres = sums * shares
    for piece, runs in pieces:
        around = [points[piece, axis] - runs.spread(centres[axis]) for axis in range(3)]
        for axis in range(3):
            for second_axis in range(axis + 1):
                runs.add(squares[axis, second_axis], around[axis] * around[second_axis])
    spread = np.moveaxis(squares * shares, 2, 0)[1:]  # eigvalsh reads the lower triangles
    lengths = np.linalg.eigvalsh(spread) if len(spread) else np.zeros((0, 3))
    boxes = np.stack([low.T, high.T], axis=1)[1:].astype(np.float64)
    return ClusterFigures(sizes[1:], centres.T[1:], boxes, np.sqrt(np.maximum(lengths, 0.0)))


_KEEP_FORMS = "largest, largest:N, min:POINTS, seed:X,Y,Z and no-sheets"
"""The forms of a keep rule, for messages and help."""

REPORTED = 20
"""Clusters of a report, the largest ones."""

REASONS = ("noise", "sheet", "small cluster", "other cluster")


@dataclass(frozen=True)
class KeepRule:
    """One rule: `kind` is "largest", "min", "seed" or "no-sheets"; `numbers` are those behind the colon."""

    kind: str
    numbers: tuple[float, ...] = ()


def parse_keep_rules(rules: str | Sequence[str]) -> tuple[KeepRule, ...]:
    """Read keep rules: ``largest``, ``largest:N``, ``min:POINTS``, ``seed:X,Y,Z`` in LPS mm, ``no-sheets``."""
    return tuple(_parse_keep_rule(rule) for rule in ([rules] if isinstance(rules, str) else rules))


def _parse_keep_rule(rule: str) -> KeepRule:
    kind, _, rest = str(rule).strip().lower().partition(":")
    try:
        numbers = tuple(float(word) for word in rest.split(",")) if rest else ()
    except ValueError:
        numbers = (math.nan,)
    whole = len(numbers) == 1 and numbers[0] >= 1 and numbers[0] == math.floor(numbers[0])
    if kind == "largest" and ":" not in str(rule):
        return KeepRule(kind, (1.0,))
    if kind in ("largest", "min") and whole and math.isfinite(numbers[0]):
        return KeepRule(kind, numbers)
    if kind == "seed" and len(numbers) == 3 and all(map(math.isfinite, numbers)):
        return KeepRule(kind, numbers)
    if kind == "no-sheets" and ":" not in str(rule):
        return KeepRule(kind)
    raise UsageError(f"the keep rule {str(rule)!r} is not known: the rules are {_KEEP_FORMS}, N and POINTS from 1 on")


@explains_arguments
def keep_clusters(
    cloud: PointCloud,
    rules: str | Sequence[str] = (),
    *,
    cores: ArrayLike | None = None,
    figures: ClusterFigures | None = None,
) -> PointStep:
    """Keep some clusters of a cloud; noise goes, and without a rule nothing else does.

    Sheets go first, then small clusters; the largest are counted among what is left.  A seed keeps its cluster alone,
    several seeds theirs, and may not be used with ``largest``.

    Parameters
    ----------
    cloud : PointCloud
        With labels, see `cluster_points`.
    rules : str or sequence of str
        ``largest``: the cluster of most points, ties by number; ``largest:N``: the N largest.  ``min:POINTS``: clusters
        of at least so many points.  ``seed:X,Y,Z``: the cluster of the core point nearest to a place in LPS mm.
        ``no-sheets``: no cluster of 500 points or more whose second principal standard deviation is over 15 times its
        first: table tops, image planes.
    cores : array_like, shape (n,), bool, optional
        Core points, see ``Clustering.cores``; without them a seed takes the nearest point of any cluster.
    figures : ClusterFigures, optional
        The figures of the clusters of this cloud, see ``Clustering.figures``; default: they are measured.

    Returns
    -------
    PointStep
        Reasons "noise", "sheet", "small cluster", "other cluster".  ``facts`` has the figures of the largest clusters,
        those of all sheets, and how far the seeds are from their points.

    Raises
    ------
    UsageError
        The cloud has no labels, a rule has another form, or ``cores`` do not fit.
    NoSurfaceError
        No cluster is left.
    """
    wanted = parse_keep_rules(rules)
    figures = measure_clusters(cloud) if figures is None or cloud.labels is None else figures
    labels = np.asarray(cloud.labels)
    if labels.max(initial=-1) >= len(figures.points):
        raise UsageError(f"the figures are of {len(figures.points):,} clusters, the cloud has others: leave them out")
    fate, facts = _judge_clusters(cloud, figures, wanted, cores)
    removed = np.append(np.uint8(1), fate).take(np.maximum(labels, -1) + 1)  # the first one is that of noise
    is_kept = removed == 0
    if not is_kept.any():
        raise NoSurfaceError(_describe_nothing(labels, figures, fate))
    facts = {
        "keep": [_as_text(rule) for rule in wanted],
        "clusters_before": len(figures.points),
        "clusters_after": int((fate == 0).sum()),
        "sheets": int(figures.sheets.sum()),
        "clusters": figures.as_dicts(REPORTED),
        **facts,
    }
    warnings = _warn_of_seeds(cloud, wanted, facts)
    return PointStep(cloud if is_kept.all() else cloud.select(is_kept), removed, REASONS, facts, warnings)


def _warn_of_seeds(cloud: PointCloud, rules: tuple[KeepRule, ...], facts: Mapping[str, object]) -> tuple[str, ...]:
    """Name seeds outside of the box of all points: of another frame or unit, most likely."""
    seeds = [rule for rule in rules if rule.kind == "seed"]
    if not seeds:
        return ()
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    far = facts.get("seed_distances_mm")
    return tuple(
        f"{_as_text(seed)} (mm LPS) lies outside of the box of the points, {distance:,.1f} mm from the nearest one in a"
        " cluster, which was kept"
        for seed, distance in zip(seeds, far if isinstance(far, list) else [], strict=True)
        if not (np.all(low <= seed.numbers) and np.all(seed.numbers <= high))
    )


def _as_text(rule: KeepRule) -> str:
    return rule.kind + (":" + ",".join(f"{number:g}" for number in rule.numbers) if rule.numbers else "")


def _judge_clusters(
    cloud: PointCloud, figures: ClusterFigures, rules: tuple[KeepRule, ...], cores: ArrayLike | None
) -> tuple[NDArray[np.uint8], dict[str, object]]:
    """Return for each cluster 0 or the number of the reason why it goes, and the facts about seeds."""
    fate = np.zeros(len(figures.points), dtype=np.uint8)
    kinds = [rule.kind for rule in rules]
    if "seed" in kinds and "largest" in kinds:
        raise UsageError("seeds say which clusters stay: the largest cannot be asked for too")
    if "no-sheets" in kinds:
        fate[figures.sheets] = 2
    for rule in rules:
        if rule.kind == "min":
            fate[(fate == 0) & (figures.points < rule.numbers[0])] = 3
    for rule in rules:
        if rule.kind == "largest":
            order = figures.order()
            fate[order[fate[order] == 0][int(rule.numbers[0]) :]] = 4
    seeds = [rule.numbers for rule in rules if rule.kind == "seed"]
    if not seeds:
        return fate, {}
    seeded = [_find_cluster(cloud, seed, cores) for seed in seeds]
    others = np.ones(len(fate), dtype=bool)
    others[[cluster for cluster, _ in seeded]] = False
    fate[others & (fate == 0)] = 4
    return fate, {"seed_distances_mm": [round(distance, 3) for _, distance in seeded]}


def _find_cluster(cloud: PointCloud, seed: tuple[float, ...], cores: ArrayLike | None) -> tuple[int, float]:
    labels = np.asarray(cloud.labels)
    allowed = labels >= 0
    if cores is not None:
        given = np.asarray(cores)
        if given.shape != labels.shape or given.dtype != bool:
            raise UsageError(
                f"cores are a truth value for each of {len(labels):,} points, not {given.shape} {given.dtype}"
            )
        allowed &= given
    if not allowed.any():
        raise NoSurfaceError("no point lies in a cluster: all are noise")
    away = ((cloud.points - np.asarray(seed)) ** 2).sum(axis=1)
    nearest = int(np.where(allowed, away, np.inf).argmin())
    return int(labels[nearest]), float(np.sqrt(away[nearest]))


def _describe_nothing(labels: NDArray[np.int32], figures: ClusterFigures, fate: NDArray[np.uint8]) -> str:
    if not len(figures.points):
        return (
            f"no cluster is left: all of {len(labels):,} points are noise, as none has enough others near it; take a"
            f" larger {name_parameter('eps')} or a smaller {name_parameter('min_samples')}"
        )
    largest = int(figures.points.max(initial=0))
    return (
        f"no cluster is left of {len(figures.points):,}: {int((labels < 0).sum()):,} of {len(labels):,} points are"
        f" noise, {int((fate == 2).sum()):,} clusters are sheets, {int((fate == 3).sum()):,} are too small, the largest"
        f" has {largest:,} points; sheets have at least {_SHEET_POINTS} points and a ratio over {_SHEET_RATIO:g}"
    )
