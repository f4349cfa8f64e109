"""`PictureData`, the plain values of a picture and what is written on it: letters, scale bar in mm, a line."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.rendering.pictures.pillow import load_font, load_pillow
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.directions import DIRECTIONS
from clrecon.rendering.views.reformation import Sheet
from clrecon.system.base_classes import Message
from clrecon.system.light_dataclass import dataclass, field

if TYPE_CHECKING:
    from PIL import Image


class Text(NamedTuple):
    """A line of text on a picture; x and the baseline y are pixels from the top left corner, `size` is its height.

    align: {"l", "m", "r"}. Where x lies in the line: at its left end, in the middle, at its right end.
    outline: Colour around the letters, of `stroke` pixels; None: no outline.
    """

    text: str
    x: float
    y: float
    align: str
    size: float
    fill: str = "black"
    outline: str | None = None
    stroke: float = 0.0


class Bar(NamedTuple):
    """A scale bar on a picture: left, top, width and height in pixels, with an outline of `stroke` pixels."""

    left: float
    top: float
    width: float
    height: float
    fill: str
    outline: str
    stroke: float


@dataclass(frozen=True, eq=False)
class Drawing:
    """What vector files draw in place of pixels: the picture without text and bars, (h, w, 4) uint8, and these."""

    ground: NDArray[np.uint8]
    marks: tuple[Text | Bar, ...] = ()


@dataclass
class PictureData(Message):
    """Pixels, depths and camera of a picture; see `clrecon.rendering.Rendering` for each attribute."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    expected_depth: NDArray[np.float32]
    camera: Camera | None
    values: NDArray[np.float32] | None = None
    mode: str = "dvr"
    report: dict[str, Any] = field(default_factory=dict)
    drawing: Drawing | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.image.shape[1], self.image.shape[0]

    @property
    def pixel_mm(self) -> float | None:
        """Side of a pixel in mm; None if it varies within the picture (perspective)."""
        if self.camera is not None:
            return self.camera.pixel_mm(self.size) if self.camera.is_parallel else None
        stated = self.report.get("pixel_mm")
        return None if stated is None else float(stated)

    @property
    def is_opaque(self) -> bool:
        """True if no pixel is transparent, not even partly."""
        return bool((self.image[..., 3] == 255).all())


SMALLEST_SIDE = 64
"""Smallest width and height in pixels; letters in smaller pictures cannot be read."""

LEAST_SHARE = 0.05
"""Smallest component of a unit vector that gets a letter: a turn by 3 degrees."""

TEXT_SHARE, _SMALLEST_TEXT = 1 / 28, 9.0
"""Height of the text as a share of the shorter side, and the smallest height in pixels."""

_PRINTED_TEXT = 8.0 / 72.0
"""Height of the text in inches of the printed figure: 8 points, which journals ask for."""

LONGEST_BAR_SHARE = 0.35
"""Longest scale bar as a share of the width.  After rounding down to 1, 2 or 5 x 10^n mm it is at least 14 %."""


class _Ink(NamedTuple):
    """Grey of the annotations, and of the outline around them."""

    fill: int
    outline: int


def orientation_letters(direction: ArrayLike) -> str:
    """Name a direction in the patient, a vector in LPS, as DICOM's Patient Orientation does: ``L``, ``LP``, ``PLS``.

    Letters L, R, P, A, S (superior, DICOM's H) and I (inferior, DICOM's F), one for each component, the largest first
    (DICOM PS3.3 C.7.6.1.1.1).  Components of less than 5 % get no letter; equal ones come in the order x, y, z.
    """
    vector = np.asarray(direction, dtype=np.float64)
    vector = vector / np.linalg.norm(vector)
    letters = {name[0].upper(): float(np.dot(vector, side)) for name, side in DIRECTIONS.items()}
    shares = {letter: round(share, 6) for letter, share in letters.items() if share >= LEAST_SHARE}
    return "".join(sorted(shares, key=lambda letter: (-shares[letter], "LRPASI".index(letter))))


def edge_letters(camera: Camera) -> dict[str, str]:
    """Letters of the directions to the ``left``, ``right``, ``top`` and ``bottom`` edge of a camera's picture."""
    right, up, _ = camera.basis()
    edges = {"left": -right, "right": right, "top": up, "bottom": -up}
    return {edge: orientation_letters(direction) for edge, direction in edges.items()}


