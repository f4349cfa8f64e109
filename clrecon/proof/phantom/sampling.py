"""Voxels of a body under any affine, sheared ones included: partial volume, point spread, noise, artefacts.

Streaks are those of an image that is reconstructed from projections which metal makes wrong: beam hardening takes a
share of long ways through metal that grows with their length, and too few photons leave noise on them.  The error of
each projection is filtered and projected back.  Source: De Man et al., "Metal streak artifacts in X-ray computed
tomography", IEEE TNS 46 (1999)."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine, column_spacing
from clrecon.geometry.affine import Float64Array, checked_affine
from clrecon.proof.phantom.shapes import Body
from clrecon.system.progress import Progress

Float32Array = NDArray[np.float32]

_CHUNK = 1 << 21
"""Points evaluated at once: bounds the scratch memory to some hundred MB."""


def map_slices(
    work: Callable[[int], None], count: int, stage: str = "slices", progress: Progress | None = None
) -> None:
    """Call ``work(k)``, which may write only to its own slice, on threads; this one tells the progress."""
    workers = max(1, min(os.cpu_count() or 1, 8, count))
    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(pool.map(work, range(count)), start=1):
            if progress is not None:
                progress(stage, done, count)


def _checked_shape(shape_kji: tuple[int, int, int]) -> tuple[int, int, int]:
    shape = tuple(int(extent) for extent in shape_kji)
    if len(shape) != 3 or min(shape) < 1:
        raise UsageError(f"a volume has three extents (nk, nj, ni) of at least 1, got {tuple(shape_kji)}")
    return shape[0], shape[1], shape[2]


def _index_box(
    bounds_mm: Float64Array, affine: Float64Array, shape: tuple[int, int, int], margin_mm: float
) -> tuple[slice, slice, slice]:
    """Return slices (k, j, i) that hold all voxels whose centre may lie within `margin_mm` of the box `bounds_mm`."""
    if not np.isfinite(bounds_mm).all():
        return slice(0, shape[0]), slice(0, shape[1]), slice(0, shape[2])
    corners = np.array(list(itertools.product(*(bounds_mm + np.array(((-margin_mm,), (margin_mm,)))).T)))
    ijk = apply_affine(np.asarray(np.linalg.inv(affine), dtype=np.float64), corners)
    low = np.floor(ijk.min(axis=0)).astype(int)
    high = np.ceil(ijk.max(axis=0)).astype(int) + 1
    ranges = [slice(min(max(a, 0), n), max(min(b, n), 0)) for a, b, n in zip(low, high, shape[::-1], strict=True)]
    return ranges[2], ranges[1], ranges[0]


def _boundary_coverage(body: Body, points: Float64Array, steps: Float64Array, subsamples: int) -> Float64Array:
    """Return the share of each voxel's parallelepiped inside `body`, computed from subsamples**3 cells in a voxel.

    Each cell contributes by a linear ramp as wide as the cell is along the gradient of the distance.  So the share is
    continuous in the position of the surface, and a plane gives no steps of 1/subsamples.
    """
    delta = 0.25 * float(np.linalg.norm(steps, axis=0).min())
    gradient = np.stack(
        [
            (body.signed_distance(points + shift) - body.signed_distance(points - shift)) / (2.0 * delta)
            for shift in delta * np.eye(3)
        ],
        axis=1,
    )
    cell = np.abs(gradient @ steps) / subsamples
    # Averaging a plane over a box has the variance of three uniform distributions; the ramp gets the same variance.
    ramp = np.maximum(np.sqrt((cell**2).sum(axis=1)), 1e-9)
    centred = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    total = np.zeros(len(points))
    for fractions in itertools.product(centred, repeat=3):
        distance = body.signed_distance(points + steps @ np.array(fractions))
        total += np.clip(0.5 + distance / ramp, 0.0, 1.0)
    return total / subsamples**3


def sample_occupancy(
    body: Body, affine: ArrayLike, shape_kji: tuple[int, int, int], subsamples: int = 6
) -> Float32Array:
    """Partial volume: the share of every voxel's parallelepiped inside `body`, (nk, nj, ni) float32, 0 to 1, iso value
    0.5.

    Exactly 0 or 1 away from the surface; near it the average over ``subsamples**3`` cells of the voxel.  The affine,
    index (i, j, k) to LPS mm, is any invertible one, shear included.
    """
    matrix, shape = checked_affine(affine), _checked_shape(shape_kji)
    if subsamples < 1:
        raise UsageError(f"subsamples must be at least 1, got {subsamples}")
    steps = matrix[:3, :3]
    # Half the longest diagonal: a surface farther from the centre cannot cut the voxel.
    reach = max(float(np.linalg.norm(steps @ np.array(signs))) for signs in itertools.product((-0.5, 0.5), repeat=3))
    share = np.zeros(shape, dtype=np.float32)
    box_k, j, i = _index_box(body.bounds_mm, matrix, shape, reach)
    step = max(1, _CHUNK // max(1, (j.stop - j.start) * (i.stop - i.start)))
    for start in range(box_k.start, box_k.stop, step):
        k = slice(start, min(start + step, box_k.stop))
        grid = np.meshgrid(*(np.arange(axis.start, axis.stop) for axis in (k, j, i)), indexing="ij")
        centres = apply_affine(matrix, np.stack([axis.ravel() for axis in reversed(grid)], axis=1))
        distance = body.signed_distance(centres)
        coverage = (distance >= 0.0).astype(np.float32)
        near = np.flatnonzero(np.abs(distance) < reach)
        for first in range(0, len(near), _CHUNK // 8):
            chosen = near[first : first + _CHUNK // 8]
            coverage[chosen] = _boundary_coverage(body, centres[chosen], steps, subsamples)
        share[k, j, i] = coverage.reshape(share[k, j, i].shape)
    return share


def _blur_axis(field: Float32Array, sigma: float, axis: int) -> Float32Array:
    """Blur along one axis with a Gaussian, sigma in steps; the edge value is continued outside."""
    # half of a normalised Gaussian, from the centre outwards, cut off at four sigma
    weights = np.exp(-0.5 * (np.arange(int(4.0 * sigma + 0.5) + 1) / max(sigma, 1e-9)) ** 2)
    weights = weights / (weights[0] + 2.0 * weights[1:].sum())
    radius, extent = len(weights) - 1, field.shape[axis]
    if radius == 0:
        return field
    widths = [(0, 0)] * field.ndim
    widths[axis] = (radius, radius)
    padded = np.moveaxis(np.pad(field, widths, mode="edge"), axis, 0)
    blurred = padded[radius : radius + extent] * np.float32(weights[0])
    for offset in range(1, radius + 1):
        pair = padded[radius - offset : radius - offset + extent] + padded[radius + offset : radius + offset + extent]
        pair *= np.float32(weights[offset])
        blurred += pair
    return np.moveaxis(blurred, 0, axis)


def _uneven_weights(at_mm: Float64Array, sigma_mm: float) -> Float32Array:
    """Return the matrix (n, n) of Gaussian means over samples at uneven places."""
    weights = np.exp(-0.5 * ((at_mm[:, None] - at_mm) / sigma_mm) ** 2)
    weights *= np.gradient(at_mm)  # each sample stands for the space between its neighbours
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float32)


def apply_point_spread(
    voxels: Float32Array,
    affine: ArrayLike,
    sigma_mm: float,
    progress: Progress | None = None,
    places: Float64Array | None = None,
) -> Float32Array:
    """Blur `voxels`, (nk, nj, ni), in place by a Gaussian of `sigma_mm` along each of the affine's three steps.

    On a perpendicular stack this is the isotropic point spread; on a sheared one the blur between slices follows the
    slice step, as the averaging of a moving table does.  `places` are k of each slice in the affine, else 0, 1, 2...
    """
    if not (math.isfinite(sigma_mm) and sigma_mm >= 0.0):
        raise UsageError(f"the point spread must be 0 mm or more, got {sigma_mm}")
    if sigma_mm == 0.0:
        return voxels
    di, dj, dk = column_spacing(checked_affine(affine))

    def blur_slice(k: int) -> None:
        voxels[k] = _blur_axis(_blur_axis(voxels[k], sigma_mm / di, 1), sigma_mm / dj, 0)

    weights = None if places is None else _uneven_weights(places * dk, sigma_mm)

    def blur_row(j: int) -> None:
        row = np.ascontiguousarray(voxels[:, j])
        voxels[:, j] = _blur_axis(row, sigma_mm / dk, 0) if weights is None else weights @ row

    map_slices(blur_slice, voxels.shape[0], "blur", progress)
    map_slices(blur_row, voxels.shape[1])
    return voxels


def add_noise(voxels: Float32Array, sigma_hu: float, seed: int) -> Float32Array:
    """Add white Gaussian noise in place; every slice has its own stream, so threads do not change the result."""
    if sigma_hu > 0.0:

        def disturb(k: int) -> None:
            generator = np.random.default_rng((seed, k))
            voxels[k] += np.float32(sigma_hu) * generator.standard_normal(voxels.shape[1:], dtype=np.float32)

        map_slices(disturb, voxels.shape[0])
    return voxels


_ANGLES = 144
"""Projections of half a turn."""
_HARDENED_PER_MM = 0.006
"""Share of a way through metal that beam hardening takes, for each mm of it."""
_STARVED_PER_MM = 0.0004
"""Noise of a way through metal, as a share of it, for each mm."""


def _radius(shape: tuple[int, ...], spacing: tuple[float, float]) -> tuple[Float32Array, Float32Array, float]:
    """Return x, y in mm about the middle of a slice, and the radius of its round field of view in mm."""
    nj, ni = shape
    y = (np.arange(nj, dtype=np.float32) - np.float32((nj - 1) / 2.0))[:, None] * np.float32(spacing[1])
    x = (np.arange(ni, dtype=np.float32) - np.float32((ni - 1) / 2.0))[None, :] * np.float32(spacing[0])
    return x, y, 0.5 * min(ni * spacing[0], nj * spacing[1])


def add_cupping(field: Float32Array, affine: NDArray[np.float64], cupping_hu: float) -> None:
    """Lower all slices in place, by `cupping_hu` in the middle and by nothing at the rim of the field of view."""
    x, y, radius = _radius(field.shape[1:], column_spacing(affine)[:2])
    field -= np.float32(cupping_hu) * np.clip(1.0 - (x * x + y * y) / np.float32(radius**2), 0.0, None)


def outside_disc(shape: tuple[int, ...], affine: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the pixels of a slice (nj, ni) outside of the round field of view."""
    x, y, radius = _radius(shape, column_spacing(affine)[:2])
    return np.asarray(x * x + y * y > np.float32((0.985 * radius) ** 2))


