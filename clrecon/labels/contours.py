"""Closed contours rasterised on slices: a voxel is inside where its centre is.

`fill_contours` has the even-odd rule, which counts the sides of all contours of a slice that a line from the centre
crosses.  `unite_contours` has the rule of CLOSED_PLANAR contours: equal ones count once, those that cross are united,
and one within another is a hole (one within that is filled again).  A centre on a side belongs to one of both
neighbours, never to both: the lower end of an interval is inside, the upper end is not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.regions import number_connected
from clrecon.system.light_dataclass import dataclass

_MOST_OVER_EACH_OTHER = 20_000
"""Most pairs of contours of one ROI that lie over each other on one slice."""

ROUNDED_MM = 0.01
"""Contours that are equal after rounding to this unit are one contour written twice."""

NOISE_MM = 0.05
"""Contours that overlap by at most this do not count as crossing, because programs round to 0.01 mm."""


_THIN_PIXELS = 0.25
"""Contours with less between them, on average along the outline, are one contour drawn twice and no hole in the other:
a ring so thin holds hardly a pixel centre."""


def fill_contours(contours: Iterable[NDArray[np.float64]], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels (nj, ni) of one slice whose centres lie inside of contours by the even-odd rule.

    contours: Corners (i, j) of each, (n, 2), in pixels, 0 at the centre of the first; the last is joined to the first.
    """
    nj, ni = shape
    inside = np.zeros(shape, dtype=bool)
    crossings = [_cross_rows(corners, nj) for corners in contours]
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(own for own, _ in crossings)])
    if not len(rows):
        return inside
    places = np.concatenate([places for _, places in crossings])
    first = np.clip(np.ceil(places), 0, ni).astype(np.int64)  # what lies at ni is beyond the slice
    top, end = int(rows.min()), int(rows.max()) + 1
    turns = np.bincount((rows - top) * (ni + 1) + first, minlength=(end - top) * (ni + 1))
    turns = turns.reshape(end - top, ni + 1)[:, :ni]
    inside[top:end] = np.cumsum(turns, axis=1) % 2
    return inside


