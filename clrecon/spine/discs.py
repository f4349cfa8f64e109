"""The course of the spine, and the discs between vertebral bodies, found together in the scan along the canal.

A disc is a plane that is darker than those on either side.  Planes of all tilts are tried, as the discs of the loin
stand askew to the canal; dynamic programming chooses those that agree best as a row, 15 to 46 mm apart.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads

Field = NDArray[np.float32]

STEP_MM = 1.0
BEYOND_MM = 40.0
"""The canal is followed this far beyond the ends of its line: the vertebrae at the ends reach further than it."""
_BEND_MM = 30.0
"""Length over which directions are averaged; two vertebrae bend against each other over this much."""
AHEAD_MM = np.arange(0.0, 57.0)
"""Places of a row of the straightened scan in front of the canal, mm."""
ASIDE_MM = np.arange(-42.0, 43.0)
"""Places to the patient's left of the canal, mm."""


@dataclass(frozen=True)
class Course:
    """Places along the spinal canal, 1 mm apart, from the head downwards: arrays (n, 3) in LPS mm and of unit vectors.

    known: ndarray, shape (n,), bool. False where the line of the canal was only continued.
    reaches: True where the first, and the last, place is the border of the scan.
    """

    canal: Float64Array
    down: Float64Array
    ahead: Float64Array
    aside: Float64Array
    known: NDArray[np.bool_]
    reaches: tuple[bool, bool]

    def __len__(self) -> int:
        return len(self.canal)

    def nearest(self, point: Float64Array) -> int:
        """Return the place whose plane across the canal is nearest to a point in LPS mm."""
        return int(np.linalg.norm(self.canal + 20.0 * self.ahead - point, axis=1).argmin())


def follow_canal(points: Float64Array, volume: Grid) -> Course:
    """Follow the canal's middle (m, 3), LPS mm from the head downwards, and beyond its ends as far as the scan goes."""
    from scipy.interpolate import PchipInterpolator
    from scipy.ndimage import gaussian_filter1d

    arcs = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    stations = np.arange(0.0, arcs[-1] + 1e-6, STEP_MM)
    line = np.stack([np.interp(stations, arcs, axis) for axis in points.T], axis=1)
    if len(points) > 2:
        line = PchipInterpolator(arcs, points, axis=0)(stations)
    sigma = min(_BEND_MM, arcs[-1]) / 3.0
    beyond = int(BEYOND_MM / STEP_MM)
    # Beyond its ends the line goes on in the direction of its last centimetres.
    reach = min(len(line) - 1, int(20.0 / STEP_MM))
    first, last = ((line[0] - line[reach]) / reach, (line[-1] - line[-1 - reach]) / reach)
    steps = np.arange(1, beyond + 1)[:, None]
    line = np.concatenate([line[0] + steps[::-1] * first, line, line[-1] + steps * last])
    known = np.zeros(len(line), bool)
    known[beyond : len(line) - beyond] = True
    line = gaussian_filter1d(line, 8.0, axis=0, mode="nearest") if len(line) > 40 else line
    down = gaussian_filter1d(np.gradient(line, axis=0), max(sigma, 1.0), axis=0, mode="nearest")
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    ahead = np.array([0.0, -1.0, 0.0]) - down * -down[:, 1:2]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    ijk = volume.lps_to_ijk(line)
    inside = np.asarray(((ijk >= -0.5) & (ijk <= np.array(volume.shape_ijk) - 0.5)).all(axis=1))
    begin, end = int(inside.argmax()), len(inside) - int(inside[::-1].argmax())
    part = slice(begin, end)
    reaches = (begin > 0, end < len(inside))
    return Course(line[part], down[part], ahead[part], np.cross(down, ahead)[part], known[part], reaches)


def sample_course(
    grid: Grid, course: Course, ahead_mm: Float64Array = AHEAD_MM, aside_mm: Float64Array = ASIDE_MM, order: int = 1
) -> Field:
    """Return a scan, or labels by order 0 (nearest), in planes across the canal (places, ahead, aside); NaN beyond."""
    from scipy.ndimage import map_coordinates

    offsets = ahead_mm[:, None, None], aside_mm[None, :, None]
    sampled = np.empty((len(course), len(ahead_mm), len(aside_mm)), np.float32)
    size = np.array(grid.shape_ijk)

    def sample(n: int) -> None:
        plane = course.canal[n] + offsets[0] * course.ahead[n] + offsets[1] * course.aside[n]
        ijk = grid.lps_to_ijk(plane.reshape(-1, 3))
        inside = ((ijk >= -0.5) & (ijk <= size - 0.5)).all(axis=1)
        low, high = np.maximum(np.floor(ijk.min(axis=0)).astype(int) - 1, 0), np.ceil(ijk.max(axis=0)).astype(int) + 2
        if not inside.any():
            sampled[n] = np.nan
            return
        part = grid.voxels[low[2] : high[2], low[1] : high[1], low[0] : high[0]].astype(np.float32)
        values = map_coordinates(part, (ijk - low).T[::-1], order=order, mode="nearest")
        sampled[n] = np.where(inside, values, np.nan).reshape(sampled[n].shape)

    def sample_places(piece: slice) -> None:
        for n in range(piece.start, piece.stop):
            sample(n)

    in_threads(sample_places, len(course), 16)
    return sampled


