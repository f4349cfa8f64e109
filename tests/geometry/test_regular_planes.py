"""Planes of a regular grid: between slices, at the outer faces of the voxels, and beyond them."""

from __future__ import annotations

import numpy as np

from clrecon.geometry import Volume
from clrecon.geometry.resample import RegularGrid, regular_grid, resample_grid


def test_voxels_reach_half_a_step_beyond_their_centres():
    voxels = np.array([[[5]], [[9]]], np.int16)
    regular = RegularGrid(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.25, -0.75], [0, 0, 0, 1.0]]), (1, 1, 11))
    # At k = -0.75, -0.5 (still in the voxel), -0.25, ...; half way between 5 and 9 is 7.
    expected = [-1000, 5, 5, 5, 6, 7, 8, 9, 9, 9, -1000]
    assert resample_grid(Volume(voxels, np.eye(4)), regular, -1000.0).ravel().tolist() == expected


def test_the_step_of_two_slices_is_that_of_their_positions():
    # The affine's step of 2.5 mm is nominal: slice 1 lies 4 mm above slice 0.
    volume = Volume(
        np.zeros((2, 3, 5), np.int16), np.diag((0.5, 0.75, 2.5, 1.0)), slice_positions=[[0, 0, 7], [0, 0, 11]]
    )
    grid = regular_grid(volume, volume.slice_origins())
    expected = np.array([[0.5, 0, 0, 0], [0, 0.75, 0, 0], [0, 0, 4.0, 7.0], [0, 0, 0, 1]])
    assert grid.shape_ijk == (5, 3, 2) and np.allclose(grid.affine, expected)
    one = Volume(np.zeros((1, 3, 5), np.int16), np.diag((0.5, 0.75, 2.5, 1.0)))
    assert np.allclose(regular_grid(one, one.slice_origins()).affine, np.diag((0.5, 0.75, 2.5, 1.0)))
