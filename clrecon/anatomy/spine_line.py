"""The spinal canal: a centre line of the vertebral column for curved reformations.

In slices across the patient every place is compared with what the middle of the spinal canal looks like.  It is soft.
Cortical bone encloses it in all directions (within 24 mm of height, so that arches close the gaps between them).  There
is a vertebral body in front and nothing but muscle behind, and the left mirrors the right.  Dynamic programming finds
the path through the slices that agrees best.  The path is the canal where it agrees over enough height; elsewhere
nothing is reported.  Each slice's point is then moved to the middle of the space that the bone encloses, and the line
is smoothed.

The search is meant for the thoracic and lumbar spine of an adult, in a scan whose axes are those of the patient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.progress import Progress, ignore_progress

__all__ = ["SpineLine", "find_spine_line"]

Field = NDArray[np.float32]

CELL_MM = (2.5, 2.5, 4.0)
"""Size along x, y, z of the cells in which the canal is searched."""
CANAL_RADIUS, BODY_RADIUS = 5.0, 10.0
RING_MM = (8.0, 10.0, 12.0, 14.0, 16.0)
"""Distances from the middle of the canal at which its wall is looked for."""
SHELL_MM = (12.0, 15.0, 18.0, 21.0, 24.0)
"""Distances from the middle of a vertebral body at which its wall is looked for."""
BODY_AHEAD_MM = (20.0, 24.0, 28.0)
"""Distances from the middle of the canal to the middle of the vertebral body."""
DIRECTIONS = 16
WORTH = 2.2
"""Score that counts neither for nor against the path; the canal has about 3.2."""
WORST = 0.6
"""Most that a slice counts against the path, so that one slice with an artefact does not end it."""
BEND_COST = 0.05
DEEPER_AHEAD = 1.2
"""The body is at least this many times deeper in front of the canal than behind it."""
SHORTEST_MM = 35.0
SURE = {"wall": 0.75, "mirror": 0.55, "body": 0.25, "soft": 0.6}
"""A slice is sure when each of its traits is at least this."""
GAP_MM = 12.0
"""Largest gap between sure slices: an artefact, or a vertebra that looks different."""
SMOOTH_MM = 12.0
POINT_STEP_MM = 15.0


@dataclass(frozen=True)
class SpineLine:
    """The middle of the spinal canal.

    Attributes
    ----------
    points : ndarray, shape (n, 3), float64
        LPS mm, from the head downwards, about 10 mm apart.
    sure_share : float
        Share of the slices of the line whose traits all reach `SURE`.
    searched_mm : float
        Height of the volume; the line may be shorter.
    """

    points: Float64Array
    sure_share: float
    searched_mm: float

    @property
    def height_mm(self) -> float:
        """Distance between the lower and the upper end along the body axis, mm."""
        return float(self.points[0, 2] - self.points[-1, 2])


@dataclass(frozen=True)
class _Cells:
    """HU (nz, ny, nx) of cells along the patient's axes, uppermost slice last, and the centre of the first cell."""

    values: Field
    origin: Float64Array

    def heights(self, mm: float) -> int:
        """Return the height of a window of `mm` along z in cells, an odd number."""
        return max(1, round(mm / CELL_MM[2]) | 1)


def find_spine_line(volume: Volume, *, progress: Progress | None = None) -> SpineLine:
    """Find the middle of the spinal canal.

    Parameters
    ----------
    volume : Volume
        A scan in HU.
    progress : callable, optional
        Called as ``progress("curve", steps done, 3)``.

    Returns
    -------
    SpineLine

    Raises
    ------
    RefusedInputError
        No part of the volume surely shows a spine; the message says how much was found.
    """
    progress = progress or ignore_progress
    progress("curve", 0, 3)
    cells = _average_cells(volume)
    progress("curve", 1, 3)
    traits = _find_traits(cells)
    progress("curve", 2, 3)
    worth = (
        traits["body"] + traits["wall"] + 0.5 * traits["soft"] + traits["mirror"]
        - traits["filled"] - 0.5 * traits["beside"] - traits["behind"]
    )  # fmt: skip
    path = _best_path(np.clip(worth - WORTH, -WORST, None))
    progress("curve", 3, 3)
    k, j, i = path.T
    sure = np.logical_and.reduce([traits[name][k, j, i] >= least for name, least in SURE.items()])
    begin, end = _longest_run(sure)
    searched, height = len(worth) * CELL_MM[2], (end - begin) * CELL_MM[2]
    if height < SHORTEST_MM:
        raise RefusedInputError(
            f"no spine was found that one could be sure of ({height:.0f} of {searched:.0f} mm look like one):"
            " give points of the centre line"
        )
    ahead, behind = _depths(cells, path[begin:end])
    if behind is not None and ahead < DEEPER_AHEAD * behind:
        raise RefusedInputError(
            f"what looks like a spine has {ahead:.0f} mm of the body in front and {behind:.0f} mm behind: it is none,"
            " or front and back of the scan are mistaken; give points of the centre line"
        )
    return SpineLine(_centre_points(cells, path[begin:end]), float(sure[begin:end].mean()), searched)


