"""Constants of a scan that its walls of bone are fitted with: blur and density of the cortex, from some profiles."""

from __future__ import annotations

import functools
import math
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
    FRAME,
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

HOW_TO_FIT = "start from an iso value of bone, such as 200 HU, or leave the surface at its iso value"

MOST_WALLS, LOOKED_AT = 500, 4000
"""Profiles that the constants are measured in, and vertices among which they are searched."""

LEAST_CONTRAST, LEAST_CORTEX_HU = 0.4, 350.0
"""Height and rise of a wall exceed this share of the 90th percentile of the heights of compact walls, or of all walls
from `LEAST_CORTEX_HU` on; the shell of a couch rises from air, but is low. Fewer than `_FEWEST_WALLS` show no bone."""

_TRIMMED, _NARROW_SPREAD = 0.8, 0.02
"""Share of the profiles, those fitted best, by which blurs are compared: others touch a second bone or a vessel. Share
by which the cortex of a place may differ there."""

SEARCH_STEPS = (1.3, 1.12, 1.05)
"""Factors by which a blur is changed as long as that helps, one after the other."""

FARTHEST = 8.0
"""Factor by which a search leaves its start at most: a blur that nothing shows goes anywhere."""

_THICK_SHARE = 0.5
_CORTEX_STEP = 1.03
_CLEARLY_LESS = 0.97
"""Where this share of the walls is thick, the cortex is what leaves least of the profiles, in steps of the second from
what they show on, down as long as less than the third of it is left: their percentile holds noise, which the blurs
follow, and it them (11 % too much at 40 HU).  Then up, in steps as below, by the same rule: vessels with contrast
medium that count as thick walls are less dense (838 HU for 907)."""

_UPWARD_STEP, _UPWARD_STEPS = 1.04, 8
_ALMOST, _STILL_THICK = 1.02, 0.25
"""Where fewer are thick, what blur makes thick is not dense: of so many steps up the first is taken that leaves the
third times the least or less (with what walls show the surface lay 0.1 mm too far outside at a blur of 1 mm).  A step
that leaves less than the last share of the thick walls thick describes them as thin ones before something dense (a
cone-beam scan: 1,442 HU for 1,096, and 0.1 mm too far inside)."""

STEPPED = 1.5
"""Slices that blur across by more than so often what they blur within make steps of slanted walls: their profiles show
no cortex."""

LEAST_SHARE = 0.03
_DIFFERENT, _ALIKE = 0.1, 0.02
"""Components with the first share of a surface's vertices are looked at by themselves, and have constants of their own
if their compact bone differs from that of all by the second, and if one fit shows it to differ by the third."""

_THICK_BLURS = 2.0
_SHARP = 1.25
_WIDE_SPREAD = 0.3
_DENSE_PERCENTILE = 75.0
_FEWEST_THICK = 12
"""Walls thicker than so many blurs show their HU where the blur is at most the second times that within the slices, if
the fit leaves the cortex free within the third; of these the percentile, since walls differ and blur only ever lowers
them."""

SOLID_SHARE = 0.85
"""Of bone that has this share of its cortex' HU behind it nothing shows where the cortex ends: it is as thick as the
profile is deep, at least.  Marrow of balls had up to 0.7, bone without marrow 0.87 to 1.05."""

_ALIKE_THICK, _THIN_BLURS = 1.55, 3.0
_SOLID_BLURS, _AS_DENSE = 4.0, 0.95
_MOST_RIMS = 0.1
"""Walls whose 85th percentile of thickness is less than the first times the 15th are alike, and thin if the median in
blurs is below the second: profiles do not tell a denser wall from a thicker one.  Shells and plates of 0.5 to 2 mm have
1.1 to 1.5, bodies 1.7 to 5.  What was measured in them is the least that describes them.  Walls of more than the third
in blurs do not count, which are rims, with 0.7 to 0.9 of these HU; if they show the fourth of these or more, or are
more than the fifth share of all, they are solid, and the cortex is known."""

