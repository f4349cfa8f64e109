"""What is drawn into pictures: the right letters, bars of the right length, and room for both."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from picture_files import PARALLEL, PERSPECTIVE, make_picture
from PIL import ImageDraw

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering.pictures.annotations import (
    LONGEST_BAR_SHARE,
    bar_length,
    check_caption,
    edge_letters,
    orientation_letters,
    sheet_letters,
)
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.reformation import straightened_sheet, stretched_sheet

BLACK, WHITE, CLEAR = (0, 0, 0, 255), (255, 255, 255, 255), (0, 0, 0, 0)


@pytest.mark.parametrize(
    ("view", "letters"),
    [
        ("anterior", "RLSI"),
        ("posterior", "LRSI"),
        ("left", "APSI"),
        ("right", "PASI"),
        ("superior", "LRAP"),
        ("inferior", "RLAP"),
    ],
)
def test_letters_of_the_views_are_those_of_the_patient(view, letters):
    camera = Camera.fit(Volume(np.zeros((4, 5, 6), np.int16), np.eye(4)), view)
    assert list(edge_letters(camera).items()) == list(zip(("left", "right", "top", "bottom"), letters, strict=True))


def test_letters_of_an_oblique_view_name_two_and_three_sides():
    assert edge_letters(PARALLEL.orbit(azimuth=30.0, elevation=20.0)) == {
        "left": "RA",
        "right": "LP",
        "top": "SPR",
        "bottom": "IAL",
    }


@pytest.mark.parametrize(
    ("direction", "letters"),
    [
        ((3, 0, 0), "L"),
        ((-1, -2, -3), "IAR"),
        ((1, 1, 0), "LP"),
        ((1, 0.04, 0), "L"),  # less than a twentieth has no letter
        ((1, 0.06, 0), "LP"),
        ((0, -1e-17, -2), "I"),
    ],
)
def test_letters_come_from_the_largest_component_to_the_smallest(direction, letters):
    assert orientation_letters(direction) == letters


def bent_curve(degrees: float) -> Curve:
    """Return a curve downwards that bends to the front by an angle, seen from the left."""
    turns = np.radians(np.linspace(0.0, degrees, 40))
    return Curve(np.column_stack([0.0 * turns, 80.0 * (np.cos(turns) - 1.0), -80.0 * np.sin(turns)]))


@pytest.mark.parametrize(
    ("degrees", "letters"),
    [
        (5.0, {"left": "A", "right": "P", "top": "S", "bottom": "I"}),
        (40.0, {"left": "A", "right": "P", "top": "S", "bottom": "I"}),  # from A to AI: both begin with A
        (80.0, {"left": "", "right": "", "top": "", "bottom": ""}),  # from A to IA: nothing is true everywhere
    ],
)
def test_letter_at_an_edge_along_a_curve_is_true_for_every_row_or_left_out(degrees, letters):
    made = straightened_sheet(bent_curve(degrees), across=np.array([0.0, 1.0, 0.0]), size=(40, 60), pixel=2.0)
    shown = ~np.isnan(made.arc)
    assert sheet_letters(made.sheet, shown) == letters


def test_stretched_picture_has_letters_at_its_sides_alone():
    made = stretched_sheet(bent_curve(60.0), across=np.array([1.0, 0.0, 0.0]), size=(40, 60), pixel=2.0)
    letters = sheet_letters(made.sheet, ~np.isnan(made.arc))
    assert (letters["left"], letters["right"]) == ("R", "L") and letters["top"] == letters["bottom"] == ""


WIDTHS_MM = np.geomspace(1e-3, 1e5, 1000)


def test_length_of_a_scale_bar_is_1_2_or_5_times_a_power_of_ten() -> None:
    lengths = np.array([bar_length(width) for width in WIDTHS_MM])
    digits = lengths / 10.0 ** np.floor(np.log10(lengths) + 1e-9)
    assert np.abs(digits[:, None] - (1, 2, 5)).min(axis=1).max() <= tolerances.ROUND_BAR


def test_scale_bar_takes_from_two_fifths_of_its_largest_share_of_the_width_to_all_of_it() -> None:
    """From 2 to the next length, 5, is the largest step."""
    shares = np.array([bar_length(width) / width for width in WIDTHS_MM])
    assert shares.min() >= 0.4 * LONGEST_BAR_SHARE * (1 - tolerances.ROUND_BAR)
    assert shares.max() <= LONGEST_BAR_SHARE * (1 + tolerances.ROUND_BAR)


def test_scale_bar_that_fits_exactly_is_taken() -> None:
    assert bar_length(100.0 / LONGEST_BAR_SHARE) == 100.0


HALF_A_PIXEL = 0.5
"""A bar is drawn in whole pixels, the nearest to its length."""


def changed_pixels(before, after) -> np.ndarray:
    return (before.image != after.image).any(axis=2)


def longest_run_of_ink(picture, ink) -> np.ndarray:
    """The longest run of the ink's colour in each of the lower rows."""
    runs = []
    for row in (picture.image[picture.image.shape[0] * 3 // 4 :, :, :3] == ink).all(axis=2):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        runs.append((edges[1::2] - edges[::2]).max(initial=0))
    return np.array(runs)


@pytest.mark.parametrize("size", [(300, 200), (301, 333), (640, 480), (1024, 700)])
@pytest.mark.parametrize(("background", "ink"), [(BLACK, 255), (CLEAR, 255)])
def test_scale_bar_is_as_long_as_its_mm_in_pixels(size, background, ink):
    rng = np.random.default_rng(size[0])
    for scale in rng.uniform(1.0, 400.0, 5):
        camera = Camera(position=(0, -900, 0), focal_point=(0, 0, 0), up=(0, 0, 1), parallel_scale=scale)
        picture = make_picture(size, background=background, camera=camera)
        picture.image[:] = background
        marked = picture.annotated(scale_bar=True)
        width, height = size
        pixel_mm = 2 * scale / height
        expected = bar_length(pixel_mm * width) / pixel_mm
        assert abs(longest_run_of_ink(marked, ink).max() - expected) <= HALF_A_PIXEL


def test_scale_bar_on_white_is_black_and_leaves_the_other_pixels():
    # 1 mm a pixel: twice the scale of 100 mm over 200 rows
    picture = make_picture((300, 200), background=WHITE, camera=PARALLEL)

    marked = picture.annotated(scale_bar=True)

    runs = longest_run_of_ink(marked, 0)
    assert runs.max() == 100.0  # mm
    assert np.count_nonzero(runs == 100.0) == 2  # pixels thick
    unchanged = ~changed_pixels(picture, marked)
    assert np.array_equal(marked.image[unchanged], picture.image[unchanged])


def test_scale_bar_of_a_perspective_picture_is_true_in_the_focal_plane_and_says_so(monkeypatch):
    picture = make_picture((400, 300), background=BLACK, camera=PERSPECTIVE)
    picture.image[:] = BLACK
    texts = []
    draw = ImageDraw.ImageDraw.text
    monkeypatch.setattr(
        ImageDraw.ImageDraw,
        "text",
        lambda pen, at, text, *how, **more: texts.append(text) or draw(pen, at, text, *how, **more),
    )
    marked = picture.annotated(scale_bar=True)
    assert set(texts) == {"100 mm (focal plane)"}
    ends, _ = PERSPECTIVE.project([(0, 0, 0), (100, 0, 0)], (400, 300))
    assert abs(longest_run_of_ink(marked, 255).max() - (ends[1, 0] - ends[0, 0])) <= HALF_A_PIXEL


@pytest.mark.parametrize("background", [BLACK, WHITE, CLEAR, (128, 128, 128, 255)])
def test_letters_stand_at_each_edge_and_stand_out_from_the_background(background):
    picture = make_picture((400, 300), background=background)

    marked = picture.annotated(letters=True)

    changed = changed_pixels(picture, marked)
    rows, columns = np.nonzero(changed)
    near = 20  # pixels: a margin and the height of a letter; measured 6 to 8
    assert columns.min() <= near and columns.max() >= 400 - near
    assert rows.min() <= near and rows.max() >= 300 - near
    assert (marked.image[..., 3][changed] > 0).all()  # seen on a transparent background too
    at_the_left = marked.image[140:160, :20].reshape(-1, 4)  # around the middle row, 150
    greys = at_the_left[at_the_left[:, 3] == 255, 0].astype(int)
    assert np.ptp(greys) >= 120  # of 255: ink and its rim


def test_annotations_leave_the_picture_that_they_are_drawn_from():
    picture = make_picture((400, 300), background=BLACK)
    picture.annotated(letters=True)
    assert np.array_equal(picture.image, make_picture((400, 300), background=BLACK).image)


def test_picture_of_64_pixels_has_room_for_letters_and_scale_bar():
    picture = make_picture((64, 64), camera=PARALLEL)
    with_letters = picture.annotated(letters=True)
    letters = changed_pixels(picture, with_letters)

    with_both = picture.annotated(letters=True, scale_bar=True)

    pixel_mm = 2 * PARALLEL.parallel_scale / 64
    assert letters.any()
    assert np.array_equal(with_both.image[letters], with_letters.image[letters])  # the bar lies over none
    assert longest_run_of_ink(with_both, 255).max() == bar_length(64 * pixel_mm) / pixel_mm


@pytest.mark.parametrize("caption", ["größe", "\u8179", "T12 \u00b2"])
def test_caption_with_a_letter_that_the_font_lacks_is_refused(caption):
    absent = next(letter for letter in caption if ord(letter) > 127)
    with pytest.raises(UsageError, match=absent):
        make_picture((400, 300)).annotated(caption=caption)


def test_caption_of_ascii_and_a_degree_sign_is_accepted():
    assert check_caption("T12 ~ 5 mm, 30\u00b0 (a_b)\ttab") is None


def test_long_caption_is_cut_where_the_picture_ends():
    picture = make_picture((200, 100))
    short, long = (changed_pixels(picture, picture.annotated(caption=text)) for text in ("Ab", "A long line " * 20))

    assert np.nonzero(short)[1].max() < 40  # two letters of 200 columns; measured 14
    assert 150 < np.nonzero(long)[1].max() < 200  # as far as whole letters fit; measured 191


def test_long_caption_is_cut_before_the_letter_at_the_top():
    with_letters = make_picture((200, 100)).annotated(letters=True)
    with_caption = make_picture((200, 100)).annotated(letters=True, caption="A long line " * 20)

    middle_of_the_width = 100
    assert np.nonzero(changed_pixels(with_letters, with_caption))[1].max() < middle_of_the_width


def test_annotations_that_are_not_asked_for_leave_the_picture():
    picture = make_picture()
    assert picture.annotated() is picture


@pytest.mark.parametrize(
    ("picture", "wanted", "message"),
    [
        (make_picture((63, 200)), {"letters": True}, "at least 64 x 64"),
        (make_picture((64, 64), camera=PERSPECTIVE), {"scale_bar": True}, "no room for '50 mm \\(focal plane\\)'"),
        (make_picture(camera=None), {"letters": True}, "sides of the patient at the edges"),
        (make_picture(camera=None), {"scale_bar": True}, "size of this picture's pixels is not known"),
    ],
)
def test_annotations_without_room_or_camera_are_refused(picture, wanted, message):
    with pytest.raises(UsageError, match=message):
        picture.annotated(**wanted)
