"""Twin of cl/surface/cortex.cl in float64: profiles, and walls fitted to them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array

SAMPLES, CENTRE = 13, 7
FRAME = 2

SHARPNESS = -0.75
"""Parameter of the cubic convolution between slices."""

INNER_SHARE = 0.25
"""Expected HU of marrow, as a share of those of cortex."""

MEAN_SPREAD = 1.0 / 6.0
"""Variance of linear interpolation, in squares of the step between voxels, over all places between them."""

LEAST_SPREAD = 0.15
"""Variance of a sample's blur, as a share of that of its profile."""

ROUNDS, SLACK = 6, 1.0003
THINNEST = 0.05
_STARTS = ((-1.1, 0.9), (-0.8, 2.2), (-0.8, 5.0))
"""Places and thicknesses where the search may begin, in blurs."""

_normal_share = np.vectorize(lambda z: 0.5 * math.erfc(-z / math.sqrt(2.0)), otypes=[np.float64])


@dataclass
class Scale:
    """Samples of a profile, at ``first_mm + n * step_mm``, and their weights."""

    first_mm: float
    step_mm: float
    weights: NDArray[np.floating]


def _convolution(distance: Float64Array) -> Float64Array:
    """Return the weights of the cubic convolution of Keys 1981 at distances of 0 to 2 slices."""
    near = (SHARPNESS + 2.0) * distance**3 - (SHARPNESS + 3.0) * distance**2 + 1.0
    far = SHARPNESS * (distance**3 - 5.0 * distance**2 + 8.0 * distance - 4.0)
    return np.where(distance < 1.0, near, far)


def _series(shares: Float64Array, steps: Float64Array) -> Float64Array:
    """Return what linear interpolation along axes adds to the blur of profiles, shape (3, n), see cl/surface/cortex.cl.

    shares, steps: shape (n, 3). Of the way between two voxels, and how far apart these lie along the profile, mm.
    """
    spread = shares * (1.0 - shares)
    third, fourth = spread * (2.0 * shares - 1.0) / 6.0, spread * (1.0 - 6.0 * spread) / 24.0
    terms = steps**2 * (spread - MEAN_SPREAD), steps**3 * third, steps**4 * fourth
    return np.stack([term.sum(axis=1) for term in terms])


def sample_profiles(
    volume: Volume, points: NDArray[np.floating], normals: NDArray[np.floating], scale: Scale, *, cubic: bool = False
) -> Float64Array:
    """Return the profiles, shape (4 * SAMPLES + FRAME, n), as cl/surface/cortex.cl has them.

    Slices must be less than two pixels apart, unless `cubic`.
    """
    normal = slice_normal(volume.affine)
    heights = np.abs(np.diff(volume.slice_origins() @ normal))
    last = np.array(volume.shape_ijk) - 1
    profiles = np.empty((4 * SAMPLES + FRAME, len(points)))
    to_next = (1.0 - cubic) * np.diff(volume.slice_origins(), axis=0)
    voxels = volume.voxels.astype(np.float64)
    for n in range(SAMPLES):
        ijk = volume.lps_to_ijk(points + (scale.first_mm + n * scale.step_mm) * normals)
        inside = ((ijk >= -0.5) & (ijk <= last + 0.5)).all(axis=1)
        clamped = np.clip(ijk, 0, last)
        low = np.minimum(clamped.astype(int), np.maximum(last - 1, 0))
        share, high = clamped - low, np.minimum(low + 1, last)
        value = np.zeros(len(points))
        k = low[:, 2]
        gaps = np.stack([heights[np.clip(k + step, 0, len(heights) - 1)] for step in (-1, 0, 1)])
        alike = (np.abs(gaps[1] / gaps - 1.0) <= 0.01).all(axis=0)
        curved = cubic & (k > 0) & (k + 2 <= last[2]) & alike
        for step in range(-1, 3):
            distance = np.abs(share[:, 2] - step)
            weight = np.where(curved, _convolution(distance), np.maximum(1.0 - distance, 0.0))
            in_slice = np.zeros(len(points))
            for upper in np.ndindex(2, 2):
                i, j = ((high if up else low)[:, axis] for axis, up in enumerate(upper))
                parts = [share[:, axis] if up else 1.0 - share[:, axis] for axis, up in enumerate(upper)]
                in_slice += parts[0] * parts[1] * voxels[np.clip(k + step, 0, last[2]), j, i]
            value += weight * in_slice
        profiles[n] = np.where(inside, value, np.nan)
        steps = np.column_stack([normals @ volume.affine[:3, :2], np.einsum("na,na->n", normals, to_next[k])])
        profiles[SAMPLES + FRAME + n :: SAMPLES] = _series(share, steps)
    layers = np.clip(np.floor(volume.lps_to_ijk(points)[:, 2]).astype(int), 0, len(heights) - 1)
    profiles[SAMPLES] = np.square(normals @ normal)
    profiles[SAMPLES + 1] = np.square(heights[layers] / np.median(heights))
    return profiles


