"""The levels that are tried for the volume of a label, before two of them enclose the wanted one."""

from __future__ import annotations

from clrecon.labels.occupancy import LEVELS, START, next_level


def test_a_step_too_far_goes_half_way_to_the_end():
    assert next_level([], 100.0, -1.0) == START
    # Newton's step would be far beyond the lowest and the highest level.
    assert next_level([(START, 50.0)], 100.0, -1e-9) == (LEVELS[0] - 1 + START) // 2
    assert next_level([(START, 100.0)], 50.0, -1e-9) == (START + LEVELS[1] + 1) // 2


def test_newton_and_then_between_two_levels():
    assert next_level([(START, 110.0)], 100.0, -2.0) == START + 5
    assert next_level([(START, 100.01)], 100.0, -2.0) == START  # less than 3 in 10,000 off
    assert next_level([(1000, 130.0), (1100, 90.0)], 100.0, -2.0) == 1075
