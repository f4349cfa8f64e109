"""Planes of a regular grid: between slices, at the outer faces of the voxels, and beyond them."""

from __future__ import annotations

import numpy as np

from clrecon.geometry import Volume
from clrecon.geometry.regular import RegularGrid, resample_grid


def test_voxels_reach_half_a_step_beyond_their_centres():
    voxels = np.array([[[5]], [[9]]], np.int16)
    regular = RegularGrid(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.25, -0.75], [0, 0, 0, 1.0]]), (1, 1, 11))
    # At k = -0.75, -0.5 (still in the voxel), -0.25, ...; half way between 5 and 9 is 7.
    expected = [-1000, 5, 5, 5, 6, 7, 8, 9, 9, 9, -1000]
    assert resample_grid(Volume(voxels, np.eye(4)), regular, -1000.0).ravel().tolist() == expected
