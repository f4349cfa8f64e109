"""An even grid for the labels of an uneven stack: thin slices, each with the labels of the nearest slice of the scan.

A label map has one affine.  Slices of a quarter of the smallest gap give every voxel of the scan the label of its own
slice, and a label the volume that its voxels have: each slice reaches half way to its neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, slice_normal
from clrecon.geometry.volume import Volume

PARTS_OF_GAP = (4.0, 2.0)
"""Slices to the smallest gap; the second where the first makes too many."""

MOST_SLICES = 4000
MOST_ASIDE = 0.4
"""Pixels that a slice may lie off the line of all: with less than half a pixel the nearest label is its own."""


class LabelSlices(NamedTuple):
    """The slices of a label map of a scan.

    affine: ndarray, shape (4, 4). Index (i, j, k) of the map to LPS mm.
    nearest: ndarray, shape (slices,), int64. For each slice of the map the slice of the scan whose labels it has.
    """

    affine: Float64Array
    nearest: NDArray[np.int64]


def label_slices(volume: Volume) -> LabelSlices:
    """Return the slices of a label map: those of an even scan, thinner ones of an uneven scan."""
    count = volume.shape_ijk[2]
    if not volume.uneven:
        return LabelSlices(volume.affine, np.arange(count))
    origins, normal = volume.slice_origins(), slice_normal(volume.affine)
    heights = origins @ normal
    turn = 1.0 if heights[-1] > heights[0] else -1.0
    heights = heights * turn
    gaps = np.diff(heights)
    line = (origins[-1] - origins[0]) / (heights[-1] - heights[0])  # mm per mm of height
    aside = (origins - origins[0] - (heights - heights[0])[:, None] * line) @ np.linalg.pinv(volume.affine[:3, :2]).T
    low, high = heights[0] - gaps[0] / 2.0, heights[-1] + gaps[-1] / 2.0
    step = next((gaps.min() / n for n in PARTS_OF_GAP if (high - low) * n / gaps.min() <= MOST_SLICES), None)
    if step is None or np.abs(aside).max() > MOST_ASIDE:
        raise UsageError(
            f"the slices of the scan are too uneven for contours: {gaps.min():.4g} to {gaps.max():.4g} mm apart, up to"
            f" {np.abs(aside).max():.2f} pixels off a line (at most {MOST_ASIDE:g})"
        )
    places = np.arange(low + step / 2.0, high, step)
    affine = np.array(volume.affine)
    affine[:3, 2] = line * step
    affine[:3, 3] = origins[0] + (places[0] - heights[0]) * line
    return LabelSlices(affine, np.searchsorted((heights[1:] + heights[:-1]) / 2.0, places))