_AS_WELL, _LEAST_LEFT = 1.05, 0.006
_DENSER_STEP, _MOST_DENSER = 1.1, 2.2
_DENSER_SHARE = 0.5
"""The cortex of such walls lies anywhere from there to the HU that leave the first times as much of the profiles, or
times the second of these HU where less is left; tried in steps of the third up to the fourth.  The last share of the
way is taken (noisy balls with walls of 0.8 to 2 mm lay 0.06 mm off with it, 0.10 with a third)."""

_ACROSS_UNSEEN, _ONE_DIRECTION = 0.13, 0.08
_UNSEEN_ERROR = 0.5
"""Walls whose normals' part across slices has squares with an upper quartile below the first do not show the blur
across, nor those within slices the one within; where the quartiles are nearer to each other than the second (plates
0.04 to 0.07, bodies 0.2 to 0.6) they show one blur of both.  What they do not show is that of the voxels, or keeps the
ratio of these, and is known within the third share."""

_LEAST_BLUR_ERROR = 0.02
_LEAST_CORTEX_ERROR = 0.05
_THIN_CORTEX_ERROR = 0.3
"""Shares below which constants are not known: phantoms differ from their own by as much.  The third holds where all
walls are so thin that blur and density are one."""


class _Trial(NamedTuple):
    """Constants as far as they are found."""

    blur_mm: float
    across_mm: float
    cortex_hu: float

    def changed(self, axes: tuple[int, ...], factor: float) -> _Trial:
        return self._replace(**{self._fields[axis]: self[axis] * factor for axis in axes})


class _Outcome(NamedTuple):
    """What a search came to: constants, how many walls are thick enough to show their HU, and whether steps up told it:
    walls that are alike with it were not so with less, so that nothing denser describes them as well."""

    trial: _Trial
    thick: int
    is_told: bool = False


class _Walls:
    """Profiles across walls, which are fitted with the constants of a trial and a spread of the cortex.

    values: ndarray, shape (ROWS, n).
    axes: Of the blurs within and across slices those that are searched, and those that change together.
    """

    def __init__(self, sampler: ProfileSampler, values: Float32Array, noise: float | None):
        profiles, known = sampler.take(values), SILENT_HU if noise is None else noise
        self.values, self.noise = values, noise
        self.depth_mm = -sampler.scale.first_mm

        def fit_trial(trial: _Trial, spread: float) -> WallFits:
            return profiles.fit(trial.blur_mm, trial.across_mm, trial.cortex_hu, known, cortex_spread=spread)

        self.fit = functools.cache(fit_trial)
        low, high = np.percentile(values[SAMPLES], (25.0, 75.0))
        self.axes: tuple[tuple[int, ...], ...] = ((0,), (1,))
        if high < _ACROSS_UNSEEN or low > 1.0 - _ACROSS_UNSEEN:
            self.axes = ((0,),) if high < _ACROSS_UNSEEN else ((1,),)
        elif high - low < _ONE_DIRECTION:
            self.axes = ((0, 1),)


def measure_constants(
    sampler: ProfileSampler, volume: Volume, points: NDArray[np.floating], normals: NDArray[np.floating]
) -> CortexConstants:
    """Measure blur and cortex in profiles at some of the points, and the noise of the scan.

    The blur is that which leaves the least of the profiles, the cortex what thick walls show.  Their uncertainties are
    half the spread over four parts of the profiles, and not less than `_LEAST_BLUR_ERROR` and `_LEAST_CORTEX_ERROR`.
    """
    values = _sample_walls(sampler, points, normals, np.arange(len(points)))
    try:
        noise = measure_noise(volume).hu
    except UsageError:  # a specimen in air
        noise = None
    walls = _Walls(sampler, values, noise)
    outcome = _search(walls, volume)
    return _measure_errors(walls, outcome.trial, outcome.thick, _find_denser(walls, outcome))


