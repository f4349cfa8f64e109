"""Measures of a line in a vertebra, and grades of given screws: how far they breach the bone, and where."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.spine.frame import VertebraFrame
from clrecon.spine.solid_bone import SolidBone
from clrecon.system.light_dataclass import dataclass

DIRECTIONS = ("medial", "lateral", "cranial", "caudal")

_RAY_STEP_MM = 0.1
_REACH_MM = 80.0
RAYS = 24
STATIONS = 5

WALL_MM = 2.0
"""Reach on both sides of the wall in which its peak and the tissue beside it are looked for."""
_LEAST_CONTRAST_HU = 150.0
"""Least difference of peak and tissue by which a half maximum is taken."""

CANAL_REACH_MM = 22.0
_CANAL_SAMPLES = 16


@dataclass(frozen=True)
class Bias:
    """How far the surface at the level lies outside of the half maximum of the pedicle's own wall.

    median_mm, low_mm, high_mm: Median and quartiles over the rays; positive: the level lies outside, distances too
        large.
    half_hu: Median of the levels half way between the wall's peak and the tissue beside it.
    rays: Rays with a wall that is dense enough.
    """

    median_mm: float
    low_mm: float
    high_mm: float
    half_hu: float
    rays: int


def line_angles(direction: Float64Array, side: float) -> tuple[float, float]:
    """Return the medial and the sagittal angle, degrees, of a direction (left, posterior, cranial) that is forward."""
    x, y, z = (float(part) for part in direction)
    return float(np.degrees(np.arctan2(-side * x, -y))), float(np.degrees(np.arctan2(z, -y)))


def _across(direction: Float64Array, side: float) -> tuple[Float64Array, Float64Array]:
    """Return the unit vectors square to a line of the frame that run medially and cranially."""
    unit = direction / np.linalg.norm(direction)
    up = np.array((0.0, 0.0, 1.0)) - unit[2] * unit
    up /= np.linalg.norm(up)
    medial = np.cross(unit, up)
    return (medial if medial[0] * side < 0.0 else -medial), up


def sector_names(offsets: Float64Array, direction: Float64Array, side: float) -> NDArray[np.intp]:
    """Return for offsets (n, 3) from a line the place in `DIRECTIONS` of the quarter in which they lie."""
    medial, up = _across(direction, side)
    shares = np.stack((offsets @ medial, -(offsets @ medial), offsets @ up, -(offsets @ up)), axis=1)
    return np.asarray(shares.argmax(axis=1), dtype=np.intp)


def segment_offsets(points: Float64Array, first: Float64Array, last: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return offsets of points (n, 3) from the nearest ones of a segment, and where on it, 0 to 1, these lie (n,)."""
    axis = last - first
    share = np.clip((points - first) @ axis / (axis @ axis), 0.0, 1.0)
    return points - first - share[:, None] * axis, share


def margins(surface: Float64Array, first: Float64Array, last: Float64Array, side: float) -> dict[str, float | None]:
    """Return a segment's least distance from points (n, 3) in the frame in each quarter, mm; None where none lies."""
    offsets, share = segment_offsets(surface, first, last)
    offsets = offsets[(share > 0.0) & (share < 1.0)]
    distance, sector = np.linalg.norm(offsets, axis=1), sector_names(offsets, last - first, side)
    margin_by_side: dict[str, float | None] = {}
    for number, name in enumerate(DIRECTIONS):
        in_sector = distance[sector == number]
        margin_by_side[name] = float(in_sector.min()) if len(in_sector) else None
    return margin_by_side


def canal_wall(bone: SolidBone, frame: VertebraFrame) -> NDArray[np.bool_]:
    """Mark the points of the surface that can be seen from the canal's axis at their own height: the canal's wall."""
    local = frame.to_frame(bone.surface)
    axis = frame.canal_at(local[:, 2])
    is_wall = np.zeros(len(local), dtype=bool)
    half = 0.75 * frame.body_height
    near = np.flatnonzero((np.linalg.norm(local - axis, axis=1) <= CANAL_REACH_MM) & (np.abs(local[:, 2]) <= half))
    blocked = np.zeros(len(near), dtype=bool)
    for share in np.linspace(0.0, 1.0, _CANAL_SAMPLES, endpoint=False):
        on_axis = axis[near] + share * (local[near] - axis[near])
        # within a step of the surface the nearest point of the lattice may be solid
        free = np.linalg.norm(local[near] - on_axis, axis=1) > 2.0 * bone.lattice.step
        blocked |= free & bone.is_solid(frame.to_lps(on_axis))
    is_wall[near[~blocked]] = True
    return is_wall