def _cross_rows(corners: NDArray[np.float64], nj: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the rows that the sides of a contour cross, and the coordinate i of each crossing."""
    following = np.roll(corners, -1, axis=0)
    upward = corners[:, 1] <= following[:, 1]
    low = np.where(upward[:, None], corners, following)
    high = np.where(upward[:, None], following, corners)
    first = np.clip(np.ceil(low[:, 1]), 0, nj).astype(np.int64)
    end = np.clip(np.ceil(high[:, 1]), 0, nj).astype(np.int64)  # a row at the upper end belongs to the next side
    counts = end - first
    side = np.repeat(np.arange(len(corners)), counts)
    rows = np.arange(len(side)) - np.repeat(np.cumsum(counts) - counts, counts) + first[side]
    rise = high[side, 1] - low[side, 1]
    share = (rows - low[side, 1]) / rise
    return rows, low[side, 0] + share * (high[side, 0] - low[side, 0])


@dataclass(frozen=True)
class United:
    """The pixels (nj, ni) inside of a slice's contours, how many (nearly) equal another one, and pairs that cross."""

    inside: NDArray[np.bool_]
    repeated: int = 0
    crossing: int = 0


@dataclass(frozen=True)
class _Patch:
    """One contour and the pixels inside, within its box; surely and maybe so where it is moved by `NOISE_MM`."""

    box: tuple[slice, slice]
    inside: NDArray[np.bool_]
    surely: NDArray[np.bool_]
    maybe: NDArray[np.bool_]
    area: float
    outline: float

    def is_drawn_again(self, patch: _Patch) -> bool:
        """Tell whether one of two nested contours leaves next to nothing of the other."""
        return abs(self.area - patch.area) <= _THIN_PIXELS * max(self.outline, patch.outline)

    def common(self, other: _Patch) -> tuple[slice, slice]:
        """Return the part of the own pixels that lies in the box of another contour, which overlaps."""
        return tuple(  # type: ignore[return-value]
            slice(max(own.start, its.start) - own.start, min(own.stop, its.stop) - own.start)
            for own, its in zip(self.box, other.box, strict=True)
        )


def unite_contours(
    contours: Sequence[NDArray[np.float64]], shape: tuple[int, int], pixel_mm: tuple[float, float]
) -> United:
    """Return the pixels inside of the CLOSED_PLANAR contours of one slice; contours and shape as of `fill_contours`.

    Two cross if both hold some pixel centre, and each one that is beyond the other; `pixel_mm` is the spacing (di, dj).
    """
    unique = list({_canonical(corners, pixel_mm): corners for corners in contours}.values())
    repeated = len(contours) - len(unique)
    near = _find_near(unique, shape)
    patches = {n: _fill_patch(unique[n], shape, pixel_mm) for n in sorted(set(chain(*near)))}
    crossing, nested = [], []
    again = []
    for a, b in near:
        first, second = patches[a], patches[b]
        if not (first.inside[first.common(second)] & second.inside[second.common(first)]).any():
            continue
        if _goes_beyond(first, second) and _goes_beyond(second, first):
            crossing.append((a, b))
        elif first.is_drawn_again(second):
            again.append((a, b))
        else:
            nested.append((a, b) if first.area >= second.area else (b, a))
    if not crossing and not again:
        return United(fill_contours(unique, shape), repeated)
    repeated += len({max(pair) for pair in again})
    return United(_paint(unique, crossing + again, nested, shape), repeated, len(crossing))


def _paint(
    contours: Sequence[NDArray[np.float64]],
    crossing: Sequence[tuple[int, int]],
    nested: Sequence[tuple[int, int]],
    shape: tuple[int, int],
) -> NDArray[np.bool_]:
    """Fill contours from the outer to the inner ones: one within an odd number of regions, or crossing, is a hole."""
    region = number_connected(len(contours), *np.array(crossing).T).tolist()
    around: list[set[int]] = [set() for _ in contours]
    for outer, inner in nested:
        around[inner].add(region[outer])
    inside = np.zeros(shape, dtype=bool)
    for depth in range(max(map(len, around)) + 1):
        for n in (n for n, regions in enumerate(around) if len(regions) == depth):
            inside[fill_contours([contours[n]], shape)] = depth % 2 == 0
    return inside


def _canonical(corners: NDArray[np.float64], pixel_mm: tuple[float, float]) -> bytes:
    """Return bytes that are equal for equal contours, whichever their first corner and direction."""
    points = np.rint(corners * pixel_mm / ROUNDED_MM).astype(np.int64)
    points = points[np.any(points != np.roll(points, -1, axis=0), axis=1)]
    turns = []
    for direction in (points, points[::-1]):
        first = int(np.lexsort(direction.T)[0]) if len(direction) else 0
        turns.append(np.roll(direction, -first, axis=0).tobytes())
    return min(turns)


def _find_near(contours: Sequence[NDArray[np.float64]], shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the pairs of contours whose bounding boxes overlap within the slice."""
    if len(contours) < 2:
        return []
    boxes = np.array([_box_of(corners, shape) for corners in contours])
    low, high = boxes[:, 0], boxes[:, 1]
    pairs: list[tuple[int, int]] = []
    for a in range(len(contours) - 1):
        size = np.minimum(high[a], high[a + 1 :]) - np.maximum(low[a], low[a + 1 :])
        pairs += [(a, int(b) + a + 1) for b in np.flatnonzero(np.all(size > 0, axis=1))]
        if len(pairs) > _MOST_OVER_EACH_OTHER:
            raise ValueError(f"more than {_MOST_OVER_EACH_OTHER:,} pairs of contours lie over each other")
    return pairs


def _box_of(corners: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the box of a contour within the slice, (i, j) of its first pixel and of the one after its last."""
    size = shape[::-1]
    low = np.clip(np.floor(corners.min(axis=0)) - 1, 0, size)
    return np.array((low, np.clip(np.ceil(corners.max(axis=0)) + 2, low, size)), dtype=np.int64)


def _fill_patch(corners: NDArray[np.float64], shape: tuple[int, int], pixel_mm: tuple[float, float]) -> _Patch:
    low, high = _box_of(corners, shape)
    size = (int(high[1] - low[1]), int(high[0] - low[0]))
    noise = NOISE_MM / np.asarray(pixel_mm)
    moved = [fill_contours([corners - low + noise * step], size) for step in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    inside = fill_contours([corners - low], size)
    i, j = corners.T
    return _Patch(
        (slice(low[1], high[1]), slice(low[0], high[0])),
        inside,
        inside & np.all(moved, axis=0),
        inside | np.any(moved, axis=0),
        abs(float(i @ np.roll(j, -1) - j @ np.roll(i, -1))) / 2.0,
        float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).sum()),
    )


def _goes_beyond(first: _Patch, second: _Patch) -> bool:
    """True if `first` surely holds a pixel that `second` does not hold."""
    left = first.surely.copy()
    left[first.common(second)] &= ~second.maybe[second.common(first)]
    return bool(left.any())
