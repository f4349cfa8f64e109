"""Figures for papers: SVG with letters, bars and names as vectors over the picture, and sizes of the printed page."""

from __future__ import annotations

import base64
from io import BytesIO
from xml.etree import ElementTree

import numpy as np
import pytest
from picture_files import PARALLEL, make_picture
from PIL import Image
from refusals import refused

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.picture import encode_image
from clrecon.rendering.pictures.sheets import add_legend, add_scale
from clrecon.system.color_scale import ColorScale

SIZE = (600, 400)
PIXEL_MM = 2.0 * PARALLEL.parallel_scale / SIZE[1]
SVG = "{http://www.w3.org/2000/svg}"
POINTS_PER_INCH = 72.0


def parse_svg(picture: Rendering) -> ElementTree.Element:
    return ElementTree.fromstring(encode_image(picture, ".svg"))


def read_texts(figure: ElementTree.Element) -> list[str]:
    return [text.text or "" for text in figure.iter(f"{SVG}text")]


def read_pixels(figure: ElementTree.Element) -> np.ndarray:
    (image,) = figure.iter(f"{SVG}image")
    _, _, data = image.attrib["{http://www.w3.org/1999/xlink}href"].partition("base64,")
    return np.array(Image.open(BytesIO(base64.b64decode(data))))


def test_svg_has_sides_caption_and_length_as_text_over_the_plain_picture():
    picture = make_picture(SIZE)

    figure = parse_svg(picture.annotated(letters=True, scale_bar=True, caption="T12 <left> & right"))

    assert read_texts(figure) == ["R", "L", "S", "I", "100 mm", "T12 <left> & right"]
    assert np.array_equal(read_pixels(figure), picture.image)


def test_scale_bar_of_svg_is_exactly_as_long_as_it_says():
    figure = parse_svg(make_picture(SIZE).annotated(scale_bar=True))

    (bar,) = figure.iter(f"{SVG}rect")
    assert float(bar.attrib["width"]) * PIXEL_MM == pytest.approx(100.0, rel=1e-5)  # six digits are written


def test_text_of_svg_stands_where_the_png_has_it():
    picture = make_picture(SIZE, background=(0, 0, 0, 255))
    annotated = picture.annotated(letters=True)

    (left, *_) = parse_svg(annotated).iter(f"{SVG}text")

    rows, columns = np.nonzero((annotated.image != picture.image).any(axis=2)[:, : SIZE[0] // 4])
    assert float(left.attrib["x"]) == pytest.approx(columns.min(), abs=2.0)  # the letter's own margin
    assert float(left.attrib["y"]) == pytest.approx(rows.max() + 1, abs=1.0)  # letters end at the baseline


def test_figure_of_a_resolution_has_its_size_in_mm_and_text_of_eight_points():
    figure = parse_svg(make_picture(SIZE).annotated(letters=True, dpi=300))

    assert figure.attrib["width"] == f"{600 / 300 * 25.4:g}mm"
    assert figure.attrib["height"] == f"{400 / 300 * 25.4:.6g}mm"
    sizes = [float(text.attrib["font-size"]) for text in figure.iter(f"{SVG}text")]
    assert sizes == pytest.approx([8.0 / POINTS_PER_INCH * 300] * 4, rel=1e-5)


def test_svg_without_a_resolution_has_a_pixel_for_each_of_the_screen():
    figure = parse_svg(make_picture(SIZE))

    assert (figure.attrib["width"], figure.attrib["height"]) == ("600", "400")
    assert figure.attrib["viewBox"] == "0 0 600 400"


@pytest.mark.parametrize("extension", [".png", ".tif", ".jpg"])
def test_file_of_a_figure_has_the_resolution_of_the_print(extension):
    picture = make_picture(SIZE).annotated(dpi=300)

    with Image.open(BytesIO(encode_image(picture, extension))) as read:
        assert float(read.info["dpi"][0]) == pytest.approx(300.0, rel=1e-4)  # PNG has whole pixels a metre


def test_background_goes_below_the_text_of_a_figure():
    annotated = make_picture(SIZE, background=(0, 0, 0, 0)).annotated(letters=True)

    figure = parse_svg(annotated.with_background("white"))

    assert read_texts(figure) == ["R", "L", "S", "I"]
    assert read_pixels(figure)[0, 0].tolist() == [255, 255, 255, 255]


def test_names_of_labels_are_text_at_the_right_of_a_figure():
    figure = parse_svg(add_legend(make_picture(SIZE).annotated(letters=True), [("#ff0000", "L1"), ("#00ff00", "L2")]))

    assert read_texts(figure) == ["R", "L", "S", "I", "L1", "L2"]
    places = {text.text: float(text.attrib["x"]) for text in figure.iter(f"{SVG}text")}
    assert min(places["L1"], places["L2"]) > SIZE[0]
    assert float(figure.attrib["width"]) == read_pixels(figure).shape[1] > SIZE[0]


def test_numbers_of_a_colour_scale_are_text_of_a_figure():
    scale = ColorScale(4.0, signed=False)

    figure = parse_svg(add_scale(make_picture(SIZE), scale, "wall, mm"))

    assert read_texts(figure) == ["wall, mm", *(f"{tick:g}" for tick in scale.ticks)]


@pytest.mark.parametrize("dpi", [35.0, 5000.0, float("nan"), "fine"])
def test_resolution_that_no_print_has_is_refused(dpi):
    with refused(UsageError, "inch", 36, 4800):
        make_picture(SIZE).annotated(dpi=dpi)


def test_text_without_room_at_its_size_in_print_is_refused():
    with refused(UsageError, "room", 120):
        make_picture((120, 80)).annotated(letters=True, scale_bar=True, caption="T12", dpi=600)
