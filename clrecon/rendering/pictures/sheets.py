"""Sheets: grey slices side by side, with lines, circles and captions drawn over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.looks.window import BONE_WINDOW, grey_image
from clrecon.rendering.pictures.picture_data import PictureData
from clrecon.rendering.pictures.pillow import load_font, load_pillow

GAP_PIXELS = 6
TEXT_PIXELS = 15
BACKGROUND = 24


@dataclass(frozen=True)
class Stroke:
    """A line or circle on a panel, in mm from the panel's centre: x to the right, y down.

    points: ndarray, shape (n, 2). Corners of a line; of a circle its centre alone.
    color: Red, green, blue.
    radius_mm: Of a circle; 0 for a line.
    """

    points: NDArray[np.float64]
    color: tuple[int, int, int]
    radius_mm: float = 0.0


@dataclass(frozen=True)
class Panel:
    """A slice with what is drawn over it.

    values: ndarray, shape (h, w). HU.
    captions: Lines of text at the top left.
    edges: Letters at the left, right, top and bottom edge.
    """

    values: NDArray[Any]
    pixel_mm: float
    captions: Sequence[str] = ()
    strokes: Sequence[Stroke] = field(default=())
    edges: tuple[str, str, str, str] = ("", "", "", "")


def draw_sheet(
    rows: Sequence[Sequence[Panel]], footer: Sequence[str] = (), window: tuple[float, float] = BONE_WINDOW
) -> PictureData:
    """Draw panels in rows, with lines of text below.

    rows: Panels of one size.
    window: HU of black and white.

    Returns: Opaque; its pixels have the size of the panels' own.
    """
    load_pillow()
    from PIL import Image, ImageDraw

    panels = [panel for row in rows for panel in row]
    if not panels or len({(panel.values.shape, panel.pixel_mm) for panel in panels}) != 1:
        raise UsageError("a sheet needs panels of one size")
    height, width = panels[0].values.shape
    columns = max(len(row) for row in rows)
    whole = (
        columns * (width + GAP_PIXELS) + GAP_PIXELS,
        len(rows) * (height + GAP_PIXELS) + GAP_PIXELS + len(footer) * (TEXT_PIXELS + 5) + (6 if footer else 0),
    )
    page = Image.new("RGB", whole, (BACKGROUND,) * 3)
    font = load_font(TEXT_PIXELS)
    for y, row in enumerate(rows):
        for x, panel in enumerate(row):
            corner = (GAP_PIXELS + x * (width + GAP_PIXELS), GAP_PIXELS + y * (height + GAP_PIXELS))
            page.paste(_draw_panel(panel, window, font), corner)
    draw = ImageDraw.Draw(page)
    top = whole[1] - len(footer) * (TEXT_PIXELS + 5) - 4
    for number, text in enumerate(footer):
        draw.text((GAP_PIXELS + 4, top + number * (TEXT_PIXELS + 5)), text, fill=(230, 230, 230), font=font)
    pixels = np.asarray(page, dtype=np.uint8)
    image = np.dstack((pixels, np.full(pixels.shape[:2], 255, np.uint8)))
    nothing = np.full(pixels.shape[:2], np.nan, np.float32)
    return PictureData(image, nothing, nothing, None, mode="sheet", report={"pixel_mm": panels[0].pixel_mm})


def _draw_panel(panel: Panel, window: tuple[float, float], font: Any) -> Any:
    from PIL import Image, ImageDraw

    grey = grey_image(panel.values, window)
    picture = Image.fromarray(np.ascontiguousarray(grey[..., 0] if grey.ndim == 3 else grey)).convert("RGB")
    draw = ImageDraw.Draw(picture)
    height, width = panel.values.shape
    middle = np.array(((width - 1) / 2.0, (height - 1) / 2.0))
    for stroke in panel.strokes:
        places = middle + np.atleast_2d(stroke.points) / panel.pixel_mm
        if stroke.radius_mm > 0.0:
            (x, y), radius = places[0], stroke.radius_mm / panel.pixel_mm
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=stroke.color, width=2)
        else:
            draw.line([(float(x), float(y)) for x, y in places], fill=stroke.color, width=2)
    outline: dict[str, Any] = {"fill": (255, 255, 255), "stroke_width": 2, "stroke_fill": (0, 0, 0), "font": font}
    for number, text in enumerate(panel.captions):
        draw.text((6, 4 + number * (TEXT_PIXELS + 4)), text, **outline)
    left, right, top, bottom = panel.edges
    for text, place, anchor in (
        (left, (5, height / 2), "lm"),
        (right, (width - 5, height / 2), "rm"),
        (top, (width / 2, 5), "mt"),
        (bottom, (width / 2, height - 5), "mb"),
    ):
        if text:
            draw.text(place, text, anchor=anchor, **outline)
    return picture