def find_exit(bone: SolidBone, start: Float64Array, direction: Float64Array) -> Float64Array:
    """Return where a ray from a point inside leaves the bone for the first time, LPS mm."""
    unit = direction / np.linalg.norm(direction)
    steps = np.arange(0.0, _REACH_MM, _RAY_STEP_MM)
    outside = ~bone.is_solid(start + steps[:, None] * unit)
    return np.asarray(start + (steps[int(outside.argmax())] if outside.any() else _REACH_MM) * unit, dtype=np.float64)


def measure_bias(bone: SolidBone, frame: VertebraFrame, first: Float64Array, last: Float64Array) -> Bias | None:
    """Measure the surface from the half maximum of the pedicle's wall on rays; None if under a quarter meet one."""
    medial, up = _across(last - first, 1.0)
    turns = np.linspace(0.0, 2.0 * np.pi, RAYS, endpoint=False)
    spokes = np.cos(turns)[:, None] * medial + np.sin(turns)[:, None] * up
    stations = first + np.linspace(0.0, 1.0, STATIONS)[:, None] * (last - first)
    steps = np.arange(0.0, 14.0, _RAY_STEP_MM)
    rays = stations[:, None, None] + steps[None, None, :, None] * spokes[None, :, None]
    places = frame.to_lps(rays.reshape(-1, 3))
    solid = bone.is_solid(places).reshape(-1, len(steps))
    values = bone.sample_hu(places).reshape(-1, len(steps))
    near = int(WALL_MM / _RAY_STEP_MM)
    off, halves = [], []
    for inside, hu in zip(solid, values, strict=True):
        wall = int(np.argmin(inside))
        if inside.all() or wall < 2 or wall + near >= len(steps):
            continue
        begin = max(0, wall - near)
        peak = begin + int(hu[begin : wall + 1].argmax())
        # tissue up to where HU rise again, to the next bone
        low = float(hu[wall : wall + near].min())
        half = (float(hu[peak]) + low) / 2.0
        below = np.flatnonzero(hu[peak : wall + near] < half)
        crossed = np.flatnonzero(hu[peak : wall + near] < bone.level)
        if hu[peak] - low < _LEAST_CONTRAST_HU or not len(below) or not len(crossed):
            continue
        off.append((int(crossed[0]) - int(below[0])) * _RAY_STEP_MM)
        halves.append(half)
    if len(off) < len(solid) // 4:
        return None
    low_mm, median_mm, high_mm = (float(value) for value in np.percentile(off, (25, 50, 75)))
    return Bias(median_mm, low_mm, high_mm, float(np.median(halves)), len(off))


_GRADES = (("A", 0.0), ("B", 2.0), ("C", 4.0), ("D", 6.0))
"""Grades with the breach, mm, up to which they reach; B to D end below theirs, E is everything else."""

SCALE = "Gertzbein-Robbins in five grades: A no breach, B below 2 mm, C below 4, D below 6, E 6 mm and more"

_STATION_MM = 0.5
_LEAST_BREACH_MM = 0.05
"""Half of what is shown: less is no breach."""

FARTHEST_MM = 15.0
"""A screw whose axis stays farther from the bone than this belongs to another vertebra or another frame."""

_LONGEST_MM, _WIDEST_MM = 150.0, 15.0


@dataclass(frozen=True)
class Screw:
    """A given screw: ends of its axis, LPS mm, diameter, mm, and name or number of the vertebra that it belongs to."""

    entry: Float64Array
    tip: Float64Array
    diameter: float
    name: str = "screw"
    label: str | None = None

    def __post_init__(self) -> None:
        numbers = np.array((*self.entry, *self.tip, self.diameter), dtype=np.float64)
        if not np.isfinite(numbers).all():
            raise UsageError(f"{self.name} needs finite numbers: two ends in mm and a diameter, not {numbers.tolist()}")
        length = float(np.linalg.norm(self.tip - self.entry))
        if not 1.0 <= length <= _LONGEST_MM:
            raise UsageError(f"{self.name} is {length:.4g} mm long: screws have 1 to {_LONGEST_MM:g} mm")
        if not 0.0 < self.diameter <= _WIDEST_MM:
            raise UsageError(f"{self.name} is {self.diameter:.4g} mm thick: screws have up to {_WIDEST_MM:g} mm")


