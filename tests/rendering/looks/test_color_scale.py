"""Colours of distances, and the strip beside a picture that says which is which."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.looks.colors import ColorScale, round_up
from clrecon.rendering.pictures.sheets import add_scale


def test_colours_of_distances_are_blue_below_zero_and_red_above() -> None:
    colors = ColorScale(2.0).colors([-5.0, -2.0, 0.0, 2.0, 9.0])
    assert colors.dtype == np.uint8 and np.array_equal(colors[0], colors[1]) and np.array_equal(colors[3], colors[4])
    assert colors[2].tolist() == [222, 222, 222]
    assert colors[0][2] > colors[0][0] + 100 and colors[3][0] > colors[3][2] + 100  # blue below zero, red above
    assert ColorScale(2.0).ticks == [-2.0, -1.0, 0.0, 1.0, 2.0]
    one = ColorScale(2.0, signed=False)
    assert one.ticks == [0.0, 0.5, 1.0, 1.5, 2.0] and one.colors([0.0])[0].tolist() == [255, 255, 178]
    brightness = one.colors(np.linspace(0.0, 2.0, 30)).astype(int).sum(axis=1)
    assert (np.diff(brightness) <= 0).all()


@pytest.mark.parametrize(("value", "limit"), [(0.3, 0.5), (1.0, 1.0), (1.01, 2.0), (7.0, 10.0), (0.0021, 0.005)])
def test_limits_of_colour_scales_are_round(value: float, limit: float) -> None:
    assert round_up(value) == pytest.approx(limit, rel=1e-12)


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_is_above_zero(limit: float) -> None:
    with refused(UsageError, 0):
        ColorScale(limit)


def test_the_strip_stands_at_the_right_and_has_all_colours() -> None:
    image = np.full((400, 300, 4), 255, np.uint8)
    nothing = np.zeros((400, 300), np.float32)
    picture, scale = Rendering(image, nothing, nothing, None), ColorScale(2.0)
    made = add_scale(picture, scale, "mm, + is\noutside of B")
    assert np.array_equal(made.image[:, :300], image) and made.image.shape[1] > 340 and made.is_opaque
    column = made.image[:, 300 + 18, :3].astype(int)
    for value in (-1.9, -1.0, 0.0, 1.0, 1.9):
        color = scale.colors([value])[0].astype(int)
        assert np.abs(column - color).max(axis=1).min() <= 3, value
    rows = [int(np.abs(column - scale.colors([value])[0]).max(axis=1).argmin()) for value in (1.5, 0.5, -0.5, -1.5)]
    assert rows == sorted(rows)
