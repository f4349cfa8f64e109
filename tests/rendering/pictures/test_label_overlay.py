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


def draw_over_grey(*, opacity=None, colors=None, image=GREY):
    """The labels, 1 red and 2 blue unless `colors` says otherwise, over an even grey of 100."""
    colors = {1: "#ff0000", 2: "#0000ff"} if colors is None else colors
    return draw_labels(image, NUMBERS, LabelStyle.of(LABELS, colors, opacity), opacity)


ROWS, OF_1, OF_2 = slice(2, 8), slice(1, 5), slice(5, 10)
"""Rows of both labels, columns of each."""
INNER_ROWS, INNER_OF_1, INNER_OF_2 = slice(3, 7), slice(2, 4), slice(6, 9)


def test_label_is_filled_with_a_share_of_its_colour_over_the_grey() -> None:
    made = draw_over_grey()
    assert (made[INNER_ROWS, INNER_OF_1, :3] == np.rint(FILL * RED + (1 - FILL) * 100)).all()
    assert (made[..., 3] == 255).all()


def test_label_is_outlined_in_its_colour_also_where_it_meets_another() -> None:
    made = draw_over_grey()
    assert (made[ROWS, OF_1.start, :3] == RED).all()
    assert (made[ROWS.start, OF_1, :3] == RED).all()
    assert (made[ROWS, OF_1.stop - 1, :3] == RED).all()
    assert (made[ROWS, OF_2.start, :3] == BLUE).all()


def test_pixels_beside_labels_and_the_given_image_stay() -> None:
    made = draw_over_grey()
    beside = NUMBERS == 0
    assert np.array_equal(made[beside], GREY[beside])
    assert (GREY[..., :3] == 100).all()


def test_label_with_a_given_opacity_is_filled_by_it_and_outlined_in_full() -> None:
    made = draw_over_grey(opacity={2: 0.8})
    assert (made[INNER_ROWS, INNER_OF_2, :3] == np.rint(0.8 * BLUE + 0.2 * 100)).all()
    assert (made[ROWS, OF_2.stop - 1, :3] == BLUE).all()


def test_label_of_opacity_0_has_no_outline_either() -> None:
    assert (draw_over_grey(opacity={1: 0.0})[NUMBERS == 1][:, :3] == 100).all()


def test_opacity_of_what_has_no_label_leaves_the_scan() -> None:
    assert np.array_equal(draw_over_grey(opacity={0: 0.0}), draw_over_grey())


def test_label_without_a_colour_is_not_drawn() -> None:
    made = draw_over_grey(colors={2: "#0000ff"})
    assert (made[NUMBERS == 1][:, :3] == 100).all()
    assert (made[ROWS, OF_2.start, :3] == BLUE).all()


def test_pixels_without_a_scan_stay_clear() -> None:
    clear_in_row_3 = GREY.copy()
    clear_in_row_3[3] = 0
    assert (draw_over_grey(image=clear_in_row_3)[3] == 0).all()


def test_labels_that_are_drawn_are_listed_with_their_pixels() -> None:
    hides_1 = LabelStyle.of(LABELS, {1: "#ff0000", 2: "#0000ff"}, {1: 0.0})
    assert facts_of_overlay(NUMBERS, hides_1) == [
        {"label_number": 2, "label": "vertebrae_L2", "color": "#0000ff", "pixels": 6 * 5}
    ]


def test_no_label_is_listed_where_none_is_drawn() -> None:
    style = LabelStyle.of(LABELS, {1: "#ff0000", 2: "#0000ff"})
    assert facts_of_overlay(np.zeros((3, 3), np.uint8), style) == []


def test_pixel_of_a_slice_has_the_label_of_the_voxel_that_it_lies_in() -> None:
    camera = Camera(position=(11.0, 9.0, -50.0), focal_point=(11.0, 9.0, 6.0), up=(0.0, -1.0, 0.0), parallel_scale=20.0)
    sheet, _ = plane_sheet(camera, size=(40, 40))

    numbers = labels_on_sheet(LABELS, sheet)

    # The middle of the first voxel lies at 0 mm.
    i, j, k = np.moveaxis(np.floor(sheet.points() / LABELS.spacing + 0.5).astype(int), -1, 0)
    inside = (0 <= i) & (i < 12) & (0 <= j) & (j < 10) & (0 <= k) & (k < 4)
    expected = np.zeros((40, 40), int)
    expected[inside] = LABELS.voxels[k[inside], j[inside], i[inside]]
    assert np.array_equal(numbers, expected)
    assert set(np.unique(numbers)) == {0, 1, 2}


def test_slice_beside_a_label_map_has_no_labels() -> None:
    beside = Camera(position=(0.0, 0.0, 90.0), focal_point=(0.0, 0.0, 80.0), up=(0.0, 1.0, 0.0), parallel_scale=20.0)
    sheet, _ = plane_sheet(beside, size=(8, 8))
    assert not labels_on_sheet(LABELS, sheet).any()
