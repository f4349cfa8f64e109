"""`split_vertebrae`: a first guess of where each vertebra is, from the scan alone; its result, and their names.

Vertebrae are counted from the head, or by the level that the user gives one of them."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.anatomy.spine_line import SpineLine, find_spine_line
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_points
from clrecon.geometry.regions import FACES, Regions
from clrecon.geometry.volume import Volume
from clrecon.labels import LabelMap
from clrecon.spine.discs import (
    AHEAD_MM,
    ASIDE_MM,
    BEYOND_MM,
    BODY_BACK_MM,
    TILTS_DEG,
    Bound,
    Course,
    Field,
    Looks,
    choose_discs,
    discs_between,
    end_of_bone,
    follow_canal,
    look_at_bodies,
    sample_course,
)
from clrecon.spine.regions import CONFIDENT, Piece, beside_share, cut_part, divide, fill_bone, judge, planes_of, weigh
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.base_classes import Message
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record
from clrecon.system.text import count_of

LEVELS = (*(f"C{n}" for n in range(1, 8)), *(f"T{n}" for n in range(1, 13)), *(f"L{n}" for n in range(1, 7)))
"""Levels from the head downwards; place n has the number n + 1 in the VerSe data set, L6 included."""


def check_level(name: str) -> str:
    level = str(name).strip().upper()
    if not re.fullmatch(r"[CTL][0-9]{1,2}", level) or level not in LEVELS:
        raise UsageError(f"there is no vertebra {str(name)[:20]!r}: they are C1 to C7, T1 to T12 and L1 to L6")
    return level


def check_landmark(name_at: tuple[Sequence[float], str] | None, first: str | None) -> str | None:
    if name_at is not None and first is not None:
        raise UsageError(
            f"{name_parameter('first')} and {name_parameter('name_at')} both name levels: give one of them"
        )
    level = first if name_at is None else name_at[1]
    return None if level is None else check_level(level)


def name_levels(count: int, given: tuple[int, str] | None) -> dict[int, str]:
    """Return numbers and names of `count` vertebrae from the head down, ``vertebra_1`` on if no place is `given`."""
    if given is None:
        return {n: f"vertebra_{n}" for n in range(1, count + 1)}
    position, level = given
    first = LEVELS.index(level) - position
    if first < 0:
        raise UsageError(
            f"{position} vertebrae were found above {level}, and there are only {position + first} levels above"
            f" {level}: look at the picture and name another level"
        )
    if first + count > len(LEVELS):
        raise UsageError(
            f"{count - position} vertebrae were found from {level} downwards, and there are only"
            f" {len(LEVELS) - first - position} levels from {level} to {LEVELS[-1]}: look at the picture and name"
            " another level"
        )
    return {first + n + 1: LEVELS[first + n] for n in range(count)}


@dataclass(frozen=True, eq=False)
class Vertebra(Record):
    """One vertebra.

    Attributes
    ----------
    number : int
        Its number in the label map.
    name : str
    confidence : float
        The overlap (Dice) with the true vertebra that is to be expected, see docs/vertebrae.md; below 0.5 it is low.
    is_confident : bool
    doubts : list of str
        What is wrong with one of low confidence.
    whole : bool
        False where the scan cuts it.
    centre_mm : list of float
        Middle of its body, LPS mm.
    height_mm : float
        Distance of the planes above and below it, middle of disc to middle of disc.
    volume_ml : float
    """

    _SHOWN = ("number", "name", "confidence", "whole", "volume_ml")
    number: int
    name: str
    confidence: float
    is_confident: bool
    doubts: list[str]
    whole: bool
    centre_mm: list[float]
    height_mm: float
    volume_ml: float


@dataclass(frozen=True)
class MiddlePlane(Message):
    """The scan along the spine, straightened: what a picture of the result shows.

    A row is 1 mm along the canal, from the head downwards.

    Attributes
    ----------
    sagittal, coronal : ndarray, shape (n, columns), float32
        HU, columns 1 mm apart; NaN outside of the scan.  Sagittal: the front is on the left.  Coronal: through the
        bodies, the patient's right is on the left.
    sagittal_labels, coronal_labels : ndarray, shape (n, columns), int32
        Numbers of the vertebrae there, those of low confidence included.
    canal_column, middle_column : int
        Column of the canal in the sagittal picture, and of the canal in the coronal one.
    lines : list of ((row, column), (row, column))
        Planes between vertebrae in the sagittal picture, from the front wall of the body to the back wall.
    rows : list of float
        Row of the middle of each vertebra.
    """

    sagittal: NDArray[np.float32]
    coronal: NDArray[np.float32]
    sagittal_labels: NDArray[np.int32]
    coronal_labels: NDArray[np.int32]
    canal_column: int
    middle_column: int
    lines: list[tuple[tuple[float, float], tuple[float, float]]]
    rows: list[float]


@dataclass(frozen=True)
class VertebraSplit(Message):
    """The result of `clrecon.split_vertebrae`.

    Attributes
    ----------
    labels : LabelMap
        On the grid of the scan.  Those of low confidence are in it only where they are to be kept.
    vertebrae : list of Vertebra
        All that were found, from the head downwards.
    discs_mm : ndarray, shape (m, 3), float64
        Middles of the discs, LPS mm, from the head downwards.
    disc_normals : ndarray, shape (m, 3), float64
        Unit vectors square to the discs, downwards.
    level_hu : float
        Bone of the map is what is this dense, or enclosed by it.
    left_out : list of str
        What else was seen along the spine and is no vertebra of the map, such as the sacrum.
    plane : MiddlePlane
    """

    _SHOWN = ("labels", "level_hu", "left_out")
    labels: LabelMap
    vertebrae: list[Vertebra]
    discs_mm: NDArray[np.float64]
    disc_normals: NDArray[np.float64]
    level_hu: float
    left_out: list[str]
    plane: MiddlePlane

    @property
    def low_confidence(self) -> list[Vertebra]:
        """The vertebrae of low confidence."""
        return [one for one in self.vertebrae if not one.is_confident]


_LEVELS_HU = (120.0, 226.0)
"""The level of bone is taken from between these."""
_LEVEL_SHARE = 0.5
"""The level lies so far between a disc and the marrow of a body."""
_CUT_MM = 8.0
"""Least height of a vertebra that the scan cuts."""
_WINGS = 0.25
"""Share of bone beside a body from which on it is the sacrum's."""
_SEED_TO_CANAL_MM = 24.0
_ARCH_BEHIND_MM, ARCH_ASIDE_MM = 13.0, 8.0
"""The spinous process lies so far behind the canal, within so much to either side."""