def find_wall(profiles: Float64Array, rise: float) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64Array]:
    """Return the first and the last sample that belong to the wall of each profile, and its highest value."""
    count = profiles.shape[1]
    first, last = np.full(count, CENTRE), np.full(count, CENTRE)
    peak = np.full(count, np.nan)
    for row in range(count):
        y = profiles[:SAMPLES, row]
        if np.isnan(y[CENTRE]):
            continue
        most, lowest = y[CENTRE], CENTRE
        for n in range(CENTRE + 1, SAMPLES):
            if np.isnan(y[n]):
                break
            if y[n] > y[lowest] + rise:
                last[row] = lowest
                break
            last[row], most = n, max(most, y[n])
            lowest = n if y[n] < y[lowest] else lowest
        fallen = -1
        for n in range(CENTRE - 1, -1, -1):
            if np.isnan(y[n]):
                break
            if fallen >= 0 and y[n] > y[fallen] + rise:
                first[row] = fallen
                break
            first[row] = n
            if (fallen >= 0 and y[n] < y[fallen]) or (fallen < 0 and y[n] < most - rise):
                fallen = n
            most = max(most, y[n])
        peak[row] = most
    return first, last, peak


@dataclass
class _Fit:
    """Fits at given places and thicknesses, shape (n,), plateaus (n, 3): outer, cortex, inner from the cortex on."""

    x0: Float64Array
    t: Float64Array
    plateaus: Float64Array
    cost: Float64Array
    samples: Float64Array
    square: Float64Array
    slope: Float64Array

    def replaced(self, by: _Fit, slack: float = 1.0) -> _Fit:
        """Return the better of both, place by place."""
        take = by.cost < slack * self.cost
        pairs = ((getattr(by, name), getattr(self, name)) for name in self.__dataclass_fields__)
        return _Fit(*(np.where(take.reshape(-1, *[1] * (one.ndim - 1)), one, other) for one, other in pairs))


