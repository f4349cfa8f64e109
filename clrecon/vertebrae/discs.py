"""Discs between vertebral bodies, found together in the scan along the canal.

A disc is a plane that is darker than the planes on either side of it: the marrow and end plates in its middle, and the
cortex around it.  Planes of all tilts are tried, because the discs of the loin stand askew to the canal.  Dynamic
programming then chooses the planes that agree best as a row: 15 to 46 mm apart, and neighbouring gaps alike.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.vertebrae.course import AHEAD_MM, ASIDE_MM, Field

GAPS_MM = (11, 46)
"""Least and largest distance of two discs."""
END_SHARES = (0.6, 1.5)
"""Where the bone beyond the last disc may end, in gaps."""
TILTS_DEG = np.arange(-40.0, 41.0, 5.0)
TILT_COST = 0.1
"""What a tilt of 30 degrees costs, as a share of a usual disc: of planes that look alike the one across is taken."""
BACK_WALL_MM = 8.0
"""The back wall of a body lies so far in front of the middle of the canal."""
DEPTH_COST = 1.5
"""Cost of the square of the logarithm of a gap's ratio to the depth of the body."""
BODY_BACK_MM = 10.0
"""Planes are looked at from here on in front of the canal: behind it lies the back wall of the body."""
CORE_ASIDE_MM = 7.0
WALL_SHARE = 0.2
"""Share of the side walls in the brightness of a plane; the rest is the median of its middle from back to front, since
bony spurs bridge the rim of a disc."""
WALL_MARGIN_MM = 3.0
"""The walls of a body are looked for from the core to so far beyond its sides: heads of ribs lie farther out."""
HALF_THICKNESS_MM = (1, 2, 3, 4, 6)
"""Half thicknesses of discs that are tried, from the middle to the end plates."""
MOST_HALF_THICKNESS = 0.2
"""Largest half thickness of a disc, as a share of the depth of the body in front of it.  Discs of adults are 3 to 5 mm
high in neck and upper chest and 9 to 12 in the loin, bodies 15 to 17 and 33 to 35 mm deep (Panjabi et al., Spine 16 and
17, 1991 and 1992; Gilad and Nissan, Spine 11, 1986); a body between its two plates is three times as high."""
PLATE_MM = 2
"""An end plate lies within so many planes beside a disc."""
BONE_HU, FAT_HU = 100.0, 0.0
"""The planes on both sides of a disc have at least the first, the disc itself at least the second."""
SOFT_HU = 40.0
"""HU of muscle and vessels beside a body."""
LEAST_USUAL, REACH_MM = 0.4, 30
"""Where no disc within the second, mm, is as deep as a usual one of the scan, shallower ones are usual; at least the
first as a share."""
WORTH = 0.3
"""Depth of a disc that counts neither for nor against it, as a share of a usual one."""
UNLIKE_COST = 2.0
"""Cost of the square of the logarithm of the ratio of neighbouring gaps."""


@dataclass(frozen=True)
class Looks:
    """The scan along the canal, as far as discs show in it.

    brightness: ndarray, shape (n, tilts), float32. HU of the plane at each place and tilt: core and side walls.
    core: ndarray, shape (n, ahead), float32. HU of the middle of each plane, from side to side.
    depth: ndarray, shape (n, tilts), float32. How much darker the plane is than those beside it, on the side where it
        is less so, HU.
    middle_mm: ndarray, shape (n,), float64. Middle of the body in front of the canal.
    front_mm, side_mm: ndarray, shape (n,), float64. Front wall of the body, and its side walls.
    """

    brightness: Field
    core: Field
    depth: Field
    middle_mm: NDArray[np.float64]
    front_mm: NDArray[np.float64]
    side_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Bound:
    """A plane at which a vertebra begins or ends.

    at: Place along the canal.
    tilt: Index into `TILTS_DEG`.
    depth_hu: How much darker it is than what lies beside it.
    is_disc: False: bone ends there and no other vertebra follows.
    """

    at: int
    tilt: int
    depth_hu: float
    is_disc: bool = True


def _edge(image: Field, first: int, least: int, most: int) -> NDArray[np.float64]:
    """Return the column at which the bodies end, smoothed along the canal: there their brightness falls by half.

    `first` is a column within all bodies; the edge lies between columns `least` and `most`.
    """
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
    """Measure at each place and tilt how much a plane looks like a disc.

    scan: ndarray, shape (n, ahead, aside), float32. See `clrecon.vertebrae.course.sample_course`.
    """
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
    shares = np.linspace(0.1, 0.9, 13)
    ahead = BODY_BACK_MM + shares * (front - BODY_BACK_MM)[:, None]
    for place, tilt in enumerate(np.radians(TILTS_DEG)):
        along = np.arange(n)[:, None] + np.tan(tilt) * (ahead - middle[:, None])
        middle_hu = _median(_lines(core, along, ahead), least=0.75)
        walls_hu = _mean(_lines(walls, along, ahead), axis=1, least=0.75)
        brightness[:, place] = (1.0 - WALL_SHARE) * middle_hu + WALL_SHARE * walls_hu
    return Looks(brightness, core, _depths(brightness, front - BACK_WALL_MM), middle, front, side)


