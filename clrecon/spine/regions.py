"""Bone along the spine, its division into vertebrae by watersheds from the discs, and their confidence.

A vertebra is judged by its discs, its walls, its marrow, its height beside its neighbours, its volume.  Each trait is a
number from 0 to 1.  The confidence is the overlap (Dice) with the true vertebra that is to be expected: the exponential
of minus the sum of what each trait lacks of 1, times its weight.  Figures are of adults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.geometry.regions import FACES, IN_SLICE, Regions, number_connected
from clrecon.geometry.volume import Volume
from clrecon.spine.discs import AHEAD_MM, ASIDE_MM, BODY_BACK_MM, TILTS_DEG, Bound, Course, Field, Looks
from clrecon.system.light_dataclass import dataclass

Mask = NDArray[np.bool_]
Planes = tuple[Float64Array, Float64Array]
"""Centres and normals (m, 3) of planes in LPS mm, from the head downwards; normals point downwards."""

_FRONT_MM = 46.0
_BEHIND_MM = 58.0
BESIDE_MM = 42.0
"""Bone farther than this from the canal belongs to no vertebra."""
_RIB_MM = (55.0, 68.0)
"""Bone so far beside the canal is rib, shoulder blade or pelvis, and so is what it joins in `Part.beside`: transverse
processes reach 35 to 38 mm at T1, 23 to 30 at T12 and 40 to 50 at L3 (Panjabi et al., Spine 16 and 17, 1991, 1992)."""
_PROCESS_MM = 38.0
_NECK_OFF_MM = 2.0
_NECK_AHEAD_MM = 6.0
_NECK_SLOPE = 1.1
"""Ribs may lie beyond the first; and beside a body, in front of the transverse process, from the second beyond its wall
on: there the process lies so far in front of the canal, and farther out it runs back by the last, mm a mm."""
_WAIST_MM = 30
"""The wall of a body is the widest within so much above and below: its waist is narrower, and so is the sacrum."""
_BODY_MARGIN_MM = 5.0
"""In front of the canal bone farther than this from the walls of the bodies is rib, vessel or pelvis."""
_PEDICLE_MM = 8.0
"""The bodies' own bounds count from so far in front of the canal."""
_CLOSING_MM = 1.5
_CANAL_MM = 4.0
"""Holes that come so near to the middle of the canal are the canal and stay open."""
_MARKER_AHEAD_MM, _MARKER_OFF_MM = 6.0, 2.0
"""A marker lies so far in front of the canal, within the walls of the body, and off the planes of the discs."""
_PEEL_MM = 1.5
"""Voxels of the rim that are less than half as bright as the bone beside them are peeled off, no deeper than this."""
_BRIGHT_HU = 600.0
_BRIGHT_MM = 0.7
ARCH_ASIDE_MM, _SPINE_ASIDE_MM = 26.0, 12.0
_OVER_MM = (16.0, 8.0)
_UNDER_MM = (20.0, 8.0)
SPINE_MM = (80.0, 1.6, 22.0, 45.0)
"""How far a vertebra reaches over the plane above it and under the one below it: its articular processes, and all else.
Its spinous process reaches down by 80 mm less 1.6 heights of the vertebra, 22 to 45: those of the chest are steep."""
_RIDGE_WIDTH = 0.12
"""Arches meet behind a disc over so much height, in gaps of the discs (standard deviation)."""
_RIDGE_AHEAD_MM = (-25.0, 4.0)
_RIDGE_MM, _RIDGE_HU = 1.5, 125.0
"""What a ridge between two arches adds to a landscape at its crest."""
_LEVEL_MM, _LEVEL_HU = 0.02, 1.0
"""Steps of the landscapes."""
_ARCH_DOWN = 0.3
"""An arch lies so much lower than its body, in gaps of the discs."""


