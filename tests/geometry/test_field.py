"""What is inside, where the surface lies, what is beyond the border."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import AIR_HU, Volume
from clrecon.geometry.field import choose_iso_rule, vertex_margin


def make_volume(low: float, high: float, dtype: str = "int16") -> Volume:
    voxels = np.full((3, 4, 5), low, dtype)
    voxels[1, 2, 3] = high
    return Volume(voxels, np.diag((0.7, 0.5, 2.5, 1.0)))


def test_an_integer_level_lies_between_the_integers():
    rule = choose_iso_rule(make_volume(-1000, 900), 200)
    assert (rule.lowest_inside, rule.iso_level) == (200, 199.5)


def test_a_fractional_level_of_integers_is_kept():
    rule = choose_iso_rule(make_volume(-1000, 900), 200.25)
    assert (rule.lowest_inside, rule.iso_level) == (201, 200.25)


def test_floats_use_the_level_itself():
    rule = choose_iso_rule(make_volume(-1.0, 1.0, "float32"), 0.25)
    assert (rule.lowest_inside, rule.iso_level) == (0.25, 0.25)


@pytest.mark.parametrize(("low", "outside"), [(-3024, AIR_HU), (-1000, -1000), (3, 3)])
def test_outside_is_the_lowest_value_but_not_below_air(low, outside):
    assert choose_iso_rule(make_volume(low, 900), 200).outside == outside


@pytest.mark.parametrize(("low", "iso_value"), [(300, 200), (-1024, -1500), (200, 200)])
def test_outside_stays_outside_when_everything_is_inside(low, iso_value):
    rule = choose_iso_rule(make_volume(low, 900), iso_value)
    assert rule.outside < rule.iso_level


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    with pytest.raises(UsageError, match="finite"):
        choose_iso_rule(make_volume(0, 1), bad)
    with pytest.raises(NoSurfaceError, match="NaN|infinite"):
        choose_iso_rule(make_volume(0.0, bad, "float32"), 0.5)


def test_the_margin_is_four_units_in_the_last_place():
    volume = Volume(np.zeros((3, 4, 5), np.int16), np.array(
        [[0.5, 0, 0, -800.0], [0, 0.25, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]))  # fmt: skip
    unit = 2.0**-14  # float32 between 512 and 1024
    assert vertex_margin(volume, 1) == pytest.approx(np.array((8, 16, 2)) * unit)
