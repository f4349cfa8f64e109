"""What is inside, where the surface lies, what is beyond the border."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from uneven_volume import HEIGHTS, SIDEWAYS, uneven

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import AIR_HU, Volume
from clrecon.geometry.iso_rule import ValueRange, choose_iso_rule, layer_margins, vertex_margin


def make_volume(*, low: float, high: float, dtype: str = "int16") -> Volume:
    """Voxels of 0.7 x 0.5 x 2.5 mm of a low value, one of them of a high one."""
    voxels = np.full((3, 4, 5), low, dtype)
    voxels[1, 2, 3] = high
    return Volume(voxels, np.diag((0.7, 0.5, 2.5, 1.0)))


def test_an_integer_level_of_integers_lies_half_a_unit_below_it():
    rule = choose_iso_rule(make_volume(low=-1000, high=900), 200)
    assert (rule.lowest_inside, rule.iso_level) == (200, 199.5)


def test_a_fractional_level_of_integers_is_kept_and_the_next_integer_is_inside():
    rule = choose_iso_rule(make_volume(low=-1000, high=900), 200.25)
    assert (rule.lowest_inside, rule.iso_level) == (201, 200.25)


def test_floats_are_inside_from_the_level_on():
    rule = choose_iso_rule(make_volume(low=-1.0, high=1.0, dtype="float32"), 0.25)
    assert (rule.lowest_inside, rule.iso_level) == (0.25, 0.25)


@pytest.mark.parametrize(("low", "outside"), [(-3024, AIR_HU), (-1000, -1000), (3, 3)])
def test_the_value_outside_is_the_lowest_of_the_volume_but_not_below_air(low, outside):
    assert choose_iso_rule(make_volume(low=low, high=900), 200).outside == outside


@pytest.mark.parametrize(("low", "iso_value"), [(300, 200), (-1024, -1500), (200, 200)])
def test_the_value_outside_lies_below_the_level_where_all_voxels_are_inside(low, iso_value):
    rule = choose_iso_rule(make_volume(low=low, high=900), iso_value)
    assert rule.outside < rule.iso_level


@pytest.mark.parametrize("order", [1, -1])
def test_the_value_outside_is_found_in_the_first_and_in_the_last_slice(order):
    voxels = np.arange(60, dtype=np.int16).reshape(3, 4, 5)[::order] - 7
    assert choose_iso_rule(Volume(voxels, np.eye(4)), 20).outside == -7


@pytest.mark.parametrize(("value", "dtype"), [(300, "int16"), (1e8, "float32"), (-1e8, "float32"), (1e-20, "float32")])
def test_the_value_outside_of_a_constant_volume_lies_below_the_level_in_float32(value, dtype):
    rule = choose_iso_rule(Volume(np.full((2, 2, 2), value, dtype), np.eye(4)), value)
    assert np.float32(rule.outside) < np.float32(rule.iso_level) <= np.float32(value)


def test_the_value_outside_of_constant_integers_lies_half_a_unit_below_the_level():
    rule = choose_iso_rule(Volume(np.full((2, 2, 2), 300, np.int16), np.eye(4)), 300)
    assert (rule.iso_level, rule.outside) == (299.5, 299.0)


@pytest.mark.parametrize(
    ("level", "outside"),
    [(2.0**24, 2.0**24 - 16.0), (-(2.0**24), -(2.0**24) - 16.0), (100.0, 99.5)],
    ids=["high", "low", "small"],
)
def test_the_value_outside_lies_half_a_unit_or_2_to_the_minus_20_of_the_level_below_it(level, outside):
    """At 2^24, where float32 comes in steps of 2, that share is 16."""
    volume = Volume(np.full((2, 2, 2), 2.0**24, np.float32), np.eye(4))
    assert choose_iso_rule(volume, level).outside == outside


@pytest.mark.parametrize(
    ("dtype", "low", "level", "outside"),
    [
        ("float32", -1000, 200.25, 1400.5),
        ("float32", 300, 200.0, 200.0 + 0.5),
        ("int16", -1000, 200.25, 1401.0),
        ("int16", -1000, 200, 1399.0),
        ("int16", 300, 200, 199.5 + 0.5),
    ],
)
def test_the_value_outside_of_a_surface_below_a_level_is_as_far_above_as_the_lowest_is_below_or_half_a_unit(
    dtype, low, level, outside
):
    assert choose_iso_rule(make_volume(low=low, high=900, dtype=dtype), level, below=True).outside == outside


@pytest.mark.parametrize(
    ("level", "below", "outside"),
    [(-(2**29), False, -(2**29) - 1), (-(2**31), False, -(2**30)), (2**29, True, 2**29), (2**31, True, 2**30)],
)
def test_the_value_outside_of_integers_lies_within_2_to_the_30_on_either_side_of_0(level, below, outside):
    assert choose_iso_rule(make_volume(low=-1000, high=900), level, below=below).outside == outside


@pytest.mark.parametrize(("figure", "slices"), [("ends", 4), ("lowest", 2)])
def test_slices_are_released_one_by_one_and_the_lowest_value_is_sought_up_to_the_first_with_air(
    monkeypatch, figure, slices
):
    released = []
    monkeypatch.setattr(Volume, "release_slices", lambda self, first, end: released.append((first, end)))
    voxels = np.zeros((4, 4, 5), np.int16)
    voxels[2] = AIR_HU  # no lower value matters: the last slice is looked at for both ends alone
    getattr(ValueRange(Volume(voxels, np.eye(4))), figure)
    assert released == [(k, k + 1) for k in range(slices)]


@pytest.mark.parametrize(("value", "scale"), [(1.0, 0.5), (900.0, 2.0**-10), (1e-40, 2.0**126)])
def test_floats_are_scaled_below_one_by_a_power_of_two_that_float32_holds(value, scale):
    assert choose_iso_rule(Volume(np.full((2, 2, 2), value, np.float32), np.eye(4)), value).value_scale == scale


def test_integers_are_not_scaled():
    assert choose_iso_rule(make_volume(low=0, high=900), 200).value_scale == 1.0


@pytest.mark.parametrize(
    ("low", "high", "dtype", "iso_value", "limit"),
    [
        (0, 2**23, "int32", 5, 2**23),
        (-(2**23), 0, "int32", -5, 2**23),
        (0, 1e31, "float32", 5, 1e30),
        (-1e31, 0, "float32", 5, 1e30),
        (0, 1, "float32", 1e31, 1e30),
        (0, 9, "int16", -1e300, 1e30),
    ],
    ids=["high integers", "low integers", "high floats", "low floats", "level of floats", "level of integers"],
)
def test_values_and_levels_between_which_float32_cannot_interpolate_are_refused(low, high, dtype, iso_value, limit):
    with refused(UsageError, limit):
        choose_iso_rule(make_volume(low=low, high=high, dtype=dtype), iso_value)


@pytest.mark.parametrize("bad", ["abc", None, {}])
def test_an_iso_value_that_is_no_number_is_refused(bad):
    with refused(UsageError, "number"):
        choose_iso_rule(make_volume(low=0, high=1), bad)


def test_a_volume_whose_steps_float32_cannot_hold_beside_its_size_is_refused():
    affine = np.diag((1e4, 1e4, 1e-3, 1.0))  # columns 10 m apart, slices a micrometre
    from_the_centre_mm = 3 * 1e4  # two of five columns, and the layer around
    with refused(UsageError, "float32", from_the_centre_mm):
        vertex_margin(Volume(np.zeros((3, 4, 5), np.int16), affine), border=1)


def margin_at(x_mm: float) -> np.ndarray:
    """The margin of vertices, in voxels of 0.1 mm, of a volume so far from the origin."""
    affine = np.diag((0.1, 0.1, 0.1, 1.0)) + np.eye(4, k=3) * x_mm
    return vertex_margin(Volume(np.zeros((3, 4, 5), np.int16), affine), border=1)


def test_the_margin_near_the_origin_is_four_steps_of_float32():
    step_at_4000_mm = 2.0**-12
    assert margin_at(4000.0) == pytest.approx(4.0 * step_at_4000_mm / 0.1)


def test_the_margin_far_from_the_origin_is_that_of_coordinates_from_the_centre():
    assert margin_at(1e6).max() < 1e-4  # a step of float32 is 0.06 mm there, 0.6 voxels


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_iso_value_that_is_not_finite_is_refused(bad):
    with refused(UsageError, "finite"):
        choose_iso_rule(make_volume(low=0, high=1), bad)


@pytest.mark.parametrize(("bad", "word"), [(np.nan, "NaN"), (np.inf, "infinite")])
def test_voxels_that_are_not_finite_are_refused(bad, word):
    with refused(NoSurfaceError, word):
        choose_iso_rule(make_volume(low=0.0, high=bad, dtype="float32"), 0.5)


def test_the_margin_is_four_steps_of_float32_in_voxels_of_each_axis():
    affine = np.diag((0.5, 0.25, 2.0, 1.0))
    affine[0, 3] = -800.0
    step_at_800_mm = 2.0**-14
    margin = vertex_margin(Volume(np.zeros((3, 4, 5), np.int16), affine), border=1)
    assert margin == pytest.approx(4 * step_at_800_mm / np.array((0.5, 0.25, 2.0)))


@pytest.mark.parametrize(
    ("dtype", "lowest", "level", "highest", "upper"),
    [("int16", 200, 199.5, 300, 300.5), ("float32", 200.0, 200.0, 300.0, 300.0)],
)
def test_the_ends_of_a_range_of_integers_lie_half_a_unit_beyond_and_those_of_floats_at_the_values(
    dtype, lowest, level, highest, upper
):
    rule = choose_iso_rule(make_volume(low=-1000, high=900, dtype=dtype), [200, 300])
    assert (rule.inside, rule.iso_value, rule.upper_value) == ("between", 200, 300)
    assert (rule.lowest_inside, rule.iso_level) == (lowest, level)
    assert (rule.highest_inside, rule.upper_level) == (highest, upper)


@pytest.mark.parametrize("level", [200, 200.0, np.int16(200), np.float32(200.0), np.array(200)])
def test_a_number_of_python_or_numpy_is_one_level(level):
    assert choose_iso_rule(make_volume(low=-1000, high=900), level) == choose_iso_rule(
        make_volume(low=-1000, high=900), 200
    )


@pytest.mark.parametrize(
    ("level", "below", "words"),
    [
        ((200, 300, 400), False, (300, 400)),
        ((300, 200), False, (300, 200, "HU")),
        ((200, 200), False, (200, "HU")),
        ((200, 300), True, (200, 300)),
    ],
    ids=["three numbers", "upper end below", "equal ends", "range and below"],
)
def test_levels_that_are_no_range_of_two_are_refused(level, below, words):
    with refused(UsageError, *words):
        choose_iso_rule(make_volume(low=-1000, high=900), level, below=below)


@pytest.mark.parametrize("border", [0, 1])
def test_each_layer_has_a_margin_of_four_steps_of_float32(border):
    lengths = np.hypot(np.diff(HEIGHTS), 0.7 * np.diff(SIDEWAYS))  # columns are 0.7 mm apart
    lengths = np.concatenate([lengths[:1]] * border + [lengths, lengths[-1:]] + [lengths[-1:]] * border)
    # The largest coordinate is about 700 mm: from 512 to 1024 float32 comes in steps of 2^-14.
    np.testing.assert_allclose(layer_margins(uneven(), border), 4.0 * 2.0**-14 / lengths, rtol=1e-9)


@pytest.mark.parametrize(
    ("level", "below", "inside"),
    [
        (200, False, [False, True, True, True, True]),
        (200, True, [True, False, False, False, False]),
        ([200, 300], False, [False, True, True, True, False]),
    ],
)
def test_values_at_the_ends_are_inside_above_and_between_and_outside_below(level, below, inside):
    rule = choose_iso_rule(make_volume(low=-1000, high=900), level, below=below)
    assert rule.mark_inside(np.array([199, 200, 250, 300, 301])).tolist() == inside