def sheet_letters(sheet: Sheet, rows: NDArray[np.bool_]) -> dict[str, str]:
    """Letters of the edges of a sheet along a curve, of sides all `rows` look at; empty where none is true for all."""
    right = sheet.steps[rows]
    up = np.cross(right, sheet.normals[rows])
    edges = {"left": -right, "right": right, "top": up, "bottom": -up}
    return {
        edge: os.path.commonprefix([orientation_letters(direction) for direction in directions])
        for edge, directions in edges.items()
    }


def bar_length(width_mm: float) -> float:
    """Longest length of the form 1, 2 or 5 x 10^n mm within 35 % of a picture's width in mm."""
    longest = LONGEST_BAR_SHARE * width_mm * (1.0 + 1e-12)
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= longest))


def annotate(
    rendering: PictureData,
    *,
    letters: bool = False,
    scale_bar: bool = False,
    caption: str | None = None,
    dpi: float | None = None,
) -> tuple[NDArray[np.uint8], Drawing | None]:
    """Draw annotations into a copy of a picture, (h, w, 4), and return the drawing of vector files with it.

    Without any annotation these are the picture's own.

    letters: Mark each edge with the side of the patient in its direction, see `orientation_letters`; along a curve only
        those that are true for all of the picture, see `sheet_letters`.
    scale_bar: Draw a bar of a round length at the bottom left.  In a perspective picture the bar is valid in the focal
        plane only, and its text says so.
    caption: One line of text at the top left, cut at the edge of the picture.
    dpi: Pixels per inch of the printed figure, for text of 8 points; None: text of a share of the picture.
    """
    check_caption(caption)
    if not (letters or scale_bar or caption):
        return rendering.image, rendering.drawing
    width, height = rendering.size
    if min(width, height) < SMALLEST_SIDE:
        raise UsageError(
            f"a picture of {width} x {height} pixels is too small for letters or a scale bar:"
            f" at least {SMALLEST_SIDE} x {SMALLEST_SIDE}"
        )
    page = _Page(rendering, dpi)
    if letters:
        edges = rendering.report.get("edges") if rendering.camera is None else edge_letters(rendering.camera)
        if edges is None:
            raise UsageError(
                "the sides of the patient at the edges of this picture are not known: leave the letters out"
            )
        for edge, text in edges.items():
            if text:
                page.draw_edge(edge, text)
    if scale_bar:
        camera, pixel_mm = rendering.camera, rendering.pixel_mm
        plane_note = ""
        if camera is not None and not camera.is_parallel:
            pixel_mm, plane_note = camera.pixel_mm(rendering.size), " (focal plane)"
        if pixel_mm is None:
            raise UsageError("the size of this picture's pixels is not known: leave the scale bar out")
        length = bar_length(pixel_mm * rendering.size[0])
        page.draw_bar(*(length / pixel_mm, f"{length:g} mm{plane_note}"))
    if caption:
        page.draw_caption(caption)
    return page.finish()


def text_pixels(share: float, side: int, dpi: float | None) -> float:
    """Return the height of text: 8 points of a figure printed with `dpi`, else a share of a side of the picture."""
    return max(_SMALLEST_TEXT, share * side if dpi is None else _PRINTED_TEXT * dpi)


def check_caption(caption: str | None) -> None:
    """Refuse a caption with characters that the font lacks: they would be drawn as boxes."""
    if not caption:
        return
    font = load_font(4.0 * _SMALLEST_TEXT)
    box = bytes(font.getmask("\uffff"))  # not a character: the font draws its box for missing ones
    absent = [
        letter for letter in dict.fromkeys(caption) if letter.isprintable() and bytes(font.getmask(letter)) == box
    ]
    if absent:
        raise UsageError(f"captions cannot be drawn with {' '.join(absent)}: the font has plain Latin letters only")