def _measure_errors(
    walls: _Walls, trial: _Trial, thick: int, together: tuple[_Trial, _Trial] | None = None
) -> CortexConstants:
    """Return the constants of a trial with their uncertainties, or those of the first of two that fit as well."""
    parts = []
    for part in [slice(first, None, 4) for first in range(4)]:
        blurs = _search_blurs(walls, part, trial, SEARCH_STEPS[1:])[:2]
        parts.append((*blurs, _measure_cortex(walls, part, trial)[0]))
    if together is not None:
        trial, denser = together
    blur_errors = [_LEAST_BLUR_ERROR if (axis,) in walls.axes else _UNSEEN_ERROR for axis in (0, 1)]
    least = np.array([*blur_errors, _LEAST_CORTEX_ERROR if thick >= _FEWEST_THICK else _THIN_CORTEX_ERROR])
    errors = np.maximum(np.std(parts, axis=0) / 2.0, least * np.mean(parts, axis=0)).tolist()
    if together is not None:
        errors = [max(error, abs(end - own)) for error, end, own in zip(errors, denser, trial, strict=True)]
    residual = float(np.sqrt(np.mean(np.square(walls.fit(trial, CORTEX_SPREAD).residual_hu))))
    places = walls.values.shape[1]
    known = CortexConstants(*trial, errors[0], errors[1], errors[2], walls.noise, residual, places, thick)
    return known if together is None else known.changed(denser=list(denser))


def _are_alike(walls: _Walls, trial: _Trial) -> bool:
    """Tell whether all walls are thin and alike, so that they do not show their HU, see `_ALIKE_THICK`."""
    blurs = blurs_of(walls.values[SAMPLES : SAMPLES + FRAME], trial.blur_mm, trial.across_mm)
    fits = walls.fit(trial, _WIDE_SPREAD)
    ratios = fits.thickness_mm / blurs
    is_solid = ratios > _SOLID_BLURS
    solid = fits.cortex_hu[is_solid]
    shows_solid = len(solid) >= _FEWEST_THICK and np.percentile(solid, _DENSE_PERCENTILE) > _AS_DENSE * trial.cortex_hu
    if shows_solid or len(solid) > _MOST_RIMS * len(ratios):
        return False
    thin, thick = np.percentile(ratios[~is_solid], (15.0, 85.0))
    return bool(thick < _ALIKE_THICK * thin and np.median(ratios) < _THIN_BLURS)


def _find_denser(walls: _Walls, outcome: _Outcome) -> tuple[_Trial, _Trial] | None:
    """Return what is taken of the constants that describe alike walls as well, and their dense end; None for one."""
    trial = outcome.trial
    if outcome.is_told or not _are_alike(walls, trial):
        return None
    end, least = trial, _left(walls, slice(None), trial)
    most = min(_MOST_DENSER * trial.cortex_hu, METAL_HU)
    while end.cortex_hu * _DENSER_STEP <= most:
        candidate = end._replace(cortex_hu=end.cortex_hu * _DENSER_STEP)
        candidate = _search_blurs(walls, slice(None), candidate, SEARCH_STEPS[1:])
        left = _left(walls, slice(None), candidate)
        if left > _AS_WELL * max(least, (_LEAST_LEFT * trial.cortex_hu) ** 2):
            break
        end, least = candidate, min(left, least)
    if end is trial:
        return None
    nearer = trial._replace(cortex_hu=trial.cortex_hu * (end.cortex_hu / trial.cortex_hu) ** _DENSER_SHARE)
    return _search_blurs(walls, slice(None), nearer, SEARCH_STEPS[1:]), end


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
            values = _sample_walls(sampler, points, normals, rows)
        except NoSurfaceError:  # a table
            continue
        if not _may_differ(sampler, values, scan):
            continue
        walls = _Walls(sampler, values, scan.noise_hu)
        outcome = _search(walls, volume)
        cortex_hu = outcome.trial.cortex_hu
        is_bone = outcome.thick >= _FEWEST_THICK and cortex_hu >= COMPACT_HU
        if is_bone and abs(cortex_hu - scan.cortex_hu) > _DIFFERENT * scan.cortex_hu:
            if scan.denser is not None and _find_denser(walls, outcome) is not None:
                continue
            groups.append((rows, _measure_errors(walls, outcome.trial, outcome.thick)))
            left[rows] = False
    return [(np.flatnonzero(left), scan), *groups]


