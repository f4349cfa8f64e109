"""The volume of a label: its voxels, on even, sheared and uneven slices alike."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.labels import LabelMap
from clrecon.labels.label_levels import count_ml, label_ml

pytestmark = pytest.mark.unit

SHEARED = np.array([[0.7, 0.1, 0.4, -250.0], [-0.1, 0.5, 0.9, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])


def test_a_label_has_the_volume_of_its_voxels_whatever_the_shear():
    voxels = np.zeros((4, 5, 6), np.uint8)
    voxels[1:3, 1:4, 2:6] = 7
    volume = Volume(voxels, SHEARED)
    expected = 24 * abs(np.linalg.det(SHEARED[:3, :3])) / 1000.0
    assert label_ml(LabelMap(voxels, SHEARED), 7) == pytest.approx(expected, rel=1e-12)
    box = (slice(0, 3), slice(0, 5), slice(1, 6))
    assert count_ml(voxels, 7, box, slice_voxel_ml(volume)) == pytest.approx(expected, rel=1e-12)
    assert label_ml(LabelMap(voxels, SHEARED), 8) == 0.0


def test_uneven_slices_reach_half_way_to_their_neighbours():
    heights = np.array([0.0, 1.0, 3.0, 3.5])
    table = np.stack([5.0 * heights, np.zeros(4), heights], axis=1)  # sheared along i: no matter
    affine = np.diag([0.5, 0.8, 1.0, 1.0])
    volume = Volume(np.zeros((4, 3, 3), np.int16), affine, slice_positions=table)
    assert slice_voxel_ml(volume) * 1000 / 0.4 == pytest.approx([1.0, 1.5, 1.25, 0.5], rel=1e-12)


def test_slices_that_run_against_their_normal_have_volumes_above_zero():
    affine = np.diag([0.5, 0.8, -2.0, 1.0])
    assert slice_voxel_ml(Volume(np.zeros((1, 2, 2)), affine)) * 1000 == pytest.approx([0.8], rel=1e-12)
