"""Clouds with normals whose surface is known, and fields that tests read back."""

from __future__ import annotations

from typing import Any

import numpy as np

from clrecon.opencl import download
from clrecon.points.cloud import PointCloud
from clrecon.proof.points import field as twin


def sphere_cloud(
    n: int = 12_000, *, radius: float = 20.0, noise: float = 0.0, seed: int = 1, centre: Any = (0.0, 0.0, 0.0)
) -> PointCloud:
    """Random points on a sphere; `noise` is the sd in each axis in mm."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(radius * normals + noise * rng.normal(size=(n, 3)) + centre, normals)


def cube_cloud(n: int = 13_000, *, edge: float = 30.0, seed: int = 1) -> PointCloud:
    """Random points on the faces of a cube around the origin, axes along x, y, z."""
    rng = np.random.default_rng(seed)
    face, places = rng.integers(0, 6, n), (rng.random((n, 2)) - 0.5) * edge
    points, normals, rows = np.zeros((n, 3)), np.zeros((n, 3)), np.arange(n)
    axis, side = face // 2, np.where(face % 2, 1.0, -1.0)
    points[rows, axis], normals[rows, axis] = side * edge / 2, side
    points[rows, (axis + 1) % 3], points[rows, (axis + 2) % 3] = places.T
    return PointCloud(points, normals)


def cube_distances(points: Any, *, edge: float = 30.0) -> np.ndarray:
    """Signed distance from the surface of that cube."""
    beyond = np.abs(np.asarray(points, float)) - edge / 2
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.where((beyond > 0.0).any(axis=1), outside, beyond.max(axis=1))


def fetch_mask(masks: Any, mask_d: Any) -> np.ndarray:
    """A mask of nodes, shape (nz, ny, nx), bool."""
    nx, ny, nz = masks.shape
    found = download(masks.device, np.empty((nz, ny, 4 * masks.words), np.uint8), mask_d)
    return np.unpackbits(found, axis=2, bitorder="little")[:, :, :nx].astype(bool)


def fetch_masks(masks: Any) -> tuple[np.ndarray, ...]:
    """Near, core and negative."""
    return tuple(fetch_mask(masks, mask_d) for mask_d in (masks.near_d, masks.core_d, masks.negative_d))


def twin_field(cloud: PointCloud, nodes: Any, settings: Any) -> tuple[twin.FieldTwin, np.ndarray, np.ndarray]:
    """The twin's field on the nodes, and its masks near and core."""
    assert cloud.normals is not None
    points = (cloud.points - nodes.base).astype(np.float32)
    field = twin.measure_field(
        points, cloud.normals, nodes.corner, settings.spacing, nodes.shape,
        reach=settings.reach, smoothing=settings.smoothing,
    )  # fmt: skip
    near = np.isfinite(field.value) & (field.squared <= np.float32(settings.bridge) ** 2)
    return field, near, near & (field.squared <= np.float32(settings.spacing) ** 2)