_GAPS_MM = (11, 46)
"""Least and largest distance of two discs."""
_END_SHARES = (0.6, 1.5)
"""Where the bone beyond the last disc may end, in gaps."""
TILTS_DEG = np.arange(-40.0, 41.0, 5.0)
_TILT_COST = 0.1
"""What a tilt of 30 degrees costs, as a share of a usual disc: of planes that look alike the one across is taken."""
_BACK_WALL_MM = 8.0
"""The back wall of a body lies so far in front of the middle of the canal."""
_DEPTH_COST = 1.5
"""Cost of the square of the logarithm of a gap's ratio to the depth of the body."""
BODY_BACK_MM = 10.0
"""Planes are looked at from here on in front of the canal: behind it lies the back wall of the body."""
CORE_ASIDE_MM = 7.0
_WALL_SHARE = 0.2
"""Share of the side walls in a plane's brightness; the rest is the median of its middle: spurs bridge a disc's rim."""
WALL_MARGIN_MM = 3.0
"""The walls of a body are looked for from the core to so far beyond its sides: heads of ribs lie farther out."""
_HALF_THICKNESS_MM = (1, 2, 3, 4, 6)
"""Half thicknesses of discs that are tried, from the middle to the end plates."""
_MOST_HALF_THICKNESS = 0.2
"""Largest half thickness of a disc, as a share of the depth of the body in front of it.  Discs of adults are 3 to 5 mm
high in neck and upper chest and 9 to 12 in the loin, bodies 15 to 17 and 33 to 35 mm deep (Panjabi et al., Spine 16 and
17, 1991 and 1992; Gilad and Nissan, Spine 11, 1986); a body between its two plates is three times as high."""
_PLATE_MM = 2
"""An end plate lies within so many planes beside a disc."""
BONE_HU, FAT_HU = 100.0, 0.0
"""The planes on both sides of a disc have at least the first, the disc itself at least the second."""
SOFT_HU = 40.0
"""HU of muscle and vessels beside a body."""
_LEAST_USUAL, REACH_MM = 0.4, 30
"""Where no disc within the second, mm, is as deep as a usual one, shallower ones are; the first is the least share."""
WORTH = 0.3
"""Depth of a disc that counts neither for nor against it, as a share of a usual one."""
_UNLIKE_COST = 2.0
"""Cost of the square of the logarithm of the ratio of neighbouring gaps."""


@dataclass(frozen=True)
class Looks:
    """The scan along the canal, as far as discs show in it: (places, tilts or columns ahead), HU, and walls, mm.

    brightness: Of the plane at each place and tilt: core and side walls.
    core: Of the middle of each plane, from side to side.
    depth: How much darker the plane is than those beside it, on the side where it is less so.
    middle_mm, front_mm, side_mm: Of the body in front of the canal.
    """

    brightness: Field
    core: Field
    depth: Field
    middle_mm: NDArray[np.float64]
    front_mm: NDArray[np.float64]
    side_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Bound:
    """A plane at which a vertebra begins or ends, `depth_hu` darker than beside it; no disc if just the bone ends."""

    at: int
    tilt: int
    depth_hu: float
    is_disc: bool = True


def _edge(image: Field, first: int, least: int, most: int) -> NDArray[np.float64]:
    """Return the column in `least` to `most` where the bodies' brightness falls by half; `first` is within them all."""
    from scipy.ndimage import gaussian_filter1d

    known = np.isfinite(image)
    total = gaussian_filter1d(np.where(known, np.clip(image, -200, 800), 0.0), 20.0, axis=0, mode="nearest")
    share = gaussian_filter1d(known.astype(np.float32), 20.0, axis=0, mode="nearest")
    smooth = total / np.maximum(share, 1e-3)
    inside = smooth[:, first:least].mean(axis=1, keepdims=True)
    dark = smooth[:, least:] < 0.5 * (inside + SOFT_HU)
    edge = np.where(dark.any(axis=1), dark.argmax(axis=1), dark.shape[1]) + least
    return np.asarray(gaussian_filter1d(np.clip(edge, least, most).astype(np.float64), 15.0, mode="nearest"))


