"""The levels that are tried for the volume of a label, alone and among labels that enclose it."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.labels.label_levels import (
    DRIFT,
    FACES_PER_AREA,
    FULL,
    LEVELS,
    MOST_SWEEPS,
    MOST_TRIALS,
    START,
    STEEPNESS,
    Borders,
    choose_levels,
    count_faces,
    find_enclosed,
    level_biases,
    next_level,
)

STEP = 1.0 / (FACES_PER_AREA * STEEPNESS * FULL)
"""Voxels that a label loses by one face towards no label, when its level rises by one."""


def test_a_step_too_far_goes_half_way_to_the_end():
    assert next_level([], 100.0, -1.0) == START
    # Newton's step would be far beyond the lowest and the highest level.
    assert next_level([(START, 50.0)], 100.0, -1e-9) == (LEVELS[0] - 1 + START) // 2
    assert next_level([(START, 100.0)], 50.0, -1e-9) == (START + LEVELS[1] + 1) // 2


def test_next_level_is_newtons_and_then_lies_between_two():
    assert next_level([(START, 110.0)], 100.0, -2.0) == START + 5
    assert next_level([(START, 100.01)], 100.0, -2.0) == START  # less than 3 in 10,000 off
    assert next_level([(1000, 130.0), (1100, 90.0)], 100.0, -2.0) == 1075


def test_the_secant_goes_through_the_two_best_trials():
    # From (1100, 180) and (1050, 190) it falls by 0.2 a level: 80 more are 400 levels on.
    assert next_level([(0, 300.0), (1050, 190.0), (1100, 180.0)], 100.0, -0.1) == 1500
    assert next_level([(1000, 60.0), (1050, 50.0), (1200, 40.0)], 100.0, -0.1) == 800
    # Less than a tenth of the expected rise is not believed.
    assert next_level([(1050, 180.001), (1100, 180.0)], 100.0, -2.0) == 1100 + 400


def test_between_two_levels_a_tenth_is_left_at_either_end():
    assert next_level([(1000, 100.1), (1100, 0.0)], 100.0, -2.0) == 1010
    assert next_level([(1000, 1100.0), (1100, 99.9)], 100.0, -2.0) == 1090


def test_the_best_level_is_kept_where_no_other_is_left():
    assert next_level([(1000, 120.0), (1001, 90.0)], 100.0, -2.0) == 1001
    many = [(1000 + number, 120.0) for number in range(MOST_TRIALS - 1)] + [(1500, 110.0)]
    assert next_level(many, 100.0, -2.0) == 1500
    assert next_level(many[1:], 100.0, -2.0) != 1500
    assert next_level([(LEVELS[1], 120.0)], 100.0, -2.0) == LEVELS[1]


def row(*numbers: int) -> np.ndarray:
    """Labels along i; the ends of the map are no faces."""
    return np.array([[numbers]], np.uint16)


def test_faces_are_counted_from_either_side():
    assert count_faces(row(0, 1, 1, 2, 0, 2)).tolist() == [[0, 0], [1, 1], [2, 1]]
    for axis in range(3):
        assert count_faces(np.moveaxis(row(0, 3, 2), 2, axis)).tolist() == [[0, 0], [0, 0], [0, 1], [1, 1]]
    cube = np.zeros((3, 3, 3), np.uint16)
    cube[1, 1, 1] = 1
    assert count_faces(cube).tolist() == [[0, 0], [6, 0]]


def test_a_label_with_more_shared_than_free_faces_is_enclosed_and_brings_its_neighbours():
    def enclosed(labels, boxes=None):
        return find_enclosed(labels, count_faces(labels), boxes)

    assert enclosed(row(0, 1, 2, 0)) == ()  # as many free as shared
    assert enclosed(row(0, 1, 2, 3, 0, 5)) == (1, 2, 3)
    assert enclosed(row(1, 2, 0, 4)) == (1, 2)
    labels = row(0, 1, 2, 3, 0, 0)
    whole, part = (slice(0, 1), slice(0, 1), slice(0, 6)), (slice(0, 1), slice(0, 1), slice(0, 3))
    assert enclosed(labels, {2: whole}) == (1, 2, 3) and enclosed(labels, {2: part}) == (1, 2)


def test_a_lead_is_counted_from_the_first_level():
    assert level_biases({2: START - 30, 4: START + 5}, 6).tolist() == [0, 0, 30, 0, -5, 0]


def test_borders_have_the_slopes_of_their_faces():
    # 2 has a free face, and one with each of 1 and 3; 9 is not asked for; 1 and 3 end with the map or no label.
    labels = np.zeros((3, 3, 6), np.uint16)
    labels[1, 1] = (1, 1, 2, 3, 9, 0)
    borders = Borders.of(labels, (1, 2, 3))
    assert borders.voxels.tolist() == [2.0, 1.0, 1.0] and borders.numbers == (1, 2, 3)
    own = np.array([8 + 0.5, 4 + 1.0, 4 + 1.0]) * (1.0 + DRIFT)
    expected = np.diag(own) - 0.5 * np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    assert borders.slopes.toarray() / STEP == pytest.approx(expected, rel=1e-12)
    assert borders.parts.tolist() == [0, 0, 0] and borders.filled.tolist() == [False] * 3


def test_labels_that_fill_a_map_are_filled_and_others_are_not():
    # 1 and 2 have no outlet; 4 touches a label that is not asked for, 6 has a free face.
    labels = np.zeros((3, 1, 8), np.uint16)
    labels[0, 0], labels[2, 0] = (1, 1, 2, 2, 2, 2, 2, 2), (4, 4, 4, 5, 6, 6, 6, 6)
    labels[1, 0] = labels[0, 0]
    alone = Borders.of(labels[:2], (1, 2))
    assert alone.filled.tolist() == [True, True]
    assert alone.share_rest(np.array([3.0, 13.0])) == pytest.approx([3.0 - 4.0, 13.0 - 12.0], rel=1e-12)
    both = Borders.of(labels, (4, 6))
    assert both.filled.tolist() == [False, False] and both.parts.tolist() == [0, 1]
    assert both.share_rest(np.array([3.0, 13.0])).tolist() == [3.0, 13.0]
    assert Borders.of(row(0, 1, 2, 2), (1, 2)).filled.tolist() == [False, False]


def measured(borders: Borders, lost: float):
    """Volumes that fall by the slopes from too small ones, and the levels at which they were asked for."""
    asked: list[dict[int, int]] = []

    def measure(levels: dict[int, int]) -> dict[int, float]:
        asked.append(dict(levels))
        rise = np.array([levels[number] - START for number in borders.numbers])
        volumes = borders.voxels - lost - borders.slopes @ rise
        return dict(zip(borders.numbers, volumes.tolist(), strict=True))

    return measure, asked


def test_enclosed_labels_get_their_volumes_in_two_rounds():
    labels = np.zeros((9, 9, 12), np.uint16)
    labels[2:7, 2:7, 2:6], labels[2:7, 2:7, 6:10] = 1, 2
    borders = Borders.of(labels, (1, 2))
    measure, asked = measured(borders, 5.0)
    levels = choose_levels(borders, measure)
    # By symmetry both move alike: 5 voxels over 105 free faces, and the drift.
    expected = START - round(5.0 / (STEP * ((1.0 + DRIFT) * 117.5 - 12.5)))
    assert levels == {1: expected, 2: expected}
    assert asked == [{1: START, 2: START}, levels]


def test_the_search_ends_where_nothing_moves_and_after_all_rounds():
    labels = np.zeros((9, 9, 12), np.uint16)
    labels[2:7, 2:7, 2:6], labels[2:7, 2:7, 6:10] = 1, 2
    borders = Borders.of(labels, (1, 2))
    asked = []

    def empty(levels):
        asked.append(levels)
        return {1: 0.0, 2: 0.0}

    assert choose_levels(borders, empty) == {1: START, 2: START}  # the first of equal ones
    assert len(asked) == 2 and asked[1] == {1: LEVELS[0], 2: LEVELS[0]}
    turns = []

    def swing(levels):
        turns.append(levels)
        return dict.fromkeys((1, 2), 100.0 + 20.0 * (-1.0) ** len(turns) + len(turns) / 100.0)

    best = choose_levels(borders, swing)
    assert len(turns) == MOST_SWEEPS and best == turns[-2 if MOST_SWEEPS % 2 == 0 else -1]