@dataclass(frozen=True)
class _Found:
    course: Course
    scan: Field
    looks: Looks
    bounds: list[Bound]
    usual: NDArray[np.float64]


@explains_arguments
def split_vertebrae(
    volume: Volume, *, level: float | None = None, seeds: ArrayLike | None = None,
    name_at: tuple[Sequence[float], str] | None = None, first: str | None = None, keep_unsure: bool = False,
    progress: Progress | None = None,
) -> VertebraSplit:  # fmt: skip
    """Make a first guess of where each vertebra is, without a label map.

    Meant for the spine of an adult from C3 down in CT.  It is a starting point for corrections by hand; a
    trained segmentation is better.

    Parameters
    ----------
    volume : Volume
        A scan in HU.
    level : float, optional
        HU from which on a voxel is bone; by default half way between discs and marrow, but 120 to 226.
    seeds : array_like, shape (n, 3), optional
        Points in LPS mm, each in the body of a vertebra, in any order: there are these vertebrae and no others, with
        one disc between each two.
    name_at : ((x, y, z), str), optional
        A point in LPS mm in a vertebra, and its level (``"L3"``): the others are named from there, and numbered as in
        the VerSe data set (C1 is 1, T1 is 8, L1 is 20).
    first : str, optional
        The level of the uppermost vertebra that is found (``"T1"``), cut or not: the others are named from there, as
        with ``name_at``.  Without both they are numbered from the head.
    keep_unsure : bool
        True: the label map has vertebrae of low confidence too.
    progress : callable, optional
        Called as ``progress("canal" or "vertebrae", steps done, steps)``.

    Raises
    ------
    UsageError
        A parameter is impossible, ``name_at`` is in no vertebra, or there are more vertebrae than levels to name.
    RefusedInputError
        No spine, fewer than two discs, or all vertebrae are of low confidence.
    """
    progress = progress or ignore_progress
    _check_input(volume, level)
    points = None if seeds is None else _checked_seeds(seeds)
    level_name = check_landmark(name_at, first)
    landmark = None if name_at is None else checked_points([name_at[0]])[0]
    progress("canal", 0, 1)
    line = _canal_points(volume, points, progress)
    progress("vertebrae", 0, 4)
    discs = _find_discs(volume, line, points)
    progress("vertebrae", 1, 4)
    hu = _choose_level(discs) if level is None else float(level)
    part = cut_part(volume, discs.course, discs.looks)
    bone = fill_bone(part, hu)
    progress("vertebrae", 2, 4)
    planes = planes_of(discs.bounds, discs.course, discs.looks)
    pieces, doubtful, rim = divide(part, bone, discs.bounds, planes, volume)
    progress("vertebrae", 3, 4)
    voxel_ml = float(abs(np.linalg.det(volume.affine[:3, :3])) / 1000.0)
    behind = pieces[(part.ahead < -_ARCH_BEHIND_MM) & (np.abs(part.aside) < ARCH_ASIDE_MM)]
    volumes, arches = (
        voxel_ml * np.bincount(voxels, minlength=len(discs.bounds) + 2) for voxels in (pieces.ravel(), behind)
    )
    measures = {"volume_ml": volumes, "doubtful_share": doubtful, "rim_share": rim, "arch_ml": arches}
    spans, left_out = _spans(discs, pieces, measures, hu)
    position = 0 if landmark is None else _place_of(landmark, spans, discs, volume, part.first, pieces)
    names = name_levels(len(spans), None if level_name is None else (position, level_name))
    vertebrae = _judge_all(spans, names, discs)
    named = {one.number: one.name for one in vertebrae if one.is_confident or keep_unsure}
    if not named:
        raise RefusedInputError(_describe_refusal(vertebrae, left_out))
    every = np.zeros(len(discs.bounds) + 2, np.uint8)  # number of each piece
    every[[piece_number for piece_number, _ in spans]] = [one.number for one in vertebrae]
    plane = _middle_plane(volume, discs, spans, _as_map(volume, part.where, every[pieces], {}))
    labels = _as_map(volume, part.where, np.where(np.isin(every, list(named)), every, 0)[pieces], named)
    centres, normals = planes_of([bound for bound in discs.bounds if bound.is_disc], discs.course, discs.looks)
    progress("vertebrae", 4, 4)
    return VertebraSplit(labels, vertebrae, centres, normals, hu, left_out, plane)


