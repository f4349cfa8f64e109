"""Measures of a line in a vertebra: entry and tip, margins by direction, the canal, the wall's bias, angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.corridors.frame import VertebraFrame
from clrecon.corridors.solid_bone import SolidBone

Float64Array = NDArray[np.float64]

DIRECTIONS = ("medial", "lateral", "cranial", "caudal")

RAY_STEP_MM = 0.1
RAYS = 24
STATIONS = 5

WALL_MM = 2.0
"""Reach on both sides of the wall in which its peak and the tissue beside it are looked for."""
LEAST_CONTRAST_HU = 150.0
"""Least difference of peak and tissue by which a half maximum is taken."""

CANAL_REACH_MM = 22.0
CANAL_SAMPLES = 16


@dataclass(frozen=True)
class Bias:
    """How far the surface at the level lies outside of the half maximum of the pedicle's own wall.

    median_mm, low_mm, high_mm: Median and quartiles over the rays; positive: the level lies outside, and distances are
        too large.
    half_hu: Median of the levels half way between the wall's peak and the tissue beside it.
    rays: Rays with a wall that is dense enough.
    """

    median_mm: float
    low_mm: float
    high_mm: float
    half_hu: float
    rays: int


def angles(direction: Float64Array, side: float) -> tuple[float, float]:
    """Return the medial and the sagittal angle of a direction (left, posterior, cranial) that runs forward, degrees.

    The medial angle is that of its projection on the axial plane towards the midline, the sagittal one that on the
    sagittal plane towards cranial.
    """
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


def margins(surface: Float64Array, first: Float64Array, last: Float64Array, side: float) -> dict[str, float | None]:
    """Return the least distance of a segment from the surface in each quarter, mm; None where there is none.

    surface: ndarray, shape (n, 3). Points in the frame.
    first, last: ndarray, shape (3,). Ends of the segment, in the frame.
    side: 1 left, -1 right.
    """
    way = last - first
    share = np.clip((surface - first) @ way / (way @ way), 0.0, 1.0)
    offsets = surface - first - share[:, None] * way
    beside = (share > 0.0) & (share < 1.0)
    offsets = offsets[beside]
    distance, sector = np.linalg.norm(offsets, axis=1), sector_names(offsets, way, side)
    found: dict[str, float | None] = {}
    for number, name in enumerate(DIRECTIONS):
        own = distance[sector == number]
        found[name] = float(own.min()) if len(own) else None
    return found


def canal_wall(bone: SolidBone, frame: VertebraFrame) -> NDArray[np.bool_]:
    """Mark the points of the surface that can be seen from the canal's axis at their own height: the canal's wall."""
    local = frame.to_frame(bone.surface)
    axis = frame.canal_at(local[:, 2])
    found = np.zeros(len(local), dtype=bool)
    half = 0.75 * frame.body_height
    near = np.flatnonzero((np.linalg.norm(local - axis, axis=1) <= CANAL_REACH_MM) & (np.abs(local[:, 2]) <= half))
    blocked = np.zeros(len(near), dtype=bool)
    for share in np.linspace(0.0, 1.0, CANAL_SAMPLES, endpoint=False):
        at = axis[near] + share * (local[near] - axis[near])
        # within a step of the surface the nearest point of the lattice may be solid
        free = np.linalg.norm(local[near] - at, axis=1) > 2.0 * bone.lattice.step
        blocked |= free & bone.is_solid(frame.to_lps(at))
    found[near[~blocked]] = True
    return found


def find_exit(bone: SolidBone, start: Float64Array, direction: Float64Array, reach: float = 80.0) -> Float64Array:
    """Return where a ray from a point inside leaves the bone for the first time, LPS mm."""
    unit = direction / np.linalg.norm(direction)
    way = np.arange(0.0, reach, RAY_STEP_MM)
    outside = ~bone.is_solid(start + way[:, None] * unit)
    return np.asarray(start + (way[int(outside.argmax())] if outside.any() else reach) * unit, dtype=np.float64)


def measure_bias(bone: SolidBone, frame: VertebraFrame, first: Float64Array, last: Float64Array) -> Bias | None:
    """Measure how far the surface lies from the half maximum of the pedicle's wall, on rays square to a line.

    first, last: ndarray, shape (3,). Ends of the part of the line that lies in the pedicle, in the frame.

    Returns: None where less than a quarter of the rays meets a wall that HU show.
    """
    medial, up = _across(last - first, 1.0)
    turns = np.linspace(0.0, 2.0 * np.pi, RAYS, endpoint=False)
    spokes = np.cos(turns)[:, None] * medial + np.sin(turns)[:, None] * up
    stations = first + np.linspace(0.0, 1.0, STATIONS)[:, None] * (last - first)
    way = np.arange(0.0, 14.0, RAY_STEP_MM)
    rays = stations[:, None, None] + way[None, None, :, None] * spokes[None, :, None]
    places = frame.to_lps(rays.reshape(-1, 3))
    solid = bone.is_solid(places).reshape(-1, len(way))
    values = bone.sample_hu(places).reshape(-1, len(way))
    near = int(WALL_MM / RAY_STEP_MM)
    off, halves = [], []
    for inside, hu in zip(solid, values, strict=True):
        wall = int(np.argmin(inside))
        if inside.all() or wall < 2 or wall + near >= len(way):
            continue
        begin = max(0, wall - near)
        peak = begin + int(hu[begin : wall + 1].argmax())
        # tissue up to where HU rise again, to the next bone
        beyond = hu[wall : wall + near]
        low = float(beyond.min())
        half = (float(hu[peak]) + low) / 2.0
        below = np.flatnonzero(hu[peak : wall + near] < half)
        crossed = np.flatnonzero(hu[peak : wall + near] < bone.level)
        if hu[peak] - low < LEAST_CONTRAST_HU or not len(below) or not len(crossed):
            continue
        off.append((int(crossed[0]) - int(below[0])) * RAY_STEP_MM)
        halves.append(half)
    if len(off) < len(solid) // 4:
        return None
    low_mm, median_mm, high_mm = (float(value) for value in np.percentile(off, (25, 50, 75)))
    return Bias(median_mm, low_mm, high_mm, float(np.median(halves)), len(off))
