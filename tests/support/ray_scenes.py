"""Volumes with known fields on every kind of grid, and cameras that look at them: for the tests of rays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from dicom_series import rotation

from clrecon.geometry import Volume
from clrecon.rendering.views.camera import Camera

TURN = rotation((15.0, -25.0, 40.0))
PLACE = np.array([40.0, -90.0, -600.0])

STEPS = {
    "even": np.diag([0.9, 0.9, 0.9]),
    "anisotropic": np.diag([0.6, 0.45, 1.3]),
    "oblique": TURN @ np.diag([0.7, 0.5, 1.2]),
    "sheared": np.array([[0.7, 0.0, 0.0], [0.0, 0.5, -0.6], [0.0, 0.0, 1.2]]),
    "mirrored": TURN @ np.diag([0.7, -0.5, 1.2]),
}
"""Columns are the steps of i, j, k in mm."""

GRIDS = (*STEPS, "uneven")
LONGEST_STEP = 1.9
"""Mm, of all grids."""

Field = Callable[[np.ndarray], np.ndarray]
"""Values (n,) at points (n, 3) in mm from the centre of the volume."""


def centre_of(volume: Volume) -> np.ndarray:
    return volume.ijk_to_lps([(np.array(volume.shape_ijk) - 1) / 2])[0]


def positions(volume: Volume) -> np.ndarray:
    """Voxel centres (nk, nj, ni, 3), mm from the centre of the volume."""
    k, j, i = np.indices(volume.voxels.shape).reshape(3, -1)
    points = volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - centre_of(volume)
    return points.reshape(*volume.voxels.shape, 3)


def make_volume(field: Field, grid: str, extent: float = 22.0, dtype: Any = np.float32) -> Volume:
    """`field` in a volume of about `extent` mm along each axis."""
    affine = np.eye(4)
    affine[:3, 3] = PLACE
    if grid == "uneven":  # turned, with gaps of their own and slices that lie aside
        gaps = np.resize((1.0, 1.0, 0.4, 0.4, 1.9, 1.0), int(extent))
        heights = np.concatenate([[0.0], np.cumsum(gaps)])
        aside = 0.3 * heights + np.random.default_rng(2).uniform(-0.2, 0.2, len(heights))
        table = heights[:, None] * TURN[:, 2] + aside[:, None] * TURN[:, 1] + PLACE
        affine[:3, :2] = TURN[:, :2] * (0.7, 0.8)
        affine[:3, 2] = (table[-1] - table[0]) / len(gaps)
        shape = (len(table), int(1.3 * extent / 0.8), int(extent / 0.7))
        volume = Volume(np.zeros(shape, np.int8), affine, slice_positions=table)
    else:
        affine[:3, :3] = STEPS[grid]
        sizes = [int(np.ceil(extent / step)) for step in np.linalg.norm(STEPS[grid], axis=0)[::-1]]
        volume = Volume(np.zeros(sizes, np.int8), affine)
    values = np.asarray(field(positions(volume).reshape(-1, 3)), dtype=np.float64).reshape(volume.voxels.shape)
    return volume.with_voxels((values if np.dtype(dtype).kind == "f" else np.rint(values)).astype(dtype))


def look(
    volume: Volume, towards: Sequence[float], half_height: float, perspective: bool = False, distance: float = 150.0
) -> Camera:
    """At the centre of a volume along a direction; `half_height` mm of it to the top of the picture."""
    centre = centre_of(volume)
    forward = np.array(towards, dtype=np.float64) / np.linalg.norm(towards)
    position = tuple(centre - distance * forward)
    up = (0.1, 0.2, 1.0)
    if perspective:
        angle = 2.0 * np.degrees(np.arctan(half_height / distance))
        return Camera(position, tuple(centre), up, view_angle=angle)
    return Camera(position, tuple(centre), up, parallel_scale=half_height)


def blobs(points: np.ndarray) -> np.ndarray:
    """Something smooth from -1000 to about 1200 HU with structure in all directions."""
    x, y, z = points.T / 3.0
    return 700.0 * np.sin(x) * np.cos(0.8 * y + 0.3) * np.cos(0.7 * z) + 500.0 * np.exp(-(x**2 + y**2 + z**2) / 9.0)


def premultiplied(image: np.ndarray) -> np.ndarray:
    """An image over black, with its opacity, float64 of 0 to 255."""
    opacity = image[..., 3:].astype(np.float64)
    return np.concatenate([image[..., :3] * (opacity / 255.0), opacity], axis=-1)
