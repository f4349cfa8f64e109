"""Twin of `clrecon.operators.points.normals`: differences of the trilinear field over half a voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume


def _values(voxels: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the trilinear field of padded voxels at index coordinates of the volume."""
    from scipy.ndimage import map_coordinates

    inside = np.clip(places[:, ::-1].T + 1.0, 0.0, np.array(voxels.shape)[:, None] - 1.0)
    values: NDArray[np.float64] = map_coordinates(voxels, inside, order=1, mode="nearest")
    return values


def find_gradients(volume: Volume, points: NDArray[np.floating], outside: float) -> NDArray[np.float64]:
    """Return the gradient of a volume at points, (n, 3), HU per mm, LPS.

    points: ndarray, shape (n, 3), LPS mm
    outside: Value beyond the border.
    """
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
