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
    assert edge_letters(PARALLEL.orbit(30.0, 20.0)) == {"left": "RA", "right": "LP", "top": "SPR", "bottom": "IAL"}


@pytest.mark.parametrize(
    ("direction", "letters"),
    [
        ((3, 0, 0), "L"),
        ((-1, -2, -3), "IAR"),
        ((1, 1, 0), "LP"),
        ((1, 0.04, 0), "L"),
        ((1, 0.06, 0), "LP"),
        ((0, -1e-17, -2), "I"),
    ],
)
def test_letters_come_from_the_largest_component_to_the_smallest(direction, letters):
    assert orientation_letters(direction) == letters


def _arc(degrees: float) -> Curve:
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
def test_letters_along_a_curve_are_true_for_every_row_or_left_out(degrees, letters):
    made = straightened_sheet(_arc(degrees), np.array([0.0, 1.0, 0.0]), (40, 60), 2.0)
    shown = ~np.isnan(made.arc)
    assert sheet_letters(made.sheet, shown) == letters


def test_the_rows_of_a_stretched_picture_have_one_direction():
    made = stretched_sheet(_arc(60.0), np.array([1.0, 0.0, 0.0]), (40, 60), 2.0)
    letters = sheet_letters(made.sheet, ~np.isnan(made.arc))
    assert (letters["left"], letters["right"]) == ("R", "L") and letters["top"] == letters["bottom"] == ""


def test_bars_are_round_and_as_long_as_they_may_be():
    for width in np.geomspace(1e-3, 1e5, 1000):
        length = bar_length(width)
        digit = length / 10.0 ** np.floor(np.log10(length) + 1e-9)
        assert min(abs(digit - one) for one in (1, 2, 5)) <= tolerances.ROUND_BAR
        assert 0.14 * width <= length <= LONGEST_BAR_SHARE * width * (1 + tolerances.ROUND_BAR)
    assert bar_length(1000 / 3.5) == 100.0


def drawn(before, after) -> np.ndarray:
    return (before.image != after.image).any(axis=2)


def bar_pixels(picture, ink) -> np.ndarray:
    """The longest run of the ink's colour in each of the lower rows."""
    runs = []
    for row in (picture.image[picture.image.shape[0] * 3 // 4 :, :, :3] == ink).all(axis=2):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        runs.append((edges[1::2] - edges[::2]).max(initial=0))
    return np.array(runs)


@pytest.mark.parametrize("size", [(300, 200), (301, 333), (640, 480), (1024, 700)])
@pytest.mark.parametrize(("background", "ink"), [(BLACK, 255), (CLEAR, 255)])
def test_the_bar_is_as_long_as_it_says(size, background, ink):
    rng = np.random.default_rng(size[0])
    for scale in rng.uniform(1.0, 400.0, 5):
        camera = Camera((0, -900, 0), (0, 0, 0), (0, 0, 1), parallel_scale=scale)
        picture = make_picture(size, background, camera)
        picture.image[:] = background
        marked = picture.annotated(scale_bar=True)
        pixel = 2 * scale / size[1]
        assert abs(bar_pixels(marked, ink).max() - bar_length(pixel * size[0]) / pixel) <= 0.5


def test_scale_bar_on_white_is_black():
    picture = make_picture((300, 200), WHITE)
    marked = picture.annotated(scale_bar=True)
    bar = bar_pixels(marked, 0)
    assert bar.max() == 100.0 and np.count_nonzero(bar == 100.0) == 2  # 100 mm at 1 mm a pixel, 2 pixels thick
    assert marked.image[~drawn(picture, marked)].tolist() == picture.image[~drawn(picture, marked)].tolist()


def test_a_perspective_bar_holds_in_the_focal_plane(monkeypatch):
    picture = make_picture((400, 300), BLACK, PERSPECTIVE)
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
    assert abs(bar_pixels(marked, 255).max() - (ends[1, 0] - ends[0, 0])) <= 0.5


@pytest.mark.parametrize("background", [BLACK, WHITE, CLEAR, (128, 128, 128, 255)])
def test_letters_stand_out_at_every_edge(background):
    picture = make_picture((400, 300), background)
    marked = picture.annotated(letters=True)
    changed = drawn(picture, marked)
    y, x = np.nonzero(changed)
    assert x.min() <= 20 and x.max() >= 380 and y.min() <= 20 and y.max() >= 280
    near_left = marked.image[140:160, :20].reshape(-1, 4)
    opaque = near_left[near_left[:, 3] == 255]
    assert np.ptp(opaque[:, 0].astype(int)) >= 120
    assert (marked.image[..., 3][changed] > 0).all()
    assert np.array_equal(picture.image, make_picture((400, 300), background).image)


def test_the_smallest_picture_has_room_for_all():
    picture = make_picture((64, 64))
    marked = picture.annotated(letters=True, scale_bar=True)
    assert drawn(picture, marked).any()


@pytest.mark.parametrize("caption", ["größe", "\u8179", "T12 \u00b2"])
def test_what_the_font_lacks_is_refused_and_not_drawn_as_boxes(caption):
    absent = next(letter for letter in caption if ord(letter) > 127)
    with pytest.raises(UsageError, match=absent):
        make_picture((400, 300)).annotated(caption=caption)
    check_caption("T12 ~ 5 mm, 30\u00b0 (a_b)\ttab")


def test_a_caption_is_cut_where_the_picture_ends():
    picture = make_picture((200, 100))
    short, long = (drawn(picture, picture.annotated(caption=text)) for text in ("Ab", "A long line " * 20))
    assert np.nonzero(short)[1].max() < 40
    assert 150 < np.nonzero(long)[1].max() < 200
    with_letters = picture.annotated(letters=True, caption="A long line " * 20)
    assert np.nonzero(drawn(picture.annotated(letters=True), with_letters))[1].max() < 100


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
