"""Boxes of labels, and filling of small masks: from each side, voxel by voxel."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from clrecon.labels.label_levels import _close_ends, _reach_from_faces, fill_solid, find_boxes


def slices(*ends):
    return tuple(slice(*end) for end in ends)


def test_a_box_reaches_one_sample_further_and_ends_with_the_grid():
    labels = np.zeros((20, 30, 40), np.uint16)
    labels[10:12, 14:17, 20], labels[0, 29, 39] = 2, 4
    boxes = find_boxes(labels, (2, 3, 4), (1, 2, 3))  # i, j, k
    assert boxes == {2: slices((6, 16), (11, 20), (18, 23)), 4: slices((0, 5), (26, 30), (37, 40))}
    assert find_boxes(labels, (), (0, 0, 0)) == {}


@pytest.mark.parametrize("face", list(product(range(3), (0, 2))), ids=str)
def test_a_way_from_any_side_is_found(face):
    axis, side = face
    passable = np.zeros((3, 3, 3), bool)
    passable[1, 1, 1] = True
    assert not _reach_from_faces(passable).any()
    np.moveaxis(passable, axis, 0)[side, 1, 1] = True
    assert np.array_equal(_reach_from_faces(passable), passable)


@pytest.mark.parametrize("axis", range(3))
def test_no_way_begins_where_the_volume_ends(axis):
    box = slices((0, 3), (1, 4), (2, 5))  # of 3 x 9 x 5: at both ends, at none, at the upper end
    passable = np.ones((5, 5, 5), bool)
    _close_ends(passable, box, (3, 9, 5))
    blocked = [[not np.moveaxis(passable, axis, 0)[side, 1:4, 1:4].any() for side in (0, -1)] for axis in range(3)]
    assert blocked[axis] == [[True, True], [False, False], [False, True]][axis]
    assert passable[1:4, 1:4, 1:4].all()


def ball(size=5):
    """A cube of a label around one empty voxel, all but the middle inside of it."""
    labels = np.zeros((size + 4,) * 3, np.uint16)
    labels[2:-2, 2:-2, 2:-2] = 7
    return labels


def test_deep_voxels_and_holes_are_filled_and_counted():
    labels = ball()
    box = slices((1, 8), (1, 8), (1, 8))
    assert fill_solid(np.zeros_like(labels), labels, 7, box, True) == 27  # all neighbours carry the label
    labels[4, 4, 4] = 0
    solid = np.where(labels == 7, labels, 0)
    assert fill_solid(solid, labels, 7, box, True) == 1 and solid[4, 4, 4] == 7
    solid = np.where(labels == 7, labels, 0)
    labels[4, 4, 4] = 3  # another label stays what it is
    assert fill_solid(solid, labels, 7, box, True) == 0 and solid[4, 4, 4] == 0


def test_samples_inside_another_label_stay_so():
    labels = ball()
    solid = np.zeros_like(labels)
    solid[4, 4, 4] = 5
    assert fill_solid(solid, labels, 7, slices((1, 8), (1, 8), (1, 8)), True) == 26 and solid[4, 4, 4] == 5


@pytest.mark.parametrize("axis", range(3))
def test_a_hole_with_a_way_out_stays_a_hole(axis):
    labels = ball()
    np.moveaxis(labels, axis, 0)[2:5, 4, 4] = 0
    solid = np.where(labels == 7, labels, 0)
    assert fill_solid(solid, labels, 7, slices((1, 8), (1, 8), (1, 8)), True) == 0
