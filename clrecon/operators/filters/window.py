"""The window of a filter: which voxels around one take part, and how much by their distance in mm."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array

LARGEST_REACH = 14
"""Most voxels from the middle of a window to its end, along each axis: with two rings, a group of 16."""

RADIUS_OF_SIGMA = 2.5
"""Radius of a window over the sigma, if it is not capped: what lies farther has less than 4 % of the weight."""

SAME_RING = 1e-6
"""Relative difference of squared distances that are one ring: a distance of affines from files."""


@dataclass(frozen=True)
class Window:
    """Taps of a window, sorted by k, j and i.

    offsets: ndarray, shape (n, 3), int32. Steps along i, j, k, the voxel itself among them.
    exponents: ndarray, shape (tables, n), float64. Logarithm to base 2 of the weight by distance: a row for each slice
        where they are uneven, else one.
    share: Weight of these taps over that of the whole window.
    whole_taps: Taps of the whole window.
    """

    offsets: NDArray[np.int32]
    exponents: Float64Array
    share: float
    whole_taps: int

    @property
    def taps(self) -> int:
        """Number of taps."""
        return len(self.offsets)

    @property
    def reach(self) -> tuple[int, int, int]:
        """Voxels from the middle to the end along i, j, k."""
        i, j, k = np.abs(self.offsets).max(axis=0).tolist()
        return i, j, k

    def rows(self) -> NDArray[np.int32]:
        """Return the rows of taps, (m, 4) int32: steps along j and k, first step along i, number of taps."""
        goes_on = (np.diff(self.offsets, axis=0) == (1, 0, 0)).all(axis=1)
        starts = np.flatnonzero(np.append(True, ~goes_on))
        first, counts = self.offsets[starts], np.diff(np.append(starts, self.taps))
        return np.column_stack([first[:, 1], first[:, 2], first[:, 0], counts]).astype(np.int32)

    def without_middle(self) -> Window:
        """Return the window without the voxel itself, whose weight is 1."""
        others = self.offsets.any(axis=1)
        return replace(self, offsets=self.offsets[others], exponents=np.ascontiguousarray(self.exponents[:, others]))


def choose_window(volume: Volume, sigma_mm: float, dimensions: int, most_taps: int) -> Window:
    """Choose the taps of a window: the box around the ball of 2.5 sigma, or the nearest voxels of it.

    Distances are those of the voxels' places, so that anisotropic, sheared and uneven volumes are filtered in mm.

    dimensions: {2, 3}. 2: within a slice alone.
    most_taps: If the box has more, the nearest voxels stay, in whole rings of equal distance: of square pixels 13 are
        the disc of five that OpenCV has, and 5, 29 and 49 those of 3, 7 and 9.

    Returns: The middle alone where `most_taps` is below the number of the first ring.
    """
    box = _box(volume, RADIUS_OF_SIGMA * sigma_mm, dimensions)
    whole = _lattice(np.minimum(box, 3 * LARGEST_REACH))
    squares = _squares(whole, _nominal_steps(volume))
    is_kept = np.asarray((np.abs(whole) <= np.minimum(box, LARGEST_REACH)).all(axis=1))
    if np.count_nonzero(is_kept) > most_taps:
        is_kept = _nearest_rings(whole, squares, is_kept, most_taps)
    weights = np.exp(-squares / (2.0 * sigma_mm**2))
    total = float(weights.sum())
    if (box > 3 * LARGEST_REACH).any():  # too many to add: the integral, for sigmas of many voxels
        steps = _nominal_steps(volume)[:, :dimensions]
        total = (math.tau * sigma_mm**2) ** (dimensions / 2) / math.sqrt(np.linalg.det(steps.T @ steps))
    share = float(weights[is_kept].sum()) / total
    kept = whole[is_kept]
    return Window(kept, _exponents(volume, kept, sigma_mm), share, math.prod((2 * box + 1).tolist()))


def _nominal_steps(volume: Volume) -> Float64Array:
    """Return the steps along i, j, k in mm as columns; of uneven slices the mean step."""
    steps = np.array(volume.affine[:3, :3])
    if volume.uneven:
        origins = volume.slice_origins()
        steps[:, 2] = (origins[-1] - origins[0]) / (len(origins) - 1)
    return steps


def _squares(offsets: NDArray[np.int32], steps: Float64Array) -> Float64Array:
    """Return the squared distances in mm."""
    places = offsets @ steps.T
    squares: Float64Array = np.einsum("ni,ni->n", places, places)
    return squares


def _box(volume: Volume, radius_mm: float, dimensions: int) -> NDArray[np.int64]:
    """Return half the size of the box of voxels that holds a ball, along i, j, k."""
    in_plane = volume.affine[:3, :2]
    if dimensions == 2:
        reach = np.append(np.linalg.norm(np.linalg.pinv(in_plane), axis=1), 0.0)
    else:
        along = np.diff(volume.slice_origins(), axis=0) if volume.uneven else volume.affine[None, :3, 2]
        layers = np.stack([np.column_stack([in_plane, step]) for step in along])
        reach = np.linalg.norm(np.linalg.inv(layers), axis=2).max(axis=0)
    # Rounding adds no voxels to a radius of whole steps.
    box: NDArray[np.int64] = np.ceil(np.minimum(radius_mm * reach, 1e6) - 1e-9).astype(np.int64)
    return box


def _lattice(box: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return all steps of a box, sorted by k, j and i."""
    k, j, i = np.meshgrid(*(np.arange(-n, n + 1) for n in box[::-1].tolist()), indexing="ij")
    return np.column_stack([i.ravel(), j.ravel(), k.ravel()]).astype(np.int32)


def _exponents(volume: Volume, offsets: NDArray[np.int32], sigma_mm: float) -> Float64Array:
    """Return the logarithms of the weights, (tables, n)."""
    per_square = -1.0 / (2.0 * math.log(2.0) * sigma_mm * sigma_mm)
    if not volume.uneven or not offsets[:, 2].any():
        return per_square * _squares(offsets, volume.affine[:3, :3])[None]
    border = int(offsets[:, 2].max())
    origins = volume.slice_origins(border)
    nk = volume.shape_ijk[2]
    exponents = np.empty((nk, len(offsets)))
    in_plane = offsets[:, :2] @ volume.affine[:3, :2].T
    for k in range(nk):
        steps = in_plane + (origins[k + border + offsets[:, 2]] - origins[k + border])
        exponents[k] = per_square * np.einsum("ni,ni->n", steps, steps)
    return exponents


def _nearest_rings(
    offsets: NDArray[np.int32], squares: Float64Array, candidates: NDArray[np.bool_], most_taps: int
) -> NDArray[np.bool_]:
    """Mark the nearest taps, in whole rings."""
    order = np.flatnonzero(candidates)
    order = order[np.argsort(squares[order], kind="stable")]
    sorted_squares = squares[order]
    is_next = np.diff(sorted_squares) > SAME_RING * sorted_squares[1:]
    ends = np.append(np.flatnonzero(is_next) + 1, len(order))
    kept = np.zeros(len(offsets), np.bool_)
    kept[order[: ends[ends <= most_taps].max(initial=1)]] = True
    return kept
