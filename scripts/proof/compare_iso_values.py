#!/usr/bin/env python3
"""Comparison of ways to choose an iso value, on phantoms with a known true surface; the table of docs/iso_value.md.

Spheres (radius 10 voxels, 1040 in 40 HU): error of the level in HU, and of the mean radius in voxels against the
surface at the true half-way level (540 HU).  Spines: the level, and the mean distance in mm from the true surface of
the vertebrae to the extracted one; "best" is the level at which that distance is smallest.
Needs numpy and scipy only; about two minutes on one core.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from clrecon.anatomy import iso_choice as choice  # noqa: E402
from clrecon.anatomy import materials  # noqa: E402
from clrecon.anatomy.iso_choice import measure_edges  # noqa: E402
from clrecon.errors import NoSurfaceError  # noqa: E402
from clrecon.geometry import Volume, column_spacing  # noqa: E402

Array = NDArray[Any]
SPHERE_RADIUS, BONE_HU, TISSUE_HU = 10.0, 1040.0, 40.0

SPINES: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "1 mm": ({}, {}),
    "0.6 mm": ({"size": (384, 384), "slices": 80, "spacing": (0.6, 0.6, 0.8), "point_spread_mm": 0.4}, {}),
    "0.6 mm, sharp, noise 60": (
        {"size": (384, 384), "slices": 80, "spacing": (0.6, 0.6, 0.8), "point_spread_mm": 0.2, "noise": 60.0},
        {},
    ),
    "1 mm, noise 50": ({"noise": 50.0}, {}),
    "1 mm, blur 1 mm": ({"point_spread_mm": 1.0, "noise": 10.0}, {}),
    "slices 4.25 mm": ({"slices": 40, "spacing": (1.0, 1.0, 4.25), "point_spread_mm": 0.7, "noise": 15.0}, {}),
    "1 mm, contrast medium": ({}, {"BLOOD_HU": 300.0, "KIDNEY_HU": 180.0}),
    # made after the method was fixed
    "0.8 mm, slices 2 mm, tilt 12": (
        {
            "size": (320, 320),
            "slices": 60,
            "spacing": (0.8, 0.8, 2.0),
            "tilt": 12.0,
            "point_spread_mm": 0.6,
            "noise": 25.0,
            "seed": 5,
        },
        {"BLOOD_HU": 220.0, "LIVER_HU": 130.0, "KIDNEY_HU": 200.0},
    ),
    "0.7 mm, slices 3 mm": (
        {"size": (360, 360), "slices": 50, "spacing": (0.7, 0.7, 3.0), "noise": 15.0, "seed": 7},
        {},
    ),
    "1.5 mm": ({"size": (200, 200), "slices": 80, "spacing": (1.5, 1.5, 1.5), "seed": 8}, {}),
}


# --- ways to choose ---
def _every_slice(volume: Volume) -> tuple[Array, Array]:
    """Count the voxels of each whole HU above the padding; also return these HU."""
    counts = materials.count_values(enumerate(volume.voxels))
    return counts, np.arange(len(counts)) + float(materials.LOWEST_HU)


def by_otsu(volume: Volume) -> float:
    """Otsu 1979 with three classes (air and fat, soft tissue, bone) in bins of 10 HU: the upper of two levels."""
    counts, hu = _every_slice(volume)
    n = len(counts) // 10
    weight, centre = counts[: n * 10].reshape(n, 10).sum(1), hu[: n * 10].reshape(n, 10).mean(1)
    w, m = np.cumsum(weight), np.cumsum(weight * centre)
    a, b = np.arange(n)[:, None], np.arange(n)[None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        between = m[a] ** 2 / w[a] + (m[b] - m[a]) ** 2 / (w[b] - w[a]) + (m[-1] - m[b]) ** 2 / (w[-1] - w[b])
    between = np.where((b > a) & np.isfinite(between), between, -np.inf)
    return float(centre[np.argmax(between) % n] + 5.0)


def by_minimum_error(volume: Volume) -> float:
    """Kittler and Illingworth 1986 on the voxels above -200 HU."""
    counts, hu = _every_slice(volume)
    counts, hu = counts[hu >= -200.0], hu[hu >= -200.0]
    w, m, s = np.cumsum(counts), np.cumsum(counts * hu), np.cumsum(counts * hu * hu)
    with np.errstate(divide="ignore", invalid="ignore"):
        p, q = w / w[-1], 1.0 - w / w[-1]
        v1, v2 = s / w - (m / w) ** 2, (s[-1] - s) / (w[-1] - w) - ((m[-1] - m) / (w[-1] - w)) ** 2
        error = p * np.log(v1) + q * np.log(v2) - 2.0 * p * np.log(p) - 2.0 * q * np.log(q)
    error[~np.isfinite(error)] = np.inf
    return float(hu[20 + np.argmin(error[20:-20])])


def by_modes(volume: Volume) -> float:
    """Half way between the soft-tissue mode and the highest mode of the histogram above the seed."""
    smooth = materials.smooth_counts(_every_slice(volume)[0])
    background = materials.find_background(_every_slice(volume)[0])
    above = smooth[background.seed - materials.LOWEST_HU :]
    peaks = np.flatnonzero((above[1:-1] > above[:-2]) & (above[1:-1] >= above[2:])) + 1
    return float((background.mode + background.seed + peaks[np.argmax(above[peaks])]) / 2.0)


def by_gradient(volume: Volume) -> float:
    """Mean HU above -200, weighted by the squared in-plane gradient."""
    total = weights = 0.0
    for values in volume.voxels.astype(np.float32):
        dj, di = np.gradient(values)
        weight = np.where(values > -200.0, dj * dj + di * di, 0.0)
        total, weights = total + float((weight * values).sum()), weights + float(weight.sum())
    return total / weights


def by_plain_edges(volume: Volume) -> float:
    """The edges of "auto", but all with equal weight and with contrast medium included."""
    sampled = range(len(volume.voxels))
    edges = measure_edges(((k, volume.voxels[k]) for k in sampled), materials.find_background(_every_slice(volume)[0]))
    return float((np.median(edges.bone) + np.median(edges.tissue)) / 2.0)


def by_preset(volume: Volume) -> float:
    """The preset "bone", the same for every scan."""
    from clrecon.jobs.presets import PRESETS

    return PRESETS["bone"].iso_value


def by_auto(volume: Volume) -> float:
    """The method "auto" of clrecon."""
    return choice.choose_iso_value(volume).iso_value


METHODS: dict[str, Callable[[Volume], float]] = {
    "preset bone": by_preset,
    "Otsu, three classes": by_otsu,
    "Kittler-Illingworth": by_minimum_error,
    "half of the histogram's modes": by_modes,
    "mean weighted by gradient": by_gradient,
    "edge plateaus, unweighted": by_plain_edges,
    "auto": by_auto,
}


# --- phantoms and their measure ---
def make_sphere(blur: float, noise: float) -> Volume:
    """Make a sphere in tissue, off the grid's centre, with partial volume and blur."""
    from scipy.ndimage import gaussian_filter

    distance = _sphere_distance(np.indices((48, 48, 48)).reshape(3, -1).T)
    field = gaussian_filter(np.clip(0.5 - distance, 0.0, 1.0).reshape(48, 48, 48), blur)
    field = TISSUE_HU + (BONE_HU - TISSUE_HU) * field
    field += noise * np.random.default_rng(7).standard_normal(field.shape)
    return Volume(np.rint(field).astype(np.int16), np.eye(4))


