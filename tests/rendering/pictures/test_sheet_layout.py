"""The layout of contact sheets and what is written on their tiles."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.pictures.sheets import LEAST_TILE, lay_out, write_on_tile

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("count", [1, 2, 7, 20, 31])
@pytest.mark.parametrize("mm", [(400.0, 400.0), (500.0, 200.0), (100.0, 380.0)])
@pytest.mark.parametrize("size", [(1600, 1200), (900, 1400)])
def test_tiles_lie_side_by_side_within_the_picture(count: int, mm: tuple[float, float], size: tuple[int, int]) -> None:
    layout = lay_out(count, mm, size)
    width, height = layout.tile
    taken = np.zeros(size[::-1], int)
    for left, top in layout.corners:
        assert 0 <= left <= size[0] - width and 0 <= top <= size[1] - height
        taken[top : top + height, left : left + width] += 1
    assert len(layout.corners) == count and taken.max() == 1
    assert width * layout.pixel_mm == pytest.approx(mm[0], rel=0.02)
    assert height * layout.pixel_mm == pytest.approx(mm[1], rel=0.02)


def test_tiles_are_as_large_as_they_can_be_and_zoom_shows_less_of_them() -> None:
    assert lay_out(4, (100.0, 100.0), (402, 402)).tile == (200, 200)
    assert lay_out(4, (100.0, 100.0), (402, 402), 2.0).pixel_mm == pytest.approx(0.25)
    assert list(lay_out(3, (100.0, 100.0), (402, 402)).corners) == [(0, 0), (202, 0), (0, 202)]


def test_too_many_slices_are_refused() -> None:
    with refused(UsageError, 500, 640, 480, LEAST_TILE):
        lay_out(500, (100.0, 100.0), (640, 480))


def test_the_longest_text_that_fits_is_written_and_small_tiles_have_no_letters() -> None:
    edges = {"left": "R", "right": "L", "top": "A", "bottom": "P"}

    def inked(side: int, texts: tuple[str, ...]) -> np.ndarray:
        blank = np.zeros((side, side, 4), np.uint8)
        made = write_on_tile(blank, texts, edges)
        assert not blank.any() and made.shape == blank.shape
        return np.asarray(made[..., 3] > 0)

    long, short = "34: z -612.5 mm", "-612.5"
    large, small = inked(200, (long, short)), inked(70, (long, short))
    assert large[:30].any() and large[80:120, :30].any() and large[80:120, -30:].any()
    assert small[:20].any() and not small[25:].any()
    assert np.array_equal(small, inked(70, (short,))) and not np.array_equal(large, inked(200, (short,)))
