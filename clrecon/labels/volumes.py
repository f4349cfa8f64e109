"""Volumes of labels in ml: the sum over their voxels, each as large as the spacing of its own slice makes it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import slice_normal
from clrecon.labels.label_map import LabelMap
from clrecon.labels.solid import Box

MM3_PER_ML = 1000.0


def slice_voxel_ml(volume: Volume) -> NDArray[np.float64]:
    """Return the volume of one voxel of each slice, shape (nk,), ml.

    A slice reaches half way to both of its neighbours along the normal, the end slices as far outward as inward.  Shear
    moves slices within their planes and changes no volume.
    """
    area = float(np.linalg.norm(np.cross(volume.affine[:3, 0], volume.affine[:3, 1])))
    heights = volume.slice_origins(border=1) @ slice_normal(volume.affine)
    return area * np.abs(heights[2:] - heights[:-2]) / 2.0 / MM3_PER_ML


def label_ml(labels: LabelMap, number: int) -> float:
    """Return the volume of a label on the map's own grid, ml."""
    return labels.counts.get(number, 0) * abs(float(np.linalg.det(labels.affine[:3, :3]))) / MM3_PER_ML


def count_ml(voxels: NDArray[Any], number: int, box: Box, voxel_ml: NDArray[np.float64]) -> float:
    """Return the volume of the voxels of a grid that carry `number`, ml.

    voxels: ndarray, shape (nk, nj, ni)
    box: Slices along k, j, i, around all voxels of the label.
    voxel_ml: ndarray, shape (nk,). See `slice_voxel_ml`.
    """
    counts = np.count_nonzero(voxels[box] == number, axis=(1, 2))
    return float(counts @ voxel_ml[box[0]])
