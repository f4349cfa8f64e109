"""Constants of a scan that its walls of bone are fitted with: blur and density of the cortex, from some profiles."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.noise import measure_noise
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import METAL_HU, Volume
from clrecon.mesh.compare.walls import COMPACT_HU
from clrecon.operators.surface.cortex import (
    CENTRE,
    CORTEX_SPREAD,
    SAMPLES,
    SILENT_HU,
    CortexConstants,
    Float32Array,
    ProfileSampler,
    WallFits,
    blurs_of,
)
from clrecon.system.pieces import spread_rows

_FEWEST_WALLS = 60
"""Profiles across walls below which nothing is known of a scan's cortex."""

MOST_WALLS, LOOKED_AT = 500, 4000
"""Profiles that the constants are measured in, and vertices among which they are searched."""

LEAST_CONTRAST, LEAST_CORTEX_HU = 0.4, 350.0
"""A wall is as high, and rises by as much, as this share of the 90th percentile of those of compact bone, or of those
that reach the second: the shell of a table rises from air, but is low. Fewer than `_FEWEST_WALLS` show no bone."""

_TRIMMED, _NARROW_SPREAD = 0.8, 0.02
"""Share of the profiles, those fitted best, by which blurs are compared: others touch a second bone or a vessel. Share
by which the cortex of a place may differ there."""

SEARCH_STEPS = (1.3, 1.12, 1.05)
"""Factors by which a blur is changed as long as that helps, one after the other."""

FARTHEST = 8.0
"""Factor by which a search leaves its start at most: a blur that nothing shows goes anywhere."""

_THICK_SHARE, _CORTEX_STEP, _CLEARLY_LESS = 0.5, 1.03, 0.97
"""Where this share of the walls is thick, the cortex is what leaves least of the profiles, in steps of the second from
what they show on: their percentile holds noise, which the blurs follow, and it them (11 % too much at 40 HU)."""

LEAST_SHARE, _DIFFERENT = 0.03, 0.1
"""Components with this share of a surface's vertices are looked at by themselves, and have constants of their own if
their compact bone differs from that of all by the second share."""

_THICK_BLURS, _SHARP, _WIDE_SPREAD, _DENSE_PERCENTILE, _FEWEST_THICK = 2.0, 1.25, 0.3, 75.0, 12
"""Walls thicker than so many blurs show their HU where the blur is at most the second times that within the slices, if
the fit leaves the cortex free within the third; of these the percentile, since walls differ and blur only ever lowers
them."""

_LEAST_BLUR_ERROR, _LEAST_CORTEX_ERROR, _THIN_CORTEX_ERROR = 0.02, 0.05, 0.3
"""Shares below which constants are not known: phantoms differ from their own by as much.  The third holds where all
walls are so thin that blur and density are one."""


class _Trial(NamedTuple):
    """Constants as far as they are found."""

    blur_mm: float
    across_mm: float
    cortex_hu: float

    def changed(self, place: int, factor: float) -> _Trial:
        blurs = [self.blur_mm, self.across_mm]
        blurs[place] *= factor
        return _Trial(blurs[0], blurs[1], self.cortex_hu)


_Fit = Callable[[_Trial, float], WallFits]
"""Fits all walls with the constants of a trial and a spread of the cortex."""