@dataclass(frozen=True)
class ScrewGrade:
    """The grade, A to E, of a screw.

    breach_mm: How far its surface lies outside of the bone at most, 0 for none.
    direction: The quarter of the largest breach: medial, lateral, cranial or caudal.
    breaches_mm: Largest breach by quarter.
    margins_mm: Least distance of the screw's surface from that of the bone by quarter; below 0 where it is outside or
        the axis is nearer than the radius.
    front_mm: Largest distance outside of the bone in the front half of the body, which is not graded.
    """

    grade: str
    breach_mm: float
    direction: str | None
    breaches_mm: dict[str, float]
    margins_mm: dict[str, float | None]
    front_mm: float
    side: str


def grade_breach(breach_mm: float) -> str:
    if breach_mm <= 0.0:
        return "A"
    return next((grade for grade, below in _GRADES[1:] if breach_mm < below), "E")


def grade_screw(bone: SolidBone, frame: VertebraFrame, screw: Screw, subject: str) -> ScrewGrade:
    """Grade a screw in a vertebra, named `subject` in messages.

    Graded is the part from the coronal plane through the canal's axis to the body's middle, and behind it what lies in
    the canal.  Farther back it has to leave the bone, and farther in front the original scale does not look.
    """
    first, last = frame.to_frame(np.stack((screw.entry, screw.tip)))
    if first[1] < last[1]:
        raise UsageError(f"{screw.name} runs from front to back in {subject}: give its entry first, then its tip")
    axis_vector = last - first
    length = float(np.linalg.norm(axis_vector))
    axis = first + np.linspace(0.0, 1.0, int(np.ceil(length / _STATION_MM)) + 1)[:, None] * axis_vector
    off = bone.depth(frame.to_lps(axis))
    middle = (frame.body_y[0] + frame.body_y[1]) / 2.0
    if off.max() < -FARTHEST_MM:
        raise UsageError(
            f"{screw.name} lies {-off.max():.0f} mm or more from {subject}: it belongs to another vertebra, or its"
            " numbers are of another frame (LPS or RAS)"
        )
    if last[1] > frame.body_y[1]:
        raise UsageError(f"the tip of {screw.name} lies behind the body of {subject}: it does not pass the pedicle")
    share = (frame.body_y[1] - first[1]) / axis_vector[1]
    side = 1.0 if (first + share * axis_vector)[0] > frame.canal[0] else -1.0
    spokes = _spokes(axis_vector)
    points = (axis[:, None] + screw.diameter / 2.0 * spokes[None]).reshape(-1, 3)
    depth = bone.depth(frame.to_lps(points))
    canal_axis = frame.canal_at(points[:, 2])
    in_canal = (np.linalg.norm((points - canal_axis)[:, :2], axis=1) < frame.canal_radius) & (
        np.abs(points[:, 2]) < 0.75 * frame.body_height
    )
    graded = ((points[:, 1] <= frame.canal[1]) | in_canal) & (points[:, 1] >= middle)
    outside = np.where(-depth >= _LEAST_BREACH_MM, -depth, 0.0)
    sector = sector_names(np.tile(spokes, (len(axis), 1)), axis_vector, side)
    breaches = {
        name: float(outside[graded & (sector == number)].max(initial=0.0)) for number, name in enumerate(DIRECTIONS)
    }
    breach = max(breaches.values())
    surface = frame.to_frame(bone.surface)
    begin = first + max(0.0, (frame.canal[1] - first[1]) / axis_vector[1]) * axis_vector
    end = first + min(1.0, (middle - first[1]) / axis_vector[1]) * axis_vector
    room: dict[str, float | None] = {}
    for name, value in margins(surface, begin, end, side).items():
        room[name] = None if value is None else value - screw.diameter / 2.0
        if breaches[name] > 0.0:
            room[name] = -breaches[name]
    return ScrewGrade(
        grade_breach(breach),
        breach,
        max(breaches, key=lambda name: breaches[name]) if breach > 0.0 else None,
        breaches,
        room,
        float(outside[points[:, 1] < middle].max(initial=0.0)),
        "left" if side > 0.0 else "right",
    )


def _spokes(axis: Float64Array) -> Float64Array:
    """Return unit vectors (n, 3) square to a direction, all around."""
    unit = axis / np.linalg.norm(axis)
    first = np.cross(unit, np.eye(3)[int(np.abs(unit).argmin())])
    first /= np.linalg.norm(first)
    turns = np.linspace(0.0, 2.0 * np.pi, 2 * RAYS, endpoint=False)
    return np.asarray(np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * np.cross(unit, first))
