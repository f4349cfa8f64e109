"""Work on long arrays: two functions at the same time."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from clrecon.system.pieces import list_distinct, side_by_side

pytestmark = pytest.mark.unit


def test_two_functions_run_at_the_same_time():
    meeting = threading.Barrier(2, timeout=20.0)
    one, other = side_by_side(lambda: ("one", meeting.wait()), lambda: ("other", meeting.wait()))
    assert (one[0], other[0]) == ("one", "other")
    assert {one[1], other[1]} == {0, 1}  # each has met the other


@pytest.mark.parametrize("first", [True, False])
def test_what_one_of_two_functions_raises_is_raised_after_both_have_ended(first):
    ended = []

    def fail() -> None:
        raise ZeroDivisionError("one of two")

    with pytest.raises(ZeroDivisionError, match="one of two"):
        if first:
            side_by_side(fail, lambda: ended.append(1))
        else:
            side_by_side(lambda: ended.append(1), fail)
    assert ended == [1]


@pytest.mark.parametrize("numbers", [[], [7], [3, 3, 3], [[5, -1], [2, 5]]])
def test_distinct_numbers_rise_and_are_each_there_once(numbers):
    found = list_distinct(np.array(numbers, dtype=np.int32))
    assert found.dtype == np.int32
    assert found.tolist() == sorted(set(np.ravel(numbers).tolist()))