@dataclass(frozen=True)
class Part:
    """The part of a volume round the spine, from voxel (k, j, i) on, and where each of its voxels lies from the canal.

    ahead, aside: mm in front of the canal and to its left, in the plane across the canal.
    place: Place along the course of that plane.
    within: Near enough to the canal to be a vertebra, or a rib beside it.
    body: Within the walls of the bodies.
    beside: Where ribs lie: beside the bodies, in front of the transverse processes, and beyond them.
    spacing: (dk, dj, di). mm.
    """

    first: tuple[int, int, int]
    values: NDArray[np.float32]
    ahead: NDArray[np.float32]
    aside: NDArray[np.float32]
    place: NDArray[np.float32]
    within: Mask
    body: Mask
    beside: Mask
    spacing: tuple[float, float, float]

    @property
    def where(self) -> tuple[slice, slice, slice]:
        k, j, i = (slice(n, n + size) for n, size in zip(self.first, self.values.shape, strict=True))
        return k, j, i

    def points(self, volume: Volume, k: int) -> Float64Array:
        """Return the places of the voxels of slice k of the part, shape (nj, ni, 3), LPS mm."""
        _, nj, ni = self.values.shape
        j, i = np.mgrid[:nj, :ni]
        ijk = np.stack([i + self.first[2], j + self.first[1], np.full_like(i, k + self.first[0])], axis=-1)
        return volume.ijk_to_lps(ijk.reshape(-1, 3)).reshape(nj, ni, 3)


def planes_of(bounds: list[Bound], course: Course, looks: Looks) -> Planes:
    stations = np.array([bound.at for bound in bounds])
    tilt = np.radians(TILTS_DEG[[bound.tilt for bound in bounds]])[:, None]
    centres = course.canal[stations] + looks.middle_mm[stations, None] * course.ahead[stations]
    return centres, np.cos(tilt) * course.down[stations] - np.sin(tilt) * course.ahead[stations]