def _sample_walls(
    sampler: ProfileSampler, points: NDArray[np.floating], normals: NDArray[np.floating], rows: NDArray[np.integer]
) -> Float32Array:
    """Return up to `MOST_WALLS` profiles across walls of bone at these rows of the points."""
    rows = rows[spread_rows(len(rows), LOOKED_AT)]
    values = sampler.values(points[rows], normals[rows])
    whole = np.isfinite(values[:SAMPLES]).all(axis=0)
    peaks = np.where(whole, values[: CENTRE + 2].max(axis=0), 0)
    rise = peaks - values[CENTRE:SAMPLES].min(axis=0)
    usable = whole & (peaks < METAL_HU)
    of_bone = peaks[usable & (peaks >= LEAST_CORTEX_HU)]
    walls = np.zeros(0, np.intp)
    if len(of_bone) >= _FEWEST_WALLS:
        compact = of_bone[of_bone >= COMPACT_HU]
        least = LEAST_CONTRAST * float(np.percentile(compact if len(compact) >= _FEWEST_WALLS else of_bone, 90.0))
        walls = np.flatnonzero(usable & (np.minimum(rise, peaks) > least))
    if len(walls) < _FEWEST_WALLS:
        raise NoSurfaceError(
            f"the surface has no walls of bone that the cortex could be measured in: {len(walls)} of"
            f" {len(rows):,} profiles across it, at least {_FEWEST_WALLS} are needed; {HOW_TO_FIT}"
        )
    return values[:, walls[spread_rows(len(walls), MOST_WALLS)]]


def _may_differ(sampler: ProfileSampler, values: Float32Array, scan: CortexConstants) -> bool:
    """Tell whether walls may be of bone with a cortex of its own: with that of the scan they show another one."""
    if np.count_nonzero(values[: CENTRE + 2].max(axis=0) >= COMPACT_HU) < _FEWEST_THICK:
        return False
    trial = _Trial(scan.blur_mm, scan.blur_across_mm, scan.cortex_hu)
    shown, thick = _measure_cortex(_Walls(sampler, values, scan.noise_hu), slice(None), trial)
    return thick < _FEWEST_THICK or abs(shown - scan.cortex_hu) > _ALIKE * scan.cortex_hu


def _search(walls: _Walls, volume: Volume) -> _Outcome:
    """Return the constants that describe the profiles."""
    values = walls.values
    dense, usual = np.percentile(values[: CENTRE + 2].max(axis=0), (95.0, _DENSE_PERCENTILE)).tolist()
    x_mm, y_mm, z_mm = volume.spacing
    within, across = (min(0.7 * edge**0.5, edge) for edge in (math.sqrt(x_mm * y_mm), z_mm))
    start = _Trial(within, max(across, 0.45 * z_mm), min(1.03 * dense, 1.2 * usual))
    best = _search_blurs(walls, slice(None), start, SEARCH_STEPS)
    cortex_hu, thick = _measure_cortex(walls, slice(None), best)
    shown = thick >= _THICK_SHARE * values.shape[1]
    for first in range(1, len(SEARCH_STEPS)):
        candidate = _search_blurs(walls, slice(None), best._replace(cortex_hu=cortex_hu), SEARCH_STEPS[first:])
        if shown and _left(walls, slice(None), candidate) >= _left(walls, slice(None), best):
            break
        best = candidate
        cortex_hu, thick = _measure_cortex(walls, slice(None), best)
    if not shown:
        return _Outcome(_search_upwards(walls, best._replace(cortex_hu=cortex_hu)), thick)
    best = _step_cortex(walls, best, 1.0 / _CORTEX_STEP)
    denser = _step_cortex(walls, best, _UPWARD_STEP) if _may_be_denser(walls, best) else best
    return _Outcome(denser, thick, is_told=denser is not best)


