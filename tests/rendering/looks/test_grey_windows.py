"""Windows by numbers and by name."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.looks.window import WINDOWS, checked_window, grey_image
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut, Projection, SlicesInSpace


@pytest.mark.parametrize(
    ("name", "level", "width"),
    [("lung", -600, 1500), ("soft", 50, 400), ("abdomen", 50, 400), ("mediastinum", 50, 350), ("brain", 40, 80),
     ("bone", 300, 1500)],
)  # fmt: skip
def test_name_of_a_window_in_any_case_stands_for_its_level_and_width(name, level, width):
    assert checked_window(name) == (level - width / 2, level + width / 2) == WINDOWS[name]
    assert checked_window(f" {name.upper()} ") == WINDOWS[name]


@pytest.mark.parametrize(
    "style",
    [Projection("mip", window="Lung"), PlaneCut(window="lung"), SlicesInSpace(window="LUNG"), CurveCut(window="lung")],
    ids=["projection", "slice", "slices in space", "curve"],
)
def test_style_with_a_window_takes_its_name(style):
    assert style.window == WINDOWS["lung"]


def test_grey_image_in_a_named_window_is_black_grey_and_white_over_it():
    grey = grey_image(np.array([[-1350.0, -600.0, 150.0]]), "lung")  # level -600, width 1500
    assert grey[0, :, 0].tolist() == [0, 128, 255]


def test_unknown_name_of_a_window_is_refused():
    with refused(UsageError, "liver", "window"):
        checked_window("liver")


def test_name_of_a_window_for_a_radiograph_in_mm_of_water_is_refused():
    with refused(UsageError, "lung", "water"):
        Projection("drr", window="lung")


@pytest.mark.parametrize("shape", [(0, 7), (1, 1), (130, 127), (3, 16_384)])
def test_grey_of_each_pixel_is_its_share_of_the_window(shape):
    values = np.random.default_rng(1).uniform(-200, 1200, shape).astype(np.float32)
    values[:, ::5] = np.nan
    pixels = grey_image(values, (0, 1000))
    shades = np.rint(255 * np.clip(np.nan_to_num(values) / np.float32(1000), 0, 1))
    assert np.array_equal(pixels[..., :3], np.repeat(shades[..., None], 3, axis=2))
    assert np.array_equal(pixels[..., 3], np.where(np.isnan(values), 0, 255))
