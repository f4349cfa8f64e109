"""Labels that are worked on together, and one by one where the device has no room for all."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from refusals import refused

from clrecon.errors import DeviceMemoryError
from clrecon.operators.surface.labels import Box, each_label

BOX: Box = (slice(0, 1), slice(0, 1), slice(0, 1))
GROUPS = [{1: BOX, 2: BOX, 3: BOX}, {4: BOX}, {5: BOX, 6: BOX}]


def work(fails: Mapping[int, int]) -> tuple[list[int], list[list[int]], list[str]]:
    """Labels in the order of their results, what was held, and what was warned of; `fails` is how often labels do."""
    left, held, warnings = dict(fails), [], list[str]()

    def hold(group: Mapping[int, Box]) -> int:
        held.append(list(group))
        return len(held)

    def extract(holds: int, number: int, box: Box) -> int:
        assert holds == len(held) and box is BOX
        if left.get(number, 0):
            left[number] -= 1
            raise DeviceMemoryError(f"no room for {number}")
        return 10 * number

    found = list(each_label(GROUPS, hold, extract, warnings))
    assert all(made == 10 * number for number, made in found)
    return [number for number, _ in found], held, warnings


def test_labels_come_in_their_order() -> None:
    assert work({}) == ([1, 2, 3, 4, 5, 6], [[1, 2, 3], [4], [5, 6]], [])


def test_the_rest_of_a_group_without_room_goes_on_one_by_one() -> None:
    words = "no room for 2: continued with one label at a time"
    assert work({2: 1}) == ([1, 2, 3, 4, 5, 6], [[1, 2, 3], [2], [3], [4], [5, 6]], [words])
    assert work({2: 2}) == ([1, 2, 3, 4, 5, 6], [[1, 2, 3], [2], [2], [3], [4], [5, 6]], [words, words])


@pytest.mark.parametrize(("number", "times"), [(2, 3), (4, 2)])
def test_a_label_without_room_for_itself_alone_is_refused(number: int, times: int) -> None:
    with refused(DeviceMemoryError, number):
        work({number: times})
