"""Boxes of labels, and filling of small masks: from each side, voxel by voxel."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from clrecon.labels.label_levels import _close_ends, _reach_from_faces, fill_solid, find_boxes


def box_of(*ends):
    return tuple(slice(*end) for end in ends)


def test_box_of_a_label_reaches_its_margin_and_a_sample_further_and_ends_with_the_grid():
    labels = np.zeros((20, 30, 40), np.uint16)
    labels[10:12, 14:17, 20] = 2
    labels[0, 29, 39] = 4  # in a corner of the grid
    margins_ijk = (1, 2, 3)
    boxes = find_boxes(labels, (2, 3, 4), margins_ijk)  # no voxel has label 3
    # Along k, j and i the margins of 3, 2 and 1 samples and one more, on either side.
    assert boxes == {2: box_of((6, 16), (11, 20), (18, 23)), 4: box_of((0, 5), (26, 30), (37, 40))}


def test_no_labels_have_no_boxes():
    assert find_boxes(np.ones((2, 2, 2), np.uint16), (), (0, 0, 0)) == {}


def test_voxel_without_a_way_to_any_face_is_not_reached():
    passable = np.zeros((3, 3, 3), bool)
    passable[1, 1, 1] = True
    assert not _reach_from_faces(passable).any()


@pytest.mark.parametrize("face", list(product(range(3), (0, 2))), ids=str)
def test_voxel_beside_a_passable_one_in_any_face_is_reached(face):
    axis, side = face
    passable = np.zeros((3, 3, 3), bool)
    passable[1, 1, 1] = True
    np.moveaxis(passable, axis, 0)[side, 1, 1] = True
    assert np.array_equal(_reach_from_faces(passable), passable)


@pytest.mark.parametrize(
    ("axis", "ends_of_volume"),
    [(0, [True, True]), (1, [False, False]), (2, [False, True])],
    ids=["k: both ends", "j: no end", "i: upper end"],
)
def test_faces_of_a_box_are_closed_where_the_volume_ends(axis, ends_of_volume):
    box, volume_shape = box_of((0, 3), (1, 4), (2, 5)), (3, 9, 5)
    passable = np.ones((5, 5, 5), bool)  # the box and a voxel around it
    _close_ends(passable, box, volume_shape)
    lower_and_upper_face = np.moveaxis(passable, axis, 0)[[0, -1], 1:4, 1:4]
    assert [not face.any() for face in lower_and_upper_face] == ends_of_volume
    assert passable[1:4, 1:4, 1:4].all()


INNER_BOX = box_of((1, 8), (1, 8), (1, 8))
"""The cube of label 7 with a voxel around it."""


def cube_of_label_7():
    """A cube of 5 x 5 x 5 voxels with two empty voxels around it."""
    labels = np.zeros((9, 9, 9), np.uint16)
    labels[2:-2, 2:-2, 2:-2] = 7
    return labels


def test_voxels_whose_neighbours_all_carry_the_label_are_filled_and_counted():
    labels = cube_of_label_7()
    assert fill_solid(np.zeros_like(labels), labels, 7, INNER_BOX, closed=True) == 3**3  # all but the outermost voxels


def test_hole_within_a_label_is_filled_and_counted():
    labels = cube_of_label_7()
    labels[4, 4, 4] = 0
    solid = labels.copy()
    assert fill_solid(solid, labels, 7, INNER_BOX, closed=True) == 1
    assert solid[4, 4, 4] == 7


def test_voxel_of_another_label_within_a_label_is_not_filled():
    labels = cube_of_label_7()
    labels[4, 4, 4] = 3
    solid = np.where(labels == 7, labels, 0)
    assert fill_solid(solid, labels, 7, INNER_BOX, closed=True) == 0
    assert solid[4, 4, 4] == 0


def test_voxel_that_another_solid_label_has_filled_keeps_that_label():
    labels = cube_of_label_7()
    solid = np.zeros_like(labels)
    solid[4, 4, 4] = 5
    assert fill_solid(solid, labels, 7, INNER_BOX, closed=True) == 3**3 - 1
    assert solid[4, 4, 4] == 5


@pytest.mark.parametrize("axis", range(3), ids=["k", "j", "i"])
def test_hole_with_a_way_out_of_the_label_is_not_filled(axis):
    labels = cube_of_label_7()
    np.moveaxis(labels, axis, 0)[2:5, 4, 4] = 0  # from a face of the cube to its middle
    solid = labels.copy()
    assert fill_solid(solid, labels, 7, INNER_BOX, closed=True) == 0
