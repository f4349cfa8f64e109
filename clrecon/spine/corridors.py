"""The corridors of one labelled vertebra: the widest straight line of each pedicle, or why there is none.

What counts of a line is its least distance to the outside of the solid bone, from the coronal plane through the canal's
axis to `BODY_SHARE` of the body's depth.  Behind that plane a screw has to leave the bone, and every line would end at
zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.iso_choice import settle_level
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import checked_iso_value
from clrecon.labels import LabelMap
from clrecon.labels.resample import resample_labels
from clrecon.spine.frame import VertebraFrame, find_frame
from clrecon.spine.measures import Bias, canal_wall, find_exit, line_angles, margins, measure_bias, segment_offsets
from clrecon.spine.solid_bone import Fitted, SolidBone, fill_vertebra
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass

Depth = Callable[[Float64Array], Float64Array]
"""Distance from the surface at points (n, 3) in the vertebra's frame, mm, positive inside."""

SIDES = {"left": 1.0, "right": -1.0}
"""Sign of x in the frame on either side of the patient."""

BODY_SHARE = 0.8
"""Share of the body's depth at which a line ends."""

REACH_MM = 8.0
"""Points of the surface so far before the tip and behind the back plane are no nearer than the pedicle's walls."""

_ALONG_MM = 0.75
"""Step along a line."""

_MEDIAL_DEG = (-15.0, 45.0)
_SAGITTAL_DEG = (-36.0, 36.0)
COARSE_DEG = 3.0
COARSE_MM = 1.0

KEPT = 100
"""Lines of the coarse search that are refined."""
FINE_STEPS = ((0.5, 1.5), (0.2, 0.6), (0.08, 0.25))
"""Steps of the refinement: of the pass point in mm, of the angles in degrees."""
_MOST_MOVES = 8
"""Moves at each step."""

SAME_MM = 0.1
"""Lines whose radius is less than this below the widest are as good: the angles' ranges are theirs."""

_EVENNESS = 0.02
"""Weight of the mean depth along a line beside its least distance: of lines alike in that the deeper one is taken."""

_QUICK_OFF_MM = 1.0
"""Quick distances are right to this much."""

_BESIDE_KNOWN_MM = 2.0
"""Lines this near to those of the coarse search are judged by the points of the surface beside these."""

THIN_MM = 0.8
"""Side of the cells of which one point of the surface each is taken, until the last step."""
LAST = 8
"""Lines of the last step, against all points of the surface."""

AT_ONCE = 50_000
"""Pairs of a line and a point of the surface whose distances are in memory together: they fit a core's cache, and the
product is too small for threads of BLAS, whose waiting for each other can take 30 times as long as the work."""


@dataclass(frozen=True)
class Span:
    """The coronal planes (y, mm in the frame) between which lines of a side (1 left, -1 right) count; the narrowest."""

    side: float
    back: float
    tip: float
    pass_y: float


@dataclass(frozen=True)
class Line:
    """A line on one side, in the vertebra's frame, by the point where it passes ``y = span.pass_y``, mm.

    medial_deg, sagittal_deg: As of `clrecon.spine.measures.line_angles`.
    radius: Its least distance from the surface, mm.
    medial_range, sagittal_range: Angles of lines whose radius is at most `SAME_MM` less.
    tried: Lines whose distance was taken.
    """

    x: float
    z: float
    medial_deg: float
    sagittal_deg: float
    radius: float
    medial_range: tuple[float, float]
    sagittal_range: tuple[float, float]
    tried: int


