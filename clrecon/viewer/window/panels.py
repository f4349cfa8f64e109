"""The window's panels as pictures: what stands in them, and which command a click on a place gives.  No toolkit.

They are drawn with Pillow and shown as textures: they look the same with every driver and need no display in tests.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.rendering.pictures.annotations import orientation_letters
from clrecon.viewer.window.layout import Box

if TYPE_CHECKING:
    from PIL import ImageFont

BACK, RAISED, LINE = (30, 32, 36), (48, 51, 57), (74, 78, 86)
TEXT, FAINT, ACCENT, WARNING = (226, 228, 232), (152, 157, 166), (82, 158, 255), (255, 190, 92)
TEXT_PIXELS, ROW = 13, 21
MARGIN = 10
OPACITY_WIDTH = 34
SAID_SHARE = 0.72
"""Of the line at the bottom, that what was said may take."""
PLAIN = (0.90, 0.86, 0.78)
"""Swatch of a part that has no colour of its own: that of bone by itself."""


@dataclass(frozen=True)
class Hit:
    """A place of a panel that answers to a click.

    box: Within the panel.
    action: A command of `ViewSession.do`, or ``{"key": letter}`` for what a key of the window does.
    share: Name of the command's argument that gets the share of the box's width left of the click; empty: none.
    """

    box: Box
    action: Mapping[str, Any]
    share: str = ""

    def command(self, x: float) -> dict[str, Any]:
        """Return the command of a click at `x` within the panel."""
        if not self.share:
            return dict(self.action)
        return {**self.action, self.share: min(max((x - self.box.left) / max(self.box.width - 1, 1), 0.0), 1.0)}


@dataclass
class Panel:
    """A panel that was drawn: ``image`` (h, w, 4) uint8, opaque, and its ``hits``."""

    image: NDArray[np.uint8]
    hits: list[Hit] = field(default_factory=list)

    def find(self, x: float, y: float) -> Hit | None:
        """Return what answers at a place; of boxes one over the other, the last."""
        return next((hit for hit in reversed(self.hits) if hit.box.holds(x, y)), None)


@cache
def _font(pixels: int) -> ImageFont.FreeTypeFont:
    from clrecon.rendering.pictures.pillow import load_font

    return load_font(pixels)


class _Pen:
    """A page with the few things that panels are made of."""

    def __init__(self, size: tuple[int, int], back: tuple[int, ...] = BACK):
        from clrecon.rendering.pictures.pillow import load_pillow

        load_pillow()
        from PIL import Image, ImageDraw

        self.size = size
        self._image = Image.new("RGBA", size, (*back[:3], back[3] if len(back) > 3 else 255))
        self.draw = ImageDraw.Draw(self._image)
        self.hits: list[Hit] = []

    def text(
        self, x: float, y: float, words: str, color: tuple[int, int, int] = TEXT, *, anchor: str = "lm",
        width: float | None = None, pixels: int = TEXT_PIXELS,
    ) -> float:  # fmt: skip
        """Write a line, shortened to a width; returns its length."""
        font = _font(pixels)
        words = shorten(words, width, font)
        self.draw.text((x, y), words, (*color, 255), font, anchor)
        return float(font.getlength(words))

    def box(self, box: Box, fill: tuple[int, ...] | None = None, outline: tuple[int, ...] | None = None) -> None:
        """Draw a rectangle with round corners."""
        corners = (box.left, box.top, box.left + box.width - 1, box.top + box.height - 1)
        self.draw.rounded_rectangle(corners, 3, fill, outline)

    def hit(self, box: Box, action: Mapping[str, Any], share: str = "") -> None:
        self.hits.append(Hit(box, action, share))

    def finish(self) -> Panel:
        return Panel(np.array(self._image), self.hits)


def shorten(words: str, width: float | None, font: Any) -> str:
    """Return a text of at most a width, with dots where something is left out."""
    if width is None or font.getlength(words) <= width:
        return words
    while words and font.getlength(words + "...") > width:
        words = words[:-1].rstrip()
    return words + "..."


def slider_track(size: tuple[int, int]) -> Box:
    """Return the bar of the slider within its panel."""
    width, height = size
    return Box(96, height // 2 - 10, max(width - 96 - 120, 8), 20)


def slider_value(size: tuple[int, int], x: float, limits: Sequence[float]) -> float:
    """Return the HU of a place on the slider, whole numbers."""
    track, (low, high) = slider_track(size), limits
    share = min(max((x - track.left) / max(track.width - 1, 1), 0.0), 1.0)
    return float(round(low + share * (high - low)))


def draw_slider(size: tuple[int, int], value: float, limits: Sequence[float], *, active: bool = True) -> Panel:
    """Draw the slider of the iso value with its scale."""
    pen, track, (low, high) = _Pen(size), slider_track(size), limits
    middle = track.top + track.height // 2
    color = ACCENT if active else FAINT
    pen.text(MARGIN, middle, "iso value", TEXT if active else FAINT, pixels=15)
    pen.box(Box(track.left, middle - 4, track.width, 8), RAISED, LINE)
    at = track.left + round(min(max((value - low) / max(high - low, 1e-6), 0.0), 1.0) * (track.width - 1))
    pen.box(Box(track.left, middle - 4, max(at - track.left, 6), 8), color)
    for hu in scale_marks(low, high, track.width):
        x = track.left + (hu - low) / (high - low) * (track.width - 1)
        pen.draw.line((x, middle + 9, x, middle + 13), (*LINE, 255))
        pen.text(x, middle + 21, f"{hu:g}", FAINT, anchor="mm", pixels=11)
    pen.draw.ellipse((at - 10, middle - 10, at + 10, middle + 10), (*color, 255), (*TEXT, 255), 2)
    pen.text(size[0] - MARGIN, middle, f"{value:g} HU", anchor="rm", pixels=20)
    if active:
        pen.hit(Box(track.left - 12, 0, track.width + 24, size[1]), {"slider": "iso"})
    return pen.finish()


def scale_marks(low: float, high: float, width: float, pixels: float = 90.0) -> list[float]:
    """Return round numbers between two, about one in so many pixels."""
    wish = (high - low) * pixels / max(width, 1.0)
    if not wish > 0.0:
        return []
    power = 10.0 ** np.floor(np.log10(wish))
    step = float(next(n * power for n in (1.0, 2.0, 5.0, 10.0) if n * power >= wish * 0.999))
    return [n * step for n in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def draw_status(size: tuple[int, int], said: str, facts: str, *, warning: bool = False) -> Panel:
    """Draw the line at the bottom: what was said last, and what the picture is."""
    pen, middle = _Pen(size, RAISED), size[1] / 2
    room = max(size[0] - 2 * MARGIN, 20)
    used = pen.text(MARGIN, middle, said, WARNING if warning else TEXT, width=SAID_SHARE * room)
    pen.text(size[0] - MARGIN, middle, facts, FAINT, anchor="rm", width=room - used - 2 * MARGIN)
    return pen.finish()


def draw_words(size: tuple[int, int], lines: Sequence[str]) -> Panel:
    """Draw a few lines in the middle: what is done before there is a picture."""
    pen = _Pen(size, (0, 0, 0))
    top = size[1] / 2 - 14 * (len(lines) - 1)
    for n, line in enumerate(lines):
        pen.text(
            size[0] / 2, top + 28 * n, line, TEXT if n == 0 else FAINT, anchor="mm", width=size[0] - 2 * MARGIN,
            pixels=20 if n == 0 else 15,
        )  # fmt: skip
    return pen.finish()


def draw_help(size: tuple[int, int], sections: Sequence[tuple[str, Sequence[tuple[str, str]]]]) -> Panel:
    """Draw the keys and gestures, in as many columns as are needed."""
    pen = _Pen(size, (18, 20, 23))
    pitch, top = 19, 26
    room = max((size[1] - 2 * top) // pitch, 6)
    columns: list[list[tuple[str, str] | str]] = [[]]
    for title, rows in sections:
        if columns[-1] and len(columns[-1]) + len(rows) + 2 > room:
            columns.append([])
        columns[-1] += [*([""] if columns[-1] else []), title, *rows]
    width = max((size[0] - 2 * MARGIN) // len(columns), 120)
    for place, lines in enumerate(columns):
        names = max((_font(TEXT_PIXELS).getlength(line[0]) for line in lines if not isinstance(line, str)), default=0.0)
        x = MARGIN + 6 + place * width
        for n, line in enumerate(lines):
            y = top + n * pitch
            if isinstance(line, str):
                pen.text(x, y, line, ACCENT)
            else:
                pen.text(x, y, line[0])
                pen.text(x + names + 14, y, line[1], FAINT, width=width - names - 24)
    return pen.finish()


def draw_side(
    size: tuple[int, int], facts: Mapping[str, Any], *, tools: Iterable[tuple[str, str, bool]] = (), first: int = 0,
    chosen: str | None = None,
) -> Panel:  # fmt: skip
    """Draw the list of modes, parts and tools.

    size: (width, height)
    facts: `ViewModel.facts`.
    tools: iterable of (key, words, whether it is on). Buttons below, each for a key of the window.
    first: Number of the part that the list of parts begins with: the wheel moves it.
    chosen: Key of the part that was picked last.
    """
    pen, tools = _Pen(size), list(tools)
    y = _draw_modes(pen, facts, MARGIN)
    foot = size[1] - -(-len(tools) // 2) * ROW - MARGIN - _clips_height(facts)
    y = _draw_parts(pen, facts, y + 8, foot - 8, first, chosen)
    y = _draw_clips(pen, facts, foot)
    half = (size[0] - 2 * MARGIN) // 2
    for n, (key, words, is_on) in enumerate(tools):
        box = Box(MARGIN + n % 2 * half, y + n // 2 * ROW, half - 3, ROW - 3)
        pen.box(box, ACCENT if is_on else RAISED)
        color = BACK if is_on else TEXT
        pen.text(box.left + 6, box.top + box.height / 2, words, color, width=half - 28, pixels=12)
        pen.text(
            box.left + box.width - 6, box.top + box.height / 2, key, BACK if is_on else FAINT, anchor="rm", pixels=12
        )
        pen.hit(box, {"key": key})
    return pen.finish()


def _draw_modes(pen: _Pen, facts: Mapping[str, Any], y: int) -> int:
    modes = facts.get("modes", ())
    if not modes:
        return y
    _title(pen, y, "show as", "o")
    y += ROW
    half = (pen.size[0] - 2 * MARGIN) // 2
    for n, mode in enumerate(modes):
        box = Box(MARGIN + n % 2 * half, y + n // 2 * ROW, half - 3, ROW - 3)
        is_on = mode["name"] == facts.get("mode")
        pen.box(box, ACCENT if is_on else RAISED)
        middle = box.top + box.height / 2
        pen.text(box.left + 6, middle, mode["name"], BACK if is_on else TEXT, width=box.width - 10, pixels=12)
        pen.hit(box, {"do": "set_mode", "name": mode["name"]})
    return y + -(-len(modes) // 2) * ROW


def _title(pen: _Pen, y: float, words: str, right: str = "") -> None:
    pen.text(MARGIN, y + ROW / 2 - 2, words, FAINT, pixels=12)
    if right:
        pen.text(pen.size[0] - MARGIN, y + ROW / 2 - 2, right, FAINT, anchor="rm", pixels=12)


def _draw_parts(pen: _Pen, facts: Mapping[str, Any], y: int, bottom: int, first: int, chosen: str | None) -> int:
    parts = facts.get("parts", ())
    rows = max((bottom - y) // ROW - 1, 0)
    if not parts or not rows:
        return y
    first = min(first, max(len(parts) - rows, 0))
    shown = parts[first : first + rows]
    count = f"{first + 1}-{first + len(shown)} of {len(parts)}" if len(shown) < len(parts) else ""
    _title(pen, y, "parts", count or "ml")
    y += ROW
    width = pen.size[0]
    for part in shown:
        middle, key = y + ROW / 2 - 1, part["key"]
        if key == chosen:
            pen.box(Box(3, y - 1, width - 6, ROW), RAISED, ACCENT)
        visible = part["visible"]
        eye = Box(MARGIN - 2, y + 2, 15, 15)
        pen.box(eye, None, FAINT)
        if visible:
            pen.draw.line([(MARGIN + 1, middle), (MARGIN + 5, middle + 4), (MARGIN + 11, middle - 4)], (*TEXT, 255), 2)
        rgb = tuple(round(255 * value) for value in part["color"] or PLAIN)
        swatch = Box(MARGIN + 18, y + 3, 13, 13)
        pen.box(swatch, rgb if visible else None, rgb)
        right = width - MARGIN - OPACITY_WIDTH - 6
        size = describe_size(part)
        used = pen.text(right, middle, size, FAINT, anchor="rm", pixels=12)
        name = Box(MARGIN + 36, y, int(right - used - 6) - MARGIN - 36, ROW)
        pen.text(name.left, middle, part["name"], TEXT if visible else FAINT, width=name.width, pixels=12)
        bar = Box(width - MARGIN - OPACITY_WIDTH, y + 5, OPACITY_WIDTH, 9)
        pen.box(bar, RAISED, LINE)
        pen.box(Box(bar.left, bar.top, max(round(part["opacity"] * bar.width), 2), bar.height), FAINT)
        pen.hit(name, {"select": key})
        pen.hit(eye, {"do": "show", "key": key, "visible": not visible})
        pen.hit(swatch, {"recolor": key})
        pen.hit(Box(bar.left, y, bar.width, ROW), {"do": "set_opacity", "key": key}, "value")
        y += ROW
    return y


def describe_size(part: Mapping[str, Any]) -> str:
    """Return the size of a part: ml of what is enclosed, else how many points or triangles it has."""
    if part.get("ml") is not None:
        ml = part["ml"]
        return f"{ml:,.0f}" if ml >= 100.0 else f"{ml:.1f}" if ml >= 1.0 else f"{ml:.2f}"
    count = part.get("count")
    return "" if count is None else f"{count:,}" if count < 100_000 else f"{count / 1e6:.2f} M"


def _clips_height(facts: Mapping[str, Any]) -> int:
    rows = len(facts.get("clips", ())) + (len(_AXES) if facts.get("clip_box") else 0)
    return (rows + 1) * ROW if rows else 0


_AXES = ("R - L", "A - P", "I - S")
"""The axes of LPS, from their lower to their higher end."""


def _draw_clips(pen: _Pen, facts: Mapping[str, Any], y: int) -> int:
    clips, box = facts.get("clips", ()), facts.get("clip_box")
    if not clips and not box:
        return y
    _title(pen, y, "clip")
    y += ROW
    width = pen.size[0]
    for n, clip in enumerate(clips):
        middle = y + ROW / 2 - 1
        pen.text(MARGIN, middle, clip_words(clip), width=70, pixels=12)
        bar = Box(MARGIN + 74, y + 5, width - MARGIN - 74 - 62, 9)
        pen.box(bar, RAISED, LINE)
        _handle(pen, bar, clip["share"])
        pen.hit(Box(bar.left, y, bar.width, ROW), {"do": "move_clip", "n": n}, "share")
        for words, left, action in (("flip", width - 58, "flip_clip"), ("x", width - 24, "remove_clip")):
            button = Box(left, y + 1, 30 if action == "flip_clip" else 14, ROW - 4)
            pen.box(button, RAISED)
            pen.text(left + button.width / 2, middle, words, anchor="mm", pixels=12)
            pen.hit(button, {"do": action, "n": n})
        y += ROW
    if box:
        for axis, (words, (low, high)) in enumerate(zip(_AXES, facts["clip_box_shares"], strict=True)):
            pen.text(MARGIN, y + ROW / 2 - 1, words, width=70, pixels=12)
            bar = Box(MARGIN + 74, y + 5, width - 2 * MARGIN - 74, 9)
            pen.box(bar, RAISED, LINE)
            inner = Box(round(bar.left + low * bar.width), bar.top, max(round((high - low) * bar.width), 1), bar.height)
            pen.box(inner, FAINT)
            _handle(pen, bar, low)
            _handle(pen, bar, high)
            pen.hit(Box(bar.left, y, bar.width, ROW), {"clip_box": axis}, "share")
            y += ROW
    return y


def clip_words(clip: Mapping[str, Any]) -> str:
    """Return the side that a clip plane takes away: its name, or the letters of an oblique one."""
    name = str(clip["name"])
    return name if name.isalpha() else f"side {orientation_letters(np.array(clip['direction'], dtype=np.float64))}"


def _handle(pen: _Pen, bar: Box, share: float) -> None:
    at = bar.left + round(min(max(share, 0.0), 1.0) * (bar.width - 1))
    pen.box(Box(at - 4, bar.top - 3, 8, 15), ACCENT)