def _step_cortex(walls: _Walls, best: _Trial, step: float) -> _Trial:
    """Return a trial whose cortex was changed by steps as long as each leaves clearly less."""
    candidate = best
    while candidate is best or _left(walls, slice(None), candidate) < _CLEARLY_LESS * _left(walls, slice(None), best):
        best = candidate
        candidate = best._replace(cortex_hu=best.cortex_hu * step)
        candidate = _search_blurs(walls, slice(None), candidate, SEARCH_STEPS[2:])
    return best


def _may_be_denser(walls: _Walls, trial: _Trial) -> bool:
    """Tell whether profiles could show a denser cortex: not those of solid bone, steps or walls that are alike."""
    fits = walls.fit(trial, _WIDE_SPREAD)  # a profile that ends within its wall shows nothing of what is inside
    is_solid = (fits.inner_hu > SOLID_SHARE * trial.cortex_hu) | (fits.thickness_mm > walls.depth_mm)
    return is_solid.mean() <= 0.5 and trial.across_mm <= STEPPED * trial.blur_mm and not _are_alike(walls, trial)


def _search_upwards(walls: _Walls, trial: _Trial) -> _Trial:
    """Return a trial whose cortex describes the profiles, where few walls are thick enough to show it."""
    if not _may_be_denser(walls, trial):
        return trial
    trials = [_search_blurs(walls, slice(None), trial, SEARCH_STEPS[2:])]
    most = _measure_cortex(walls, slice(None), trials[0])[1]
    for _ in range(_UPWARD_STEPS):
        denser = trials[-1]._replace(cortex_hu=trials[-1].cortex_hu * _UPWARD_STEP)
        denser = _search_blurs(walls, slice(None), denser, SEARCH_STEPS[1:])
        if _measure_cortex(walls, slice(None), denser)[1] < _STILL_THICK * most:
            break
        trials.append(denser)
    left = [_left(walls, slice(None), each) for each in trials]
    return next(each for each, value in zip(trials, left, strict=True) if value <= _ALMOST * min(left))


def _left(walls: _Walls, part: slice, trial: _Trial) -> float:
    """Return the mean square of what a trial leaves of a part of the profiles."""
    squares = np.sort(np.square(walls.fit(trial, _NARROW_SPREAD).residual_hu[part], dtype=np.float64))
    return float(np.mean(squares[: max(1, int(_TRIMMED * len(squares)))]))


def _search_blurs(walls: _Walls, part: slice, best: _Trial, factors: tuple[float, ...]) -> _Trial:
    """Return the blurs that leave least of a part of the profiles, from those of a trial on."""
    first, least = best, _left(walls, part, best)
    for factor in factors:
        for axes in walls.axes:
            for change in (factor, 1.0 / factor):
                while (value := _left(walls, part, trial := best.changed(axes, change))) < 0.9999 * least:
                    best, least = trial, value
                    if not all(1.0 / FARTHEST < new / old < FARTHEST for new, old in zip(trial, first, strict=True)):
                        return best
    return best


def _measure_cortex(walls: _Walls, part: slice, trial: _Trial) -> tuple[float, int]:
    """Return the HU of compact bone in a part of the profiles, and how many walls are thick enough to show it."""
    fits = walls.fit(trial, _WIDE_SPREAD)
    blurs = blurs_of(walls.values[SAMPLES : SAMPLES + FRAME, part], trial.blur_mm, trial.across_mm)
    thick = (fits.thickness_mm[part] > _THICK_BLURS * blurs) & (blurs < _SHARP * trial.blur_mm)
    if np.count_nonzero(thick) < _FEWEST_THICK:
        return trial.cortex_hu, int(np.count_nonzero(thick))
    shown = float(np.percentile(fits.cortex_hu[part][thick], _DENSE_PERCENTILE))
    return float(np.clip(shown, trial.cortex_hu / 1.25, trial.cortex_hu * 1.25)), int(np.count_nonzero(thick))