def line_points(lines: Float64Array, span: Span) -> Float64Array:
    """Return points (n, m, 3) of lines (n, 4: x, z, medial, sagittal), from the back plane to the tip."""
    # y of -1, forward, not of unit length
    medial, sagittal = np.radians(lines[:, 2]), np.radians(lines[:, 3])
    direction = np.stack((-span.side * np.tan(medial), np.full(np.shape(medial), -1.0), np.tan(sagittal)), axis=-1)
    start = np.stack((lines[:, 0], np.full(len(lines), span.pass_y), lines[:, 1]), axis=1)
    count = int(np.ceil((span.back - span.tip) / _ALONG_MM)) + 1
    steps = span.pass_y - np.linspace(span.back, span.tip, count)
    return np.asarray(start[:, None] + steps[None, :, None] * direction[:, None])


def _least_and_mean(depth: Depth, lines: Float64Array, span: Span) -> tuple[Float64Array, Float64Array]:
    points = line_points(lines, span)
    depths = depth(points.reshape(-1, 3)).reshape(points.shape[:2])
    return depths.min(axis=1), depths.mean(axis=1)


def segment_distances(first: Float64Array, last: Float64Array, points: Float64Array) -> Float64Array:
    """Return the least distance (n,) of segments between ends (n, 3) from points (m, 3); infinite without points."""
    if not len(points):
        return np.full(len(first), np.inf)
    squares = [part.min(axis=1) for part in _pair_squares(first, last, points)]
    return np.sqrt(np.maximum(np.concatenate(squares), 0.0), dtype=np.float64)


