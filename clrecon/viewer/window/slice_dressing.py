"""Slices as the window shows them: letters, scale, the lines of the other slices, measures that lie in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.rendering.pictures.annotations import bar_length, edge_letters
from clrecon.viewer.window.picture_overlay import MEASURE_COLOR, PLANE_COLORS, marked_lines

if TYPE_CHECKING:
    from clrecon.rendering import Rendering
    from clrecon.rendering.views.camera import Camera

NORMALS = {"axial": 2, "coronal": 1, "sagittal": 0}
"""Axis of the patient across each slice."""

NEAR_MM = 2.0
"""Points of measures are drawn in slices that pass them so near."""

TEXT_PIXELS = 13
WHITE = (255, 255, 255, 255)

GAP = 7
"""Pixels around the cross that stay free."""


def dress_slice(rendering: Rendering, plane: str, facts: Mapping[str, Any]) -> NDArray[np.uint8]:
    """Return the image of a slice with all that is drawn over it.

    rendering: A slice with a camera.
    plane: "axial", "coronal" or "sagittal".
    facts: `ViewModel.facts`.

    Returns: ndarray, shape (h, w, 4), uint8. Opaque.
    """
    from PIL import Image, ImageDraw

    from clrecon.rendering.pictures.pillow import load_font, load_pillow

    load_pillow()
    camera, (width, height) = rendering.camera, rendering.size
    assert camera is not None
    page = Image.fromarray(rendering.with_background((0.0, 0.0, 0.0)).image)
    pen = ImageDraw.Draw(page)
    (x, y), _ = _pixel(camera, rendering.size, facts["cross"])
    for other, axis in NORMALS.items():
        if other != plane:
            color = _ink(PLANE_COLORS[other])
            right = abs(camera.basis().right[axis]) > abs(camera.basis().up[axis])
            if right:  # the other slice is seen as a line from top to bottom
                pen.line((x, 0, x, y - GAP), color)
                pen.line((x, y + GAP, x, height), color)
            else:
                pen.line((0, y, x - GAP, y), color)
                pen.line((x + GAP, y, width, y), color)
    _draw_measures(pen, camera, rendering.size, facts, NORMALS[plane])
    ink = _ink(PLANE_COLORS[plane])
    pen.rectangle((0, 0, width - 1, height - 1), outline=ink)
    font = load_font(TEXT_PIXELS)
    pen.text((6, 5), plane, ink, font)
    places = {
        "left": ((6, height / 2), "lm"),
        "right": ((width - 6, height / 2), "rm"),
        "top": ((width / 2, 5), "mt"),
        "bottom": ((width / 2, height - 6), "ms"),
    }
    for edge, letters in edge_letters(camera).items():
        _write(pen, *places[edge], letters, font)
    pixel = camera.pixel_mm(rendering.size)
    length = bar_length(0.7 * pixel * width)
    bottom = height - 7
    pen.line([(7, bottom - 4), (7, bottom), (7 + length / pixel, bottom), (7 + length / pixel, bottom - 4)], WHITE, 2)
    _write(pen, (7, bottom - 6), "ls", f"{length:g} mm", font)
    return np.array(page)


def dress_curve(rendering: Rendering) -> NDArray[np.uint8]:
    """Return the image of a picture along a curve, with its name and a frame, (h, w, 4) uint8, opaque."""
    from PIL import Image, ImageDraw

    from clrecon.rendering.pictures.pillow import load_font, load_pillow

    load_pillow()
    page = Image.fromarray(rendering.with_background((0.0, 0.0, 0.0)).image)
    pen = ImageDraw.Draw(page)
    color = _ink(MEASURE_COLOR)
    pen.rectangle((0, 0, page.width - 1, page.height - 1), outline=color)
    pen.text((6, 5), "along the curve", color, load_font(TEXT_PIXELS))
    return np.array(page)


def slice_place(
    camera: Camera, size: tuple[int, int], at: tuple[float, float], cross: Any
) -> tuple[float, float, float]:
    """Return the place in LPS mm that a pixel of a slice through the cross shows.

    camera: Of the slice's picture.
    size: (width, height). Of that picture.
    at: (x, y). Pixels from its top left corner.
    cross: (x, y, z). LPS mm.
    """
    right, up, forward = camera.basis()
    width, height = size
    pixel = camera.pixel_mm(size)
    place = np.array(camera.position) + (at[0] + 0.5 - 0.5 * width) * pixel * right
    place = place + (0.5 * height - at[1] - 0.5) * pixel * up
    place = place + ((np.array(cross) - place) @ forward) * forward
    x, y, z = place.tolist()
    return x, y, z


def _write(pen: Any, at: tuple[float, float], anchor: str, words: str, font: Any) -> None:
    """Write in white with a dark rim, so that it is read over lines and bone."""
    pen.text(at, words, WHITE, font, anchor, stroke_width=2, stroke_fill=(0, 0, 0, 255))


def _draw_measures(pen: Any, camera: Camera, size: tuple[int, int], facts: Mapping[str, Any], axis: int) -> None:
    from clrecon.rendering.pictures.pillow import load_font

    for points, words, is_line in marked_lines(facts):
        near = np.abs(points[:, axis] - facts["cross"][axis]) <= NEAR_MM
        places = [_pixel(camera, size, point)[0] for point in points]
        color = _ink(MEASURE_COLOR)
        if is_line and near.all():
            pen.line(places, color, 2)
            if words:
                pen.text((places[-1][0] + 6, places[-1][1] - 6), words, color, load_font(TEXT_PIXELS), "ls")
        for (x, y), is_near in zip(places, near, strict=True):
            if is_near:
                pen.ellipse((x - 3, y - 3, x + 3, y + 3), color)


def _pixel(camera: Camera, size: tuple[int, int], point: Any) -> tuple[tuple[float, float], float]:
    pixels, depths = camera.project([point], size)
    return (float(pixels[0, 0]), float(pixels[0, 1])), float(depths[0])


def _ink(color: tuple[float, float, float]) -> tuple[int, int, int, int]:
    red, green, blue = (round(255 * value) for value in color)
    return red, green, blue, 255
