"""The outer surface of bone across the vertices of a mesh: the fits of their profiles, and how far each is trusted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import AIR_HU, METAL_HU
from clrecon.mesh.compare.walls import FAINT_HU, lie_near, near_mm
from clrecon.opencl import Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cortex import (
    CORRELATED_MM,
    STEP_MM,
    CortexConstants,
    Float32Array,
    ProfileSampler,
    ProfileScale,
    WallFits,
    WallProfiles,
    blurs_of,
    unexplained_hu,
)
from clrecon.operators.surface.cortex_constants import LEAST_CONTRAST, SOLID_SHARE, find_groups, measure_constants
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks, deal_in_order

_STATES = ("fitted", "not bone", "metal", "badly fitted", "no room")
"""What is across a vertex: a wall; no wall of bone; metal; a profile unlike a wall; another wall or the end of the
volume just outside of it."""

FITTED, NOT_BONE, METAL, BADLY_FITTED, NO_ROOM = range(len(_STATES))
_THINNEST_BLURS, EDGE_SHARE = 0.2, 0.6
"""A wall thinner than so many blurs, before something of less than this share of the cortex' HU, is an edge without a
wall: a vessel, an organ, marrow.  Of true walls 1 to 3 % are as thin."""

_FAINT_MM, _CELLS_NEAR = 0.3, 3.0
"""Bone has within `near_mm`, looked for in cells of a third of it, a wall that rises to `LEAST_CONTRAST` of the cortex'
HU, to `FAINT_HU`, or to this over the blur of these HU, as a wall of 0.75 mm does.  Vessels, couches and the heart have
none: of true walls of phantoms none was lost, of a thorax with contrast medium three quarters of the fitted heart."""

_ACROSS, _HIDDEN_BLURS = 1.25, 0.3
"""Where a profile is blurred by more than so often what slices are within themselves, a wall thinner than so many of
these blurs is badly fitted: thick slices hide where within them it lies."""

_MOST_RESIDUAL, _LEAST_CORTEX = 3.0, 0.7
"""Residual, in what noise and model explain, from which on a profile is not that of a wall, and the share of the scan's
cortex below which a wall is not of bone alone: a vessel with contrast medium or a disc touches it."""

LEAST_ROOM = 2
"""Samples outside of a vertex that belong to its wall, at least."""

MOST_SHIFT_MM = 2.5
"""Largest shift of a vertex to its wall; a fit with a larger shift, or standard error, counts as bad."""

_WEIGHT_FACTOR, _LEAST_WEIGHED = 1.125, 0.054
"""By what the fit's own error is multiplied where it weighs neighbours, and what is added in squares, in blurs."""

_ERROR_FACTOR, _COARSE_ERROR = 1.1, 0.025
"""By what the error from noise and from what the fit leaves is multiplied where it is stated, and the share of step^3 /
blur^2 that is added in squares: what interpolation between voxels blurs is known as a series of three terms."""

_JUDGES = 2
"""Threads that judge fits: numpy takes a quarter of the device's time."""

DENSER_ERROR = np.float32(0.5)
"""Standard error of what lies anywhere from as far on the other side up to 1: from the least cortex to the densest
where half of the way is taken."""


@dataclass(frozen=True)
class CortexFit:
    """Where the outer surface of bone lies across the vertices of a mesh, shape (n,) each.

    own_cortex_hu: HU of the cortex of components that have constants of their own.
    states: uint8. Places in `_STATES`; all values below are those of the fit, in every state.
    hidden: bool. Badly fitted because thick slices hide the wall.
    shift_mm: From the vertex along its normal, outwards positive.
    thickness_mm: Of the wall; solid bone has at least the depth of a profile.
    error_mm: Standard error of the shift.
    spread_mm: That error without what coarse voxels add, by which neighbours are weighed.
    room_mm: From the vertex outwards to the next wall, or to the end of the profile.
    """

    constants: CortexConstants
    own_cortex_hu: tuple[float, ...]
    states: NDArray[np.uint8]
    hidden: NDArray[np.bool_]
    shift_mm: Float32Array
    thickness_mm: Float32Array
    error_mm: Float32Array
    spread_mm: Float32Array
    room_mm: Float32Array

    def counts(self) -> dict[str, int]:
        """Return the number of vertices in each state."""
        return {name: int(np.count_nonzero(self.states == state)) for state, name in enumerate(_STATES)}


_Fitted = tuple[NDArray[np.intp], CortexConstants, WallFits, Float32Array, Float32Array | None]
"""Rows of points, their constants, fits, frames, and shifts at the dense end of the constants."""


