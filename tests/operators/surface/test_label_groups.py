"""Labels that are worked on together, and one by one where the device has no room for all."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from refusals import refused

from clrecon.errors import DeviceMemoryError
from clrecon.operators.surface.labels import Box, each_label

BOX: Box = (slice(0, 1), slice(0, 1), slice(0, 1))
GROUPS = [{1: BOX, 2: BOX, 3: BOX}, {4: BOX}, {5: BOX, 6: BOX}]


NO_ROOM_FOR_2 = "no room for 2: continued with one label at a time"


def extract_groups(fails: Mapping[int, int]) -> tuple[list[int], list[list[int]], list[str]]:
    """Labels in the order of their results, what was held, and warnings, where labels have no room `fails` times."""
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


def test_labels_are_held_in_their_groups_and_extracted_in_their_order() -> None:
    assert extract_groups(fails={}) == ([1, 2, 3, 4, 5, 6], [[1, 2, 3], [4], [5, 6]], [])


def test_the_rest_of_a_group_without_room_is_held_one_by_one_with_a_warning() -> None:
    order, held, warnings = extract_groups(fails={2: 1})
    assert order == [1, 2, 3, 4, 5, 6]
    assert held == [[1, 2, 3], [2], [3], [4], [5, 6]]
    assert warnings == [NO_ROOM_FOR_2]


def test_a_label_without_room_alone_is_held_once_more() -> None:
    order, held, warnings = extract_groups(fails={2: 2})
    assert order == [1, 2, 3, 4, 5, 6]
    assert held == [[1, 2, 3], [2], [2], [3], [4], [5, 6]]
    assert warnings == [NO_ROOM_FOR_2, NO_ROOM_FOR_2]


@pytest.mark.parametrize(("number", "fails"), [(2, 3), (4, 2)], ids=["of a group", "a group of its own"])
def test_a_label_without_room_alone_twice_is_refused(number: int, fails: int) -> None:
    with refused(DeviceMemoryError, number):
        extract_groups(fails={number: fails})
