"""Slices side by side in one picture, with lines, circles, captions and the scale of colours on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.looks.window import BONE_WINDOW, grey_image
from clrecon.rendering.pictures.annotations import Drawing, PictureData, Text, text_pixels
from clrecon.rendering.pictures.picture import Rendering
from clrecon.rendering.pictures.pillow import load_font, load_pillow
from clrecon.system.color_scale import ColorScale
from clrecon.system.light_dataclass import dataclass, field, replace

if TYPE_CHECKING:
    from PIL import Image

SHEET_SIZE = (1600, 1200)
"""Default width and height of a contact sheet: twenty slices of about 300 pixels."""

_TILE_GAP_PIXELS = 2
LEAST_TILE = 64
"""Least pixels along the shorter side of a tile; what is written on smaller ones cannot be read."""

_LEAST_LETTERED = 96
"""Least pixels along the shorter side of a tile with letters."""

TEXT_SHARE = 1 / 14
_LEAST_TEXT = 9.0
MOST_TEXT = 18.0


@dataclass(frozen=True)
class SheetLayout:
    """Tiles of one size in rows: width and height in pixels, and the left and top pixel of each."""

    tile: tuple[int, int]
    pixel_mm: float
    corners: tuple[tuple[int, int], ...]


def lay_out(count: int, mm: tuple[float, float], size: tuple[int, int], zoom: float = 1.0) -> SheetLayout:
    """Place tiles, each of which shows this width and height in mm at zoom 1, so that they are as large as possible."""
    best: tuple[float, int, tuple[int, int]] | None = None
    for columns in range(1, count + 1):
        rows = -(-count // columns)
        room = [
            (whole - (many - 1) * _TILE_GAP_PIXELS) // many for whole, many in zip(size, (columns, rows), strict=True)
        ]
        if min(room) < 1:
            continue
        pixel = max(mm[0] / room[0], mm[1] / room[1])
        tile = tuple(min(most, max(1, round(length / pixel))) for most, length in zip(room, mm, strict=True))
        if best is None or pixel < best[0] - 1e-12:
            best = pixel, columns, (tile[0], tile[1])
    if best is None or min(best[2]) < LEAST_TILE:
        raise UsageError(
            f"{count:,} pictures are too many for a sheet of {size[0]} x {size[1]} pixels, in which each needs"
            f" {LEAST_TILE}: show fewer, or make it larger"
        )
    pixel, columns, (width, height) = best
    rows = -(-count // columns)
    left = (size[0] - columns * (width + _TILE_GAP_PIXELS) + _TILE_GAP_PIXELS) // 2
    top = (size[1] - rows * (height + _TILE_GAP_PIXELS) + _TILE_GAP_PIXELS) // 2
    corners = tuple(
        (left + n % columns * (width + _TILE_GAP_PIXELS), top + n // columns * (height + _TILE_GAP_PIXELS))
        for n in range(count)
    )
    return SheetLayout((width, height), pixel / zoom, corners)


def write_on_tile(image: NDArray[np.uint8], texts: tuple[str, ...], edges: Mapping[str, str]) -> NDArray[np.uint8]:
    """Write on a copy of a tile (h, w, 4): the first text that fits, else the last, at the top left.

    edges: Sides of the patient at the ``left`` and ``right`` edge, for tiles of `_LEAST_LETTERED` pixels and more.
    """
    load_pillow()
    from PIL import Image, ImageDraw

    height, width = image.shape[:2]
    font = load_font(float(np.clip(TEXT_SHARE * min(height, width), _LEAST_TEXT, MOST_TEXT)))
    fitting = [text for text in texts if font.getlength(text) <= width - 6]
    picture: Any = Image.fromarray(np.ascontiguousarray(image))
    pen = ImageDraw.Draw(picture)

    def write_text(corner: tuple[float, float], text: str, anchor: str) -> None:
        pen.text(corner, text, (255, 255, 255, 255), font, anchor, stroke_width=1, stroke_fill=(0, 0, 0, 255))

    write_text((3, 2), fitting[0] if fitting else texts[-1], "la")
    if min(height, width) >= _LEAST_LETTERED:
        for x, anchor, edge in ((3, "lm", "left"), (width - 3, "rm", "right")):
            write_text((x, height / 2), edges[edge], anchor)
    return np.array(picture)


GAP_PIXELS = 6
_TEXT_PIXELS = 15
BACKGROUND = 24


@dataclass(frozen=True)
class Stroke:
    """A line, or a circle about a point, on a panel, in mm from the panel's centre: x to the right, y down."""

    points: NDArray[np.float64]
    color: tuple[int, int, int]
    radius_mm: float = 0.0


@dataclass(frozen=True)
class Panel:
    """A slice, in HU, with what is drawn over it; edges have the letters at the left, right, top and bottom."""

    values: NDArray[Any]
    pixel_mm: float
    captions: Sequence[str] = ()
    strokes: Sequence[Stroke] = field(default=())
    edges: tuple[str, str, str, str] = ("", "", "", "")


