"""Segments painted into one map: which numbers there may be, and which overlaps are told."""

from __future__ import annotations

import numpy as np
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.labels.segments import Painter, Wanted


def painter(names, only=None):
    return Painter("a.dcm", np.zeros((1, 1, 4), np.uint16), names, Wanted(only))


def mask(*voxels):
    return np.array([[number in voxels for number in range(4)]])


def test_the_largest_number_is_painted_and_no_further_one():
    one = painter({65_535: "last"})
    one.paint(0, 65_535, mask(2))
    assert one.finish(np.eye(4)).counts == {65_535: 1}
    for number in (0, 65_536):
        with refused(RefusedInputError, "a.dcm", number, 1, 65535):
            painter({number: "x"})
    with refused(RefusedInputError, 70000):  # the first of them
        painter({1: "x", 70_000: "y", 0: "z"})


def test_the_pair_with_most_voxels_is_told_and_the_others_are_counted():
    one = painter({1: "a", 2: "b", 3: "c"})
    for number, voxels in ((1, (0, 1)), (2, (1,)), (3, (0, 1))):
        one.paint(0, number, mask(*voxels))
    # 1 and 2 share a voxel, 1 and 3, 2 and 3 too: the first of equal ones
    with refused(RefusedInputError, 1, 2):
        one.finish(np.eye(4))
    two = painter({1: "a", 2: "b", 3: "c"})
    for number, painted in ((1, (0, 1, 2)), (2, (1,)), (3, (0, 2))):
        two.paint(0, number, mask(*painted))
    with refused(RefusedInputError, 1, 3, 2):
        two.finish(np.eye(4))


def test_pairs_are_counted_over_all_slices():
    one = Painter("a.dcm", np.zeros((2, 1, 4), np.uint16), {1: "a", 2: "b"}, Wanted())
    for k in (0, 1):
        one.paint(k, 1, mask(0, 1))
        one.paint(k, 2, mask(1, 2))
    with refused(RefusedInputError, 1, 2):
        one.finish(np.eye(4))


def test_wanted_segments_are_painted_last_and_the_others_by_falling_number():
    names = dict.fromkeys((1, 2, 3, 4, 5), "")
    assert painter(names).order == [1, 2, 3, 4, 5]
    assert painter(names, (2, 4)).order == [5, 3, 1, 2, 4]
