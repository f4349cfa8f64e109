"""Twin of `clrecon.operators.reformat.sheets`: slices and curved reformations in float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.reformation import Sheet, SlabSamples

EDGE = 2.0**-20
"""Index steps beyond the box of a volume that still count as inside: the rounding error of a pixel on a face."""


def is_inside(volume: Volume, points: Float64Array) -> NDArray[np.bool_]:
    """True for points (..., 3) in LPS mm within the box of a volume, half a voxel beyond the outer voxel centres."""
    ijk = volume.lps_to_ijk(points.reshape(-1, 3))
    last = np.array(volume.shape_ijk) - 1
    inside = ((ijk >= -0.5 - EDGE) & (ijk <= last + 0.5 + EDGE)).all(axis=1)
    return np.asarray(inside.reshape(points.shape[:-1]))


def sample_field(volume: Volume, points: Float64Array) -> Float64Array:
    """Interpolate trilinearly between voxel centres.

    points: ndarray, shape (n, 3), float64. LPS mm, all of them within the box of the volume.

    Returns: ndarray, shape (n,), float64. HU; between the outer voxel centres and the faces of the box the nearest
        value.
    """
    last = np.array(volume.shape_ijk) - 1
    at = np.clip(volume.lps_to_ijk(points), 0.0, last)
    low = np.floor(at).astype(np.intp)
    part = at - low
    high = np.minimum(low + (part > 0.0), last)
    values = np.zeros(len(at))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (np.where(upper, high[:, axis], low[:, axis]) for axis, upper in enumerate(corner))
        weight = np.prod(np.where(corner, part, 1.0 - part), axis=1)
        # Voxels with weight 0 are ignored: they may be NaN.
        values += np.where(weight > 0.0, weight * volume.voxels[k, j, i].astype(np.float64), 0.0)
    return values


def reformat_sheet(volume: Volume, sheet: Sheet, samples: SlabSamples, combine: str = "mean") -> Float64Array:
    """Compute the values of all pixels of a sheet.

    combine: {"mean", "max", "min"}. How the samples of a pixel that lie within the volume are combined.

    Returns: ndarray, shape (h, w), float64. HU; NaN where no sample lies within the volume.
    """
    shape = sheet.height, sheet.width
    values = np.full(shape, 0.0 if combine == "mean" else np.nan)
    weights = np.zeros(shape)
    for offset, weight in zip(samples.offsets, samples.weights, strict=True):
        points = sheet.points(depth=offset)
        inside = is_inside(volume, points)
        sampled = sample_field(volume, points[inside])
        weights[inside] += weight
        if combine == "mean":
            values[inside] += weight * sampled
        else:
            values[inside] = (np.fmax if combine == "max" else np.fmin)(values[inside], sampled)
    if combine == "mean":
        values = values / np.where(weights > 0.0, weights, 1.0)
    return np.asarray(np.where(weights > 0.0, values, np.nan))