def measure_constants(
    sampler: ProfileSampler,
    volume: Volume,
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    scan: CortexConstants | None = None,
) -> CortexConstants:
    """Measure blur and cortex in profiles at some of the points; the noise is that of the scan, if it is known.

    The blur is that which leaves the least of the profiles, the cortex what thick walls show.  Their uncertainties are
    half the spread over four parts of the profiles, and not less than `_LEAST_BLUR_ERROR` and `_LEAST_CORTEX_ERROR`.
    """
    rows = spread_rows(len(points), LOOKED_AT)
    values = sampler.values(points[rows], normals[rows])
    walls, peaks = _find_walls(values)
    if len(walls) < _FEWEST_WALLS:
        raise NoSurfaceError(
            f"the surface has no walls of bone that the cortex could be measured in: {len(walls)} of"
            f" {len(rows):,} profiles across it, at least {_FEWEST_WALLS} are needed"
        )
    values, peaks = values[:, walls], peaks[walls]
    try:
        noise = measure_noise(volume).hu if scan is None else scan.noise_hu
    except UsageError:  # a specimen in air
        noise = None
    step = volume.spacing
    dense = float(np.percentile(peaks, 95.0))
    usual = 1.2 * float(np.percentile(peaks, _DENSE_PERCENTILE))
    start = _Trial(
        _usual_blur(float(np.sqrt(step[0] * step[1]))), max(_usual_blur(step[2]), 0.45 * step[2]),
        min(1.03 * dense, usual),
    )  # fmt: skip
    known = noise if noise is not None else SILENT_HU
    profiles = sampler.take(values)

    @functools.cache
    def fit(trial: _Trial, cortex_spread: float) -> WallFits:
        return profiles.fit(*trial, known, cortex_spread=cortex_spread)

    found, thick = _search(fit, values, start)
    parts = []
    for part in (slice(first, None, 4) for first in range(4)):
        one = _search_blurs(fit, part, found, SEARCH_STEPS[1:])
        parts.append((one.blur_mm, one.across_mm, _measure_cortex(fit, values, part, found)[0]))
    of_cortex = _LEAST_CORTEX_ERROR if thick >= _FEWEST_THICK else _THIN_CORTEX_ERROR
    least = np.array([_LEAST_BLUR_ERROR, _LEAST_BLUR_ERROR, of_cortex])
    spread = np.maximum(np.std(parts, axis=0) / 2.0, least * np.mean(parts, axis=0))
    residual = fit(found, CORTEX_SPREAD).residual_hu
    errors = [float(value) for value in spread]
    return CortexConstants(
        blur_mm=found.blur_mm,
        blur_across_mm=found.across_mm,
        cortex_hu=found.cortex_hu,
        blur_error_mm=errors[0],
        blur_across_error_mm=errors[1],
        cortex_error_hu=errors[2],
        noise_hu=noise,
        residual_hu=float(np.sqrt(np.mean(np.square(residual)))),
        places=values.shape[1],
        thick=thick,
    )


def find_groups(
    sampler: ProfileSampler,
    volume: Volume,
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    components: NDArray[np.integer],
    scan: CortexConstants,
) -> list[tuple[NDArray[np.intp], CortexConstants]]:
    """Return the rows of points that share constants, and these: those of the scan for all rows that are left over.

    components: ndarray, shape (n,). Component of each point, -1 for none.
    """
    groups, left = [], np.ones(len(points), bool)
    sizes = np.bincount(components[components >= 0], minlength=1)
    large = np.flatnonzero(sizes >= LEAST_SHARE * len(points))
    for component in large if len(large) > 1 else []:
        rows = np.flatnonzero(components == component)
        try:
            own = measure_constants(sampler, volume, points[rows], normals[rows], scan)
        except NoSurfaceError:  # a table
            continue
        is_bone = own.thick >= _FEWEST_THICK and own.cortex_hu >= COMPACT_HU
        if is_bone and abs(own.cortex_hu - scan.cortex_hu) > _DIFFERENT * scan.cortex_hu:
            groups.append((rows, own))
            left[rows] = False
    return [(np.flatnonzero(left), scan), *groups]


def _usual_blur(step_mm: float) -> float:
    """Return the blur from which on that of voxels with this edge is searched, mm."""
    return min(0.7 * step_mm**0.5, step_mm)


