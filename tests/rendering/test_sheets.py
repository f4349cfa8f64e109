"""Sheets of slices: where panels, lines and circles lie, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering.pictures.picture import encode_image
from clrecon.rendering.pictures.sheets import GAP_PIXELS, Panel, Stroke, draw_sheet

pytest.importorskip("PIL")
RED, GREEN = (255, 0, 0), (0, 255, 0)


def panel(*strokes: Stroke, value: float = 300.0) -> Panel:
    return Panel(np.full((101, 201), value, np.float32), 0.5, (), strokes)


def where(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Rows and columns of the pixels of a colour, within the first panel, from its centre."""
    found = np.argwhere((image[..., :3] == color).all(axis=-1))
    return np.asarray(found - GAP_PIXELS - np.array([50, 100]))


def test_strokes_lie_where_their_mm_say() -> None:
    line = Stroke(np.array([[-20.0, 10.0], [20.0, 10.0]]), RED)
    circle = Stroke(np.array([5.0, 0.0]), GREEN, 10.0)
    sheet = draw_sheet([[panel(line, circle)]])
    rows, columns = where(sheet.image, RED).T
    assert abs(rows.mean() - 20.0) <= 1.0
    assert (columns.min(), columns.max()) == pytest.approx((-40, 40), abs=1)
    off = where(sheet.image, GREEN) - np.array([0, 10])
    radii = np.linalg.norm(off, axis=1)
    assert len(radii) > 60 and radii.min() > 17.5 and radii.max() < 21.5
    assert sheet.pixel_mm == 0.5 and sheet.is_opaque


def test_panels_stand_side_by_side() -> None:
    sheet = draw_sheet([[panel(value=1050.0), panel(value=-450.0)], [panel(value=300.0)]], window=(-450.0, 1050.0))
    assert sheet.size == (2 * 201 + 3 * GAP_PIXELS, 2 * 101 + 3 * GAP_PIXELS)
    middles = [(GAP_PIXELS + 50, GAP_PIXELS + 100), (GAP_PIXELS + 50, 2 * GAP_PIXELS + 301)]
    assert [int(sheet.image[place][0]) for place in middles] == [255, 0]
    assert int(sheet.image[2 * GAP_PIXELS + 151, GAP_PIXELS + 100][0]) == 128
    taller = draw_sheet([[panel()]], ["one", "two"])
    assert taller.size[1] > draw_sheet([[panel()]]).size[1]
    assert encode_image(taller, ".png") == encode_image(draw_sheet([[panel()]], ["one", "two"]), ".png")


def test_letters_and_captions_are_drawn() -> None:
    plain = panel()
    told = Panel(plain.values, 0.5, ["caption"], (), ("L", "R", "A", "P"))
    difference = (draw_sheet([[told]]).image != draw_sheet([[plain]]).image).any(axis=-1)
    rows, columns = np.nonzero(difference)
    assert rows.min() < 20 and rows.max() > 85
    assert columns.min() < 25 and columns.max() > 185


@pytest.mark.parametrize("rows", [[], [[]], [[panel(), Panel(np.zeros((50, 50), np.float32), 0.5)]]])
def test_panels_of_different_size_are_refused(rows: list[list[Panel]]) -> None:
    with refused(UsageError, "sheet", "size"):
        draw_sheet(rows)