def _depths(cells: _Cells, path: NDArray[np.int64]) -> tuple[float, float | None]:
    """Return the median depth of tissue in front of a path and behind it, mm; None behind where the volume ends within
    it.
    """
    thick = _disc_mean((cells.values > -300.0).astype(np.float32), BODY_RADIUS) > 0.6  # the table is thinner
    k, j, i = path.T
    rows = thick[k, :, i]
    ends = rows.shape[1] - 1 - rows[:, ::-1].argmax(axis=1)
    ahead = float(np.median(j - rows.argmax(axis=1)) * CELL_MM[1])
    behind = float(np.median(ends - j) * CELL_MM[1])
    outside = rows.shape[1] - 1 - ends <= BODY_RADIUS / CELL_MM[1]
    return ahead, None if np.median(outside) else behind


def _longest_run(sure: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the first and the end of the longest run of sure slices; gaps up to `GAP_MM` do not divide a run."""
    best, begin, last = (0, 0), None, 0
    for k in np.flatnonzero(sure):
        if begin is None or (k - last - 1) * CELL_MM[2] > GAP_MM:
            begin = int(k)
        last = int(k)
        if last + 1 - begin > best[1] - best[0]:
            best = begin, last + 1
    return best


def _average_cells(volume: Volume) -> _Cells:
    """Average the voxels in blocks of about a cell, then interpolate at the cells."""
    from scipy.ndimage import map_coordinates

    size = np.array(volume.shape_ijk)
    block = np.maximum(1, np.rint(np.minimum(CELL_MM, 2.5) / volume.spacing)).astype(int)
    block = np.minimum(block, size)
    whole = size // block * block
    fi, fj, fk = (int(n) for n in block)
    means = np.empty((whole // block)[::-1], np.float32)
    for k in range(len(means)):
        part = np.clip(volume.voxels[fk * k : fk * (k + 1), : whole[1], : whole[0]], -1024, 1500)
        rows = part.mean(axis=0, dtype=np.float32)
        means[k] = rows.reshape(len(means[k]), fj, -1, fi).mean(axis=(1, 3))
        volume.release_slices(fk * k, fk * (k + 1))
    corners = volume.ijk_to_lps(
        [tuple(n - 0.5 if upper else -0.5 for n, upper in zip(size, bits, strict=True)) for bits in np.ndindex(2, 2, 2)]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    count = np.maximum(((high - low) / CELL_MM).astype(int), 1)
    origin = 0.5 * (low + high) - 0.5 * (count - 1) * CELL_MM
    x, y = (origin[axis] + CELL_MM[axis] * np.arange(count[axis]) for axis in (0, 1))
    values = np.empty(count[::-1], np.float32)
    for k in range(count[2]):
        plane = np.broadcast_arrays(x, y[:, None], origin[2] + CELL_MM[2] * k)
        ijk = volume.lps_to_ijk(np.stack(plane, axis=-1).reshape(-1, 3))
        inside = ((ijk >= -0.5) & (ijk <= size - 0.5)).all(axis=1)
        at = ((ijk + 0.5) / block - 0.5).T[::-1]
        found = map_coordinates(means, at, order=1, mode="nearest")
        values[k] = np.where(inside, np.nan_to_num(found, nan=-1024.0), -1024.0).reshape(values[k].shape)
    return _Cells(values, origin)


def _shifted(field: Field, right: float, back: float) -> Field:
    """Shift the field so that each cell has the value `right` and `back` mm further in its slice; 0 beyond the ends."""
    dx, dy = round(right / CELL_MM[0]), round(back / CELL_MM[1])
    moved = np.zeros_like(field)
    ny, nx = field.shape[1:]
    if abs(dx) < nx and abs(dy) < ny:
        to = (slice(None), slice(max(0, -dy), ny - max(0, dy)), slice(max(0, -dx), nx - max(0, dx)))
        moved[to] = field[:, max(0, dy) : ny + min(0, dy), max(0, dx) : nx + min(0, dx)]
    return moved


def _disc_mean(field: Field, radius: float) -> Field:
    """Return the mean within `radius` mm in each slice."""
    from scipy.ndimage import convolve

    reach = int(np.ceil(radius / CELL_MM[0]))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * CELL_MM[0]
    disc = (x**2 + y**2 <= radius**2).astype(np.float32)
    return np.asarray(convolve(field, disc[None] / disc.sum(), mode="constant"))


def _enclosed(bone: Field, distances: tuple[float, ...]) -> Field:
    """Return the share of the directions in which bone stands at one of the distances."""
    sums = np.zeros_like(bone)
    for angle in np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS):
        wall = np.zeros_like(bone)
        for distance in distances:
            np.maximum(wall, _shifted(bone, distance * np.cos(angle), distance * np.sin(angle)), out=wall)
        sums += np.minimum(wall / 0.7, 1.0)
    return np.asarray(sums / DIRECTIONS, dtype=np.float32)


def _cortex(cells: _Cells, height: float) -> Field:
    """Return the density of cortical bone, 0 to 1: the largest within `height` mm along z."""
    from scipy.ndimage import maximum_filter1d

    cortex = np.clip((cells.values - 170.0) / 130.0, 0.0, 1.0)
    return np.asarray(maximum_filter1d(cortex, cells.heights(height), axis=0, mode="nearest"))


def _find_traits(cells: _Cells) -> dict[str, Field]:
    """Measure how much each cell is like the middle of the spinal canal: a field of 0 to 1 for each trait."""
    from scipy.ndimage import maximum_filter, uniform_filter1d

    values = cells.values
    bone = np.clip((values - 110.0) / 130.0, 0.0, 1.0)
    bone = uniform_filter1d(bone, cells.heights(16.0), axis=0, mode="nearest")
    soft = _disc_mean(((values > -80.0) & (values < 130.0)).astype(np.float32), CANAL_RADIUS)
    wall = _enclosed(maximum_filter(_cortex(cells, 24.0), (1, 2, 2)), RING_MM)
    body = 0.5 * _disc_mean(bone, BODY_RADIUS) + 0.5 * _enclosed(_cortex(cells, 12.0), SHELL_MM)
    thick, thin = _disc_mean(bone, 12.0), _disc_mean(bone, CANAL_RADIUS)
    traits = {
        "soft": soft,
        "wall": wall,
        "body": np.maximum.reduce([_shifted(body, 0.0, -ahead) for ahead in BODY_AHEAD_MM]),
        "filled": _disc_mean(bone, 4.0),
        "beside": np.minimum(_shifted(thin, 36.0, -24.0) + _shifted(thin, -36.0, -24.0), 1.0),
        "behind": np.maximum(_shifted(thick, 0.0, 50.0), _shifted(thick, 0.0, 64.0)),
    }
    without = traits["body"] + wall + 0.5 * soft - traits["filled"] - 0.5 * traits["beside"] - traits["behind"]
    traits["mirror"] = _mirrored(cells, (without > WORTH - 1.3) & (soft > 0.4))
    return traits


def _mirrored(cells: _Cells, wanted: NDArray[np.bool_]) -> Field:
    """Correlate the left with the mirrored right: 40 mm to the sides, 44 mm to the front and 36 mm to the back."""
    from scipy.ndimage import uniform_filter, uniform_filter1d

    smooth = uniform_filter1d(np.clip(cells.values, -300.0, 500.0), cells.heights(9.0), axis=0, mode="nearest")
    smooth = uniform_filter(smooth, (1, 2, 2))
    back = np.arange(round(-44.0 / CELL_MM[1]), round(36.0 / CELL_MM[1]) + 1, 2)[:, None]
    aside = np.arange(1, round(40.0 / CELL_MM[0]) + 1, 2)
    ny, nx = smooth.shape[1:]
    found = np.zeros_like(smooth)
    places = np.argwhere(wanted)
    for part in np.array_split(places, len(places) // 20000 + 1):
        k, j, i = (axis[:, None, None] for axis in part.T)
        rows = np.clip(j + back, 0, ny - 1)
        right = smooth[k, rows, np.clip(i + aside, 0, nx - 1)]
        left = smooth[k, rows, np.clip(i - aside, 0, nx - 1)]
        mean = 0.5 * (right + left).mean(axis=(1, 2), keepdims=True)
        right, left = right - mean, left - mean
        power = (right**2).sum(axis=(1, 2)) + (left**2).sum(axis=(1, 2))
        found[tuple(part.T)] = 2.0 * (right * left).sum(axis=(1, 2)) / (power + 1.0)
    return np.asarray(np.clip(found, 0.0, 1.0), dtype=np.float32)


def _best_path(gain: Field) -> NDArray[np.int64]:
    """Return the path with the highest sum: cells (n, 3) as (k, j, i), one a slice, at most one cell aside from slice
    to slice.

    It begins and ends where the sum is best, so that slices that count against it lie only between slices that count
    for it.
    """
    steps = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    sums = gain[0].copy()
    came = np.full(gain.shape, -1, np.int8)
    best, end = float(sums.max()), (0, *np.unravel_index(sums.argmax(), sums.shape))
    for k in range(1, len(gain)):
        before = np.full((len(steps), *sums.shape), -np.inf, np.float32)
        padded = np.pad(sums, 1, constant_values=-np.inf)
        for n, (dy, dx) in enumerate(steps):
            before[n] = padded[1 + dy : 1 + dy + sums.shape[0], 1 + dx : 1 + dx + sums.shape[1]]
            before[n] -= BEND_COST * np.hypot(dy, dx)
        step = before.argmax(axis=0)
        before_best = np.take_along_axis(before, step[None], axis=0)[0]
        came[k] = np.where(before_best > 0.0, step, -1)
        sums = gain[k] + np.maximum(before_best, 0.0)
        if sums.max() > best:
            best, end = float(sums.max()), (k, *np.unravel_index(sums.argmax(), sums.shape))
    path: list[Any] = []
    k, j, i = (int(n) for n in end)
    while best > 0.0:
        path.append((k, j, i))
        if came[k, j, i] < 0:
            break
        dy, dx = steps[came[k, j, i]]
        k, j, i = k - 1, j + dy, i + dx
    return np.array(path[::-1], np.int64).reshape(-1, 3)


def _centre_points(cells: _Cells, path: NDArray[np.int64]) -> Float64Array:
    """Return the middle of the space that bone encloses in each slice of a path, smoothed, from the upper end to the
    lower.
    """
    from scipy.ndimage import gaussian_filter1d

    bone = _cortex(cells, 16.0)
    ny, nx = bone.shape[1:]
    y, x = np.mgrid[:ny, :nx]
    middles = path[:, 1:].astype(np.float64)
    for n, (k, _, _) in enumerate(path):
        for _ in range(3):
            distance = np.hypot((y - middles[n, 0]) * CELL_MM[1], (x - middles[n, 1]) * CELL_MM[0])
            weight = np.clip((11.0 - distance) / CELL_MM[0], 0.0, 1.0) * (1.0 - bone[k])
            if weight.sum() > 0.0:
                moved = np.array([(weight * y).sum(), (weight * x).sum()]) / weight.sum()
                middles[n] += np.clip(moved - middles[n], -1.0, 1.0)
    # The line continues beyond its ends by point symmetry, so that smoothing does not bend it there.
    beyond = min(len(middles) - 1, round(4.0 * SMOOTH_MM / CELL_MM[2]))
    longer = np.pad(middles, ((beyond, beyond), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(longer, SMOOTH_MM / CELL_MM[2], axis=0, mode="nearest")[beyond:][: len(middles)]
    places = np.column_stack([smooth[:, 1], smooth[:, 0], path[:, 0]]) * CELL_MM + cells.origin
    count = max(2, round(len(path) * CELL_MM[2] / POINT_STEP_MM) + 1)
    return places[np.unique(np.rint(np.linspace(0, len(path) - 1, count)).astype(int))][::-1]