def _find_walls(values: Float32Array) -> tuple[NDArray[np.intp], Float32Array]:
    """Return up to `MOST_WALLS` profiles across walls of bone, and the highest value of each profile."""
    whole = np.isfinite(values[:SAMPLES]).all(axis=0)
    peaks = np.where(
        whole, values[: CENTRE + 2].max(axis=0, initial=-np.inf, where=np.isfinite(values[: CENTRE + 2])), 0
    )
    rise = peaks - values[CENTRE:SAMPLES].min(axis=0, initial=np.inf, where=np.isfinite(values[CENTRE:SAMPLES]))
    usable = whole & (peaks < METAL_HU)
    of_bone = peaks[usable & (peaks >= LEAST_CORTEX_HU)]
    if len(of_bone) < _FEWEST_WALLS:
        return np.zeros(0, np.intp), peaks
    compact = of_bone[of_bone >= COMPACT_HU]
    least = LEAST_CONTRAST * float(np.percentile(compact if len(compact) >= _FEWEST_WALLS else of_bone, 90.0))
    walls = np.flatnonzero(usable & (np.minimum(rise, peaks) > least))
    return walls[spread_rows(len(walls), MOST_WALLS)], peaks


def _search(fit: _Fit, values: Float32Array, start: _Trial) -> tuple[_Trial, int]:
    """Return the constants that describe the profiles, and how many walls are thick enough to show their HU."""
    found = _search_blurs(fit, slice(None), start, SEARCH_STEPS)
    cortex_hu, thick = _measure_cortex(fit, values, slice(None), found)
    shown = thick >= _THICK_SHARE * values.shape[1]
    for first in range(1, len(SEARCH_STEPS)):
        other = _search_blurs(fit, slice(None), found._replace(cortex_hu=cortex_hu), SEARCH_STEPS[first:])
        if shown and _left(fit, slice(None), other) >= _left(fit, slice(None), found):
            break
        found = other
        cortex_hu, thick = _measure_cortex(fit, values, slice(None), found)
    if not shown:
        return found._replace(cortex_hu=cortex_hu), thick
    while True:
        other = found._replace(cortex_hu=found.cortex_hu / _CORTEX_STEP)
        other = _search_blurs(fit, slice(None), other, SEARCH_STEPS[2:])
        if _left(fit, slice(None), other) >= _CLEARLY_LESS * _left(fit, slice(None), found):
            return found, thick
        found = other


def _left(fit: _Fit, part: slice, trial: _Trial) -> float:
    """Return the mean square of what a trial leaves of a part of the profiles."""
    squares = np.sort(np.square(fit(trial, _NARROW_SPREAD).residual_hu[part], dtype=np.float64))
    return float(np.mean(squares[: max(1, int(_TRIMMED * len(squares)))]))


def _search_blurs(fit: _Fit, part: slice, found: _Trial, factors: tuple[float, ...]) -> _Trial:
    """Return the blurs that leave least of a part of the profiles, from those of a trial on."""
    first, least = found, _left(fit, part, found)
    for factor in factors:
        for place in (0, 1):
            for change in (factor, 1.0 / factor):
                while (value := _left(fit, part, trial := found.changed(place, change))) < 0.9999 * least:
                    found, least = trial, value
                    if not all(1.0 / FARTHEST < new / old < FARTHEST for new, old in zip(trial, first, strict=True)):
                        return found
    return found


def _measure_cortex(fit: _Fit, values: Float32Array, part: slice, found: _Trial) -> tuple[float, int]:
    """Return the HU of compact bone in a part of the profiles, and how many walls are thick enough to show it."""
    fits = fit(found, _WIDE_SPREAD)
    blurs = blurs_of(values[:, part], found.blur_mm, found.across_mm)
    thick = (fits.thickness_mm[part] > _THICK_BLURS * blurs) & (blurs < _SHARP * found.blur_mm)
    if np.count_nonzero(thick) < _FEWEST_THICK:
        return found.cortex_hu, int(np.count_nonzero(thick))
    shown = float(np.percentile(fits.cortex_hu[part][thick], _DENSE_PERCENTILE))
    return float(np.clip(shown, found.cortex_hu / 1.25, found.cortex_hu * 1.25)), int(np.count_nonzero(thick))
