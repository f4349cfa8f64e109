"""Grades of given screws: how far a cylinder lies outside of the bone, and in which direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.corridors.frame import VertebraFrame
from clrecon.corridors.measures import DIRECTIONS, RAYS, margins, sector_names
from clrecon.corridors.solid_bone import SolidBone
from clrecon.errors import UsageError

Float64Array = NDArray[np.float64]

GRADES = (("A", 0.0), ("B", 2.0), ("C", 4.0), ("D", 6.0))
"""Grades with the breach, mm, up to which they reach; B to D end below theirs, E is everything else."""

SCALE = "Gertzbein-Robbins in five grades: A no breach, B below 2 mm, C below 4, D below 6, E 6 mm and more"

STATION_MM = 0.5
LEAST_BREACH_MM = 0.05
"""Half of what is shown: less is no breach."""

FARTHEST_MM = 15.0
"""A screw whose axis stays farther from the bone than this belongs to another vertebra or another frame."""

LONGEST_MM, WIDEST_MM = 150.0, 15.0


@dataclass(frozen=True)
class Screw:
    """A given screw.

    entry, tip: ndarray, shape (3,). Ends of its axis, LPS mm.
    diameter: mm.
    label: Name or number of the vertebra that it belongs to.
    """

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
        if not 1.0 <= length <= LONGEST_MM:
            raise UsageError(f"{self.name} is {length:.4g} mm long: screws have 1 to {LONGEST_MM:g} mm")
        if not 0.0 < self.diameter <= WIDEST_MM:
            raise UsageError(f"{self.name} is {self.diameter:.4g} mm thick: screws have up to {WIDEST_MM:g} mm")


@dataclass(frozen=True)
class ScrewGrade:
    """The grade of a screw.

    grade: {"A", "B", "C", "D", "E"}
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
    """Return the grade of a breach in mm."""
    if breach_mm <= 0.0:
        return "A"
    return next((grade for grade, below in GRADES[1:] if breach_mm < below), "E")


def grade_screw(bone: SolidBone, frame: VertebraFrame, screw: Screw, what: str) -> ScrewGrade:
    """Grade a screw in a vertebra.

    Graded is the part between the coronal plane through the canal's axis and the middle of the body, and behind that
    plane what lies in the canal.  Farther back the screw has to leave the bone, and farther in front the original scale
    does not look.

    what: Name of the vertebra, for messages.
    """
    first, last = frame.to_frame(np.stack((screw.entry, screw.tip)))
    if first[1] < last[1]:
        raise UsageError(f"{screw.name} runs from front to back in {what}: give its entry first, then its tip")
    way = last - first
    length = float(np.linalg.norm(way))
    axis = first + np.linspace(0.0, 1.0, int(np.ceil(length / STATION_MM)) + 1)[:, None] * way
    off = bone.depth(frame.to_lps(axis))
    middle = (frame.body_y[0] + frame.body_y[1]) / 2.0
    if off.max() < -FARTHEST_MM:
        raise UsageError(
            f"{screw.name} lies {-off.max():.0f} mm or more from {what}: it belongs to another vertebra, or its numbers"
            " are of another frame (LPS or RAS)"
        )
    if last[1] > frame.body_y[1]:
        raise UsageError(f"the tip of {screw.name} lies behind the body of {what}: it does not pass the pedicle")
    share = (frame.body_y[1] - first[1]) / way[1]
    side = 1.0 if (first + share * way)[0] > frame.canal[0] else -1.0
    spokes = _spokes(way)
    points = (axis[:, None] + screw.diameter / 2.0 * spokes[None]).reshape(-1, 3)
    depth = bone.depth(frame.to_lps(points))
    canal_axis = frame.canal_at(points[:, 2])
    in_canal = (np.linalg.norm((points - canal_axis)[:, :2], axis=1) < frame.canal_radius) & (
        np.abs(points[:, 2]) < 0.75 * frame.body_height
    )
    graded = ((points[:, 1] <= frame.canal[1]) | in_canal) & (points[:, 1] >= middle)
    outside = np.where(-depth >= LEAST_BREACH_MM, -depth, 0.0)
    sector = sector_names(np.tile(spokes, (len(axis), 1)), way, side)
    breaches = {
        name: float(outside[graded & (sector == number)].max(initial=0.0)) for number, name in enumerate(DIRECTIONS)
    }
    breach = max(breaches.values())
    surface = frame.to_frame(bone.surface)
    begin = first + max(0.0, (frame.canal[1] - first[1]) / way[1]) * way
    end = first + min(1.0, (middle - first[1]) / way[1]) * way
    room = margins(surface, begin, end, side)
    return ScrewGrade(
        grade_breach(breach),
        breach,
        max(breaches, key=lambda name: breaches[name]) if breach > 0.0 else None,
        breaches,
        {
            name: -breaches[name] if breaches[name] > 0.0 else None if value is None else value - screw.diameter / 2.0
            for name, value in room.items()
        },
        float(outside[points[:, 1] < middle].max(initial=0.0)),
        "left" if side > 0.0 else "right",
    )


def _spokes(way: Float64Array) -> Float64Array:
    """Return unit vectors (n, 3) square to a direction, all around."""
    unit = way / np.linalg.norm(way)
    first = np.cross(unit, np.eye(3)[int(np.abs(unit).argmin())])
    first /= np.linalg.norm(first)
    turns = np.linspace(0.0, 2.0 * np.pi, 2 * RAYS, endpoint=False)
    return np.asarray(np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * np.cross(unit, first))