def _sphere_distance(kji: Array) -> Array:
    return np.asarray(np.linalg.norm(kji - (23.7, 23.4, 24.1), axis=1) - SPHERE_RADIUS)


def make_spine(settings: dict[str, Any], hu: dict[str, float]) -> tuple[Volume, Array]:
    """Make a spine phantom and, in an array of its shape, the signed distance to the bone of its vertebrae in mm."""
    from clrecon.proof.phantom import PhantomSettings, add_noise, apply_point_spread, spine
    from clrecon.proof.phantom.series import place_slices
    from clrecon.proof.phantom.settings import CENTRE_LPS_MM
    from clrecon.proof.phantom.spine import draw_spine
    from clrecon.proof.phantom.vertebra import vertebra_distance

    chosen = PhantomSettings(**settings)
    affine = place_slices(chosen).affine
    with mock.patch.dict(vars(spine), hu):
        field, anatomy = draw_spine(chosen, affine)
    add_noise(apply_point_spread(field, affine, chosen.point_spread_mm), chosen.noise, 0)
    distance = np.full(field.shape, -50.0, dtype=np.float32)
    j, i = np.ogrid[: field.shape[1], : field.shape[2]]
    for k in range(len(field)):
        x, y, z = (row[0] * i + row[1] * j + row[2] * k + row[3] for row in affine[:3])
        for vertebra in anatomy.vertebrae:
            centre = vertebra.center + np.array(CENTRE_LPS_MM)
            if abs(float(z.mean()) - centre[2]) < 75.0:
                offset = [(a - b).astype(np.float32) for a, b in zip((x, y, z), centre, strict=True)]
                local = [
                    sum(np.float32(c) * part for c, part in zip(axis, offset, strict=True)) for axis in vertebra.axes
                ]
                np.maximum(distance[k], vertebra_distance(vertebra, *local), out=distance[k])
    return Volume(np.rint(field).astype(np.int16), affine), distance


