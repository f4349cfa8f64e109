"""Clouds on shapes whose surface is known: 2.4 points a square millimetre, with normal noise along each axis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

POINTS_A_MM2 = 2.4
NOISE_MM = 0.2


@dataclass(frozen=True)
class Shape:
    """A cloud with its truth.

    clean, points: (n, 3) float32, points of the shape, and the same with noise.
    normals: (n, 3), true normals of the clean points, outward.
    distance: Signed distance of points from the shape's surface, mm; negative inside.
    regions: (n,) bool, parts of the shape over which figures are taken.
    """

    clean: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    distance: Callable[[Any], Any]
    regions: dict[str, np.ndarray]

    def rms(self, points: Any, region: str) -> float:
        away = self.distance(np.asarray(points, np.float64)[self.regions[region]])
        return float(np.sqrt((away**2).mean()))

    def mean(self, points: Any, region: str) -> float:
        return float(self.distance(np.asarray(points, np.float64)[self.regions[region]]).mean())


def _make(clean: np.ndarray, normals: np.ndarray, distance: Callable, regions: dict, seed: int) -> Shape:
    noisy = clean + np.random.default_rng(seed + 100).normal(0.0, NOISE_MM, clean.shape)
    return Shape(clean.astype(np.float32), noisy.astype(np.float32), normals, distance, regions)


def plane(*, size: float = 60.0, seed: int = 1) -> Shape:
    """A square in the plane z = 0, `size` mm wide."""
    rng = np.random.default_rng(seed)
    n = round(POINTS_A_MM2 * size**2)
    clean = np.c_[rng.uniform(-size / 2, size / 2, (n, 2)), np.zeros(n)]
    inner = (np.abs(clean[:, :2]) < size / 2 - 3.0).all(axis=1)
    return _make(clean, np.tile([0.0, 0.0, 1.0], (n, 1)), lambda p: p[:, 2], {"inner": inner}, seed)


def sphere(*, radius: float = 20.0, seed: int = 2) -> Shape:
    """A sphere about the origin."""
    rng = np.random.default_rng(seed)
    n = round(POINTS_A_MM2 * 4.0 * np.pi * radius**2)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    everywhere = np.ones(n, bool)
    return _make(
        radius * normals, normals, lambda p: np.linalg.norm(p, axis=1) - radius, {"everywhere": everywhere}, seed
    )


def cube(*, size: float = 30.0, seed: int = 3) -> Shape:
    """A cube about the origin, `size` mm wide."""
    rng = np.random.default_rng(seed)
    n, half = round(POINTS_A_MM2 * 6.0 * size**2), size / 2
    clean = rng.uniform(-half, half, (n, 3))
    face = rng.integers(0, 6, n)
    rows, sign = np.arange(n), np.where(face % 2, 1.0, -1.0)
    clean[rows, face // 2] = sign * half
    normals = np.zeros((n, 3))
    normals[rows, face // 2] = sign

    def distance(p: np.ndarray) -> np.ndarray:
        beyond = np.abs(p) - half
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)

    from_edge = np.sort(half - np.abs(clean), axis=1)[:, 1]
    return _make(clean, normals, distance, {"faces": from_edge > 3.0, "edges": from_edge < 1.0}, seed)