def cut_part(volume: Volume, course: Course, looks: Looks) -> Part:
    """Cut out the box of the volume that can hold the vertebrae."""
    from scipy.ndimage import maximum_filter1d

    sides = list(product((-_RIB_MM[1], _RIB_MM[1]), (-_FRONT_MM, _BEHIND_MM)))
    ijk = volume.lps_to_ijk(np.concatenate([course.canal + np.array([x, y, 0.0]) for x, y in sides]))
    low = np.clip(np.floor(ijk.min(axis=0)).astype(int), 0, np.array(volume.shape_ijk) - 1)
    high = np.clip(np.ceil(ijk.max(axis=0)).astype(int) + 1, low + 1, volume.shape_ijk)
    box = volume.voxels[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    values = np.nan_to_num(box.astype(np.float32), nan=-1024.0)
    di, dj, dk = volume.spacing
    part = Part(
        first=(int(low[2]), int(low[1]), int(low[0])),
        values=values,
        ahead=np.empty(values.shape, np.float32),
        aside=np.empty(values.shape, np.float32),
        place=np.empty(values.shape, np.float32),
        within=np.empty(values.shape, bool),
        body=np.empty(values.shape, bool),
        beside=np.empty(values.shape, bool),
        spacing=(dk, dj, di),
    )
    order = np.argsort(course.canal[:, 2], kind="stable")
    widest = maximum_filter1d(looks.side_mm, 2 * _WAIST_MM + 1)
    heights, numbers = course.canal[order, 2], np.arange(len(course))
    for k in range(len(values)):
        places = part.points(volume, k)
        stations = np.interp(places[..., 2], heights, order.astype(np.float64))
        for _ in range(2):  # from the canal at the same height to the plane across the canal, where it is bent
            nearest = np.clip(np.rint(stations), 0, len(course) - 1).astype(int)
            off = places - course.canal[nearest]
            stations = nearest + (off * course.down[nearest]).sum(axis=-1)
        ahead, aside = ((off * way[nearest]).sum(axis=-1) for way in (course.ahead, course.aside))
        part.ahead[k], part.aside[k] = ahead, aside
        part.place[k] = np.clip(stations, 0, len(course) - 1)
        front, side = np.interp(stations, numbers, looks.front_mm), np.interp(stations, numbers, widest)
        near = (ahead <= _FRONT_MM) & (ahead >= -_BEHIND_MM) & (np.abs(aside) <= _RIB_MM[1])
        near &= (stations >= -1.0) & (stations <= len(course))
        walls = (ahead <= front + _BODY_MARGIN_MM) & (np.abs(aside) <= side + _BODY_MARGIN_MM)
        part.within[k] = near & (walls | (ahead < _PEDICLE_MM))
        off = np.abs(aside) - side
        before = (off > _NECK_OFF_MM) & (ahead > _NECK_AHEAD_MM - _NECK_SLOPE * off)
        part.beside[k] = near & (before | (np.abs(aside) > _PROCESS_MM))
        part.body[k] = near & walls & (ahead >= _MARKER_AHEAD_MM)
    return part


def _ball(spacing: tuple[float, float, float]) -> Mask:
    """Return the voxels within `_CLOSING_MM`, and along each axis the next one at least."""
    radii = [max(_CLOSING_MM, step) for step in spacing]
    reach = [int(radius / step + 1e-6) for radius, step in zip(radii, spacing, strict=True)]
    grid = np.meshgrid(
        *[np.arange(-n, n + 1) * step / r for n, step, r in zip(reach, spacing, radii, strict=True)], indexing="ij"
    )
    return np.asarray(sum(axis**2 for axis in grid) <= 1.0 + 1e-6)


def fill_bone(part: Part, level: float) -> Mask:
    """Return bone from the level on, closed as far as vertebrae reach, without holes in slices but the canal."""
    from scipy.ndimage import binary_closing

    dense = (part.values >= level) & part.within
    raw = dense & (np.abs(part.aside) <= BESIDE_MM)
    ball = _ball(part.spacing)
    margins = [(n // 2, n // 2) for n in ball.shape]
    inner = tuple(slice(n, n + size) for (n, _), size in zip(margins, raw.shape, strict=True))
    bone = np.asarray(binary_closing(np.pad(raw, margins, mode="edge"), ball)[inner]) | raw
    canal = np.hypot(part.ahead, part.aside) <= _CANAL_MM
    gaps = Regions(~bone, IN_SLICE)
    bone |= gaps.cells_of(~gaps.reach_border() & (gaps.sum_of(canal) == 0))
    return np.asarray((bone & part.within & (np.abs(part.aside) <= BESIDE_MM)) | dense)


def divide(
    part: Part, bone: Mask, bounds: list[Bound], planes: Planes, volume: Volume
) -> tuple[NDArray[np.uint8], Float64Array, Float64Array]:
    """Divide bone into the pieces between planes: 1 above the first plane, and so on.

    Two watersheds from the same markers are compared.  That of the distance field keeps arches together that touch in
    facet joints, that of the brightness follows the dark gap of a joint which the closing has filled.  In both there
    are ridges between arches at the heights of the discs.  Where they differ, a group of voxels in front of the canal
    goes to the vertebra at whose height it lies, and an arch to the one that is a little higher.

    Returns also the share of each piece that the two give to different ones, and that in voxels of its surface: of
    those partial volume makes the place uncertain.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    beside = Regions(bone & part.beside, FACES)  # bone beside the bodies that joins bone far beside them: ribs
    ribs = beside.cells_of(beside.sum_of(np.abs(part.aside) >= _RIB_MM[0]) > 0)
    bone = bone & (np.abs(part.aside) <= BESIDE_MM)
    markers = _mark_bodies(part, bone, planes, volume)
    ridge = _ridges(part, bounds)
    depth = distance_transform_edt(bone, sampling=part.spacing)
    by_depth = flood(_RIDGE_MM * ridge - depth, _LEVEL_MM, markers, bone)
    bright = gaussian_filter(np.clip(part.values, 0.0, _BRIGHT_HU), [_BRIGHT_MM / step for step in part.spacing])
    by_brightness = flood(_RIDGE_HU * ridge - bright, _LEVEL_HU, markers, bone)
    pieces = _bound(part, _settle(part, by_depth, by_brightness, bounds), bounds, planes, volume)
    pieces[ribs] = 0
    pieces[~_peel(part, pieces > 0)] = 0
    count, differ, rim = (
        np.bincount(pieces[chosen], minlength=len(bounds) + 2)
        for chosen in (pieces >= 0, by_depth != by_brightness, _find_rim(pieces))
    )
    return pieces, differ / np.maximum(count, 1), rim / np.maximum(count, 1)


def flood(landscape: NDArray[Any], step: float, markers: NDArray[np.int32], mask: Mask) -> NDArray[np.int32]:
    """Return the watershed of a landscape from markers, over faces of voxels in a mask; `step`: height of a level.

    Level by level from the lowest, each voxel that a basin has reached gives its number to those beside it.
    """
    numbers = np.pad(np.where(mask, markers, -1), 1, constant_values=-1)
    _, nj, ni = numbers.shape
    flat, levels = numbers.reshape(-1), np.zeros(numbers.size, np.int16)
    places = np.flatnonzero(flat >= 0)
    levels[places] = heights = ((landscape[mask] - landscape[mask].min(initial=0.0)) / step).astype(np.int16)
    by_height = places[np.argsort(heights, kind="stable")]
    for level, at_level in enumerate(np.split(by_height, np.cumsum(np.bincount(heights)))):
        ready = at_level[flat[at_level] > 0]
        while len(ready):
            reached = []
            for offset in (1, -1, ni, -ni, ni * nj, -ni * nj):
                free = ready[flat[ready + offset] == 0] + offset
                flat[free] = flat[free - offset]
                reached.append(free)
            ready = np.concatenate(reached)
            ready = ready[levels[ready] <= level]
    return np.maximum(numbers[1:-1, 1:-1, 1:-1], 0)


def number_groups(kinds: NDArray[np.int32]) -> NDArray[np.signedinteger[Any]]:
    """Number the groups of voxels of one kind that faces connect, from 1; return the numbers of those of a kind > 0."""
    nodes = np.cumsum(kinds > 0).reshape(kinds.shape) - 1
    pairs = []
    for axis in range(3):
        kind, node = np.moveaxis(kinds, axis, 0), np.moveaxis(nodes, axis, 0)
        alike = (kind[1:] == kind[:-1]) & (kind[1:] > 0)
        pairs.append(np.stack([node[1:][alike], node[:-1][alike]]))
    return number_connected(int(np.count_nonzero(kinds)), *np.concatenate(pairs, axis=1))


def _find_rim(pieces: NDArray[np.uint8]) -> Mask:
    """Return the voxels beside one of another piece, or of none, or at the end of the volume."""
    inner = np.ones(pieces.shape, bool)
    for axis in range(3):
        ours, inside = np.moveaxis(pieces, axis, 0), np.moveaxis(inner, axis, 0)
        alike = ours[1:] == ours[:-1]
        inside[0] = inside[-1] = False
        inside[1:] &= alike
        inside[:-1] &= alike
    return ~inner


def _peel(part: Part, bone: Mask) -> Mask:
    """Return bone without the rim that partial volume and closing have added: the edge is where HU fall by half."""
    from scipy.ndimage import binary_erosion, maximum_filter1d, minimum_filter1d

    sizes = [2 * max(1, int(_PEEL_MM / step + 1e-6)) + 1 for step in part.spacing]
    brightest, darkest = part.values.copy(), part.values.copy()
    for axis, size in enumerate(sizes):  # along the three axes alone: across the corner lies other bone
        np.maximum(brightest, maximum_filter1d(part.values, size, axis=axis), out=brightest)
        np.minimum(darkest, minimum_filter1d(part.values, size, axis=axis), out=darkest)
    dim = part.values < 0.5 * (brightest + darkest)
    for _ in range(max(1, round(_PEEL_MM / min(part.spacing)))):
        rim = bone & ~binary_erosion(bone, border_value=1)
        bone = bone & ~(rim & dim)
    return bone


def _bound(
    part: Part, pieces: NDArray[np.uint8], bounds: list[Bound], planes: Planes, volume: Volume
) -> NDArray[np.uint8]:
    """Take from each piece what lies too far beyond its planes: sacrum, pelvis, ribs of other levels."""
    centres, normals = planes
    last = len(centres)
    cuts = np.array([bound.at for bound in bounds], np.float64)
    gaps = np.diff(cuts) if last > 1 else np.array([30.0])
    heights = np.r_[gaps[0], gaps[0], gaps, gaps[-1]]  # of piece n, the first is no piece
    first, less, low, high = SPINE_MM
    spine = np.clip(first - less * heights, low, high)
    for k, plane in enumerate(pieces):
        chosen = plane > 0
        if not chosen.any():
            continue
        places, station = part.points(volume, k)[chosen], plane[chosen].astype(np.int64)
        aside, ahead = np.abs(part.aside[k][chosen]), part.ahead[k][chosen]
        near = (aside <= ARCH_ASIDE_MM) & (ahead < _MARKER_AHEAD_MM)
        above, below = np.minimum(station - 2, last - 1), np.minimum(station - 1, last - 1)
        over = -((places - centres[above]) * normals[above]).sum(axis=1)
        under = ((places - centres[below]) * normals[below]).sum(axis=1)
        far = (station > 1) & (over > np.where(near, _OVER_MM[0], _OVER_MM[1]))
        reach = np.where(near & (aside <= _SPINE_ASIDE_MM), spine[station], np.where(near, _UNDER_MM[0], _UNDER_MM[1]))
        far |= (station <= last) & (under > reach)
        plane[chosen] = np.where(far, 0, station)
    return pieces


def _ridges(part: Part, bounds: list[Bound]) -> NDArray[np.float32]:
    """Return ridges, 0 to 1, at the heights at which one arch ends and the next begins: those of the discs."""
    cuts = np.array([bound.at for bound in bounds], np.float64)
    gaps = np.gradient(cuts) if len(cuts) > 1 else np.array([30.0])
    stations = np.arange(int(part.place.max()) + 2)[:, None]
    heights = np.exp(-0.5 * ((stations - cuts) / (_RIDGE_WIDTH * gaps)) ** 2).max(axis=1)
    arch = (part.ahead < _RIDGE_AHEAD_MM[1]) & (part.ahead > _RIDGE_AHEAD_MM[0])
    return np.where(arch, heights[np.rint(part.place).astype(int)], 0.0).astype(np.float32)


def _mark_bodies(part: Part, bone: Mask, planes: Planes, volume: Volume) -> NDArray[np.int32]:
    """Return the bone of the bodies with its piece's number, but for what is near to a plane."""
    markers = np.zeros(bone.shape, np.int32)
    for k, plane in enumerate(bone & part.body):
        if plane.any():
            places = part.points(volume, k)[plane]
            sides = np.stack([(places - centre) @ normal for centre, normal in zip(*planes, strict=True)], axis=1)
            off = np.abs(sides).min(axis=1) >= _MARKER_OFF_MM
            markers[k][plane] = np.where(off, 1 + (sides > 0.0).sum(axis=1), 0)
    return markers


def _settle(
    part: Part, by_depth: NDArray[np.int32], by_brightness: NDArray[np.int32], bounds: list[Bound]
) -> NDArray[np.uint8]:
    """Choose one of two divisions for each group of voxels in which they differ."""
    cuts = np.array([bound.at for bound in bounds], np.float64)
    gaps = np.diff(cuts) if len(cuts) > 1 else np.array([30.0])
    upper, lower = np.r_[cuts[0] - gaps[0], cuts], np.r_[cuts, cuts[-1] + gaps[-1]]
    differ = by_depth != by_brightness
    pairs = np.where(differ, by_depth * (len(bounds) + 2) + by_brightness, 0)
    groups = number_groups(pairs)
    if not len(groups):
        return by_brightness.astype(np.uint8)
    count = np.maximum(np.bincount(groups), 1)
    station, ahead = (np.bincount(groups, field[differ]) / count for field in (part.place, part.ahead))
    ours = np.zeros((2, len(count)), np.int64)
    for n, division in enumerate((by_depth, by_brightness)):
        ours[n, groups] = division[differ]
    number = np.maximum(ours - 1, 0)
    expected = 0.5 * (upper + lower)[number] + np.where(ahead < 0.0, _ARCH_DOWN, 0.0) * (lower - upper)[number]
    nearer = np.abs(station - expected).argmin(axis=0)
    result = by_brightness.astype(np.uint8)
    result[differ] = np.take_along_axis(ours, nearer[None], axis=0)[0][groups]
    return result


CONFIDENT = 0.6
"""Least confidence of a vertebra that is written without being asked for."""
WEIGHTS = {
    "rim": 0.34, "upper disc": 0.09, "lower disc": 0.09, "inside": 0.3, "wall": 0.3, "height": 0.25, "border": 0.1,
    "arch": 0.45, "canal": 0.3, "marrow": 0.3, "dark": 0.3, "volume": 0.4, "one part": 0.3, "line": 0.15,
}  # fmt: skip
"""What a trait of 0 takes from the logarithm of the confidence.  Those of rim, discs and border are least squares over
88 vertebrae of phantoms; phantoms hardly show the others: these take more than least squares gave."""
_LEAST_DEPTH_HU = 30.0
"""Least depth of any disc: noise and partial volume make shallower ones."""
MARROW_HU = 60.0
"""Least HU of the middle of a body; muscle and a disc beside a thin one have less."""
_VOLUME_ML = (3.0, 80.0)
"""Least and largest volume of a vertebra; C3 of a small adult has 4 ml."""
_ARCH_SHARE = (0.003, 0.02)
"""Share of a vertebra that lies behind its canal in the middle: too little, and enough for a spinous process."""
_WALL_DIRECTIONS = np.radians(np.arange(-130.0, 131.0, 15.0))
"""Directions from the middle of a body in which its wall is looked for, 0 is to the front; the pedicles are behind."""


@dataclass(frozen=True)
class Piece:
    """The bone between two planes, at places along the canal; a plane is None where the scan ends first.

    largest_share: Share of its voxels in its largest connected part.
    doubtful_share: Share of its voxels that two ways of dividing the bone give to different vertebrae.
    rim_share: Share of its voxels in its surface.
    arch_ml: Volume of its spinous process.
    """

    upper: Bound | None
    lower: Bound | None
    begin: int
    end: int
    volume_ml: float
    largest_share: float
    doubtful_share: float
    rim_share: float
    arch_ml: float

    @property
    def whole(self) -> bool:
        return self.upper is not None and self.lower is not None


Traits = dict[str, tuple[float, str]]
"""Each trait from 0 to 1, and what is wrong where it is too low."""


def weigh(traits: Traits) -> tuple[float, list[str]]:
    """Return the confidence, and what is wrong where it is too low: the traits that make it so, the worst first."""
    costs = {name: WEIGHTS[name] * (1.0 - value) for name, (value, _) in traits.items()}
    confidence = math.exp(-sum(costs.values()))
    if confidence >= CONFIDENT:
        return confidence, []
    worst = sorted(costs, key=lambda name: -costs[name])
    return confidence, [traits[name][1] for name in worst if costs[name] >= 0.2 * costs[worst[0]]]


def _ramp(value: float, nothing: float, all_of_it: float) -> float:
    return float(np.clip((value - nothing) / (all_of_it - nothing), 0.0, 1.0))


def judge(
    piece: Piece, gaps: Sequence[float], scan: Field, looks: Looks, course: Course, usual: NDArray[np.float64]
) -> Traits:
    """Judge a piece by itself, by `gaps`, heights of whole neighbours in mm, and the `usual` depth of discs in HU."""
    height = piece.end - piece.begin
    traits: Traits = {}
    for name, bound in (("upper", piece.upper), ("lower", piece.lower)):
        if bound is not None:
            depth = _ramp(bound.depth_hu, 0.0, max(0.8 * float(usual[bound.at]), 2.0 * _LEAST_DEPTH_HU))
            traits[f"{name} disc"] = depth, f"the disc at its {name} end is {bound.depth_hu:.0f} HU darker than bone"
    inner = _further_disc(looks, piece)
    known = [bound.depth_hu for bound in (piece.upper, piece.lower) if bound is not None]
    share = inner / max(min(known), 0.5 * float(usual[piece.begin : piece.end].max(initial=1.0)), 1.0)
    traits["inside"] = _ramp(share, 1.0, 0.5), f"{inner:.0f} HU darker plane within it: there may be another disc"
    wall = _walls(scan, looks, piece)
    traits["wall"] = _ramp(wall, 0.6, 0.95), f"its body has a wall in {100 * wall:.0f} % of the directions"
    marrow, dark = _marrow(scan, looks, piece)
    traits["marrow"] = _ramp(marrow, MARROW_HU - 20.0, MARROW_HU + 20.0), f"the middle of its body has {marrow:.0f} HU"
    traits["dark"] = _ramp(dark, 0.1, 0.0), f"{100 * dark:.0f} % of the middle of its body is fat or air"
    tube = scan[piece.begin : piece.end, :4][:, :, np.abs(ASIDE_MM) <= 3.0]
    measured = tube[np.isfinite(tube)]
    canal = float(((measured > 250.0) | (measured < -150.0)).mean()) if measured.size else 1.0
    traits["canal"] = _ramp(canal, 0.35, 0.0), f"{100 * canal:.0f} % of its canal is filled with bone or air"
    seen = float(course.known[piece.begin : piece.end].mean())
    traits["line"] = _ramp(seen, 0.4, 0.75), f"its canal was seen on {100 * seen:.0f} % of its height"
    if piece.whole and gaps:
        usual_mm = float(np.median(gaps))
        ratio = max(height / usual_mm, usual_mm / height)
        remark = f"its height is {height} mm, and {usual_mm:.0f} mm is usual beside it"
        traits["height"] = _ramp(ratio, 1.6, 1.25), remark
    low, high = _VOLUME_ML if piece.whole else (1.0, _VOLUME_ML[1])
    fits = min(_ramp(piece.volume_ml, 0.6 * low, low), _ramp(piece.volume_ml, 1.25 * high, high))
    traits["volume"] = fits, f"its volume is {piece.volume_ml:.3g} ml, not {low:g} to {high:g}"
    torn = piece.doubtful_share
    traits["border"] = _ramp(torn, 0.6, 0.15), f"{100 * torn:.0f} % of it may be a neighbour's: their joints are closed"
    if piece.whole:
        arch = piece.arch_ml
        share = arch / max(piece.volume_ml, 1e-6)
        traits["arch"] = _ramp(share, *_ARCH_SHARE), f"it has only {arch:.1f} ml of a spinous process"
    rim = piece.rim_share
    traits["rim"] = 1.0 - rim, f"{100 * rim:.0f} % of its voxels lie in its surface: the slices are thick for its size"
    traits["one part"] = _ramp(piece.largest_share, 0.6, 0.95), f"{100 * piece.largest_share:.0f} % of it hang together"
    return traits


def _further_disc(looks: Looks, piece: Piece) -> float:
    """Return the depth of the best plane well within a piece, HU."""
    margin = max(7, (piece.end - piece.begin) // 4)
    part = looks.depth[piece.begin + margin : piece.end - margin]
    known = part[np.isfinite(part)]
    return float(known.max()) if known.size else 0.0


def _middle_rows(piece: Piece) -> slice:
    margin = (piece.end - piece.begin) // 4
    first = min(piece.begin + margin, piece.end - 1)
    return slice(first, max(piece.end - margin, first + 1))


def _walls(scan: Field, looks: Looks, piece: Piece) -> float:
    """Return the share of directions in which cortex brighter than the marrow stands round the middle of the body."""
    rows = range(*_middle_rows(piece).indices(len(scan)))
    rings_hu = []
    for n in rows:
        middle, deep = looks.middle_mm[n], looks.front_mm[n] - looks.middle_mm[n]
        reach = np.arange(0.6, 1.5, 0.1)[:, None]
        ahead = middle + reach * deep * np.cos(_WALL_DIRECTIONS)
        aside = reach * looks.side_mm[n] * np.sin(_WALL_DIRECTIONS)
        j = np.clip(np.rint(ahead - AHEAD_MM[0]).astype(int), 0, len(AHEAD_MM) - 1)
        i = np.clip(np.rint(aside - ASIDE_MM[0]).astype(int), 0, len(ASIDE_MM) - 1)
        rings_hu.append(np.nan_to_num(scan[n, j, i], nan=-1000.0))
    rings = np.stack(rings_hu)
    highest, outside = rings.max(axis=1), rings[:, -3:].min(axis=1)
    # a wall: as dense as bone, and softer beyond it
    return float(((highest >= 130.0) & (outside <= highest - 60.0)).mean())


def _marrow(scan: Field, looks: Looks, piece: Piece) -> tuple[float, float]:
    """Return the median HU of the middle of the body, and the share of its voxels that are fat or air."""
    rows = _middle_rows(piece)
    middle = float(np.median(looks.middle_mm[rows]))
    ahead = np.abs(AHEAD_MM - middle) <= 5.0
    core = scan[rows][:, ahead][:, :, np.abs(ASIDE_MM) <= 8.0]
    known = core[np.isfinite(core)]
    return (float(np.median(known)), float((known < -60.0).mean())) if known.size else (-1000.0, 1.0)


def beside_share(scan: Field, looks: Looks, piece: Piece, level: float) -> float:
    """Return the share of bone right beside a body: muscle stands there, but at the sacrum its wings."""
    side = looks.side_mm[max(piece.begin - 20, 0)]  # of the body above: the wings have no side wall
    ahead = (AHEAD_MM >= BODY_BACK_MM - 4.0) & (AHEAD_MM <= BODY_BACK_MM + 10.0)
    aside = np.abs(np.abs(ASIDE_MM) - side - 7.0) <= 4.0
    beside = scan[_middle_rows(piece)][:, ahead][:, :, aside]
    known = beside[np.isfinite(beside)]
    return float((known >= level).mean()) if known.size else 0.0
