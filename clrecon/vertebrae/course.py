"""The course of the spine: the line of the canal a place every mm, with a frame, and the scan seen along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.system.pieces import in_threads

Field = NDArray[np.float32]

STEP_MM = 1.0
BEYOND_MM = 40.0
"""The canal is followed this far beyond the ends of its line: the vertebrae at the ends reach further than it."""
BEND_MM = 30.0
"""Length over which directions are averaged; two vertebrae bend against each other over this much."""
AHEAD_MM = np.arange(0.0, 57.0)
"""Places of a row of the straightened scan in front of the canal, mm."""
ASIDE_MM = np.arange(-42.0, 43.0)
"""Places to the patient's left of the canal, mm."""


@dataclass(frozen=True)
class Course:
    """Places along the spinal canal, 1 mm apart, from the head downwards.

    canal: ndarray, shape (n, 3), float64. LPS mm.
    down, ahead, aside: ndarray, shape (n, 3), float64. Unit vectors at each place: along the canal, to the front, and
        to the patient's left.
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
    """Follow the middle of the canal, and beyond the ends of its line as far as the scan goes.

    points: ndarray, shape (m, 3), float64. LPS mm from the head downwards, see `clrecon.anatomy.spine_line.SpineLine`.
    volume: The scan.
    """
    from scipy.interpolate import PchipInterpolator
    from scipy.ndimage import gaussian_filter1d

    arcs = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0.0, arcs[-1] + 1e-6, STEP_MM)
    line = np.stack([np.interp(at, arcs, axis) for axis in points.T], axis=1)
    if len(points) > 2:
        line = PchipInterpolator(arcs, points, axis=0)(at)
    sigma = min(BEND_MM, arcs[-1]) / 3.0
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
    inside = _inside(volume, line)
    begin, end = int(inside.argmax()), len(inside) - int(inside[::-1].argmax())
    part = slice(begin, end)
    reaches = (begin > 0, end < len(inside))
    return Course(line[part], down[part], ahead[part], np.cross(down, ahead)[part], known[part], reaches)


def _inside(volume: Grid, places: Float64Array) -> NDArray[np.bool_]:
    ijk = volume.lps_to_ijk(places)
    return np.asarray(((ijk >= -0.5) & (ijk <= np.array(volume.shape_ijk) - 0.5)).all(axis=1))


def sample_course(
    grid: Grid, course: Course, ahead_mm: Float64Array = AHEAD_MM, aside_mm: Float64Array = ASIDE_MM, order: int = 1
) -> Field:
    """Return a scan or label map in planes across the canal.

    ahead_mm, aside_mm: Places of the rows and columns of a plane.
    order: 1: trilinear interpolation; 0: the nearest voxel.

    Returns: ndarray, shape (n, len(ahead_mm), len(aside_mm)), float32. NaN outside of the grid.
    """
    from scipy.ndimage import map_coordinates

    offsets = ahead_mm[:, None, None], aside_mm[None, :, None]
    found = np.empty((len(course), len(ahead_mm), len(aside_mm)), np.float32)
    size = np.array(grid.shape_ijk)

    def sample(n: int) -> None:
        plane = course.canal[n] + offsets[0] * course.ahead[n] + offsets[1] * course.aside[n]
        ijk = grid.lps_to_ijk(plane.reshape(-1, 3))
        inside = ((ijk >= -0.5) & (ijk <= size - 0.5)).all(axis=1)
        low, high = np.maximum(np.floor(ijk.min(axis=0)).astype(int) - 1, 0), np.ceil(ijk.max(axis=0)).astype(int) + 2
        if not inside.any():
            found[n] = np.nan
            return
        part = grid.voxels[low[2] : high[2], low[1] : high[1], low[0] : high[0]].astype(np.float32)
        values = map_coordinates(part, (ijk - low).T[::-1], order=order, mode="nearest")
        found[n] = np.where(inside, values, np.nan).reshape(found[n].shape)

    def sample_places(where: slice) -> None:
        for n in range(where.start, where.stop):
            sample(n)

    in_threads(sample_places, len(course), 16)
    return found
