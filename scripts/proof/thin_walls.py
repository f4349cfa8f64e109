"""Phantoms of thin walls and narrow joints for `measure_levels.py`: shapes known everywhere, sampled finely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume

Values = NDArray[np.float64]
FINER = 4
"""Samples along each axis of a voxel."""


@dataclass(frozen=True)
class Shape:
    """Bone and what is around it.

    hu: HU of points at x, y, z in mm from the middle, shape (n,) each.
    is_bone: Whether they lie within its outer surface; marrow counts as bone.
    size_mm, spacing: Of the volume, x y z; each axis has whole voxels.
    blur_mm, noise: Of the scan.
    bone_hu, tissue_hu: Compact bone, and what is around it.
    """

    hu: Callable[[Values, Values, Values], Values]
    is_bone: Callable[[Values, Values, Values], NDArray[np.bool_]]
    size_mm: tuple[float, float, float]
    spacing: tuple[float, float, float]
    blur_mm: float
    noise: float
    bone_hu: float
    tissue_hu: float

    @property
    def affine(self) -> Values:
        steps = np.asarray(self.spacing)
        found = np.diag([*steps, 1.0])
        found[:3, 3] = -0.5 * steps * (self.shape - 1)
        return found

    @property
    def shape(self) -> NDArray[np.int64]:
        return np.rint(np.divide(self.size_mm, self.spacing)).astype(np.int64)


def _floor(x: Values, y: Values) -> tuple[Values, Values]:
    """Height and thickness, 0.3 to 0.8 mm, of the floor of an orbit."""
    return 3.0 * np.sin(x / 9.0) + 2.0 * np.cos(y / 11.0), 0.55 + 0.25 * np.sin(x / 5.0) * np.cos(y / 6.0)


def _in_floor(x: Values, y: Values, z: Values) -> NDArray[np.bool_]:
    height, thickness = _floor(x, y)
    rim = np.hypot(x, y) > 17.0  # as thick as a bone that shows its density
    return np.abs(z - height) < np.where(rim, 2.0, 0.5 * thickness)


def _floor_hu(x: Values, y: Values, z: Values) -> Values:
    return np.where(_in_floor(x, y, z), 1200.0, np.where(z > _floor(x, y)[0], -80.0, -1000.0))


def _blade(x: Values, y: Values) -> tuple[Values, Values]:
    """Height and half the thickness of a scapula: a blade of 1.6 mm within a border of 9 mm."""
    return 2.5 * np.sin(x / 13.0) + 0.02 * y**2, 0.8 + 3.7 / (1.0 + np.exp(-(np.abs(x) - 17.0)))


def _in_blade(x: Values, y: Values, z: Values, deep: float = 0.0) -> NDArray[np.bool_]:
    height, half = _blade(x, y)
    return (np.abs(z - height) < half - deep) & (np.abs(x) < 24.0 - deep)


def _blade_hu(x: Values, y: Values, z: Values) -> Values:
    return np.where(_in_blade(x, y, z, 0.6), 250.0, np.where(_in_blade(x, y, z), 1100.0, 55.0))


def _in_facets(x: Values, y: Values, z: Values, deep: float = 0.0) -> NDArray[np.bool_]:
    """Two processes whose curved faces are 0.5 mm apart."""
    away = x - 0.02 * (y**2 + z**2)
    within = (np.abs(y) < 9.0 - deep) & (np.abs(z) < 9.0 - deep)
    return within & (np.abs(away) > 0.25 + deep) & (np.abs(away) < 8.0 - deep)


def _facets_hu(x: Values, y: Values, z: Values) -> Values:
    return np.where(_in_facets(x, y, z, 1.2), 220.0, np.where(_in_facets(x, y, z), 1000.0, 45.0))


SHAPES = {
    "floor of an orbit, 0.3 to 0.8 mm": Shape(
        _floor_hu, _in_floor, (48.0, 48.0, 24.0), (0.4, 0.4, 0.6), 0.45, 25.0, 1200.0, -80.0
    ),
    "scapula": Shape(_blade_hu, _in_blade, (60.0, 48.0, 30.0), (0.6, 0.6, 1.0), 0.6, 20.0, 1100.0, 55.0),
    "facet joint, 0.5 mm": Shape(_facets_hu, _in_facets, (24.0, 24.0, 24.0), (0.4, 0.4, 0.6), 0.5, 20.0, 1000.0, 45.0),
}


def draw_shape(shape: Shape, seed: int = 1) -> Volume:
    """Draw a shape: means over finer samples, blurred, with noise."""
    from scipy.ndimage import gaussian_filter

    parts = (np.arange(FINER) + 0.5) / FINER - 0.5
    axes = [
        ((np.arange(n)[:, None] + parts).reshape(-1) * step - 0.5 * step * (n - 1))
        for n, step in zip(shape.shape, shape.spacing, strict=True)
    ]
    x, y = axes[0], axes[1][:, None]
    voxels = np.empty(shape.shape[::-1], np.float32)
    for k, heights in enumerate(axes[2].reshape(-1, FINER)):
        fine = shape.hu(*np.broadcast_arrays(x, y, heights[:, None, None]))
        ni, nj = int(shape.shape[0]), int(shape.shape[1])
        voxels[k] = fine.reshape(FINER, nj, FINER, ni, FINER).mean(axis=(0, 2, 4))
    voxels = gaussian_filter(voxels, np.divide(shape.blur_mm, shape.spacing)[::-1], mode="nearest")
    voxels += np.random.default_rng(seed).normal(0.0, shape.noise, voxels.shape)
    return Volume(np.rint(voxels).astype(np.int16), shape.affine)