def _check_input(volume: Volume, level: float | None) -> None:
    if level is not None and not math.isfinite(level):
        raise UsageError(f"the level of bone is a number of HU, not {level!r}")
    if volume.uneven:
        raise RefusedInputError(
            "the slices are unevenly spaced, and a label map cannot follow them: resample the scan first"
        )


def _checked_seeds(seeds: ArrayLike) -> Float64Array:
    points = checked_points(seeds)
    if len(points) < 2:
        raise UsageError(
            "seeds are points in the bodies of at least two vertebrae: with one there is no disc to look for"
        )
    return points[np.argsort(-points[:, 2])]


def _canal_points(volume: Volume, seeds: Float64Array | None, progress: Progress) -> Float64Array:
    """Return the middle of the canal; with seeds, where it is not found, it lies behind them."""
    try:
        line = find_spine_line(volume, progress=lambda _, done, total: progress("canal", done, total))
        return _without_short_ends(line)
    except RefusedInputError as error:
        if seeds is not None:
            return np.asarray(seeds + np.array([0.0, _SEED_TO_CANAL_MM, 0.0]))
        reason = str(error).partition(": give points")[0].partition("; give points")[0]
        raise RefusedInputError(
            f"{reason}; no vertebrae without it: give a point in each of them ({name_parameter('seeds', 'X,Y,Z')})"
        ) from error


def _without_short_ends(line: SpineLine) -> Float64Array:
    """Return the points of a line without ends that are not sure and so short that going straight on is better."""
    heights = line.points[::-1, 2]
    upper, lower = line.sure_mm
    first = upper if heights[-1] - upper < BEYOND_MM else heights[-1]
    last = lower if lower - heights[0] < BEYOND_MM else heights[0]
    inner = heights[(heights > last + 1.0) & (heights < first - 1.0)]
    heights_kept = np.array([last, *inner, first])[::-1]
    return np.stack([np.interp(heights_kept, heights, axis) for axis in line.points[::-1].T], axis=1)