def fit_walls(
    resident: DeviceVolume,
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    *,
    stopwatch: Stopwatch,
    constants: CortexConstants | None = None,
    components: NDArray[np.integer] | None = None,
    cubic: bool = False,
) -> CortexFit:
    """Find the outer surface of bone across points of a surface at a low level.

    points, normals: ndarray, shape (n, 3). LPS mm, and unit vectors outwards.
    constants: Those of the scan; None: measured.
    components: ndarray, shape (n,). Those of the points, of which large ones may have a cortex of their own.
    cubic: Fit profiles whose values between slices are those of a cubic convolution; constants are of linear ones.
    """
    sampler = ProfileSampler(resident, stopwatch)
    if constants is None:
        constants = measure_constants(sampler, resident.volume, points, normals)
    count = len(points)
    groups = [(np.arange(count), constants)]
    if components is not None:
        groups = find_groups(sampler, resident.volume, points, normals, components, constants)
    levels = tuple(known.cortex_hu for _, known in groups[1:])
    shows_bone = np.zeros(count, bool)
    marks = np.empty(count, np.uint8), np.empty(count, bool)
    fit = CortexFit(constants, levels, *marks, *(np.empty(count, np.float32) for _ in range(5)))
    if cubic:
        sampler = ProfileSampler(resident, stopwatch, cubic=True)

    def fit_pieces() -> Iterator[_Fitted]:
        for members, known in groups:
            for rows, values_d in sampler.pieces(points, normals, members):
                with stopwatch.running(resident.device):
                    profiles = WallProfiles(sampler, values_d, len(rows))
                    walls, frames = profiles.fit_with(known), profiles.frames()
                    denser = None if known.denser is None else profiles.fit_with(known.at_dense_end()).shift_mm
                yield rows, known, walls, frames, denser

    def judge_piece(fitted: _Fitted) -> None:
        members, known, fits, frames, denser = fitted
        within, across = known.blur_mm**2, known.blur_across_mm**2
        for span in chunks(len(members)):  # products of more rows keep threads of BLAS busy with waiting
            rows, walls = members[span], WallFits(*(row[span] for row in fits.rows()))
            blurs = np.sqrt(within + (across - within) * np.square(normals[rows] @ sampler.frame.normal))
            hidden = (blurs > _ACROSS * known.blur_mm) & (walls.thickness_mm < _HIDDEN_BLURS * blurs)
            fit.states[rows] = judge_walls(walls, known, sampler.scale, hidden)
            around_hu = AIR_HU if known.noise_hu is None else 0.0  # a specimen lies in air
            rise = np.minimum(LEAST_CONTRAST, _FAINT_MM / blurs) * (known.cortex_hu - around_hu)
            shows_bone[rows] = walls.peak_hu >= np.minimum(around_hu + rise, FAINT_HU)
            fit.hidden[rows] = hidden & (fit.states[rows] == BADLY_FITTED)
            solid_mm = np.float32(-sampler.scale.first_mm) * (walls.inner_hu > SOLID_SHARE * walls.cortex_hu)
            fit.thickness_mm[rows] = np.maximum(walls.thickness_mm, solid_mm)
            fit.shift_mm[rows], fit.room_mm[rows] = walls.shift_mm, walls.room_mm
            fit.spread_mm[rows] = standard_errors(walls, known)
            steps = sampler.frame.steps_along(normals[rows], frames[1, span])
            ratios = steps / blurs_of(frames[:, span], known.blur_mm, known.blur_across_mm)
            fit.error_mm[rows] = standard_errors(walls, known, coarse_mm=steps * ratios * ratios)
            if denser is not None:
                fit.error_mm[rows] = np.hypot(fit.error_mm[rows], DENSER_ERROR * (denser[span] - walls.shift_mm))

    for _ in deal_in_order([judge_piece] * _JUDGES, fit_pieces()):  # beside the fits of the next pieces
        pass
    fit.states[(fit.states == FITTED) & (fit.error_mm > MOST_SHIFT_MM)] = BADLY_FITTED
    is_wall = np.isin(fit.states, (FITTED, BADLY_FITTED))
    is_far = is_wall & ~lie_near(points, shows_bone, near_mm(resident.volume) / _CELLS_NEAR, _CELLS_NEAR)
    fit.states[is_far], fit.hidden[is_far] = NOT_BONE, False
    return fit


def judge_walls(
    walls: WallFits, constants: CortexConstants, scale: ProfileScale, hidden: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return the state of each place."""
    states = np.zeros(len(walls.shift_mm), np.uint8)
    cortex, explained = constants.cortex_hu, unexplained_hu(constants.cortex_hu, constants.known_noise)
    thin = walls.thickness_mm < _THINNEST_BLURS * constants.blur_mm
    states[walls.residual_hu > _MOST_RESIDUAL * explained] = BADLY_FITTED
    states[np.abs(walls.shift_mm) > MOST_SHIFT_MM] = BADLY_FITTED
    states[walls.cortex_hu < _LEAST_CORTEX * cortex] = BADLY_FITTED
    states[thin & (walls.inner_hu < EDGE_SHARE * cortex)] = NOT_BONE
    states[hidden] = BADLY_FITTED
    states[walls.peak_hu >= METAL_HU] = METAL
    states[~(walls.room_mm > (LEAST_ROOM - 0.5) * scale.step_mm) | np.isnan(walls.peak_hu)] = NO_ROOM
    return states


def standard_errors(
    walls: WallFits, constants: CortexConstants, *, coarse_mm: Float32Array | None = None
) -> Float32Array:
    """Return the standard errors of shifts, mm: of noise, what the model leaves, the constants, and coarse voxels.

    Where the cortex differs from that of the scan by more than it may, the error grows by the ratio.

    coarse_mm: ndarray, shape (n,). step^3 / blur^2; None: the errors by which neighbours are weighed.
    """
    cortex, noise = constants.cortex_hu, constants.known_noise
    if coarse_mm is None:
        left = np.maximum(walls.residual_hu, np.float32(unexplained_hu(cortex, noise)))
        factor, added = _WEIGHT_FACTOR, np.float32(_LEAST_WEIGHED * constants.blur_mm)
    else:
        left, factor = np.hypot(walls.residual_hu, np.float32(noise)), _ERROR_FACTOR
        added = np.float32(_COARSE_ERROR) * coarse_mm
    differs = np.abs(walls.cortex_hu - cortex) / (constants.cortex_spread * cortex)
    errors = np.float32(factor * np.sqrt(CORRELATED_MM / STEP_MM)) * np.sqrt(walls.shift_variance) * left
    return np.maximum(differs, 1.0).astype(np.float32) * np.hypot(errors, added)
