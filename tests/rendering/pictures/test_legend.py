"""The legend of labels: which labels it names, in which colours, and where it lies beside a picture."""

from __future__ import annotations

import numpy as np
from refusals import refused

from clrecon.errors import UsageError
from clrecon.jobs.render.settings import LabelLook, RenderSettings
from clrecon.labels import LabelMap
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.label_style import LabelStyle, list_legend
from clrecon.rendering.pictures.sheets import add_legend


def black_picture(*, width: int, height: int) -> Rendering:
    image = np.zeros((height, width, 4), np.uint8)
    image[..., 3] = 255
    nothing = np.full((height, width), np.nan, np.float32)
    return Rendering(image, nothing, nothing, None)


def has_color(image: np.ndarray, rgb: tuple[int, int, int]) -> bool:
    return bool((image[..., :3] == rgb).all(axis=-1).any())


def test_legend_names_labels_that_are_coloured_and_not_hidden() -> None:
    labels = LabelMap(np.array([[[1, 2, 3]]], np.uint8), np.eye(4), {1: "L1", 2: "L2", 3: "Sacrum / S1"})
    look = LabelStyle.of(labels, {"L1": "#ff0000", "L2": "#00ff00", 3: "#0000ff"}, {"L2": 0.0})

    assert list_legend(look) == [("#ff0000", "L1"), ("#0000ff", "Sacrum_S1")]


def test_legend_lies_at_the_right_of_the_picture_which_keeps_its_pixels() -> None:
    picture = black_picture(width=60, height=200)

    with_legend = add_legend(picture, [("#ff0000", "L1"), ("#00ff00", "L2")])

    assert np.array_equal(with_legend.image[:, :60], picture.image)
    legend = with_legend.image[:, 60:]
    assert has_color(legend, (255, 0, 0)) and has_color(legend, (0, 255, 0))
    assert with_legend.size[1] == 200


def test_labels_beyond_the_height_of_the_picture_have_no_colours_in_its_legend() -> None:
    colors = [(200, number, 0) for number in range(100)]
    labels = [("#" + bytes(color).hex(), f"label {number}") for number, color in enumerate(colors)]

    legend = add_legend(black_picture(width=60, height=200), labels).image[:, 60:]

    is_named = [has_color(legend, color) for color in colors]
    count = sum(is_named)
    assert 5 < count < 20  # rows of about 14 pixels in 200
    assert is_named == [True] * count + [False] * (100 - count)


def test_legend_without_a_label_map_is_refused() -> None:
    assert RenderSettings.of(labels=LabelLook("map.nii.gz"), legend=True).legend
    with refused(UsageError, "legend", "labels"):
        RenderSettings.of(legend=True)
