"""Small scenes for views: a scan of three balls of bone, a mesh, a cloud and labels in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import sample_meshes as samples

from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.points.cloud import PointCloud

AFFINE = np.array([[0.9, 0.08, 0.0, -60.0], [-0.08, 0.9, 0.1, -40.0], [0.0, -0.1, 1.4, 200.0], [0, 0, 0, 1.0]])
SHAPE = (22, 40, 44)


class Ball(NamedTuple):
    """A ball of bone in the scan."""

    middle_ijk: tuple[float, float, float]
    radius_mm: float


BALLS = (Ball((13.0, 20.0, 11.0), 9.0), Ball((33.0, 14.0, 9.0), 5.0), Ball((34.0, 31.0, 14.0), 3.0))
"""The largest first."""

ISO = 300.0


def middle(number: int) -> np.ndarray:
    """Middle of a ball in LPS mm."""
    return AFFINE[:3, :3] @ np.array(BALLS[number].middle_ijk) + AFFINE[:3, 3]


def make_scan(*, affine: np.ndarray = AFFINE, dtype: Any = np.int16, scale: float = 1.0) -> Volume:
    """Balls of 1000 HU whose surface at 300 HU lies at their radius, in -800 HU."""
    k, j, i = np.indices(SHAPE, dtype=np.float64)
    places = np.stack([i, j, k], axis=-1) @ AFFINE[:3, :3].T + AFFINE[:3, 3]
    hu = np.full(SHAPE, -800.0)
    for number, ball in enumerate(BALLS):
        away = np.linalg.norm(places - middle(number), axis=-1) - ball.radius_mm
        hu = np.maximum(hu, np.clip(ISO - 250.0 * away, -800.0, 1000.0))
    return Volume(np.rint(scale * hu).astype(dtype), affine)


def make_mesh(*, at: np.ndarray | None = None, radius: float = 4.0) -> Mesh:
    """A ball in front of the scan."""
    vertices, triangles = samples.ball(radius, rings=24)
    return Mesh(vertices + (middle(0) + (0.0, -25.0, 0.0) if at is None else at), triangles)


def make_cloud(*, count: int = 200) -> PointCloud:
    """Points around the second ball."""
    points = np.random.default_rng(1).normal(size=(count, 3))
    points *= 7.0 / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points + middle(1))


def make_labels() -> LabelMap:
    """The left half of the scan, and the right one."""
    voxels = np.zeros(SHAPE, np.uint8)
    voxels[:, :, :22], voxels[:, :, 22:] = 1, 2
    return LabelMap(voxels, AFFINE, {1: "one", 2: "two"})
