"""A vertebra of boxes and cylinders, whose widest corridors are known: a body, a plate behind it, and two pedicles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clrecon.geometry import Volume

BODY_HALF = (21.0, 15.0, 13.0)
PLATE_Y, PLATE_HALF = 40.0, (24.0, 6.0, 9.0)
CANAL_Y = (15.0 + 34.0) / 2.0
"""y of the middle of the canal."""
PEDICLE_X, PEDICLE_Z = 16.0, 2.0
"""Where the pedicles' axes cross the plane of the canal's middle."""
INSIDE_HU, OUTSIDE_HU = 1000.0, 0.0
HALF_HU = 500.0


@dataclass(frozen=True)
class BoxVertebra:
    """Sizes in mm and degrees, and the rotation (rows: left, posterior, cranial) and centre in LPS mm."""

    left_radius: float = 4.0
    right_radius: float = 3.0
    medial_deg: float = 10.0
    rotation: Any = None
    centre: tuple[float, float, float] = (5.0, -40.0, 200.0)
    arch: bool = True

    @property
    def axes(self) -> np.ndarray:
        return np.eye(3) if self.rotation is None else np.asarray(self.rotation)

    def axis(self, side: float) -> tuple[np.ndarray, np.ndarray]:
        """A point and the forward direction of a pedicle's axis, in the vertebra's frame."""
        way = np.array((-side * np.tan(np.radians(self.medial_deg)), -1.0, 0.0))
        return np.array((side * PEDICLE_X, CANAL_Y, PEDICLE_Z)), way / np.linalg.norm(way)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance from the surface of the nearest part in LPS mm (n, 3), positive inside; exact near faces."""
        local = (points - np.array(self.centre)) @ self.axes.T
        parts = [_box(local, (0.0, 0.0, 0.0), BODY_HALF)]
        if self.arch:
            parts.append(_box(local, (0.0, PLATE_Y, 0.0), PLATE_HALF))
            for side, radius in ((1.0, self.left_radius), (-1.0, self.right_radius)):
                start, way = self.axis(side)
                off = local - start
                along = off @ way
                wall = radius - np.linalg.norm(off - along[:, None] * way, axis=1)
                parts.append(np.minimum(wall, 14.0 - np.abs(along)))
        return np.max(parts, axis=0)

    def scan(self, affine: np.ndarray, shape: tuple[int, int, int]) -> tuple[Volume, np.ndarray]:
        """A volume with partial volume effect, and its labels (number 3), on a grid."""
        nk, nj, ni = shape
        k, j, i = (part.ravel() for part in np.indices(shape))
        steps = np.linalg.norm(affine[:3, :3], axis=0)
        subslices = max(1, round(steps[2] / steps[0]))
        ramp = (steps.prod() / subslices) ** (1.0 / 3.0)
        share = np.zeros(shape)
        for offset in (np.arange(subslices) + 0.5) / subslices - 0.5:
            points = np.stack((i, j, k + offset), axis=1) @ affine[:3, :3].T + affine[:3, 3]
            share += np.clip(self.depth(points).reshape(nk, nj, ni) / ramp + 0.5, 0.0, 1.0) / subslices
        hu = OUTSIDE_HU + (INSIDE_HU - OUTSIDE_HU) * share
        return Volume(np.rint(hu).astype(np.int16), affine), np.where(share >= 0.5, 3, 0).astype(np.uint8)


def _box(points: np.ndarray, centre: tuple[float, ...], half: tuple[float, ...]) -> np.ndarray:
    return (np.array(half) - np.abs(points - np.array(centre))).min(axis=1)


def grid_around(
    vertebra: BoxVertebra,
    *,
    spacing: tuple[float, float, float] = (0.8, 0.8, 1.0),
    shear: float = 0.0,
    mirrored: bool = False,
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """An affine and a shape (nk, nj, ni) that hold the vertebra, with sheared slices or i running to the right."""
    steps = np.diag(spacing).astype(float)
    steps[1, 2] = shear * spacing[2]
    if mirrored:
        steps[0, 0] *= -1.0
    size = np.array([84.0, 110.0, 60.0]) / np.array(spacing)
    counts = np.ceil(size).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = steps
    middle = np.array(vertebra.centre) + vertebra.axes.T @ np.array((0.0, 15.0, 0.0))
    affine[:3, 3] = middle - steps @ ((counts - 1) / 2.0)
    return affine, (int(counts[2]), int(counts[1]), int(counts[0]))


def turned(about_x: float, about_y: float, about_z: float) -> np.ndarray:
    """Rows: left, posterior and cranial direction after turns about z, then y, then x, degrees."""
    a, b, c = np.radians((about_x, about_y, about_z))
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return (x @ y @ z).T