def fit_profiles(
    profiles: Float64Array,
    scale: Scale,
    blur_mm: float,
    across_mm: float,
    cortex_hu: float,
    precisions: tuple[float, float, float],
    rise: float,
) -> Float64Array:
    """Return results (9, n) of profiles, see `sample_profiles`; precisions of the HU around, of cortex and inside."""
    steep, gap = profiles[SAMPLES : SAMPLES + FRAME]
    spread, *cumulants = profiles[SAMPLES + FRAME :].reshape(3, SAMPLES, -1).transpose(0, 2, 1)
    over = np.maximum(blur_mm**2 + (across_mm**2 - blur_mm**2) * gap, 0.1 * blur_mm**2)
    width = np.sqrt(blur_mm**2 * (1.0 - steep) + over * steep)
    square = width[:, None] ** 2
    widths = np.sqrt(np.maximum(square + spread, LEAST_SPREAD * square))
    third, fourth = cumulants[0] / widths**3, cumulants[1] / widths**4
    first, last, peak = find_wall(profiles, rise)
    places = scale.first_mm + scale.step_mm * np.arange(SAMPLES)
    counts = (np.arange(SAMPLES) >= first[:, None]) & (np.arange(SAMPLES) <= last[:, None])
    weights = np.where(counts, scale.weights.astype(np.float64), 0.0)
    values = np.where(counts, profiles[:SAMPLES].T / 1000.0 - cortex_hu / 1000.0, 0.0)
    expected = np.array([0.0, 0.0, (INNER_SHARE - 1.0) * cortex_hu / 1000.0])
    precision = np.array(precisions)

    def edge_share(z: Float64Array) -> tuple[Float64Array, Float64Array]:
        density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
        share = _normal_share(z) - density * (third * (z**2 - 1.0) + fourth * (z**3 - 3.0 * z))
        return share, density * (1.0 + third * (z**3 - 3.0 * z) + fourth * (z**4 - 6.0 * z**2 + 3.0)) / widths

    def fit_walls(x0: Float64Array, t: Float64Array) -> _Fit:
        outer, rise_x = edge_share((places - x0[:, None]) / widths)
        solid, fall_x = edge_share((places - x0[:, None] + t[:, None]) / widths)
        inner = 1.0 - solid
        shares = np.stack([outer, 1.0 - outer - inner, inner], axis=2)
        square = np.einsum("ns,nsa,nsb->nab", weights, shares, shares) + np.diag(precision)
        plateaus = np.linalg.solve(
            square, (np.einsum("ns,nsa,ns->na", weights, shares, values) + precision * expected)[..., None]
        )
        plateaus = plateaus[..., 0]
        left = values - np.einsum("nsa,na->ns", shares, plateaus)
        out, ctx, mar = (plateaus[:, place, None] for place in range(3))
        by_x = (ctx - out) * rise_x - (ctx - mar) * fall_x
        changes = np.stack([by_x, (ctx - mar) * fall_x], axis=2)
        mixed = np.einsum("ns,nsa,nsb->nab", weights, changes, shares)
        curvature = np.einsum("ns,nsa,nsb->nab", weights, changes, changes)
        curvature -= mixed @ np.linalg.solve(square, mixed.transpose(0, 2, 1))
        samples = np.einsum("ns,ns->n", weights, left**2)
        cost = samples + (precision * (plateaus - expected) ** 2).sum(axis=1)
        return _Fit(x0, t, plateaus, cost, samples, curvature, np.einsum("ns,nsa,ns->na", weights, changes, left))

    nearest, room = places[first], places[last]
    thickest = scale.step_mm * SAMPLES
    ease = np.array([2.5e-13, 7.5e-12]) * (cortex_hu / scale.step_mm) ** 2
    begins = [fit_walls(np.clip(x * width, nearest, room), t * width) for x, t in _STARTS]
    now = begins[0].replaced(begins[1]).replaced(begins[2])
    damping = np.full(len(width), 0.01)
    for _ in range(ROUNDS):
        system = now.square.copy()
        system[:, (0, 1), (0, 1)] *= 1.0 + damping[:, None]
        system[:, (0, 1), (0, 1)] += ease
        step = np.linalg.solve(system, now.slope[..., None])[..., 0]
        x0 = np.clip(now.x0 + np.clip(step[:, 0], -width, width), nearest, room)
        t = np.maximum(now.t + np.clip(step[:, 1], -1.5 * width, 1.5 * width), 0.5 * now.t)
        following = fit_walls(x0, np.clip(t, THINNEST * width, thickest))
        damping = damping * np.where(following.cost < SLACK * now.cost, 0.2, 5.0)
        now = now.replaced(following, SLACK)
    now.square[:, (0, 1), (0, 1)] += ease
    variance = 1e-6 * np.linalg.inv(now.square)[:, 0, 0]
    residual = 1000.0 * np.sqrt(np.maximum(now.samples, 0.0) / (weights.sum(axis=1) + 1e-6))
    return np.vstack([now.x0, now.t, 1000.0 * now.plateaus.T + cortex_hu, residual, variance, peak, room])