def _find_discs(volume: Volume, line: Float64Array, seeds: Float64Array | None) -> _Found:
    course = follow_canal(line, volume)
    scan = sample_course(volume, course)
    looks = look_at_bodies(scan)
    if seeds is None:
        bounds, usual = choose_discs(looks)
    else:
        seed_stations = [course.nearest(seed) for seed in seeds]
        if min(np.diff(sorted(seed_stations))) < 8:
            raise UsageError("two seeds lie at the same height of the spine: one is needed in each vertebra")
        bounds, usual = discs_between(looks, seed_stations)
    if len(bounds) < 2 and seeds is None:
        disc_count = "one disc was" if bounds else "no disc was"
        raise RefusedInputError(
            f"{disc_count} found along {len(course)} mm of the spine, and a vertebra is what lies between two:"
            f" give a point in each vertebra ({name_parameter('seeds', 'X,Y,Z')})"
        )
    gaps = [float(b.at - a.at) for a, b in itertools.pairwise(bounds)] or [30.0]
    first = end_of_bone(looks, bounds[0], gaps[0], -1)
    last = end_of_bone(looks, bounds[-1], gaps[-1], 1)
    bounds = [*([first] if first else []), *bounds, *([last] if last else [])]
    return _Found(course, scan, looks, bounds, usual)


def _choose_level(discs: _Found) -> float:
    """Return the level half way between the discs and the marrow of the bodies, HU."""
    disc_stations = np.array([bound.at for bound in discs.bounds if bound.is_disc])
    middles = (disc_stations[:-1] + disc_stations[1:]) // 2 if len(disc_stations) > 1 else disc_stations + 15
    columns = [discs.looks.middle_mm.astype(int) + shift for shift in (-5, 0, 5)]
    disc, marrow = (
        float(np.nanmedian(np.stack([discs.looks.core[rows, column[rows]] for column in columns])))
        for rows in (disc_stations, np.clip(middles, 0, len(discs.scan) - 1))
    )
    return float(np.clip(disc + _LEVEL_SHARE * (marrow - disc), *_LEVELS_HU))


def _spans(
    discs: _Found, pieces: NDArray[np.uint8], measures: Mapping[str, NDArray[Any]], level: float
) -> tuple[list[tuple[int, Piece]], list[str]]:
    """Return the number and span of each piece that is a vertebra, and what else was seen.

    `measures` are fields of a `Piece`, each by the number of the piece.
    """
    from scipy.ndimage import find_objects

    bounds = discs.bounds
    boxes = find_objects(pieces, max_label=len(bounds) + 1)
    spans, left_out = [], []
    gaps = [float(b.at - a.at) for a, b in itertools.pairwise(bounds)] or [30.0]
    for number, (upper, lower) in enumerate(itertools.pairwise([None, *bounds, None]), 1):
        begin, end = (upper.at if upper else 0), (lower.at if lower else len(discs.course))
        if end <= begin:
            continue
        share = 0.0
        if (box := boxes[number - 1]) is not None:
            sizes = Regions(pieces[box] == number, FACES).sizes
            share = float(sizes.max() / sizes.sum())
        measured = {name: float(by_piece[number]) for name, by_piece in measures.items()}
        piece = Piece(upper, lower, begin, end, largest_share=share, **measured)
        reason = _no_vertebra(piece, discs, gaps, level)
        if reason is None:
            spans.append((number, piece))
        elif reason:
            side_text = "above the first vertebra" if number == 1 else "below the last vertebra"
            left_out.append(f"{side_text} {reason}")
    return spans, left_out


def _no_vertebra(piece: Piece, discs: _Found, gaps: list[float], level: float) -> str | None:
    """Return why a piece is no vertebra, None where it may be one, "" where there is nothing to tell."""
    height = piece.end - piece.begin
    known = piece.upper or piece.lower
    if known is None or not (known.is_disc or piece.whole):
        return ""  # beyond the end of the bone
    if piece.lower is None or not piece.lower.is_disc:
        share = beside_share(discs.scan, discs.looks, piece, level)
        if share >= _WINGS:
            return f"the bone has wings ({100 * share:.0f} % beside its body): it looks like the sacrum"
    if piece.whole:
        return None
    reaches = discs.course.reaches[0 if piece.upper is None else 1]
    gap = gaps[0] if piece.upper is None else gaps[-1]
    if not reaches or height > 1.3 * gap:
        return f"{height} mm follow without a disc that was found"
    return None if height >= _CUT_MM else f"only {height} mm of a vertebra are in the scan"


