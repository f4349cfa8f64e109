"""The volume of a label: its voxels, on even, sheared and uneven slices alike."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.labels import LabelMap
from clrecon.labels.label_levels import count_ml, label_ml

pytestmark = pytest.mark.unit

SHEARED = np.array([[0.7, 0.1, 0.4, -250.0], [-0.1, 0.5, 0.9, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])


def map_of_24_voxels() -> np.ndarray:
    """Label 7 in a block of 2 x 3 x 4 voxels."""
    voxels = np.zeros((4, 5, 6), np.uint8)
    voxels[1:3, 1:4, 2:6] = 7
    return voxels


SHEARED_VOXEL_ML = abs(np.linalg.det(SHEARED[:3, :3])) / 1000.0


def test_label_has_the_volume_of_its_voxels_in_a_sheared_map():
    ml = label_ml(LabelMap(map_of_24_voxels(), SHEARED), 7)
    assert ml == pytest.approx(24 * SHEARED_VOXEL_ML, rel=tolerances.LABEL_FLOAT64)


def test_label_has_the_volume_of_its_voxels_in_a_box_of_a_sheared_volume():
    voxels = map_of_24_voxels()
    box = (slice(0, 3), slice(0, 5), slice(1, 6))  # holds all of the label
    ml = count_ml(voxels, 7, box, slice_voxel_ml(Volume(voxels, SHEARED)))
    assert ml == pytest.approx(24 * SHEARED_VOXEL_ML, rel=tolerances.LABEL_FLOAT64)


def test_label_without_a_voxel_has_no_volume():
    assert label_ml(LabelMap(map_of_24_voxels(), SHEARED), 8) == 0.0


def test_voxels_of_uneven_slices_reach_half_way_to_their_neighbours():
    heights = np.array([0.0, 1.0, 3.0, 3.5])
    positions = np.stack([5.0 * heights, np.zeros(4), heights], axis=1)  # sheared along i: no matter
    affine = np.diag([0.5, 0.8, 1.0, 1.0])
    volume = Volume(np.zeros((4, 3, 3), np.int16), affine, slice_positions=positions)
    pixel_mm2 = 0.5 * 0.8
    thickness_mm = slice_voxel_ml(volume) * 1000 / pixel_mm2
    # the outermost slices are as thick as their one gap
    assert thickness_mm == pytest.approx([1.0, (1 + 2) / 2, (2 + 0.5) / 2, 0.5], rel=tolerances.LABEL_FLOAT64)


def test_voxels_of_slices_that_run_against_their_normal_have_volumes_above_zero():
    affine = np.diag([0.5, 0.8, -2.0, 1.0])
    voxel_ml = slice_voxel_ml(Volume(np.zeros((1, 2, 2)), affine))
    assert voxel_ml == pytest.approx([0.5 * 0.8 * 2.0 / 1000], rel=tolerances.LABEL_FLOAT64)