def look_at_bodies(scan: Field) -> Looks:
    """Measure at each place and tilt of a scan by `sample_course` how much a plane looks like a disc."""
    clipped = np.clip(scan, -200.0, 900.0)
    core = _mean(clipped[:, :, np.abs(ASIDE_MM) <= CORE_ASIDE_MM], axis=2)
    front = _edge(core, int(BODY_BACK_MM), 18, 46)
    across = _mean(clipped[:, 14:24], axis=1)
    # the darker side: a vessel with contrast medium lies beside the other
    side = _edge(np.fmin(across[:, len(ASIDE_MM) // 2 :], across[:, len(ASIDE_MM) // 2 :: -1]), 0, 9, 32)
    walls = _mean(np.stack([_highest(clipped, sign, side) for sign in (1, -1)], axis=2), axis=2)
    middle = 0.5 * (BODY_BACK_MM + front)
    n = len(scan)
    brightness = np.full((n, len(TILTS_DEG)), np.nan, np.float32)
    ahead = BODY_BACK_MM + np.linspace(0.1, 0.9, 13) * (front - BODY_BACK_MM)[:, None]
    for tilt_number, tilt in enumerate(np.radians(TILTS_DEG)):
        along = np.arange(n)[:, None] + np.tan(tilt) * (ahead - middle[:, None])
        middle_hu = _median(_lines(core, along, ahead), least=0.75)
        walls_hu = _mean(_lines(walls, along, ahead), axis=1, least=0.75)
        brightness[:, tilt_number] = (1.0 - _WALL_SHARE) * middle_hu + _WALL_SHARE * walls_hu
    depth = np.full_like(brightness, np.nan)
    for half in _HALF_THICKNESS_MM:
        centre = _mean(np.stack([_shifted(brightness, shift) for shift in range(1 - half, half)]), axis=0)
        plates = [
            np.fmax.reduce([_shifted(brightness, sign * (half + n)) for n in range(_PLATE_MM)]) for sign in (-1, 1)
        ]
        disc_hu = np.minimum(*plates) - centre
        disc_hu[~(np.minimum(*plates) >= BONE_HU) | ~(centre >= FAT_HU)] = np.nan
        disc_hu[half > np.maximum(_MOST_HALF_THICKNESS * (front - _BACK_WALL_MM), 2.0)] = np.nan
        depth = np.fmax(depth, disc_hu)
    return Looks(brightness, core, depth, middle, front, side)


def _shifted(field: Field, shift: int) -> Field:
    """Return the values `shift` places further down; NaN beyond the ends."""
    moved = np.full_like(field, np.nan)
    if shift < 0:
        moved[-shift:] = field[:shift]
    elif shift > 0:
        moved[:-shift] = field[shift:]
    else:
        moved[:] = field
    return moved


def _mean(values: Field, axis: int, least: float = 0.5) -> Field:
    """Return the mean of what is known, NaN where less than `least` of the values are."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count >= least * values.shape[axis], total / np.maximum(count, 1), np.nan).astype(np.float32)


def _median(values: Field, least: float) -> Field:
    """Return the median of each row, NaN where less than `least` of its values are known."""
    known = np.isfinite(values)
    median = np.median(np.where(known, values, -200.0), axis=1)
    return np.where(known.mean(axis=1) >= least, median, np.nan).astype(np.float32)


def _highest(values: Field, sign: int, side_mm: NDArray[np.float64]) -> Field:
    """Return the highest value of each row from the core to the wall on one side."""
    aside = sign * ASIDE_MM
    inside = (aside >= CORE_ASIDE_MM) & (aside <= side_mm[:, None] + WALL_MARGIN_MM)
    return np.asarray(np.where(inside[:, None] & np.isfinite(values), values, -200.0).max(axis=2))


def _lines(image: Field, along: NDArray[np.float64], ahead: NDArray[np.float64]) -> Field:
    """Return values of an image (n, ahead) on lines, interpolated along the canal; NaN outside."""
    from scipy.ndimage import map_coordinates

    inside = (along >= 0) & (along <= len(image) - 1)
    filled = np.where(np.isfinite(image), image, -200.0)
    sampled = map_coordinates(filled, [along, ahead / (AHEAD_MM[1] - AHEAD_MM[0])], order=1, mode="nearest")
    return np.asarray(np.where(inside, sampled, np.nan), dtype=np.float32)


def choose_discs(looks: Looks) -> tuple[list[Bound], NDArray[np.float64]]:
    """Choose the discs together, none where nothing looks like one; also the depth of a usual one at each place, HU."""
    depth = np.nan_to_num(looks.depth, nan=-1e3)
    usual = _usual_depth(depth.max(axis=1))
    if not usual.any():
        return [], usual
    worth, tilt = _worth(depth, usual)
    row = _best_row(worth - WORTH, looks.front_mm - _BACK_WALL_MM)
    return [Bound(int(at), int(tilt[at]), float(depth[at, tilt[at]])) for at in row], usual


def _usual_depth(best: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the depth of a usual disc at each place: the scan's, or less where all within reach are shallower."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    highest = maximum_filter1d(best, 2 * (_GAPS_MM[0] // 2) + 1, mode="nearest")
    peaks = np.where((best > 0) & (best == highest), best, 0.0).astype(np.float64)
    if not peaks.any():
        return np.zeros(len(best))
    usual = float(np.median(np.sort(peaks[peaks > 0])[-max(2, len(best) // 30) :]))
    local = gaussian_filter1d(maximum_filter1d(peaks, 2 * REACH_MM + 1, mode="nearest"), REACH_MM / 2, mode="nearest")
    return np.clip(local, _LEAST_USUAL * usual, usual)


def _worth(depth: Field, usual: NDArray[np.float64]) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Return how much like a disc the best plane of each place is, 1 for a usual one, and its tilt."""
    worth = np.clip(depth / usual[:, None], -1.0, 1.2) - _TILT_COST * (TILTS_DEG / 30.0) ** 2
    tilt = worth.argmax(axis=1)
    return np.take_along_axis(worth, tilt[:, None], axis=1)[:, 0], tilt


def discs_between(looks: Looks, seeds: list[int]) -> tuple[list[Bound], NDArray[np.float64]]:
    """Return the best disc between each two neighbouring seeds, places in bodies; as `choose_discs`."""
    depth = np.nan_to_num(looks.depth, nan=-1e3)
    bounds = []
    for upper, lower in itertools.pairwise(sorted(seeds)):
        margin = max(2, (lower - upper) // 5)
        part = depth[upper + margin : lower - margin]
        worth, tilt = _worth(part, np.full(len(part), max(float(part.max()), 1.0)))
        best = int(worth.argmax())
        bounds.append(Bound(upper + margin + best, int(tilt[best]), float(part[best, tilt[best]])))
    usual = float(np.median([bound.depth_hu for bound in bounds])) if bounds else 0.0
    return bounds, np.full(len(depth), usual)


def end_of_bone(looks: Looks, bound: Bound, gap: float, sign: int) -> Bound | None:
    """Return where bone ends beyond the first (`sign` -1) or last disc, None if not in time; `gap` is of discs, mm."""
    flat = looks.brightness[:, len(TILTS_DEG) // 2]
    first, last = (int(bound.at + sign * share * gap) for share in _END_SHARES)
    best: Bound | None = None
    for station in range(first, last + sign, sign):
        if not 0 < station < len(flat) - 1:
            break
        inner = flat[max(0, min(station - 6 * sign, station - sign)) : max(station - 6 * sign, station - sign) + 1]
        outer = flat[max(0, min(station + sign, station + 6 * sign)) : max(station + sign, station + 6 * sign) + 1]
        if not (np.isfinite(inner).sum() >= 4 and np.isfinite(outer).sum() >= 4):
            continue
        bone = float(np.nanmean(inner))
        drop = bone - float(np.nanmean(outer))
        if bone >= BONE_HU and drop >= 0.5 * (bone - SOFT_HU) and (best is None or drop > best.depth_hu):
            best = Bound(station, len(TILTS_DEG) // 2, drop, is_disc=False)
    return best


def _best_row(score: NDArray[np.floating], body_depth_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the row of discs with the highest sum; gaps as `_GAPS_MM` allows, and about as long as a body is deep."""
    least, most = _GAPS_MM
    gaps = np.arange(least, most + 1)
    unlike = _UNLIKE_COST * np.log(gaps[:, None] / gaps[None, :]) ** 2
    n = len(score)
    # sums[s, g]: the best row that ends at place s with a last gap of gaps[g]; first[s]: the row of s alone
    sums = np.full((n, len(gaps)), -np.inf)
    came = np.full((n, len(gaps)), -2, np.int64)
    for s in range(n):
        for g, gap in enumerate(gaps):
            before = s - gap
            if before < 0:
                break
            unlikely = _DEPTH_COST * math.log(gap / body_depth_mm[s - gap // 2]) ** 2
            further = sums[before] - unlike[:, g]
            chosen = int(further.argmax())
            alone = score[before]
            if further[chosen] > alone:
                sums[s, g], came[s, g] = score[s] + further[chosen] - unlikely, chosen
            else:
                sums[s, g], came[s, g] = score[s] + alone - unlikely, -1
    best_alone = int(score.argmax())
    if score[best_alone] <= 0.0:
        return np.array([], np.int64)
    end = np.unravel_index(int(sums.argmax()), sums.shape)
    if not sums[end] > score[best_alone]:
        return np.array([best_alone])
    s, g = (int(value) for value in end)
    row = [s]
    while g >= 0:
        s, g = s - int(gaps[g]), int(came[s, g])
        row.append(s)
    return np.array(row[::-1], np.int64)