class _Page:
    """A page for annotations: two masks, one for the strokes and one for the outlines around them."""

    def __init__(self, rendering: PictureData, dpi: float | None):
        load_pillow()
        from PIL import Image, ImageDraw

        self._picture = Image.fromarray(np.ascontiguousarray(rendering.image))
        self._size = rendering.size
        self._masks = [Image.new("L", self._size, 0) for _ in range(2)]
        self._pens = [ImageDraw.Draw(mask) for mask in self._masks]
        self._ink = _choose_ink(rendering)
        self._drawing = rendering.drawing or Drawing(rendering.image)
        self._marks: list[Text | Bar] = []
        shorter = min(self._size)
        text = text_pixels(TEXT_SHARE, shorter, dpi)
        self._font = load_font(text)
        self._margin = max(2, round(0.02 * shorter))
        self._stroke = max(1, round(text / 14.0))
        self._boxes: list[tuple[float, float, float, float]] = []

    def draw_edge(self, edge: str, text: str) -> None:
        width, height = self._size
        gap = self._margin + self._stroke
        # Anchors of Pillow: left, middle, right; top, middle, baseline.  Capitals have no descender.
        x, y, anchor = {
            "left": (gap, height / 2, "lm"),
            "right": (width - gap, height / 2, "rm"),
            "top": (width / 2, gap, "mt"),
            "bottom": (width / 2, height - gap, "ms"),
        }[edge]
        self._write((x, y), text, anchor)

    def draw_bar(self, pixels: float, text: str) -> None:
        """Draw a bar with text over it; its filled part is `pixels` long, rounded to a whole number."""
        thickness = max(2, round(0.18 * self._font.size))
        left = self._margin + self._stroke
        end = left + max(1, round(pixels))
        bottom = self._size[1] - left
        over = thickness + 2 * self._stroke + max(1, round(0.12 * self._font.size))
        if self._overlaps(self._box((left, bottom - over), text, "ls")):
            bottom -= round(self._font.size) + self._stroke  # above the letters of the bottom edge
        for pen, border in zip(self._pens, (self._stroke, 0), strict=True):
            pen.rectangle((left - border, bottom - thickness - border, end - 1 + border, bottom - 1 + border), fill=255)
        self._marks.append(Bar(left, bottom - thickness, pixels, thickness, *self._pen_style))
        self._write((left, bottom - over), text, "ls")

    def draw_caption(self, text: str) -> None:
        """Draw one line at the top left, cut before the letters of the top edge."""
        line = "".join(character if character.isprintable() else " " for character in text)
        corner = (self._margin + self._stroke, self._margin + self._stroke)
        ends = [left for left, top, _, _ in self._boxes if top < corner[1] + self._font.size]
        room = min([self._size[0] - self._margin, *ends]) - corner[0] - 3 * self._stroke
        if self._font.getlength(line) > room:
            while line and self._font.getlength(line + "...") > room:
                line = line[:-1].rstrip()
            line += "..."
        self._write(corner, line, "lt")

    def finish(self) -> tuple[NDArray[np.uint8], Drawing]:
        from PIL import Image

        picture = self._picture
        for mask, grey in zip(self._masks, (self._ink.outline, self._ink.fill), strict=True):
            layer: Image.Image = Image.new("RGBA", self._size, (grey, grey, grey, 0))
            layer.putalpha(mask)
            picture = Image.alpha_composite(picture, layer)
        return np.array(picture), Drawing(self._drawing.ground, (*self._drawing.marks, *self._marks))

    @property
    def _pen_style(self) -> tuple[str, str, float]:
        fill, outline = ("white", "black") if self._ink.fill else ("black", "white")
        return fill, outline, self._stroke

    def _write(self, corner: tuple[float, float], text: str, anchor: str) -> None:
        box = self._box(corner, text, anchor)
        left, top, right, bottom = box
        if left < 0 or top < 0 or right > self._size[0] or bottom > self._size[1] or self._overlaps(box):
            width, height = self._size
            raise UsageError(
                f"a picture of {width} x {height} pixels has no room for {text!r}: make it larger, or draw less in it"
            )
        self._boxes.append(box)
        baseline = corner[1] + top - self._box(corner, text, f"{anchor[0]}s")[1]
        self._marks.append(Text(text, corner[0], baseline, anchor[0], self._font.size, *self._pen_style))
        for pen, stroke in zip(self._pens, (self._stroke, 0), strict=True):
            pen.text(corner, text, 255, self._font, anchor, stroke_width=stroke)

    def _box(self, corner: tuple[float, float], text: str, anchor: str) -> tuple[float, float, float, float]:
        return self._pens[0].textbbox(corner, text, self._font, anchor, stroke_width=self._stroke)

    def _overlaps(self, box: tuple[float, float, float, float]) -> bool:
        left, top, right, bottom = box
        return any(left < r and l < right and top < b and t < bottom for l, t, r, b in self._boxes)  # noqa: E741


def _choose_ink(rendering: PictureData) -> _Ink:
    """Choose white ink for a dark or transparent picture and black for a bright one; the border decides."""
    rim = max(1, round(0.08 * min(rendering.size)))
    inside = np.zeros(rendering.image.shape[:2], dtype=bool)
    inside[rim:-rim, rim:-rim] = True
    border = rendering.image[~inside].astype(np.float64)
    seen = border[:, :3].mean(axis=1) * border[:, 3] / 255.0
    return _Ink(0, 255) if seen.mean() > 140.0 else _Ink(255, 0)