def draw_sheet(
    rows: Sequence[Sequence[Panel]], footer: Sequence[str] = (), window: tuple[float, float] = BONE_WINDOW
) -> PictureData:
    """Draw panels of one size in rows, with lines of text below; the picture is opaque, with the panels' own pixels."""
    load_pillow()
    from PIL import Image, ImageDraw

    panels = list(chain(*rows))
    if not panels or len({(panel.values.shape, panel.pixel_mm) for panel in panels}) != 1:
        raise UsageError("a sheet needs panels of one size")
    height, width = panels[0].values.shape
    columns = max(len(row) for row in rows)
    whole = (
        columns * (width + GAP_PIXELS) + GAP_PIXELS,
        len(rows) * (height + GAP_PIXELS) + GAP_PIXELS + len(footer) * (_TEXT_PIXELS + 5) + (6 if footer else 0),
    )
    page = Image.new("RGB", whole, (BACKGROUND,) * 3)
    font = load_font(_TEXT_PIXELS)
    for y, row in enumerate(rows):
        for x, panel in enumerate(row):
            corner = (GAP_PIXELS + x * (width + GAP_PIXELS), GAP_PIXELS + y * (height + GAP_PIXELS))
            page.paste(_draw_panel(panel, window, font), corner)
    draw = ImageDraw.Draw(page)
    top = whole[1] - len(footer) * (_TEXT_PIXELS + 5) - 4
    for number, text in enumerate(footer):
        draw.text((GAP_PIXELS + 4, top + number * (_TEXT_PIXELS + 5)), text, fill=(230, 230, 230), font=font)
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
        draw.text((6, 4 + number * (_TEXT_PIXELS + 4)), text, **outline)
    left, right, top, bottom = panel.edges
    for text, corner, anchor in (
        (left, (5, height / 2), "lm"),
        (right, (width - 5, height / 2), "rm"),
        (top, (width / 2, 5), "mt"),
        (bottom, (width / 2, height - 5), "mb"),
    ):
        if text:
            draw.text(corner, text, anchor=anchor, **outline)
    return picture


_TEXT_SHARE = 1 / 36


def add_scale(picture: Rendering, scale: ColorScale, title: str) -> Rendering:
    """Return an opaque picture with a scale at the right of its image; depth and camera stay those of the left."""
    load_pillow()
    from PIL import Image, ImageDraw

    height = picture.image.shape[0]
    text = text_pixels(_TEXT_SHARE, height, picture.report.get("dpi"))
    font = load_font(text)
    names = [f"{tick:+g}" if scale.signed and tick else f"{tick:g}" for tick in scale.ticks]
    gap, bar = round(0.8 * text), round(1.4 * text)
    lines = title.splitlines()
    wide = max(gap + bar + gap // 2 + max(font.getlength(name) for name in names), *map(font.getlength, lines))
    strip = Image.new("RGBA", (round(wide) + 2 * gap, height), "white")
    pen = ImageDraw.Draw(strip)
    top = gap + round(1.3 * text * len(lines)) + gap
    bottom = height - 2 * gap
    values = np.linspace(scale.limit, scale.low, bottom - top)
    colors = np.full((bottom - top, bar, 4), 255, np.uint8)
    colors[..., :3] = scale.colors(values)[:, None]
    strip.paste(Image.fromarray(colors), (gap, top))
    pen.rectangle((gap, top, gap + bar - 1, bottom - 1), outline="black", width=max(1, round(text / 14.0)))
    texts = [(gap, gap + round(1.3 * text * row), line, "lt") for row, line in enumerate(lines)]
    for tick, name in zip(scale.ticks, names, strict=True):
        tick_y = top + (scale.limit - tick) / (scale.limit - scale.low) * (bottom - 1 - top)
        texts.append((gap + bar + gap // 2, tick_y, name, "lm"))
    return _add_strip(picture, strip, texts, font)


def add_legend(picture: Rendering, labels: Sequence[tuple[str, str]]) -> Rendering:
    """Return an opaque picture with the colour (#rrggbb) and name of each label at its right, as many as fit."""
    load_pillow()
    from PIL import Image, ImageDraw

    height = picture.image.shape[0]
    text = text_pixels(_TEXT_SHARE, height, picture.report.get("dpi"))
    font = load_font(text)
    gap, line = round(0.8 * text), round(1.5 * text)
    room = max(1, (height - 2 * gap) // line)
    shown = [*labels] if len(labels) <= room else [*labels[: room - 1], ("white", f"{len(labels) - room + 1:,} more")]
    wide = 2 * gap + line + max((font.getlength(name) for _, name in shown), default=0.0)
    strip = Image.new("RGBA", (round(wide), height), "white")
    pen = ImageDraw.Draw(strip)
    texts = []
    for row, (color, name) in enumerate(shown):
        top = gap + row * line
        pen.rectangle((gap, top, gap + text, top + text), fill=color)
        texts.append((gap + line, top + text / 2, name, "lm"))
    return _add_strip(picture, strip, texts, font)


def _add_strip(
    picture: Rendering, strip: Image.Image, texts: Sequence[tuple[float, float, str, str]], font: Any
) -> Rendering:
    """Return a picture with a strip at its right: x, y, text and anchor of what is written in black on it."""
    from PIL import ImageDraw

    drawing = picture.drawing or Drawing(picture.image)
    ground = np.concatenate([drawing.ground, np.array(strip)], axis=1)
    pen = ImageDraw.Draw(strip)
    marks = []
    for x, y, text, anchor in texts:
        pen.text((x, y), text, "black", font, anchor)
        baseline = y + pen.textbbox((x, y), text, font, anchor)[1] - pen.textbbox((x, y), text, font, "ls")[1]
        marks.append(Text(text, picture.size[0] + x, baseline, anchor[0], font.size))
    image = np.concatenate([picture.image, np.array(strip)], axis=1)
    return replace(picture, image=image, drawing=Drawing(ground, (*drawing.marks, *marks)))
