"""Sheets of slices: where panels, lines and circles lie, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.pictures.picture import encode_image
from clrecon.rendering.pictures.sheets import GAP_PIXELS, Panel, Stroke, draw_sheet

pytest.importorskip("PIL")
RED, GREEN = (255, 0, 0), (0, 255, 0)


PIXEL_MM = 0.5


def make_panel(*strokes: Stroke, value: float = 300.0) -> Panel:
    """A panel of 201 x 101 pixels of one value in HU, with lines and circles over it."""
    return Panel(np.full((101, 201), value, np.float32), pixel_mm=PIXEL_MM, strokes=strokes)


def pixels_from_centre(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Rows and columns of the pixels of a colour, within the first panel, from its centre."""
    found = np.argwhere((image[..., :3] == color).all(axis=-1))
    return np.asarray(found - GAP_PIXELS - np.array([101 // 2, 201 // 2]))


def test_line_lies_at_its_mm_in_a_panel() -> None:
    line = Stroke(np.array([[-20.0, 10.0], [20.0, 10.0]]), RED)

    sheet = draw_sheet([[make_panel(line)]])

    assert sheet.pixel_mm == PIXEL_MM
    rows, columns = pixels_from_centre(sheet.image, RED).T
    assert abs(rows.mean() - 10.0 / PIXEL_MM) <= 1.0  # pixel
    assert (columns.min(), columns.max()) == pytest.approx((-20.0 / PIXEL_MM, 20.0 / PIXEL_MM), abs=1)  # pixel


def test_circle_lies_at_its_mm_in_a_panel() -> None:
    circle = Stroke(np.array([5.0, 0.0]), GREEN, radius_mm=10.0)

    sheet = draw_sheet([[make_panel(circle)]])

    middle = np.array([0.0, 5.0 / PIXEL_MM])  # row, column
    radii = np.linalg.norm(pixels_from_centre(sheet.image, GREEN) - middle, axis=1)
    assert len(radii) > 60  # half of the 2 pi 20 pixels of its outline; measured 228, of a stroke of 2 pixels
    width = 2.5  # pixels of the stroke, to each side
    assert np.abs(radii - 10.0 / PIXEL_MM).max() < width


def test_sheet_of_panels_is_opaque() -> None:
    assert draw_sheet([[make_panel()]]).is_opaque


def test_panels_stand_side_by_side_in_rows_with_gaps_in_the_greys_of_the_window() -> None:
    height, width = 101, 201

    sheet = draw_sheet(
        [[make_panel(value=1050.0), make_panel(value=-450.0)], [make_panel(value=300.0)]], window=(-450.0, 1050.0)
    )

    assert sheet.size == (2 * width + 3 * GAP_PIXELS, 2 * height + 3 * GAP_PIXELS)
    first_row, second_row = GAP_PIXELS + height // 2, 2 * GAP_PIXELS + height + height // 2
    left, right = GAP_PIXELS + width // 2, 2 * GAP_PIXELS + width + width // 2
    greys = [int(sheet.image[place][0]) for place in ((first_row, left), (first_row, right), (second_row, left))]
    assert greys == [255, 0, 128]  # the ends of the window, and its middle


def test_captions_of_a_sheet_make_it_taller() -> None:
    assert draw_sheet([[make_panel()]], ["one", "two"]).size[1] > draw_sheet([[make_panel()]]).size[1]


def test_sheet_that_is_drawn_again_has_the_same_bytes() -> None:
    first, again = (encode_image(draw_sheet([[make_panel()]], ["one", "two"]), ".png") for _ in range(2))
    assert first == again


def test_letters_and_caption_of_a_panel_are_drawn_at_its_edges() -> None:
    plain = make_panel()
    with_texts = replace(plain, captions=["caption"], edges=("L", "R", "A", "P"))
    height, width = plain.values.shape
    difference = (draw_sheet([[with_texts]]).image != draw_sheet([[plain]]).image).any(axis=-1)
    rows, columns = np.nonzero(difference)
    near = 14  # pixels; the outlines of the letters begin 3 to 4 from the edges
    assert rows.min() < GAP_PIXELS + near and rows.max() > GAP_PIXELS + height - near
    assert columns.min() < GAP_PIXELS + near and columns.max() > GAP_PIXELS + width - near


@pytest.mark.parametrize("rows", [[], [[]], [[make_panel(), Panel(np.zeros((50, 50), np.float32), 0.5)]]])
def test_sheet_of_no_panels_or_of_different_sizes_is_refused(rows: list[list[Panel]]) -> None:
    with refused(UsageError, "sheet", "size"):
        draw_sheet(rows)