def _pair_squares(first: Float64Array, last: Float64Array, points: Float64Array) -> Iterator[NDArray[np.float32]]:
    """Yield the squared distances (k, m) of the segments, some at a time, from points (m, 3), of which there is one."""
    middle = points.mean(axis=0)
    rows = points - middle
    ones = np.ones(len(rows))
    # float32 is right to 0.001 mm for coordinates of some centimetres about the middle
    table = np.stack((*rows.T, ones, np.einsum("ij,ij->i", rows, rows))).astype(np.float32)
    step = max(1, AT_ONCE // len(points))
    for start in range(0, max(len(first), 1), step):
        starts, ends = first[start : start + step] - middle, last[start : start + step] - middle
        length = np.linalg.norm(ends - starts, axis=1)
        unit = (ends - starts) / np.maximum(length, 1e-9)[:, None]
        start_along = np.einsum("ij,ij->i", unit, starts)
        nothing = np.zeros(len(starts))
        along = np.column_stack((unit, -start_along, nothing)).astype(np.float32) @ table
        square = (
            np.column_stack((-2.0 * starts, np.einsum("ij,ij->i", starts, starts), nothing + 1.0)).astype(np.float32)
            @ table
        )
        # square of the distance from the first end; less what lies along the segment, plus what lies beyond its ends
        clipped = np.clip(along, np.float32(0.0), length.astype(np.float32)[:, None])
        along *= np.float32(2.0)
        along -= clipped
        along *= clipped
        square -= along
        yield square


@dataclass(frozen=True)
class LineJudge:
    """Scores of lines on one side, by quick distances and by points (n, 3) of the surface, mm in the frame.

    walls: The points within `reach` mm of known lines, whose ends (n, 6) `known` finds.
    """

    depth: Depth
    surface: Float64Array
    span: Span
    walls: Float64Array
    reach: float
    known: Any

    @classmethod
    def beside(cls, lines: Float64Array, reach: float, depth: Depth, surface: Float64Array, span: Span) -> LineJudge:
        """Make the judge of lines (n, 4) and of those beside them."""
        from scipy.spatial import cKDTree

        ways = line_points(lines, span)
        first, last = ways[:, 0], ways[:, -1]
        square = np.min([part.min(axis=0) for part in _pair_squares(first, last, surface)], axis=0)
        return cls(depth, surface, span, surface[square <= reach**2], reach, cKDTree(np.hstack((first, last))))

    def radius(self, lines: Float64Array) -> Float64Array:
        """Return the least distance of lines (n, 4) from the points of the surface."""
        points = line_points(lines, self.span)
        first, last = points[:, 0], points[:, -1]
        least = segment_distances(first, last, self.walls)
        # no point of a line is farther from one that is known than its ends are, and all else is farther than `reach`
        aside, _ = self.known.query(np.hstack((first, last)))
        undecided = least > self.reach - aside - 0.01
        least[undecided] = segment_distances(first[undecided], last[undecided], self.surface)
        return least

    def score(self, lines: Float64Array, above: Float64Array | None = None) -> Float64Array:
        """Return the radius with a little of the mean; below 0 out of the bone; only for lines that may be `above`."""
        least, mean = _least_and_mean(self.depth, lines, self.span)
        score = np.minimum(least, 0.0) - 1.0
        hopeful = least > (0.0 if above is None else np.maximum(above - _QUICK_OFF_MM, 0.0))
        score[hopeful] = self.radius(lines[hopeful]) + _EVENNESS * mean[hopeful]
        return score


def _pass_points(coarse: Depth, frame: VertebraFrame, side: float, back: float) -> tuple[float, Float64Array]:
    """Return y of the narrowest coronal section of the pedicle, and points (n, 2: x, z) in it."""
    half = 0.75 * frame.body_height
    x = frame.canal[0] + side * np.arange(2.0, 32.0, COARSE_MM)
    z = np.arange(-half, half + 0.1, COARSE_MM)
    grid = np.stack([part.ravel() for part in np.meshgrid(x, z, indexing="ij")], axis=1)
    best: tuple[float, float, Float64Array] = (np.inf, back, np.zeros((0, 2)))
    for y in np.arange(frame.body_y[1] - 1.0, back + 0.1, COARSE_MM):
        depths = coarse(np.stack((grid[:, 0], np.full(len(grid), y), grid[:, 1]), axis=1))
        deepest = float(depths.max())
        if deepest < best[0]:
            best = (deepest, float(y), grid[depths >= max(0.6 * deepest, 0.3)])
    return best[1], best[2]


def _thin(points: Float64Array) -> Float64Array:
    """Return the first of the points in each cell of `THIN_MM`."""
    cells = np.floor((points - points.min(axis=0, initial=0.0)) / THIN_MM).astype(np.int64)
    key = (cells[:, 0] << 40) + (cells[:, 1] << 20) + cells[:, 2]
    return points[np.sort(np.unique(key, return_index=True)[1])]


def find_line(depth: Depth, surface: Float64Array, frame: VertebraFrame, side: float) -> tuple[Line | None, Span]:
    """Find the widest line of one side (1 left, -1 right); None where no line stays inside of the bone.

    depth: Quick distances, for the many lines of the first search; 0 or less outside.
    surface: ndarray, shape (n, 3). Points of the surface, mm in the frame: exact distances, for the best lines.
    """
    back = frame.canal[1]
    tip = frame.body_y[1] - BODY_SHARE * (frame.body_y[1] - frame.body_y[0])
    pass_y, places = _pass_points(depth, frame, side, back)
    span = Span(side, back, tip, pass_y)
    if not len(places):
        return None, span
    near = (surface[:, 1] > tip - REACH_MM) & (surface[:, 1] < back + REACH_MM)
    medial = np.arange(_MEDIAL_DEG[0], _MEDIAL_DEG[1] + 0.1, COARSE_DEG)
    sagittal = np.arange(_SAGITTAL_DEG[0], _SAGITTAL_DEG[1] + 0.1, COARSE_DEG)
    turns = np.stack([part.ravel() for part in np.meshgrid(medial, sagittal, indexing="ij")], axis=1)
    lines = np.hstack((np.repeat(places, len(turns), axis=0), np.tile(turns, (len(places), 1))))
    parts = np.array_split(lines, len(lines) // 5000 + 1)
    score = np.concatenate([_least_and_mean(depth, part, span)[0] for part in parts])
    order = np.argsort(score)[::-1]
    chosen = order[:KEPT][score[order[:KEPT]] > 0.0]
    if not len(chosen):
        return None, span
    reach = float(score[order[0]]) + _QUICK_OFF_MM + _BESIDE_KNOWN_MM
    judge, last = (
        LineJudge.beside(lines[chosen], reach, depth, points, span) for points in (_thin(surface[near]), surface[near])
    )
    free = np.ones(4, dtype=bool)
    best, top, tried = _refine(judge, lines[chosen], free)
    winner = best[int(top.argmax())]
    for column, angles in ((2, medial), (3, sagittal)):
        starts = []
        for angle in angles:  # the best lines of this angle, from the first search and from the widest line
            rows = np.flatnonzero(lines[:, column] == angle)
            turned = winner.copy()
            turned[column] = angle
            starts += [lines[rows[int(score[rows].argmax())]], turned]
        free_columns = free.copy()
        free_columns[column] = False
        refined, scores, more = _refine(judge, np.array(starts), free_columns, FINE_STEPS[:2])
        best, top = np.concatenate((best, refined)), np.concatenate((top, scores))
        tried = tried + more
    best = best[top > 0.0]
    refined, scores, more = _refine(last, best[np.argsort(top[top > 0.0])[::-1][:LAST]], free, FINE_STEPS[1:])
    winner, tried = refined[int(scores.argmax())], tried + more
    best = np.concatenate((best, refined))
    radii = last.radius(best)
    radius = float(last.radius(winner[None])[0])
    good = best[radii >= radius - SAME_MM]
    ranges = [(float(good[:, column].min()), float(good[:, column].max())) for column in (2, 3)]
    x, z, medial_deg, sagittal_deg = (float(value) for value in winner)
    return Line(x, z, medial_deg, sagittal_deg, radius, ranges[0], ranges[1], len(lines) + tried), span


def _refine(
    judge: LineJudge, lines: Float64Array, free: NDArray[np.bool_], steps: tuple[tuple[float, float], ...] = FINE_STEPS
) -> tuple[Float64Array, Float64Array, int]:
    """Move lines (n, 4) to higher scores (n,), together, in ever finer steps of `free` columns; count those judged."""
    lines = lines.copy()
    score = judge.score(lines)
    tried = len(lines)
    for shift, turn in steps:
        moves = np.diag((shift, shift, turn, turn))[free]
        moves = np.concatenate((moves, -moves))
        going = np.arange(len(lines))
        for _ in range(_MOST_MOVES):
            following = (lines[going, None] + moves[None]).reshape(-1, 4)
            scores = judge.score(following, np.repeat(score[going], len(moves))).reshape(len(going), len(moves))
            tried += scores.size
            which = scores.argmax(axis=1)
            gained = scores[np.arange(len(going)), which]
            better = gained > score[going] + 1e-4
            going = going[better]
            lines[going] += moves[which[better]]
            score[going] = gained[better]
            if not len(going):
                break
    return lines, score, tried


_LEAST_RADIUS_MM, _LARGEST_RADIUS_MM = 1.0, 9.0
"""Radii of pedicles: below there is no room for any screw, above there is no pedicle."""

_RESOLVED_VOXELS = 2.0
"""Least width of a pedicle in voxels, across its nearest wall."""

BESIDE_MM = 1.5
"""Points of the surface that are this much farther from the line than the nearest one are the corridor's walls."""


@dataclass(frozen=True)
class Corridor:
    """The widest line through one pedicle, left or right of the patient.  Points (3,) are LPS mm.

    refused: Why there is no corridor; everything below is None then.
    radius: Least distance of the line from the surface of the bone, from `back` to `tip`, mm.
    entry: Where the line, followed backwards, leaves the bone.
    back: Where its distance begins to count: in the coronal plane through the canal's axis.
    pass_point: In the narrowest coronal section of the pedicle.
    tip: At 80 % of the body's depth.
    length: From entry to tip, mm.
    medial_deg, sagittal_deg: Angles in the vertebra's frame, see `clrecon.spine.measures.line_angles`.
    medial_lps_deg, sagittal_lps_deg: The same in the patient's frame.
    medial_range_deg, sagittal_range_deg: Angles, in the vertebra's frame, of lines whose radius is at most 0.1 mm less.
    margins, canal: Least distances from the surface by quarter, and from the wall of the vertebral canal, mm.
    bias: How far the level lies from the half maximum of this pedicle's wall; None for a fitted surface.
    by_hu_share: Share of the walls' points that HU place and not the label.
    width_voxels: Width of the corridor in voxels, across its nearest wall.
    tried: Lines whose distance was taken.
    """

    side: str
    refused: str | None = None
    radius: float | None = None
    entry: Float64Array | None = None
    back: Float64Array | None = None
    pass_point: Float64Array | None = None
    tip: Float64Array | None = None
    length: float | None = None
    medial_deg: float | None = None
    sagittal_deg: float | None = None
    medial_lps_deg: float | None = None
    sagittal_lps_deg: float | None = None
    medial_range_deg: tuple[float, float] | None = None
    sagittal_range_deg: tuple[float, float] | None = None
    margins: dict[str, float | None] | None = None
    canal: float | None = None
    bias: Bias | None = None
    by_hu_share: float | None = None
    width_voxels: float | None = None
    tried: int | None = None


@dataclass(frozen=True)
class VertebraCorridors:
    """Both corridors of a vertebra, left and right, and the name of its label."""

    name: str
    bone: SolidBone
    frame: VertebraFrame
    corridors: tuple[Corridor, ...]
    warnings: tuple[str, ...]


def screw_diameter(radius: float, margin: float) -> float:
    """Return the largest diameter of a screw that keeps a margin to the surface, mm, down to the last tenth."""
    return max(0.0, math.floor(20.0 * (radius - margin) + 1e-9) / 10.0)


@explains_arguments
def find_corridors(
    volume: Volume, labels: LabelMap, label: int | str, iso_value: float | Literal["auto"]
) -> VertebraCorridors:
    """Find the widest straight corridors through the pedicles of a labelled vertebra.

    It measures one surface at one level of HU and is not for planning an operation; see docs/corridor.md.

    Parameters
    ----------
    volume : Volume
        HU.
    labels : LabelMap
        On any grid; each label is one vertebra.
    label : int or str
        Number or name, as `LabelMap.find` takes it.
    iso_value : float or "auto"
        HU at which the bone's surface lies; "auto" is that of `choose_iso_value`.

    Returns
    -------
    VertebraCorridors
        Points in LPS mm.  A side without a corridor says why.

    Raises
    ------
    UsageError
        There is no such label.
    RefusedInputError
        The label is not that of a whole vertebra, or it is cut off at the end of the scan.
    """
    number = labels.find(label)
    placed, (level, _) = resample_labels(labels, volume), settle_level(volume, iso_value)
    return measure_corridors(volume, placed.voxels, number, checked_iso_value(level), labels.name(number))


def measure_corridors(
    volume: Volume, labels: NDArray[Any], number: int, level: float, name: str, fitted: Fitted | None = None
) -> VertebraCorridors:
    """Find the corridors of a vertebra, label `number` on the volume's own grid; `name` is for messages."""
    bone = fill_vertebra(volume, labels, number, level, name, fitted)
    try:
        frame = find_frame(bone, name)
    except RefusedInputError as error:
        if not len(bone.cut):
            raise
        raise RefusedInputError(f"{error}; it reaches the end of the scan and may be cut off there") from error
    warnings = _judge_cut(bone, frame, name)
    surface = frame.to_frame(bone.surface)
    wall = surface[canal_wall(bone, frame)]
    corridors = []
    for side, sign in SIDES.items():
        line, span = find_line(lambda points: bone.quick_depth(frame.to_lps(points)), surface, frame, sign)
        corridors.append(_measure_corridor(bone, frame, surface, wall, side, line, span))
    return VertebraCorridors(name, bone, frame, tuple(corridors), tuple(warnings))


def _judge_cut(bone: SolidBone, frame: VertebraFrame, name: str) -> list[str]:
    """Refuse a vertebra whose body or pedicles go on beyond the scan; warn where only processes do."""
    if not len(bone.cut):
        return []
    local = frame.to_frame(bone.cut)  # joints above and below the body are processes too
    front = (local[:, 1] < frame.canal[1]) & (np.abs(local[:, 2]) <= 0.6 * frame.body_height)
    if front.any():
        raise RefusedInputError(
            f"{name} is cut off: {int(front.sum()):,} voxels of its body and pedicles lie in the outermost layer of the"
            " scan, and it may go on beyond; corridors need the whole body and both pedicles"
        )
    return [f"{name} touches the end of the scan with its processes; body and pedicles are whole"]


def _measure_corridor(
    bone: SolidBone, frame: VertebraFrame, surface: Float64Array, wall: Float64Array, side: str, line: Line | None,
    span: Span,
) -> Corridor:  # fmt: skip
    if line is None:
        return Corridor(
            side,
            f"no line stays in the bone at {bone.level:g} HU from the canal's plane to the front of the body: the"
            " pedicle is not resolved, or the level is too high",
        )
    ends = line_points(np.array([[line.x, line.z, line.medial_deg, line.sagittal_deg]]), span)[0]
    first, last = ends[0], ends[-1]
    axis = last - first
    voxels, by_hu = _walls(bone, frame, surface, first, last, line.radius)
    refused = None
    if line.radius > _LARGEST_RADIUS_MM:
        refused = f"the widest line has a radius of {line.radius:.1f} mm: that is no pedicle of one vertebra"
    elif voxels < _RESOLVED_VOXELS:
        refused = (
            f"the pedicle is not resolved: the widest line is {2.0 * line.radius:.1f} mm wide, {voxels:.1f} voxels, and"
            f" less than {_RESOLVED_VOXELS:g} say nothing of its walls"
        )
    elif line.radius < _LEAST_RADIUS_MM:
        refused = f"the widest line has a radius of {line.radius:.1f} mm: there is no room in this pedicle"
    if refused is not None:
        return Corridor(side, refused, width_voxels=voxels)
    middle = first + (span.back - frame.body_y[1]) / (span.back - span.tip) * axis
    start, *_, tip = frame.to_lps(np.stack((first, last)))
    exit_point = find_exit(bone, start, start - tip)
    lps = tip - start
    pass_point = first + (span.back - span.pass_y) / (span.back - span.tip) * axis
    medial, sagittal = line_angles(axis, span.side)
    medial_lps, sagittal_lps = line_angles(lps, span.side)
    canal = float(np.linalg.norm(segment_offsets(wall, first, last)[0], axis=1).min()) if len(wall) else None
    return Corridor(
        side, None, line.radius, exit_point, start, frame.to_lps(pass_point[None])[0], tip,
        float(np.linalg.norm(tip - exit_point)), medial, sagittal, medial_lps, sagittal_lps, line.medial_range,
        line.sagittal_range, margins(surface, first, last, span.side), canal,
        None if bone.fitted else measure_bias(bone, frame, first, middle), by_hu, voxels, line.tried,
    )  # fmt: skip


def _walls(
    bone: SolidBone, frame: VertebraFrame, surface: Float64Array, first: Float64Array, last: Float64Array, radius: float
) -> tuple[float, float]:
    """Return the width of a line in voxels along the way to the nearest wall, and the share of walls that HU place."""
    offsets, _ = segment_offsets(surface, first, last)
    distance = np.linalg.norm(offsets, axis=1)
    nearest = int(distance.argmin())
    voxel = float(np.abs(bone.steps.T @ ((offsets[nearest] / distance[nearest]) @ frame.axes)).max())
    beside = distance <= radius + BESIDE_MM
    return 2.0 * radius / voxel, float(bone.by_hu[beside].mean())
