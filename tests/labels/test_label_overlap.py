"""Segments painted into one map: which numbers there may be, and which overlaps are told."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.labels.segments import Painter, Wanted


def painter_of(names, only=None):
    """A painter of segments into a map of one row of 4 voxels."""
    return Painter("a.dcm", np.zeros((1, 1, 4), np.uint16), names, Wanted(only))


def row_with(*voxels):
    """A mask of these of the 4 voxels."""
    return np.array([[number in voxels for number in range(4)]])


def test_segment_of_the_largest_number_is_painted():
    painter = painter_of({65_535: "last"})
    painter.paint(k=0, number=65_535, mask=row_with(2))
    assert painter.finish(np.eye(4)).counts == {65_535: 1}


@pytest.mark.parametrize("number", [0, 65_536])
def test_segment_of_a_number_outside_of_1_to_65_535_is_refused(number):
    with refused(RefusedInputError, "a.dcm", number, 1, 65535):
        painter_of({number: "x"})


def test_first_of_several_segments_with_a_wrong_number_is_named():
    with refused(RefusedInputError, 70000):
        painter_of({1: "x", 70_000: "y", 0: "z"})


def test_first_of_three_pairs_that_overlap_equally_is_named_in_the_refusal():
    painter = painter_of({1: "L1", 2: "L2", 3: "L3"})
    # 1 and 2 share voxel 1; 3 shares voxel 0 with 1, and voxel 1 with 2, which was painted over 1
    for number, voxels in ((1, (0, 1)), (2, (1,)), (3, (0, 1))):
        painter.paint(k=0, number=number, mask=row_with(*voxels))
    with refused(RefusedInputError, "L1", "L2", 1):
        painter.finish(np.eye(4))


def test_pair_with_the_largest_overlap_is_named_in_the_refusal():
    painter = painter_of({1: "L1", 2: "L2", 3: "L3"})
    for number, voxels in ((1, (0, 1, 2)), (2, (1,)), (3, (0, 2))):  # 1 and 2 share voxel 1, 1 and 3 two voxels
        painter.paint(k=0, number=number, mask=row_with(*voxels))
    with refused(RefusedInputError, "L1", "L3", 2):
        painter.finish(np.eye(4))


def test_voxels_that_two_segments_share_are_counted_over_all_slices():
    painter = Painter("a.dcm", np.zeros((5, 1, 4), np.uint16), {1: "L1", 2: "L2"}, Wanted())
    for k in range(5):
        painter.paint(k, number=1, mask=row_with(0, 1))
        painter.paint(k, number=2, mask=row_with(1, 2))
    with refused(RefusedInputError, "L1", "L2", 5):
        painter.finish(np.eye(4))


def test_wanted_segments_are_painted_last_and_the_others_by_falling_number():
    names = dict.fromkeys((1, 2, 3, 4, 5), "")
    assert painter_of(names, (2, 4)).order == [5, 3, 1, 2, 4]


def test_segments_are_painted_in_their_order_where_all_are_wanted():
    assert painter_of(dict.fromkeys((1, 2, 3, 4, 5), "")).order == [1, 2, 3, 4, 5]
