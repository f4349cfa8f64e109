"""The picture of every run: the straightened spine with planes and vertebrae drawn over it."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clrecon.rendering.looks.label_style import distinct_colors
from clrecon.rendering.pictures.pillow import load_font, load_pillow

if TYPE_CHECKING:
    from clrecon.spine import VertebraSplit

PIXELS_PER_MM = 3
WINDOW_HU = (-150.0, 650.0)
TINT = 0.35
"""Share of a vertebra's colour in its pixels."""
LOW_COLOR = (255, 40, 40)
LINE_COLOR = (255, 230, 0)
TEXT_MM = 6.0
NAMES_MM = 62
"""Width of the column with names, mm."""


def draw_vertebrae(split: VertebraSplit) -> bytes:
    """Return the picture as PNG: from the side, names and confidence, and from the front.

    The spine is straightened along the canal; a row is a millimetre of it.  Planes between vertebrae are yellow,
    vertebrae have colours of their own, and those of low confidence are hatched in red.
    """
    load_pillow()
    from PIL import Image, ImageDraw

    plane = split.plane
    colors = (255 * distinct_colors(len(split.vertebrae))).astype(np.uint8)
    shades = {one.number: np.array(shade) for one, shade in zip(split.vertebrae, colors, strict=True)}
    doubted = [one.number for one in split.low_confidence]
    left = _tinted(plane.sagittal, plane.sagittal_labels, shades, doubted)
    right = _tinted(plane.coronal, plane.coronal_labels, shades, doubted)
    gap = np.zeros((len(left), NAMES_MM * PIXELS_PER_MM, 3), np.uint8)
    picture = Image.fromarray(np.concatenate([left, gap, right], axis=1))
    pen = ImageDraw.Draw(picture)
    for front, back in plane.lines:
        ends = [((column + 0.5) * PIXELS_PER_MM, (row + 0.5) * PIXELS_PER_MM) for row, column in (front, back)]
        pen.line(ends, fill=LINE_COLOR, width=2)
        row = 0.5 * (front[0] + back[0])
        at = left.shape[1] + gap.shape[1], (row + 0.5) * PIXELS_PER_MM
        pen.line([at, (picture.width, at[1])], fill=LINE_COLOR, width=1)
    font = load_font(TEXT_MM * PIXELS_PER_MM)
    for one, row in zip(split.vertebrae, split.plane.rows, strict=True):
        text = (
            f"{one.name}  {one.confidence:.2f}" + ("" if one.is_confident else "  low") + ("" if one.whole else "  cut")
        )
        color = tuple(int(value) for value in shades[one.number]) if one.is_confident else LOW_COLOR
        pen.text((left.shape[1] + 6, (row + 0.5) * PIXELS_PER_MM), text, color, font, "lm")
    stream = BytesIO()
    picture.save(stream, "PNG")
    return stream.getvalue()


def _tinted(
    values: NDArray[np.float32], labels: NDArray[np.int32], shades: dict[int, NDArray[np.uint8]], doubted: list[int]
) -> NDArray[np.uint8]:
    """Return grey values with the colours of the vertebrae over them, enlarged."""
    low, high = WINDOW_HU
    grey = np.clip((np.nan_to_num(values, nan=low) - low) / (high - low), 0.0, 1.0) * 255.0
    large = np.repeat(np.repeat(grey, PIXELS_PER_MM, axis=0), PIXELS_PER_MM, axis=1)
    numbers = np.repeat(np.repeat(labels, PIXELS_PER_MM, axis=0), PIXELS_PER_MM, axis=1)
    picture = np.repeat(large[..., None], 3, axis=2)
    rows, columns = np.indices(numbers.shape)
    for number, shade in shades.items():
        own = numbers == number
        if number in doubted:
            own &= (rows + columns) % 12 < 4
            shade = np.array(LOW_COLOR)
        picture[own] = (1.0 - TINT) * picture[own] + TINT * shade
    return np.asarray(np.rint(picture), dtype=np.uint8)
