"""Likeness of pictures whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.reading import read_volume
from clrecon.rendering.pictures.likeness import make_control_pictures, measure_pictures

pytestmark = pytest.mark.unit


def make_drawn_square(shape=(40, 50), top=10, left=12, size=20) -> np.ndarray:
    """A black picture with a square of random greys above 0."""
    pixels = np.zeros(shape, np.uint8)
    pixels[top : top + size, left : left + size] = np.random.default_rng(3).integers(1, 256, (size, size))
    return pixels


def test_equal_pictures_have_no_error_and_a_likeness_of_1():
    square = make_drawn_square(top=10, left=12, size=20)
    found = measure_pictures(square, square.copy())
    assert (found.mse, found.ssim, found.box) == (0.0, 1.0, (10, 12, 10 + 20, 12 + 20))


def test_pictures_are_compared_in_the_box_of_what_is_drawn_in_either():
    one, other = make_drawn_square(top=10, left=12, size=20), make_drawn_square(top=15, left=5, size=20)
    assert measure_pictures(one, other).box == (10, 5, 15 + 20, 12 + 20)


def test_pictures_are_compared_as_a_whole_on_request():
    square = make_drawn_square(shape=(40, 50))
    assert measure_pictures(square, square.copy(), whole=True).box == (0, 0, 40, 50)


def test_likeness_of_pictures_is_that_of_scikit_image_and_their_error_the_mean_square():
    from skimage.metrics import structural_similarity

    one = make_drawn_square(top=10, left=12, size=20)
    other = np.roll(one, 1, axis=0)

    found = measure_pictures(one, other)

    box = np.s_[10 : 10 + 20 + 1, 12 : 12 + 20]  # of both squares
    assert found.ssim == pytest.approx(structural_similarity(one[box], other[box], win_size=7, data_range=255))
    assert found.mse == pytest.approx(np.mean((one[box].astype(float) - other[box]) ** 2))


def test_likeness_of_even_pictures_is_that_of_their_means():
    flat = np.full((20, 20), 100, np.uint8)

    brighter = measure_pictures(flat, flat + np.uint8(10))

    c1 = (0.01 * 255) ** 2  # of the definition of SSIM
    assert brighter.mse == 10.0**2
    assert brighter.ssim == pytest.approx((2 * 100 * 110 + c1) / (100**2 + 110**2 + c1))


def test_box_of_a_single_pixel_grows_to_the_seven_pixels_of_the_window_of_ssim():
    in_last_corner = np.zeros((9, 30), np.uint8)
    in_last_corner[8, 29] = 200
    in_first_corner = in_last_corner[::-1, ::-1]

    assert measure_pictures(in_last_corner, in_last_corner).box == (2, 23, 9, 30)
    assert measure_pictures(in_first_corner, in_first_corner).box == (0, 0, 7, 7)


@pytest.mark.parametrize("background", [0, 255], ids=["black", "white"])
def test_transparent_pictures_are_compared_in_grey_over_the_background(background):
    grey = make_drawn_square(top=10, left=12, size=20)
    is_drawn = grey[:, :, None] > 0
    in_colour = np.where(is_drawn, np.stack([grey] * 3, axis=2), background).astype(np.uint8)
    hidden = 77  # of pixels without opacity
    transparent = np.dstack([np.where(is_drawn, in_colour, hidden), np.where(grey > 0, 255, 0)]).astype(np.uint8)

    found = measure_pictures(in_colour, transparent, background=(background,) * 3)

    assert found.as_dict() == {"mse": 0.0, "ssim": 1.0, "box": [10, 12, 10 + 20, 12 + 20]}


def test_control_pictures_have_the_form_of_the_original():
    grey = make_drawn_square()
    controls = make_control_pictures(grey, make_drawn_square(top=11))
    assert list(controls) == ["black", "white", "noise", "shifted", "next"]
    assert {(control.shape, control.dtype) for control in controls.values()} == {(grey.shape, grey.dtype)}


def test_shifted_control_picture_is_the_original_five_pixels_on():
    grey = make_drawn_square()
    assert np.array_equal(make_control_pictures(grey)["shifted"][:, 5:], grey[:, :-5])


def test_control_pictures_of_white_and_noise_are_unlike_the_original():
    grey = make_drawn_square()
    controls = make_control_pictures(grey)
    errors = {name: measure_pictures(controls[name], grey, whole=True).mse for name in ("white", "black")}
    assert errors["white"] > errors["black"]  # most of the original is black
    assert measure_pictures(controls["noise"], grey).ssim < 0.02  # measured 0.007


def test_control_picture_of_noise_is_the_same_each_time():
    grey = make_drawn_square()
    assert np.array_equal(make_control_pictures(grey)["noise"], make_control_pictures(grey)["noise"])


@pytest.mark.parametrize(
    ("one", "other", "said"),
    [
        (np.zeros((8, 8), np.uint8), np.zeros((8, 8), np.uint8), "nothing is drawn"),
        (
            make_drawn_square(shape=(40, 50)),
            make_drawn_square(shape=(41, 50)),
            r"these have \(40, 50, 1\) and \(41, 50, 1\)",
        ),
        (np.ones((6, 50), np.uint8), np.ones((6, 50), np.uint8), "50 x 6 pixels is smaller than the window"),
        (make_drawn_square().astype(float), make_drawn_square(), "type uint8, this one has .* and float64"),
    ],
)
def test_pictures_that_cannot_be_compared_are_refused(one, other, said):
    with pytest.raises(UsageError, match=said):
        measure_pictures(one, other)


def test_background_that_is_no_colour_is_refused():
    with refused(UsageError, 0, 255, 300):  # the range, and what is given
        measure_pictures(make_drawn_square(), make_drawn_square(), background=300)


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
