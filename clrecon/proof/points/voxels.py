"""Twins of what a volume says to points: the voxels of a band of HU, what neighbouring slices have in common, gradients
as differences of the trilinear field over half a voxel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume


def mark_shell(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark those of the marked voxels that have one of their six neighbours outside; beyond the ends all is outside."""
    padded = np.pad(marked, 1)
    inner = np.ones_like(marked)
    for axis in range(3):
        for step in (-1, 1):
            inner &= np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1]
    return marked & ~inner


def extract_voxels(
    volume: Volume,
    low: float,
    high: float = np.inf,
    *,
    shell: bool = False,
    labels: NDArray[Any] | None = None,
    label: int = 0,
    paper: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int64]]:
    """Return the centres, (n, 3), LPS mm, in the order k, j, i, the HU and the ijk of voxels from `low` to `high`, both
    included.

    shell: Only voxels with one of six neighbours outside; beyond the volume all is outside.
    labels: ndarray, shape (nk, nj, ni). Only voxels with `label`, or with any number but 0 where it is 0.
    paper: Every slice lies where the first one does.
    """
    marked = (volume.voxels >= low) & (volume.voxels <= high)
    if labels is not None:
        marked &= (labels == label) if label else (labels != 0)
    if shell:
        marked = mark_shell(marked)
    k, j, i = np.nonzero(marked)
    origins = volume.slice_origins()
    place = origins[np.zeros_like(k) if paper else k]
    points = place + i[:, None] * volume.affine[:3, 0] + j[:, None] * volume.affine[:3, 1]
    return points, volume.voxels[marked].astype(np.float32), np.stack([i, j, k], axis=1)


def count_overlaps(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Count the voxels of each slice, and those in common with the next one and the one after, as (3, nk)."""
    counts = np.zeros((3, len(inside)), np.int64)
    for apart in range(3):
        both = inside[: len(inside) - apart] & inside[apart:] if apart < len(inside) else inside[:0]
        counts[apart, : len(both)] = both.sum(axis=(1, 2))
    return counts


def _values(voxels: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the trilinear field of padded voxels at index coordinates of the volume."""
    from scipy.ndimage import map_coordinates

    inside = np.clip(places[:, ::-1].T + 1.0, 0.0, np.array(voxels.shape)[:, None] - 1.0)
    values: NDArray[np.float64] = map_coordinates(voxels, inside, order=1, mode="nearest")
    return values


def find_gradients(volume: Volume, points: NDArray[np.floating], outside: float) -> NDArray[np.float64]:
    """Return the gradient of a volume, surrounded by `outside`, at points: (n, 3), HU per mm, LPS."""
    voxels = np.pad(np.asarray(volume.voxels, dtype=np.float64), 1, constant_values=outside)
    places = volume.lps_to_ijk(points)
    origins, nk = volume.slice_origins(1), volume.shape_ijk[2]
    differences, ways = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for axis, half in enumerate(0.5 * np.eye(3)):
        differences[:, axis] = _values(voxels, places + half) - _values(voxels, places - half)
        ways[:, :, axis] = volume.affine[:3, axis]
    for row, k in enumerate(places[:, 2]):
        above, below = (
            np.array([np.interp(at, np.arange(-1, nk + 1), column) for column in origins.T])
            for at in (k + 0.5, k - 0.5)
        )
        ways[row, :, 2] = above - below
    gradients = np.zeros((len(points), 3))
    known = np.linalg.det(ways) != 0.0  # above and below all slices nothing changes along k
    gradients[known] = np.linalg.solve(ways[known].transpose(0, 2, 1), differences[known, :, None])[:, :, 0]
    return gradients