def add_streaks(
    field: Float32Array, metal: NDArray[np.bool_], metal_hu: float, affine: NDArray[np.float64], strength: float,
    seed: int,
) -> None:  # fmt: skip
    """Add the streaks of metal of `metal_hu` to the slices that show it, in place."""
    spacing = column_spacing(affine)[:2]
    x, y, radius = _radius(field.shape[1:], spacing)
    step = min(spacing)
    bins = 2 * math.ceil(1.5 * radius / step) + 8
    ramp = np.abs(np.fft.rfftfreq(2 * bins, step))

    def disturb(k: int) -> None:
        rows, columns = np.nonzero(metal[k])
        if not len(rows):
            return
        noise = np.random.default_rng((seed, 31, k)).standard_normal((_ANGLES, bins))
        error = np.zeros(field.shape[1:], dtype=np.float32)
        for n, angle in enumerate(np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES):
            cos, sin = np.float32(math.cos(angle) / step), np.float32(math.sin(angle) / step)
            hit = np.rint(x[0, columns] * cos + y[rows, 0] * sin).astype(np.intp) + bins // 2
            metal_mm = np.bincount(hit, minlength=bins) * (spacing[0] * spacing[1] / step)
            # A voxel shades more than the bin of its centre.
            metal_mm = np.convolve(metal_mm, (0.25, 0.5, 0.25), mode="same")
            wrong = metal_hu * metal_mm**2 * (_STARVED_PER_MM * noise[n] - _HARDENED_PER_MM)
            filtered = np.fft.irfft(np.fft.rfft(wrong, 2 * bins) * ramp)[:bins].astype(np.float32)
            error += filtered[(x * cos + y * sin + np.float32(bins // 2 + 0.5)).astype(np.intp)]
        field[k] += error * np.float32(strength * np.pi / _ANGLES)

    map_slices(disturb, len(field))
