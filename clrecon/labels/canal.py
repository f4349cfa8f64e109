"""The spinal canal of one vertebra: the hole of its arch slice by slice, joined, and cut at the pedicles' height."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.regions import FACES, IN_SLICE, Regions, find_holes
from clrecon.system.light_dataclass import dataclass

Bits = NDArray[np.bool_]

LEAST_HOLE_MM2 = 60.0
"""Smaller holes in an arch are gaps of a mask, not a canal; canals of adults have at least 150 mm2."""

MOST_TOGETHER_MM = 12.0
"""Slices that together close the arch lie within this height, the height of a pedicle: the lamina is lower than the
pedicles, and in tilted or coarse slices no single slice shows a closed ring."""

BEYOND_MM = 6.0
"""A hole is a canal if it is open over this distance above and below."""

_MOST_BLOCKED = 0.5
"""Share of a hole's outline that bone may cover there.  The wall of a canal that is tilted by 30 degrees covers a
quarter, the bone below a hollow endplate nearly all."""

STEEPEST = 1.0
"""Largest shift of the canal from slice to slice, mm per mm: 45 degrees."""

SPREAD_MM = 4.0
"""The canal extends at most this far beyond its outline in the nearest closed slice; the rest are gaps of a mask."""

ROUNDS = 3
"""Times that the direction of the canal is found with the wall that follows from the one before."""


@dataclass(frozen=True)
class Canal:
    """The canal of one vertebra, as high as the pedicles.

    closed_slices: Slices in which the arch is closed, alone or together with its neighbours.
    together: Slices that close the arch together; 1 where single ones do.
    """

    voxels: Bits
    closed_slices: int
    together: int
    height_mm: float


def find_canal(solid: Bits, volume: Volume) -> Canal | None:
    """Find the canal beside the solid bone of a vertebra (nk, nj, ni), its holes filled; None where no arch is closed.

    In each slice, axial within 45 degrees, the largest hole of the arch is looked for that is open above and below;
    where no slice has one, in so many neighbouring slices together as it takes.  In slices above and below it the
    pedicles still join the body with the arch, but there is a gap behind: with a wall across the middle of the canal
    its front half is closed there too.  These slices are the pedicles' height.  In them the back half goes on from the
    nearest closed slice, in the direction of the canal.
    """
    places = _Places(volume)
    main, together = _join_holes(solid, places)
    if main is None:
        return None
    closed = np.flatnonzero(main.any(axis=(1, 2)))
    front, slope, wall = _find_front(solid, main, places)
    canal, ends = main.copy(), places.ends
    for k in np.flatnonzero(front.any(axis=(1, 2))):
        near = int(closed[np.argmin(np.abs(closed - k))])
        section = places.shift(main[near], near, int(k), slope)
        canal[k] |= front[k] & places.spread(section, SPREAD_MM)
        canal[k] |= section & wall[k] & ~solid[k]
    slices = np.flatnonzero(canal.any(axis=(1, 2)))
    return Canal(canal, len(closed), together, float((ends[1:] - ends[:-1])[slices].sum()))


class _Places:
    """Where the voxels of axial slices are: x and y in the patient, and heights along the normal, mm."""

    def __init__(self, volume: Volume):
        ni, nj, _ = volume.shape_ijk
        normal = slice_normal(volume.affine)
        self.origins = volume.slice_origins()
        beyond = np.abs(volume.slice_origins(1) @ normal - self.origins[0] @ normal)
        beyond[0] *= -1.0
        self.heights: Float64Array = beyond[1:-1]
        self.ends: Float64Array = (beyond[1:] + beyond[:-1]) / 2.0
        self.plane = volume.affine[:2, :2]
        self.area = float(np.linalg.norm(np.cross(volume.affine[:3, 0], volume.affine[:3, 1])))
        i, j = np.arange(ni)[None, :], np.arange(nj)[:, None]
        self._x, self._y = (row[0] * i + row[1] * j for row in self.plane)

    def x(self, k: int) -> Float64Array:
        return np.asarray(self._x + self.origins[k, 0])

    def y(self, k: int) -> Float64Array:
        return np.asarray(self._y + self.origins[k, 1])

    def mean_y(self, voxels: Bits) -> float:
        k, j, i = np.nonzero(voxels)
        return float(np.mean(self._y[j, i] + self.origins[k, 1]))

    def spread(self, section: Bits, mm: float) -> Bits:
        """Return a section and what lies within a distance of it."""
        from scipy.ndimage import distance_transform_edt

        if not section.any():
            return section
        steps = np.linalg.norm(self.plane, axis=0)
        return np.asarray(distance_transform_edt(~section, sampling=(steps[1], steps[0])) <= mm)

    def shift(self, section: Bits, source: int, target: int, slope: Float64Array) -> Bits:
        """Return a section of slice `source` where the canal's direction leads in slice `target`."""
        away = slope * (self.heights[target] - self.heights[source])
        away -= (self.origins[target] - self.origins[source])[:2]
        di, dj = np.rint(np.linalg.solve(self.plane, away)).astype(int)
        j, i = np.nonzero(section)
        nj, ni = section.shape
        is_inside = (j + dj >= 0) & (j + dj < nj) & (i + di >= 0) & (i + di < ni)
        shifted = np.zeros_like(section)
        shifted[j[is_inside] + dj, i[is_inside] + di] = True
        return shifted