def cross_level(field: Array, level: float) -> Array:
    """Return the points (n, 3) in index steps k, j, i where grid edges cross `level`, linearly interpolated."""
    points = []
    for axis in range(3):
        moved = np.moveaxis(field, axis, -1).astype(np.float32)
        inside = moved >= level
        at = np.argwhere(inside[..., 1:] != inside[..., :-1])
        low, high = moved[tuple(at.T)], moved[at[:, 0], at[:, 1], at[:, 2] + 1]
        exact = at.astype(np.float64)
        exact[:, 2] += (level - low) / (high - low)
        points.append(exact[:, {0: (2, 0, 1), 1: (0, 2, 1), 2: (0, 1, 2)}[axis]])
    return np.concatenate(points)


class SpineError:
    """Mean distance in mm from the true surface of the vertebrae to the surface at a level."""

    def __init__(self, volume: Volume, distance: Array):
        self.steps = np.array(column_spacing(volume.affine))[::-1]
        self.truth = cross_level(distance, 0.0)[::5] * self.steps
        self.field = np.where(distance < -6.0, np.float32(0.0), volume.voxels)  # the rest of the body is not bone

    def __call__(self, level: float) -> float:
        from scipy.spatial import cKDTree

        return float(cKDTree(cross_level(self.field, level) * self.steps).query(self.truth)[0].mean())


def _level(method: Callable[[Volume], float], volume: Volume) -> float | None:
    try:
        return method(volume)
    except (NoSurfaceError, ValueError):
        return None


def compare_spheres() -> None:
    """Print the table of spheres."""
    print(f"\n| sphere, error in HU / radius in voxels | {' | '.join(METHODS)} |\n|{'---|' * (len(METHODS) + 1)}")
    for blur, noise in ((0.8, 0.0), (0.8, 50.0), (1.5, 0.0), (1.5, 50.0)):
        volume = make_sphere(blur, noise)

        def radius(level: float, volume: Volume = volume) -> float:
            distance = _sphere_distance(cross_level(volume.voxels, level))
            near = distance[np.abs(distance) < 4.0]
            return float(near.mean()) if len(near) else np.inf

        true = (BONE_HU + TISSUE_HU) / 2.0
        cells = []
        for method in METHODS.values():
            level = _level(method, volume)
            cells.append("none" if level is None else f"{level - true:+.0f} / {radius(level) - radius(true):+.3f}")
        print(f"| blur {blur:g}, noise {noise:g} HU | {' | '.join(cells)} |", flush=True)


def compare_spines() -> None:
    """Print the table of spines."""
    print(f"\n| spine, HU (mm) | best | {' | '.join(METHODS)} |\n|{'---|' * (len(METHODS) + 2)}")
    for name, (settings, hu) in SPINES.items():
        volume, distance = make_spine(settings, hu)
        error = SpineError(volume, distance)
        scan = {level: error(float(level)) for level in range(150, 651, 25)}
        best = min(scan, key=scan.__getitem__)
        levels = [_level(method, volume) for method in METHODS.values()]
        cells = ["none" if level is None else f"{level:.0f} ({error(level):.2f})" for level in levels]
        print(f"| {name} | {best} ({scan[best]:.2f}) | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spheres", action="store_true", help="the spheres only (seconds)")
    arguments = parser.parse_args()
    compare_spheres()
    if not arguments.spheres:
        compare_spines()


if __name__ == "__main__":
    main()