def _depths(brightness: Field, body_depth_mm: NDArray[np.float64]) -> Field:
    """Return how much darker each plane is than the end plates beside it, for the likeliest thickness of a disc."""
    depth = np.full_like(brightness, np.nan)
    for half in HALF_THICKNESS_MM:
        centre = _mean(np.stack([_shifted(brightness, shift) for shift in range(1 - half, half)]), axis=0)
        plates = [
            np.fmax.reduce([_shifted(brightness, sign * (half + n)) for n in range(PLATE_MM)]) for sign in (-1, 1)
        ]
        found = np.minimum(*plates) - centre
        found[~(np.minimum(*plates) >= BONE_HU) | ~(centre >= FAT_HU)] = np.nan
        found[half > np.maximum(MOST_HALF_THICKNESS * body_depth_mm, 2.0)] = np.nan
        depth = np.fmax(depth, found)
    return depth


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
    found = map_coordinates(filled, [along, ahead / (AHEAD_MM[1] - AHEAD_MM[0])], order=1, mode="nearest")
    return np.asarray(np.where(inside, found, np.nan), dtype=np.float32)


def choose_discs(looks: Looks) -> tuple[list[Bound], NDArray[np.float64]]:
    """Choose the discs together.

    Returns: From the head downwards; empty where nothing looks like a disc.
    Returns: ndarray, shape (n,), float64. Depth of a usual disc at each place, HU.
    """
    depth = np.nan_to_num(looks.depth, nan=-1e3)
    usual = _usual_depth(depth.max(axis=1))
    if not usual.any():
        return [], usual
    worth, tilt = _worth(depth, usual)
    row = _best_row(worth - WORTH, looks.front_mm - BACK_WALL_MM)
    return [Bound(int(at), int(tilt[at]), float(depth[at, tilt[at]])) for at in row], usual


def _usual_depth(best: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the depth of a usual disc at each place: that of the scan, or less where all within reach are shallower.

    Discs of the neck and the upper chest are thinner than those below, and partial volume fills them.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    near = GAPS_MM[0] // 2
    highest = maximum_filter1d(best, 2 * near + 1, mode="nearest")
    peaks = np.where((best > 0) & (best == highest), best, 0.0).astype(np.float64)
    if not peaks.any():
        return np.zeros(len(best))
    usual = float(np.median(np.sort(peaks[peaks > 0])[-max(2, len(best) // 30) :]))
    local = gaussian_filter1d(maximum_filter1d(peaks, 2 * REACH_MM + 1, mode="nearest"), REACH_MM / 2, mode="nearest")
    return np.clip(local, LEAST_USUAL * usual, usual)


def _worth(depth: Field, usual: NDArray[np.float64]) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Return how much like a disc the best plane of each place is, 1 for a usual one, and its tilt."""
    worth = np.clip(depth / usual[:, None], -1.0, 1.2) - TILT_COST * (TILTS_DEG / 30.0) ** 2
    tilt = worth.argmax(axis=1)
    return np.take_along_axis(worth, tilt[:, None], axis=1)[:, 0], tilt


def discs_between(looks: Looks, seeds: list[int]) -> tuple[list[Bound], NDArray[np.float64]]:
    """Return the best disc between each two neighbouring seeds, places in bodies; as `choose_discs`."""
    depth = np.nan_to_num(looks.depth, nan=-1e3)
    found = []
    for upper, lower in itertools.pairwise(sorted(seeds)):
        margin = max(2, (lower - upper) // 5)
        part = depth[upper + margin : lower - margin]
        worth, tilt = _worth(part, np.full(len(part), max(float(part.max()), 1.0)))
        at = int(worth.argmax())
        found.append(Bound(upper + margin + at, int(tilt[at]), float(part[at, tilt[at]])))
    usual = float(np.median([bound.depth_hu for bound in found])) if found else 0.0
    return found, np.full(len(depth), usual)


def end_of_bone(looks: Looks, bound: Bound, gap: float, sign: int) -> Bound | None:
    """Return where the bone beyond the first (`sign` -1) or last disc ends, None where it does not end in time.

    bound: That disc.
    gap: Distance of neighbouring discs there, mm.
    """
    flat = looks.brightness[:, len(TILTS_DEG) // 2]
    first, last = (int(bound.at + sign * share * gap) for share in END_SHARES)
    best: Bound | None = None
    for at in range(first, last + sign, sign):
        if not 0 < at < len(flat) - 1:
            break
        inner = flat[max(0, min(at - 6 * sign, at - sign)) : max(at - 6 * sign, at - sign) + 1]
        outer = flat[max(0, min(at + sign, at + 6 * sign)) : max(at + sign, at + 6 * sign) + 1]
        if not (np.isfinite(inner).sum() >= 4 and np.isfinite(outer).sum() >= 4):
            continue
        bone = float(np.nanmean(inner))
        drop = bone - float(np.nanmean(outer))
        if bone >= BONE_HU and drop >= 0.5 * (bone - SOFT_HU) and (best is None or drop > best.depth_hu):
            best = Bound(at, len(TILTS_DEG) // 2, drop, is_disc=False)
    return best


def _best_row(score: NDArray[np.floating], body_depth_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the places of the row of discs with the highest sum; gaps as `GAPS_MM` allows, and about as long as a body
    is deep.
    """
    least, most = GAPS_MM
    gaps = np.arange(least, most + 1)
    unlike = UNLIKE_COST * np.log(gaps[:, None] / gaps[None, :]) ** 2
    n = len(score)
    # sums[s, g]: the best row that ends at place s with a last gap of gaps[g]; first[s]: the row of s alone
    sums = np.full((n, len(gaps)), -np.inf)
    came = np.full((n, len(gaps)), -2, np.int64)
    for s in range(n):
        for g, gap in enumerate(gaps):
            before = s - gap
            if before < 0:
                break
            unlikely = DEPTH_COST * math.log(gap / body_depth_mm[s - gap // 2]) ** 2
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