def _join_holes(solid: Bits, places: _Places) -> tuple[Bits | None, int]:
    """Return the largest hole, joined over the slices, and how many slices close it together; None without one."""
    nk = len(solid)
    for together in range(1, nk + 1):
        if together > 1 and places.ends[together] - places.ends[0] > MOST_TOGETHER_MM:
            break
        joined = np.stack([solid[k : k + together].any(axis=0) for k in range(nk - together + 1)])
        parts = Regions(find_holes(joined), IN_SLICE)
        holes = parts.cells_of(parts.sizes >= LEAST_HOLE_MM2 / places.area)
        if holes.any():
            spread = np.zeros_like(solid)
            for k, hole in enumerate(holes):
                spread[k : k + together] |= hole
            hole = _largest_open(spread, solid, places)
            if hole is not None:
                return hole, together
    return None, 0


def _largest_open(holes: Bits, solid: Bits, places: _Places) -> Bits | None:
    """Return the largest hole, joined over the slices, that goes on above and below; None without one.

    A hollow endplate is a ring in the slices through its rim, but bone lies on one side of its hole.  Gaps of a mask in
    the body lie in front of the middle of all bone, the canal behind it.
    """
    components = Regions(holes, FACES)
    middle = places.mean_y(solid)
    for number in np.argsort(-components.sizes[1:], kind="stable") + 1:
        hole = components.cells_of(np.arange(components.count + 1) == number)
        if places.mean_y(hole) <= middle:
            continue
        section = hole.any(axis=0)
        first, last = components.boxes[number, 0]
        away = places.heights - places.heights[[first, last]][:, None]
        above = (away[1] > 0.0) & (away[1] <= max(BEYOND_MM, away[1, min(last + 1, len(solid) - 1)]))
        below = (away[0] < 0.0) & (away[0] >= min(-BEYOND_MM, away[0, max(first - 1, 0)]))
        if all(solid[side].any(axis=0)[section].mean() < _MOST_BLOCKED for side in (above, below)):
            return np.asarray(hole)
    return None


def _find_front(solid: Bits, main: Bits, places: _Places) -> tuple[Bits, Float64Array, Bits]:
    """Return the canal's front half in the pedicles' slices, its shift in x and y per mm of height, the wall behind."""
    middle = float(np.mean(places.heights[np.nonzero(main)[0]]))
    behind = places.mean_y(main)
    slope = np.zeros(2)
    front, wall = np.zeros_like(solid), np.zeros_like(solid)
    for _ in range(ROUNDS):
        limits = behind + slope[1] * (places.heights - middle)
        wall = np.stack([places.y(n) >= limit for n, limit in enumerate(limits)])
        blocked = solid | wall
        components = Regions(find_holes(blocked), FACES)
        sizes = components.sum_of(main)
        front = components.cells_of((sizes > 0) & (np.arange(len(sizes)) == np.argmax(sizes)))
        rows = np.flatnonzero(front.any(axis=(1, 2)))
        if len(rows) < 3:
            break
        middles = np.array([_front_of(front[n], places.x(int(n)), places.y(int(n))) for n in rows])
        # the median of the slopes between all pairs (Theil and Sen): slices with gaps beside the canal are few
        i, j = np.triu_indices(len(rows), 1)
        slopes = (middles[j] - middles[i]) / (places.heights[rows[j]] - places.heights[rows[i]])[:, None]
        slope = np.clip(np.median(slopes, axis=0), -STEEPEST, STEEPEST)
    return front, slope, wall


def _front_of(section: Bits, x: Float64Array, y: Float64Array) -> tuple[float, float]:
    """Return the middle of a section from side to side, and its front: the median over columns of their lowest y."""
    lowest = np.where(section, y, np.inf).min(axis=0)[section.any(axis=0)]
    return float(x[section].min() + x[section].max()) / 2.0, float(np.median(lowest))
