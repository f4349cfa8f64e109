"""Colours of distances, and the strip beside a picture that says which is which."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.sheets import add_scale
from clrecon.system.color_scale import ColorScale, round_up


def test_colours_of_signed_values_are_blue_below_zero_grey_at_it_and_red_above() -> None:
    below, zero, above = ColorScale(2.0).colors([-2.0, 0.0, 2.0]).astype(int)

    assert below[2] > below[0] + 100  # the ends of RdBu: (33, 102, 172)
    assert zero.tolist() == [222, 222, 222]
    assert above[0] > above[2] + 100  # (178, 24, 43)


def test_colours_of_values_beyond_the_limit_are_those_at_it() -> None:
    scale = ColorScale(2.0)
    assert np.array_equal(scale.colors([-5.0, 9.0]), scale.colors([-2.0, 2.0]))
    assert scale.colors([9.0]).dtype == np.uint8


def test_colours_of_unsigned_values_begin_light_and_darken() -> None:
    scale = ColorScale(2.0, signed=False)

    brightness = scale.colors(np.linspace(0.0, 2.0, 30)).astype(int).sum(axis=1)

    assert scale.colors([0.0])[0].tolist() == [255, 255, 178]
    assert (np.diff(brightness) <= 0).all()
    assert brightness[-1] < brightness[0]


@pytest.mark.parametrize(("signed", "ticks"), [(True, [-2.0, -1.0, 0.0, 1.0, 2.0]), (False, [0.0, 0.5, 1.0, 1.5, 2.0])])
def test_ticks_of_a_colour_scale_run_over_its_range(signed: bool, ticks: list[float]) -> None:
    assert ColorScale(2.0, signed=signed).ticks == ticks


@pytest.mark.parametrize(("value", "limit"), [(0.3, 0.5), (1.0, 1.0), (1.01, 2.0), (7.0, 10.0), (0.0021, 0.005)])
def test_limit_of_a_colour_scale_is_the_next_of_1_2_5_times_a_power_of_ten(value: float, limit: float) -> None:
    assert round_up(value) == pytest.approx(limit, rel=1e-12)


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_colour_scale_of_no_limit_above_0_is_refused(limit: float) -> None:
    with refused(UsageError, 0):
        ColorScale(limit)


@pytest.fixture
def with_scale() -> Rendering:
    """A white picture of 300 x 400 pixels with a scale from -2 to 2 mm beside it."""
    nothing = np.zeros((400, 300), np.float32)
    white = Rendering(np.full((400, 300, 4), 255, np.uint8), nothing, nothing, None)
    return add_scale(white, ColorScale(2.0), "mm, + is\noutside of B")


def test_scale_is_added_at_the_right_of_an_opaque_picture(with_scale: Rendering) -> None:
    assert (with_scale.image[:, :300] == 255).all()
    assert with_scale.image.shape[1] > 340  # 300 of the picture, and the strip; measured 378
    assert with_scale.is_opaque


def test_strip_of_a_scale_has_its_colours_with_the_highest_value_at_the_top(with_scale: Rendering) -> None:
    # Beside the 300 columns of the picture, in text of 400 / 36 = 11.1 pixels: a gap of 0.8, half of a strip of 1.4.
    middle_of_strip = 300 + 9 + 16 // 2
    strip = with_scale.image[:, middle_of_strip, :3].astype(int)

    values = (1.9, 1.0, 0.0, -1.0, -1.9)
    away = [np.abs(strip - ColorScale(2.0).colors([value])[0].astype(int)).max(axis=1) for value in values]
    assert max(rows.min() for rows in away) <= 3  # of 255: 4 mm over some 300 rows
    places = [int(rows.argmin()) for rows in away]
    assert places == sorted(places)
