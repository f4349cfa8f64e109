"""What an iso rule says of itself: words for people, entries for reports, and what is taken where nothing is said."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule

VOLUME = Volume(np.array([[[-1000, 900]]], np.int16), np.eye(4))


@pytest.mark.parametrize(
    ("level", "below", "words", "place"),
    [
        (200, False, "200 HU", "at 200 HU"),
        (-400.5, True, "below -400.5 HU", "of what lies below -400.5 HU"),
        ((100, 300), False, "100 to 300 HU", "at 100 to 300 HU"),
    ],
    ids=["above", "below", "between"],
)
def test_a_rule_describes_its_level_and_phrases_where_its_surface_lies(level, below, words, place):
    rule = choose_iso_rule(VOLUME, level, below=below)
    assert (rule.describe(), rule.phrase()) == (words, place)


@pytest.mark.parametrize(
    ("level", "below", "expected"),
    [
        (200, False, (200, 199.5, "above", "linear", [200, None], [199.5, None])),
        (200, True, (200, 199.5, "below", "linear", [None, 200], [None, 199.5])),
        ((100, 300), False, (None, None, "between", "linear", [100, 300], [99.5, 300.5])),
    ],
    ids=["above", "below", "between"],
)
def test_the_report_of_a_rule_has_its_level_and_both_ends_of_what_is_inside(level, below, expected):
    report = choose_iso_rule(VOLUME, level, below=below).as_report()
    assert list(report) == ["iso_value_hu", "iso_level_hu", "inside", "vertex_rule", "inside_hu", "inside_levels_hu"]
    assert tuple(report.values()) == expected


def test_a_rule_made_by_hand_has_one_level_above_which_is_inside_and_scales_nothing():
    rule = IsoRule(iso_value=0.5, lowest_inside=1, iso_level=0.5, outside=0.0, closed=True)
    assert rule.levels == (0.5,)
    assert (rule.value_scale, rule.topology, rule.inside) == (1.0, "separated", "above")


@pytest.mark.parametrize(("closed", "border"), [(True, 1), (False, 0)])
def test_a_rule_that_closes_the_surface_has_a_layer_around_the_volume(closed, border):
    rule = IsoRule(iso_value=0.5, lowest_inside=1, iso_level=0.5, outside=0.0, closed=closed)
    assert rule.border == border
