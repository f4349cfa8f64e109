"""The layout of contact sheets and what is written on their tiles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.pictures.sheets import LEAST_TILE, lay_out, write_on_tile

pytestmark = pytest.mark.unit


of_many_sheets = [
    pytest.mark.parametrize("count", [1, 2, 7, 20, 31]),
    pytest.mark.parametrize("mm", [(400.0, 400.0), (500.0, 200.0), (100.0, 380.0)], ids=["square", "wide", "tall"]),
    pytest.mark.parametrize("size", [(1600, 1200), (900, 1400)], ids=["landscape", "portrait"]),
]


def of_each_sheet(test: Callable[..., None]) -> Callable[..., None]:
    for mark in of_many_sheets:
        test = mark(test)
    return test


@of_each_sheet
def test_tiles_lie_side_by_side_within_the_picture(count: int, mm: tuple[float, float], size: tuple[int, int]) -> None:
    layout = lay_out(count, mm, size)

    width, height = layout.tile
    taken = np.zeros((size[1] + height, size[0] + width), int)  # with room for tiles that would stick out
    for left, top in layout.corners:
        taken[top : top + height, left : left + width] += 1
    assert taken[: size[1], : size[0]].sum() == taken.sum() == count * width * height
    assert taken.max() == 1


@of_each_sheet
def test_tiles_show_the_whole_slice(count: int, mm: tuple[float, float], size: tuple[int, int]) -> None:
    layout = lay_out(count, mm, size)

    shown = [pixels * layout.pixel_mm for pixels in layout.tile]
    assert shown == pytest.approx(mm, rel=0.02)  # to the whole pixel, of tiles of 50 pixels and more


def test_tiles_are_as_large_as_they_can_be_two_pixels_apart() -> None:
    layout = lay_out(4, mm=(100.0, 100.0), size=(402, 402))

    assert layout.tile == (200, 200)  # two tiles and the gap fill 402 pixels
    assert list(layout.corners) == [(0, 0), (202, 0), (0, 202), (202, 202)]


def test_zoom_of_two_halves_the_mm_of_a_pixel() -> None:
    layout = lay_out(4, mm=(100.0, 100.0), size=(402, 402), zoom=2.0)

    assert layout.pixel_mm == pytest.approx(100.0 / 200 / 2.0)  # on tiles of 200 pixels


def test_last_row_of_tiles_starts_at_the_left() -> None:
    layout = lay_out(3, mm=(100.0, 100.0), size=(402, 402))

    assert list(layout.corners) == [(0, 0), (202, 0), (0, 202)]  # tiles of 200 pixels, two apart


def test_slices_that_would_be_smaller_than_the_least_tile_are_refused() -> None:
    with refused(UsageError, 500, 640, 480, LEAST_TILE):
        lay_out(500, mm=(100.0, 100.0), size=(640, 480))


EDGES = {"left": "R", "right": "L", "top": "A", "bottom": "P"}
LONG, SHORT = "34: z -612.5 mm", "-612.5"
LARGE, SMALL = 200, 70  # pixels: LONG and the letters fit on the large tile alone


def inked(side: int, texts: tuple[str, ...]) -> np.ndarray:
    """Where texts and the letters of the edges are written on an empty tile of so many pixels."""
    return np.asarray(write_on_tile(np.zeros((side, side, 4), np.uint8), texts, EDGES)[..., 3] > 0)


def test_small_tile_carries_the_shorter_text_where_the_longer_does_not_fit() -> None:
    assert np.array_equal(inked(SMALL, (LONG, SHORT)), inked(SMALL, (SHORT,)))
    assert inked(SMALL, (SHORT,))[:20].any()  # the rows of the text


def test_large_tile_carries_the_longest_text() -> None:
    assert np.array_equal(inked(LARGE, (LONG, SHORT)), inked(LARGE, (LONG,)))
    assert not np.array_equal(inked(LARGE, (LONG, SHORT)), inked(LARGE, (SHORT,)))


@pytest.mark.parametrize("columns", [slice(0, 30), slice(-30, None)], ids=["left", "right"])
def test_large_tile_has_the_letters_of_its_edges(columns: slice) -> None:
    around_the_middle = slice(LARGE // 2 - 20, LARGE // 2 + 20)
    assert inked(LARGE, (SHORT,))[around_the_middle, columns].any()


def test_small_tile_has_no_letters() -> None:
    assert not inked(SMALL, (SHORT,))[25:].any()  # nothing below the text


def test_tile_that_is_written_on_is_left_as_it_was() -> None:
    blank = np.zeros((LARGE, LARGE, 4), np.uint8)

    made = write_on_tile(blank, (SHORT,), EDGES)

    assert not blank.any()
    assert made.shape == blank.shape
