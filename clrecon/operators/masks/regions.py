"""Rows of voxels in a box or a tube: where each row of a volume enters and leaves it, in mm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array, checked_points
from clrecon.points.stencil import SLACK
from clrecon.system.light_dataclass import dataclass

Ends = tuple[Float64Array, Float64Array]

BOX_SLACK_MM = 1e-6
"""Voxels this far beyond the sides of a box still count as inside, so that a box that ends at voxels contains them."""


@dataclass(frozen=True)
class RowSpans:
    """Spans of voxels in rows of a volume: first and last column, (n, 2) uint16, and the first span of each row k nj +
    j, and n, (nj nk + 1,) uint32.
    """

    columns: NDArray[np.uint16]
    row_counts: NDArray[np.uint32]

    @classmethod
    def of(cls, volume: Volume, rows: NDArray[np.int64], first: Float64Array, last: Float64Array) -> RowSpans:
        """Round spans to voxels within, cut them at the ends of the rows and sort them by row."""
        ni, nj, nk = volume.shape_ijk
        low = np.ceil(np.clip(first, 0, ni)).astype(np.int64)
        high = np.floor(np.clip(last, -1, ni - 1)).astype(np.int64)
        some = np.flatnonzero(low <= high)
        some = some[np.argsort(rows[some], kind="stable")]
        counts = np.bincount(rows[some], minlength=nj * nk)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
        return cls(np.stack([low[some], high[some]], axis=1).astype(np.uint16), starts)


def checked_mm(mm: float, subject: str) -> float:
    if isinstance(mm, bool) or not isinstance(mm, (int, float, np.number)) or not 0.0 < float(mm) < np.inf:
        raise UsageError(f"{subject} is {mm!r}: a number of mm above 0 is needed")
    return float(mm)


def checked_box(box: Sequence[float | None] | ArrayLike) -> Float64Array:
    """Return the sides of a box, shape (3, 2), open ones infinite."""
    try:
        sides = np.array([np.nan if side is None else side for side in box], dtype=np.float64)  # type: ignore[union-attr]
        low, high = sides.reshape(3, 2).T
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"a box is six numbers of mm, X0,X1,Y0,Y1,Z0,Z1, open sides None, not {box!r}") from None
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    for axis, first, last in zip("xyz", low, high, strict=True):
        if not first <= last:
            raise UsageError(f"the box runs from {first:g} to {last:g} mm in {axis}: the lower number comes first")
    return np.stack([low, high], axis=1)


def box_spans(volume: Volume, sides: Float64Array) -> RowSpans:
    """Find the voxels whose centres lie in a box of `sides`, (3, 2), LPS mm; see `checked_box` and `BOX_SLACK_MM`."""
    _, nj, nk = volume.shape_ijk
    starts = volume.slice_origins()[:, None, :] + np.arange(nj)[:, None] * volume.affine[:3, 1]
    starts = starts.reshape(-1, 3)
    first, last = np.full(len(starts), -np.inf), np.full(len(starts), np.inf)
    for axis, (low, high) in enumerate(sides):
        step = volume.affine[axis, 0]
        ends = _between(starts[:, axis], step, low - BOX_SLACK_MM, high + BOX_SLACK_MM)
        first, last = np.maximum(first, ends[0]), np.minimum(last, ends[1])
    return RowSpans.of(volume, np.arange(nj * nk), first, last)


def tube_spans(volume: Volume, points: ArrayLike, radius_mm: float) -> RowSpans:
    """Find the voxels whose centres lie within ``radius_mm * (1 + 1e-6)`` of a line through points, LPS mm."""
    line = checked_points(points)
    if not len(line) or not np.isfinite(line).all():
        raise UsageError(f"the line of a tube needs points that are numbers, these are {len(line)} points")
    radius = checked_mm(radius_mm, "the radius of the tube") * (1.0 + SLACK)
    ends = list(zip(line[:-1], line[1:], strict=True)) or [(line[0], line[0])]
    parts = [
        _capsule(volume, begin, end, radius, j, k) for begin, end in ends for j, k in _rows(volume, begin, end, radius)
    ]
    if not parts:
        return RowSpans.of(volume, np.empty(0, np.int64), np.empty(0), np.empty(0))
    rows, first, last = (np.concatenate(part) for part in zip(*parts, strict=True))
    return RowSpans.of(volume, rows, first, last)


def _between(start: Float64Array, step: float, low: float, high: float) -> Ends:
    """Return between which i ``start + i step`` is from `low` to `high`; infinity to -infinity where it never is."""
    if abs(step) < 1e-12:
        never = (start < low) | (start > high)
        return np.where(never, np.inf, -np.inf), np.where(never, -np.inf, np.inf)
    to_low, to_high = (low - start) / step, (high - start) / step
    return np.minimum(to_low, to_high), np.maximum(to_low, to_high)


def _rows(
    volume: Volume, begin: Float64Array, end: Float64Array, radius: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield j and k of the rows near a piece of a line."""
    _, nj, _ = volume.shape_ijk
    origins, normal = volume.slice_origins(), slice_normal(volume.affine)
    both = np.stack([begin, end])
    heights = origins @ normal
    low, high = (both @ normal).min() - radius, (both @ normal).max() + radius
    k = np.flatnonzero((heights >= low) & (heights <= high))
    if not len(k):
        return
    inverse = np.linalg.pinv(volume.affine[:3, :2])
    places = (both[None] - origins[k][:, None]) @ inverse[1]
    spread = radius * float(np.sqrt((inverse[1] ** 2).sum())) + 1.0
    j = np.arange(max(0, int(places.min() - spread)), min(nj - 1, int(places.max() + spread) + 1) + 1)
    if len(j):
        yield np.tile(j, len(k)), np.repeat(k, len(j))


def _capsule(
    volume: Volume, begin: Float64Array, end: Float64Array, radius: float, j: NDArray[np.int64], k: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Float64Array, Float64Array]:
    """Return rows, and where each enters and leaves the points within `radius` of a piece of a line, convex."""
    nj = volume.shape_ijk[1]
    starts = volume.slice_origins()[k] + j[:, None] * volume.affine[:3, 1]
    step = volume.affine[:3, 0]
    spans = [_within(starts - centre, step, radius) for centre in (begin, end)]
    length = float(np.linalg.norm(end - begin))
    if length > 0.0:
        along = (end - begin) / length
        away = starts - begin
        height, climb = away @ along, float(step @ along)
        side = _within(away - height[:, None] * along, step - climb * along, radius)
        between = _between(height, climb, 0.0, length)
        spans.append((np.maximum(side[0], between[0]), np.minimum(side[1], between[1])))
    ends = [(np.where(a <= b, a, np.inf), np.where(a <= b, b, -np.inf)) for a, b in spans]
    first = np.minimum.reduce([a for a, _ in ends])
    return k * nj + j, first, np.maximum.reduce([b for _, b in ends])


def _within(away: Float64Array, step: Float64Array, radius: float) -> Ends:
    """Return between which numbers i ``away + i step`` is not longer than `radius`."""
    square = float(step @ step)
    if square < 1e-24:
        never = (away**2).sum(axis=1) > radius**2
        return np.where(never, np.inf, -np.inf), np.where(never, -np.inf, np.inf)
    middle = -(away @ step) / square
    rest = (radius**2 - ((away + middle[:, None] * step) ** 2).sum(axis=1)) / square
    half = np.sqrt(np.maximum(rest, 0.0))
    return np.where(rest < 0.0, np.inf, middle - half), np.where(rest < 0.0, -np.inf, middle + half)
