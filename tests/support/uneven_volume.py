"""A volume whose slices lie at places of their own, no two layers sheared alike."""

from __future__ import annotations

import numpy as np
from dicom_series import rotation

from clrecon.geometry import Volume

IN_PLANE = rotation((20.0, -35.0, 10.0))[:, :2] * (0.5, 0.7)
HEIGHTS = np.array([0.0, 1.25, 2.4, 3.75, 8.75, 9.0])
SIDEWAYS = np.array([0.0, 0.3, 0.2, 1.0, 2.5, 2.0])
"""Mm along the columns: no two layers are sheared alike."""


def positions(*, sign: float = 1.0) -> np.ndarray:
    """Places of the six slices, LPS mm; with -1 they run against the normal."""
    normal = np.cross(*IN_PLANE.T)
    normal *= sign / np.linalg.norm(normal)
    return np.array([-120.0, 80.0, -700.0]) + HEIGHTS[:, None] * normal + SIDEWAYS[:, None] * IN_PLANE[:, 1]


def uneven(voxels: np.ndarray | None = None, *, sign: float = 1.0) -> Volume:
    """A volume of six slices at `positions`, of zeros by default."""
    table = positions(sign=sign)
    affine = np.eye(4)
    affine[:3, :2] = IN_PLANE
    affine[:3, 2] = (table[-1] - table[0]) / (len(table) - 1)
    affine[:3, 3] = table[0]
    if voxels is None:
        voxels = np.zeros((len(table), 5, 4), np.int16)
    return Volume(voxels, affine, slice_positions=table)
