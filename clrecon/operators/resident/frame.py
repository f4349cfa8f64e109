"""Field coordinates, in which kernels sample a volume, and the box of its voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array

BOX_BORDER = 0.5
"""Index steps beyond the outermost voxel centres that still belong to a volume."""


@dataclass(frozen=True)
class FieldFrame:
    """The map from LPS mm to field coordinates: indices; for uneven slices indices in the plane of slice 0, and height
    in mm.

    matrix: ndarray, shape (3, 3), float64
    offset: ndarray, shape (3,), float64. Field coordinates of p are ``matrix @ p + offset``.
    """

    matrix: Float64Array
    offset: Float64Array

    @classmethod
    def of(cls, volume: Volume) -> FieldFrame:
        """Return the frame of a volume."""
        if volume.uneven:
            origin = volume.slice_origins()[0]
            normal = slice_normal(volume.affine)
            if normal @ volume.affine[:3, 2] < 0.0:
                normal = -normal
            matrix = np.vstack([np.linalg.pinv(volume.affine[:3, :2]), normal])
            return cls(matrix, -matrix @ origin)
        inverse: Float64Array = np.asarray(np.linalg.inv(volume.affine), dtype=np.float64)
        return cls(inverse[:3, :3], inverse[:3, 3])

    def places(self, points: Float64Array) -> Float64Array:
        """Return the field coordinates (n, 3) of LPS points (n, 3)."""
        return points @ self.matrix.T + self.offset

    def planes(self, planes: Float64Array) -> Float64Array:
        """Convert half-spaces (n, 4) of LPS, ``normal . p >= offset``, to field coordinates."""
        normals = planes[:, :3] @ np.linalg.inv(self.matrix)
        return np.column_stack([normals, planes[:, 3] + normals @ self.offset])


def volume_box(volume: Volume) -> tuple[Float64Array, Float64Array]:
    """Return the lowest and highest field coordinates of a volume, half a voxel beyond its outermost centres."""
    return enclose(volume, np.full(3, -BOX_BORDER), np.array(volume.shape_ijk) - 1.0 + BOX_BORDER)


def enclose(volume: Volume, low: Float64Array, high: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the lowest and highest field coordinates of the box between two corners in voxel indices."""
    if not volume.uneven:
        return low, high
    ks = {low[2], high[2], *range(math.ceil(low[2]), math.floor(high[2]) + 1)}
    corners = [(i, j, k) for k in ks for i in (low[0], high[0]) for j in (low[1], high[1])]
    places = FieldFrame.of(volume).places(volume.ijk_to_lps(corners))
    return places.min(axis=0), places.max(axis=0)
