"""The levels that are tried for the volume of a label, alone and among labels that enclose it."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

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


# Trials are levels and the volumes that they gave; `wanted` is the volume, `rise` its change when the level rises by 1.


def test_first_level_tried_is_the_start():
    assert next_level([], wanted=100.0, rise=-1.0) == START


def test_step_beyond_the_lowest_or_highest_level_goes_half_way_to_it():
    flat = -1e-9  # so small a change of volume a level that Newton's step would be far beyond either end
    assert next_level([(START, 50.0)], wanted=100.0, rise=flat) == (LEVELS[0] - 1 + START) // 2
    assert next_level([(START, 100.0)], wanted=50.0, rise=flat) == (START + LEVELS[1] + 1) // 2


def test_second_level_tried_is_that_of_newton():
    # 10 voxels too many at -2 voxels a level
    assert next_level([(START, 110.0)], wanted=100.0, rise=-2.0) == START + 5


def test_level_less_than_3_in_10_000_off_its_volume_is_kept():
    assert next_level([(START, 100.01)], wanted=100.0, rise=-2.0) == START


def test_between_levels_on_either_side_the_next_one_is_interpolated():
    # 30 of the 40 voxels between them: three quarters of the way
    assert next_level([(1000, 130.0), (1100, 90.0)], wanted=100.0, rise=-2.0) == 1075


def test_two_levels_on_one_side_are_continued_along_their_secant():
    # From (1050, 190) to (1100, 180) the volume falls by 0.2 a level: 80 more are 400 levels on.
    assert next_level([(0, 300.0), (1050, 190.0), (1100, 180.0)], wanted=100.0, rise=-0.1) == 1500
    # From (1050, 50) to (1000, 60), the two best, it rises by 0.2 a level: 40 more are 200 levels back.
    assert next_level([(1000, 60.0), (1050, 50.0), (1200, 40.0)], wanted=100.0, rise=-0.1) == 800


def test_secant_flatter_than_a_tenth_of_the_expected_slope_is_not_followed():
    # 80 voxels at a tenth of 2 voxels a level
    assert next_level([(1050, 180.001), (1100, 180.0)], wanted=100.0, rise=-2.0) == 1100 + 400


def test_interpolated_level_keeps_a_tenth_of_the_way_from_either_end():
    assert next_level([(1000, 100.1), (1100, 0.0)], wanted=100.0, rise=-2.0) == 1010  # the first is all but right
    assert next_level([(1000, 1100.0), (1100, 99.9)], wanted=100.0, rise=-2.0) == 1090


def test_best_level_is_kept_between_neighbours_and_at_the_highest():
    assert next_level([(1000, 120.0), (1001, 90.0)], wanted=100.0, rise=-2.0) == 1001
    assert next_level([(LEVELS[1], 120.0)], wanted=100.0, rise=-2.0) == LEVELS[1]


def test_best_level_is_kept_after_the_most_trials():
    trials = [(1000 + number, 120.0) for number in range(MOST_TRIALS - 1)] + [(1500, 110.0)]
    assert next_level(trials, wanted=100.0, rise=-2.0) == 1500
    assert next_level(trials[1:], wanted=100.0, rise=-2.0) != 1500  # one trial less


def row(*numbers: int) -> np.ndarray:
    """A map of one row of labels along i; where the map ends a label has no face."""
    return np.array([[numbers]], np.uint16)


def test_faces_of_each_label_are_counted_as_free_or_shared():
    free_and_shared = count_faces(row(0, 1, 1, 2, 0, 2))
    assert free_and_shared.tolist() == [[0, 0], [1, 1], [2, 1]]  # of the labels 0, 1, 2


@pytest.mark.parametrize("axis", range(3), ids=["k", "j", "i"])
def test_faces_are_counted_along_each_axis(axis):
    along_axis = np.moveaxis(row(0, 3, 2), 2, axis)
    assert count_faces(along_axis).tolist() == [[0, 0], [0, 0], [0, 1], [1, 1]]  # of the labels 0 to 3


def test_single_voxel_has_six_free_faces():
    voxel = np.zeros((3, 3, 3), np.uint16)
    voxel[1, 1, 1] = 1
    assert count_faces(voxel)[1].tolist() == [6, 0]


@pytest.mark.parametrize(
    ("labels", "enclosed"),
    [
        pytest.param(row(0, 1, 2, 0), (), id="as many free as shared faces"),
        pytest.param(row(0, 1, 2, 3, 0, 5), (1, 2, 3), id="2 between 1 and 3"),
        pytest.param(row(1, 2, 0, 4), (1, 2), id="1 between 2 and the end of the map"),
    ],
)
def test_label_with_more_shared_than_free_faces_is_enclosed_and_brings_its_neighbours(labels, enclosed):
    assert find_enclosed(labels, count_faces(labels)) == enclosed


@pytest.mark.parametrize(("end", "enclosed"), [(6, (1, 2, 3)), (3, (1, 2))], ids=["whole row", "up to label 2"])
def test_neighbours_of_an_enclosed_label_are_those_in_its_box(end, enclosed):
    labels = row(0, 1, 2, 3, 0, 0)
    box = (slice(0, 1), slice(0, 1), slice(0, end))
    assert find_enclosed(labels, count_faces(labels), {2: box}) == enclosed


def test_biases_are_levels_below_the_start_by_number():
    assert level_biases({2: START - 30, 4: START + 5}, 6).tolist() == [0, 0, 30, 0, -5, 0]


def test_slopes_of_volumes_follow_from_the_faces_of_each_label():
    # One row amid a map of 3 x 3 x 6, so each of its voxels has 4 free faces around it. 1 has two voxels and ends with
    # the map, 2 lies between 1 and 3, 3 beside 9, which is not asked for.
    labels = np.zeros((3, 3, 6), np.uint16)
    labels[1, 1] = (1, 1, 2, 3, 9, 0)

    borders = Borders.of(labels, (1, 2, 3))

    free_and_half_the_shared = np.array([8 + 0.5, 4 + 1.0, 4 + 1.0])
    shared_with_neighbour = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    expected = np.diag(free_and_half_the_shared * (1.0 + DRIFT)) - 0.5 * shared_with_neighbour
    assert borders.slopes.toarray() / STEP == pytest.approx(expected, rel=tolerances.LABEL_FLOAT64)


def test_labels_that_touch_are_one_part_with_their_voxels():
    borders = Borders.of(row(0, 1, 1, 2, 3, 0), (1, 2, 3))
    assert borders.numbers == (1, 2, 3)
    assert borders.voxels.tolist() == [2.0, 1.0, 1.0]
    assert borders.parts.tolist() == [0, 0, 0]


LABELS_1_AND_2 = np.array([[[1, 1, 2, 2, 2, 2, 2, 2]]] * 2, np.uint16)
"""A map that two labels of 4 and 12 voxels fill."""


def test_labels_without_a_free_face_are_filled():
    assert Borders.of(LABELS_1_AND_2, (1, 2)).filled.tolist() == [True, True]


def test_rest_of_labels_that_fill_a_map_is_shared_by_their_voxels():
    rest = np.array([3.0, 13.0])  # 16 in all: 4 for the 4 voxels of label 1, 12 for those of label 2
    shared = Borders.of(LABELS_1_AND_2, (1, 2)).share_rest(rest)
    assert shared == pytest.approx([3.0 - 4.0, 13.0 - 12.0], rel=tolerances.LABEL_FLOAT64)


def test_labels_beside_another_label_or_none_are_not_filled_and_keep_their_rest():
    # 4 touches 5, which is not asked for; 6 touches 5 too
    beside_another = np.concatenate([LABELS_1_AND_2, row(4, 4, 4, 5, 6, 6, 6, 6)])
    borders = Borders.of(beside_another, (4, 6))
    assert borders.filled.tolist() == [False, False]
    assert borders.parts.tolist() == [0, 1]
    assert borders.share_rest(np.array([3.0, 13.0])).tolist() == [3.0, 13.0]
    beside_none = row(0, 1, 2, 2)
    assert Borders.of(beside_none, (1, 2)).filled.tolist() == [False, False]


def two_boxes_side_by_side() -> Borders:
    labels = np.zeros((9, 9, 12), np.uint16)
    labels[2:7, 2:7, 2:6], labels[2:7, 2:7, 6:10] = 1, 2  # of 5 x 5 x 4 voxels
    return Borders.of(labels, (1, 2))


def measure_by_slopes(borders: Borders, lost: float):
    """A measure whose volumes are `lost` voxels too small at START and fall by the slopes; and the levels asked for."""
    asked: list[dict[int, int]] = []

    def measure(levels: dict[int, int]) -> dict[int, float]:
        asked.append(dict(levels))
        rise = np.array([levels[number] - START for number in borders.numbers])
        volumes = borders.voxels - lost - borders.slopes @ rise
        return dict(zip(borders.numbers, volumes.tolist(), strict=True))

    return measure, asked


def test_enclosed_labels_get_their_volumes_in_two_rounds():
    borders = two_boxes_side_by_side()
    measure, asked = measure_by_slopes(borders, lost=5.0)

    levels = choose_levels(borders, measure)

    # By symmetry both move alike. A box has 25 + 4 x 20 = 105 free faces and 25 shared ones, which count half.
    faces = (1.0 + DRIFT) * (105 + 25 / 2) - 25 / 2
    expected = START - round(5.0 / (STEP * faces))
    assert levels == {1: expected, 2: expected}
    assert asked == [{1: START, 2: START}, levels]


def test_search_ends_at_the_start_where_the_lowest_level_gives_no_volume_either():
    asked = []

    def measure_nothing(levels):
        asked.append(levels)
        return {1: 0.0, 2: 0.0}

    levels = choose_levels(two_boxes_side_by_side(), measure_nothing)

    assert levels == {1: START, 2: START}  # the first of equal ones
    assert asked[1:] == [{1: LEVELS[0], 2: LEVELS[0]}]


def test_search_that_does_not_settle_ends_after_all_rounds_with_the_best_one():
    asked = []

    def swing_around_100_voxels(levels):
        asked.append(levels)
        number = len(asked)
        return dict.fromkeys((1, 2), 100.0 + 20.0 * (-1.0) ** number + number / 100.0)

    levels = choose_levels(two_boxes_side_by_side(), swing_around_100_voxels)

    assert len(asked) == MOST_SWEEPS
    odd_rounds = asked[::2]  # 20 voxels too few, and ever less: those of even rounds are further off
    assert levels == odd_rounds[-1]
