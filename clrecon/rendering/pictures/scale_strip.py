"""A strip beside a picture with the scale of its colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from clrecon.rendering.looks.color_scale import ColorScale
from clrecon.rendering.pictures.picture import Rendering
from clrecon.rendering.pictures.pillow import load_font, load_pillow

_TEXT_SHARE, _SMALLEST_TEXT = 1 / 36, 9.0


def add_scale(picture: Rendering, scale: ColorScale, title: str) -> Rendering:
    """Return a picture with a strip at its right that has the colours, their numbers and a title.

    picture: With an opaque background.  Only its image grows: depth and camera stay those of the left part.
    title: Lines over the scale, such as ``mm``.
    """
    load_pillow()
    from PIL import Image, ImageDraw

    height = picture.image.shape[0]
    text = max(_SMALLEST_TEXT, _TEXT_SHARE * height)
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
    for row, line in enumerate(lines):
        pen.text((gap, gap + round(1.3 * text * row)), line, "black", font, "lt")
    for tick, name in zip(scale.ticks, names, strict=True):
        place = top + (scale.limit - tick) / (scale.limit - scale.low) * (bottom - 1 - top)
        pen.text((gap + bar + gap // 2, place), name, "black", font, "lm")
    return replace(picture, image=np.concatenate([picture.image, np.array(strip)], axis=1))
