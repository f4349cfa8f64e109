"""Planes of a regular grid: between slices, at the outer faces of the voxels, and beyond them."""

from __future__ import annotations

import numpy as np

from clrecon.geometry import Volume
from clrecon.geometry.resample import RegularGrid, regular_grid, resample_grid


def test_resampled_planes_hold_the_end_values_half_a_step_beyond_the_last_centres_and_air_further_out():
    """Slices of 5 and 9 at k = 0 and 1; planes at k = -0.75, -0.5 (still in the voxel), -0.25 and so on to 1.75."""
    voxels = np.array([[[5]], [[9]]], np.int16)
    quarter_steps = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.25, -0.75], [0, 0, 0, 1.0]])
    grid = RegularGrid(quarter_steps, shape_ijk=(1, 1, 11))
    planes = resample_grid(Volume(voxels, np.eye(4)), grid, air=-1000.0)
    assert planes.ravel().tolist() == [-1000, 5, 5, 5, 6, 7, 8, 9, 9, 9, -1000]


SPACING = np.diag((0.5, 0.75, 2.5, 1.0))


def test_the_grid_of_two_slices_has_the_step_between_their_positions():
    """The step of 2.5 mm of the affine is nominal: slice 1 lies 4 mm above slice 0."""
    volume = Volume(np.zeros((2, 3, 5), np.int16), SPACING, slice_positions=[[0, 0, 7], [0, 0, 11]])
    grid = regular_grid(volume, volume.slice_origins())
    assert grid.shape_ijk == (5, 3, 2)
    assert np.allclose(grid.affine, [[0.5, 0, 0, 0], [0, 0.75, 0, 0], [0, 0, 4.0, 7.0], [0, 0, 0, 1]])


def test_the_grid_of_a_single_slice_has_the_step_of_its_affine():
    single = Volume(np.zeros((1, 3, 5), np.int16), SPACING)
    assert np.allclose(regular_grid(single, single.slice_origins()).affine, SPACING)
