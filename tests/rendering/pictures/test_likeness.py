"""Likeness of pictures whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.reading import read_volume
from clrecon.rendering.pictures.likeness import make_control_pictures, measure_pictures

pytestmark = pytest.mark.unit


def picture(shape=(40, 50), top=10, left=12, size=20) -> np.ndarray:
    pixels = np.zeros(shape, np.uint8)
    pixels[top : top + size, left : left + size] = np.random.default_rng(3).integers(1, 256, (size, size))
    return pixels


def test_equal_pictures_have_no_error():
    found = measure_pictures(picture(), picture())
    assert (found.mse, found.ssim, found.box) == (0.0, 1.0, (10, 12, 30, 32))


def test_the_box_holds_what_is_drawn_in_either():
    one, other = picture(), picture(top=15, left=5)
    assert measure_pictures(one, other).box == (10, 5, 35, 32)
    assert measure_pictures(one, other, whole=True).box == (0, 0, 40, 50)


def test_figures_are_those_of_scikit_image_and_by_hand():
    from skimage.metrics import structural_similarity

    one, other = picture(), np.roll(picture(), 1, axis=0)
    found = measure_pictures(one, other)
    inner = np.s_[10:31, 12:32]
    assert found.ssim == pytest.approx(structural_similarity(one[inner], other[inner], win_size=7, data_range=255))
    assert found.mse == pytest.approx(np.mean((one[inner].astype(float) - other[inner]) ** 2))
    flat = np.full((20, 20), 100, np.uint8)
    brighter = measure_pictures(flat, flat + np.uint8(10))
    assert brighter.mse == 100.0
    c1 = (0.01 * 255) ** 2
    assert brighter.ssim == pytest.approx((2 * 100 * 110 + c1) / (100**2 + 110**2 + c1))  # without structure


def test_a_small_thing_gets_the_window_of_ssim():
    one = np.zeros((9, 30), np.uint8)
    one[8, 29] = 200
    assert measure_pictures(one, one).box == (2, 23, 9, 30)
    assert measure_pictures(one[::-1, ::-1], one[::-1, ::-1]).box == (0, 0, 7, 7)


def test_pictures_are_compared_in_grey_over_the_background():
    grey = picture()
    colour = np.stack([grey] * 3, axis=2)
    clear = np.dstack([np.where(grey[:, :, None] > 0, colour, 77), np.where(grey > 0, 255, 0)]).astype(np.uint8)
    assert measure_pictures(colour, clear).as_dict() == {"mse": 0.0, "ssim": 1.0, "box": [10, 12, 30, 32]}
    white = np.where(colour > 0, colour, 255).astype(np.uint8)
    assert measure_pictures(white, clear, background=(255, 255, 255)).mse == 0.0


def test_control_pictures_are_unlike_the_original():
    grey = picture()
    controls = make_control_pictures(grey, picture(top=11))
    assert list(controls) == ["black", "white", "noise", "shifted", "next"]
    assert all(control.shape == grey.shape and control.dtype == np.uint8 for control in controls.values())
    assert np.array_equal(controls["shifted"][:, 5:], grey[:, :-5])
    assert measure_pictures(controls["white"], grey, whole=True).mse > measure_pictures(controls["black"], grey).mse
    assert measure_pictures(controls["noise"], grey).ssim < 0.1
    assert np.array_equal(controls["noise"], make_control_pictures(grey)["noise"])


@pytest.mark.parametrize(
    ("one", "other", "said"),
    [
        (np.zeros((8, 8), np.uint8), np.zeros((8, 8), np.uint8), "nothing is drawn"),
        (picture(), picture((41, 50)), r"these have \(40, 50, 1\) and \(41, 50, 1\)"),
        (np.ones((6, 50), np.uint8), np.ones((6, 50), np.uint8), "50 x 6 pixels is smaller than the window"),
        (picture().astype(float), picture(), "type uint8, this one has .* and float64"),
    ],
)
def test_what_cannot_be_compared_is_refused(one, other, said):
    with pytest.raises(UsageError, match=said):
        measure_pictures(one, other)


def test_a_background_that_is_no_colour_is_refused():
    with refused(UsageError, 0, 255):
        measure_pictures(picture(), picture(), background=300)


def test_controls_of_a_real_slice_are_those_of_the_documents(real_data):
    voxels = read_volume(real_data / "thoracic_0p8mm").voxels.astype(np.float64)
    one, after = (np.rint(np.clip((voxels[k] + 200.0) / 1000.0, 0.0, 1.0) * 255.0).astype(np.uint8) for k in (47, 48))
    found = {
        name: measure_pictures(control, one, whole=True) for name, control in make_control_pictures(one, after).items()
    }
    assert {name: round(figures.ssim, 3) for name, figures in found.items()} == {
        "black": 0.548, "white": 0.087, "noise": 0.003, "shifted": 0.711, "next": 0.93
    }  # fmt: skip
    assert [round(figures.mse) for figures in found.values()] == [2141, 53847, 17207, 488, 43]