def _place_of(
    point: Float64Array, spans: list[tuple[int, Piece]], discs: _Found, volume: Volume, first: tuple[int, int, int],
    pieces: NDArray[np.uint8],
) -> int:  # fmt: skip
    """Return the place of the vertebra at a point: by its bone, else by the height of the point along the spine."""
    i, j, k = np.rint(volume.lps_to_ijk([point])[0]).astype(int) - np.array(first[::-1])
    number = 0
    if all(0 <= n < size for n, size in zip((k, j, i), pieces.shape, strict=True)):
        number = int(pieces[k, j, i])
    station = discs.course.nearest(point)
    far = float(np.linalg.norm(discs.course.canal[station] - point)) > 80.0
    for index, (number_there, piece) in enumerate(spans):
        if number_there == number or (not number and not far and piece.begin <= station < piece.end):
            return index
    shown = ", ".join(f"{value:g}" for value in point)
    raise UsageError(f"there is no vertebra at {shown} mm: give a point in the body of one that was found")


def _judge_all(spans: list[tuple[int, Piece]], names: dict[int, str], discs: _Found) -> list[Vertebra]:
    vertebrae = []
    for n, ((_, piece), (number, name)) in enumerate(zip(spans, names.items(), strict=True)):
        beside = [spans[m][1] for m in (n - 2, n - 1, n + 1, n + 2) if 0 <= m < len(spans)]
        gaps = [float(one.end - one.begin) for one in beside if one.whole and _between_discs(one)]
        traits = judge(piece, gaps if _between_discs(piece) else [], discs.scan, discs.looks, discs.course, discs.usual)
        confidence, doubts = weigh(traits)
        middle = (piece.begin + piece.end) // 2
        centre = discs.course.canal[middle] + discs.looks.middle_mm[middle] * discs.course.ahead[middle]
        vertebrae.append(
            Vertebra(
                number=number,
                name=name,
                confidence=round(confidence, 3),
                is_confident=confidence >= CONFIDENT,
                doubts=doubts,
                whole=piece.whole,
                centre_mm=[round(float(value), 2) for value in centre],
                height_mm=float(piece.end - piece.begin),
                volume_ml=round(piece.volume_ml, 3),
            )
        )
    return vertebrae


def _between_discs(piece: Piece) -> bool:
    return all(bound is not None and bound.is_disc for bound in (piece.upper, piece.lower))


def _describe_refusal(vertebrae: list[Vertebra], left_out: list[str]) -> str:
    if not vertebrae:
        return f"no vertebra was found: {'; '.join(left_out) or 'nothing lies between two discs'}"
    first = vertebrae[0]
    return (
        f"none of the {count_of(len(vertebrae), 'vertebra', 'vertebrae')} found has a confidence of {CONFIDENT:g}"
        f" or more ({first.name} {first.confidence:.2f}: {'; '.join(first.doubts)}): give a point in each"
        f" ({name_parameter('seeds', 'X,Y,Z')}), or keep them ({name_parameter('keep_unsure', True)}) and look at the"
        " picture"
    )


def _as_map(volume: Volume, box: tuple[slice, slice, slice], numbers: NDArray[Any], names: dict[int, str]) -> LabelMap:
    voxels = np.zeros(volume.voxels.shape, np.uint8)
    voxels[box] = numbers
    return LabelMap(voxels, volume.affine, names)


def _middle_plane(volume: Volume, discs: _Found, spans: list[tuple[int, Piece]], labels: LabelMap) -> MiddlePlane:
    """Sample the scan and all labels in the straightened middle plane and through the bodies."""
    course, looks = discs.course, discs.looks
    ahead = np.arange(-58.0, AHEAD_MM[-1])
    sagittal = sample_course(volume, course, ahead, np.zeros(1))[:, ::-1, 0]
    numbers = sample_course(labels, course, ahead, np.zeros(1), order=0)[:, ::-1, 0]
    rows, columns = np.arange(len(course)), np.rint(looks.middle_mm).astype(int)
    coronal = discs.scan[rows, columns]
    beside = sample_course(labels, course, AHEAD_MM, ASIDE_MM, order=0)[rows, columns]
    canal = len(ahead) - 1 - int(-ahead[0])
    lines = []
    for bound in discs.bounds:
        slope, middle = math.tan(math.radians(TILTS_DEG[bound.tilt])), looks.middle_mm[bound.at]
        ends = (looks.front_mm[bound.at], BODY_BACK_MM)
        front, back = ((float(bound.at + slope * (end - middle)), float(canal - end)) for end in ends)
        lines.append((front, back))
    return MiddlePlane(
        sagittal,
        coronal,
        np.nan_to_num(numbers).astype(np.int32),
        np.nan_to_num(beside).astype(np.int32),
        canal,
        int(-ASIDE_MM[0]),
        lines,
        [0.5 * (piece.begin + piece.end) for _, piece in spans],
    )
