"""Twin of mode slices: slices of a volume in space, blended along the ray of each pixel, in float64."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.camera import Camera


def overlay_slices(
    volume: Volume,
    camera: Camera,
    size: Sequence[int],
    slices: Sequence[int],
    opacity: float,
    lowest_hu: float,
    colors: Callable[[Float64Array], Float64Array],
    clip: Float64Array | None = None,
) -> tuple[Float64Array, Float64Array]:
    """Find where each ray crosses the planes of slices, from front to back, and blend them.

    size: (width, height)
    opacity: Opacity of a slice where its value is `lowest_hu` or more; elsewhere it is transparent.
    colors: Function from HU (n,) to red, green and blue (n, 3).
    clip: ndarray, shape (n, 4). Half-spaces that are kept: ``normal . p >= offset``.

    Returns:
    rgba: ndarray, shape (h, w, 4), float64. Premultiplied.
    depth: ndarray, shape (h, w), float64. Mm to the first visible slice; NaN without one.
    """
    width, height = size
    origins, directions = (rays.reshape(-1, 3) for rays in camera.rays(size))
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    starts = volume.slice_origins()[list(slices)]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = ((starts[:, None] - origins) @ normal) / (directions @ normal)
    rgba, depth = np.zeros((len(origins), 4)), np.full(len(origins), np.nan)
    for order in np.argsort(crossings, axis=0):
        t = np.take_along_axis(crossings, order[None], axis=0)[0]
        k = np.asarray(slices)[order]
        there = np.isfinite(t) & (camera.is_parallel | (t >= 0.0))
        points = origins + np.where(there, t, 0.0)[:, None] * directions
        if clip is not None:
            there &= (points @ clip[:, :3].T >= clip[:, 3]).all(axis=1)
        value, inside = _read_slices(volume, points, k)
        there &= inside & (value >= lowest_hu)
        weight = np.where(there, (1.0 - rgba[:, 3]) * opacity, 0.0)
        rgba[:, :3] += weight[:, None] * colors(value)
        rgba[:, 3] += weight
        depth = np.where(there & np.isnan(depth), t, depth)
    return rgba.reshape(height, width, 4), depth.reshape(height, width)


def _read_slices(volume: Volume, points: Float64Array, k: NDArray[np.int64]) -> tuple[Float64Array, NDArray[np.bool_]]:
    """Read bilinear values (n,) at points of slices k, and which points are in the slice or half a voxel around it."""
    ij = (points - volume.slice_origins()[k]) @ np.linalg.pinv(volume.affine[:3, :2]).T
    last = np.array(volume.shape_ijk[:2]) - 1
    inside = ((ij >= -0.5) & (ij <= last + 0.5)).all(axis=1)
    ij = np.clip(ij, 0, last)
    low = np.minimum(ij.astype(int), np.maximum(last - 1, 0))
    high = np.minimum(low + 1, last)
    part_i, part_j = (ij - low).T
    rows = [
        volume.voxels[k, j, low[:, 0]] * (1.0 - part_i) + volume.voxels[k, j, high[:, 0]] * part_i
        for j in (low[:, 1], high[:, 1])
    ]
    return rows[0] * (1.0 - part_j) + rows[1] * part_j, inside
