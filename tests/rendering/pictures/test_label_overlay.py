"""Labels over grey pictures: what is filled, outlined, hidden and named, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.labels import LabelMap
from clrecon.rendering.pictures.label_style import FILL, LabelStyle, draw_labels, facts_of_overlay, labels_on_sheet
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.reformation import plane_sheet

pytestmark = pytest.mark.unit

NAMES = {1: "vertebrae_L1", 2: "vertebrae_L2"}


def label_map() -> LabelMap:
    """Two blocks beside each other in a slice of 12 x 10, in each of 4 slices."""
    voxels = np.zeros((4, 10, 12), np.uint8)
    voxels[:, 2:8, 1:5], voxels[:, 2:8, 5:10] = 1, 2
    return LabelMap(voxels, np.diag([2.0, 2.0, 3.0, 1.0]), NAMES)


LABELS = label_map()
NUMBERS = LABELS.voxels[0]
GREY = np.full((10, 12, 4), 100, np.uint8)
GREY[..., 3] = 255
RED, BLUE = np.array([255, 0, 0]), np.array([0, 0, 255])


def drawn(opacity=None, colors=None, image=GREY):
    colors = {1: "#ff0000", 2: "#0000ff"} if colors is None else colors
    return draw_labels(image, NUMBERS, LabelStyle.of(LABELS, colors, opacity), opacity)


def test_a_label_is_filled_and_outlined_in_its_colour() -> None:
    made = drawn()
    assert (made[2:8, 1, :3] == RED).all() and (made[2, 1:5, :3] == RED).all() and (made[2:8, 4, :3] == RED).all()
    assert (made[2:8, 5, :3] == BLUE).all()  # where two labels meet each has its outline
    inside = np.rint(FILL * RED + (1 - FILL) * 100)
    assert (made[3:7, 2:4, :3] == inside).all() and (made[..., 3] == 255).all()
    beside = NUMBERS == 0
    assert np.array_equal(made[beside], GREY[beside]) and (GREY[..., :3] == 100).all()


def test_shares_are_those_given_and_a_share_of_0_hides_the_outline_too() -> None:
    made = drawn({1: 0.0, 2: 0.8})
    assert (made[NUMBERS == 1][:, :3] == 100).all()
    assert (made[3:7, 6:9, :3] == np.rint(0.8 * BLUE + 0.2 * 100)).all() and (made[2:8, 9, :3] == BLUE).all()
    assert np.array_equal(drawn({0: 0.0}), drawn())  # what has no label is the scan itself


def test_labels_without_a_colour_and_pixels_without_a_scan_stay() -> None:
    made = drawn(colors={2: "#0000ff"})
    assert (made[NUMBERS == 1][:, :3] == 100).all() and (made[2:8, 5, :3] == BLUE).all()
    clear = GREY.copy()
    clear[3] = 0
    assert (drawn(image=clear)[3] == 0).all()


def test_labels_that_are_drawn_are_listed_with_their_pixels() -> None:
    look = LabelStyle.of(LABELS, {1: "#ff0000", 2: "#0000ff"}, {1: 0.0})
    assert facts_of_overlay(NUMBERS, look) == [
        {"label_number": 2, "label": "vertebrae_L2", "color": "#0000ff", "pixels": 30}
    ]
    assert facts_of_overlay(np.zeros((3, 3), np.uint8), look) == []


def test_a_pixel_has_the_label_of_the_voxel_that_it_lies_in() -> None:
    camera = Camera((11.0, 9.0, -50.0), (11.0, 9.0, 6.0), (0.0, -1.0, 0.0), parallel_scale=20.0)
    sheet, _ = plane_sheet(camera, (40, 40))
    places = sheet.points()
    at = np.floor(places / (2.0, 2.0, 3.0) + 0.5).astype(int)
    inside = ((at >= 0) & (at < (12, 10, 4))).all(axis=-1)
    truth = np.zeros((40, 40), int)
    truth[inside] = LABELS.voxels[at[inside][:, 2], at[inside][:, 1], at[inside][:, 0]]
    found = labels_on_sheet(LABELS, sheet)
    assert np.array_equal(found, truth) and set(np.unique(found)) == {0, 1, 2}
    far = plane_sheet(Camera((0.0, 0.0, 90.0), (0.0, 0.0, 80.0), (0.0, 1.0, 0.0), parallel_scale=20.0), (8, 8))[0]
    assert not labels_on_sheet(LABELS, far).any()
