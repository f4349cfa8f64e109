"""Contact sheets: the layout of slices side by side in one picture, and what is written on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.pictures.pillow import load_font, load_pillow

SHEET_SIZE = (1600, 1200)
"""Default width and height of a contact sheet: twenty slices of about 300 pixels."""

GAP_PIXELS = 2
LEAST_TILE = 64
"""Least pixels along the shorter side of a tile; what is written on smaller ones cannot be read."""

LEAST_LETTERED = 96
"""Least pixels along the shorter side of a tile with letters."""

TEXT_SHARE, LEAST_TEXT, MOST_TEXT = 1 / 14, 9.0, 18.0


@dataclass(frozen=True)
class SheetLayout:
    """Tiles of one size in rows.

    tile: Width and height of a tile, pixels.
    corners: sequence of (int, int). Left and top pixel of each tile.
    """

    tile: tuple[int, int]
    pixel_mm: float
    corners: tuple[tuple[int, int], ...]


def lay_out(count: int, mm: tuple[float, float], size: tuple[int, int], zoom: float = 1.0) -> SheetLayout:
    """Place tiles so that each is as large as possible.

    mm: Width and height that a tile shows at zoom 1.
    size: Width and height of the picture; it is not exceeded.
    zoom: 2 shows everything twice as large, and half as much of it.
    """
    best: tuple[float, int, tuple[int, int]] | None = None
    for columns in range(1, count + 1):
        rows = -(-count // columns)
        room = [(whole - (many - 1) * GAP_PIXELS) // many for whole, many in zip(size, (columns, rows), strict=True)]
        if min(room) < 1:
            continue
        pixel = max(mm[0] / room[0], mm[1] / room[1])
        tile = tuple(min(most, max(1, round(length / pixel))) for most, length in zip(room, mm, strict=True))
        if best is None or pixel < best[0] - 1e-12:
            best = pixel, columns, (tile[0], tile[1])
    if best is None or min(best[2]) < LEAST_TILE:
        raise UsageError(
            f"{count:,} slices are too many for a sheet of {size[0]} x {size[1]} pixels, in which each needs"
            f" {LEAST_TILE}: show fewer, or make it larger"
        )
    pixel, columns, (width, height) = best
    rows = -(-count // columns)
    left = (size[0] - columns * (width + GAP_PIXELS) + GAP_PIXELS) // 2
    top = (size[1] - rows * (height + GAP_PIXELS) + GAP_PIXELS) // 2
    corners = tuple(
        (left + n % columns * (width + GAP_PIXELS), top + n // columns * (height + GAP_PIXELS)) for n in range(count)
    )
    return SheetLayout((width, height), pixel / zoom, corners)


def write_on_tile(image: NDArray[np.uint8], texts: tuple[str, ...], edges: Mapping[str, str]) -> NDArray[np.uint8]:
    """Write on a copy of a tile.

    image: ndarray, shape (h, w, 4), uint8
    texts: The first that fits stands at the top left, else the last.
    edges: Letters of the sides of the patient at the ``left`` and ``right`` edge; tiles under `LEAST_LETTERED` pixels
        have none.
    """
    load_pillow()
    from PIL import Image, ImageDraw

    height, width = image.shape[:2]
    font = load_font(float(np.clip(TEXT_SHARE * min(height, width), LEAST_TEXT, MOST_TEXT)))
    fitting = [text for text in texts if font.getlength(text) <= width - 6]
    picture: Any = Image.fromarray(np.ascontiguousarray(image))
    pen = ImageDraw.Draw(picture)

    def write(at: tuple[float, float], text: str, anchor: str) -> None:
        pen.text(at, text, (255, 255, 255, 255), font, anchor, stroke_width=1, stroke_fill=(0, 0, 0, 255))

    write((3, 2), fitting[0] if fitting else texts[-1], "la")
    if min(height, width) >= LEAST_LETTERED:
        for x, anchor, edge in ((3, "lm", "left"), (width - 3, "rm", "right")):
            write((x, height / 2), edges[edge], anchor)
    return np.array(picture)
