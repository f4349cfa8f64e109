"""Colours and opacities of labels."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.labels import LabelMap
from clrecon.rendering.pictures.label_style import LabelStyle, distinct_colors

LABELS = LabelMap(
    np.array([0, 4, 9, 9, 2, 0, 0, 4]).reshape(2, 2, 2), np.eye(4), {4: "vertebrae_L2", 9: "rib_left_1", 7: "heart"}
)


FROM_THE_PICTURE = -1
"""In place of a colour: the label keeps that of the picture."""


def test_labels_have_their_given_colours_and_opacities():
    style = LabelStyle.of(LABELS, {"L2": "red", 9: (0, 0.5, 1)}, {"rib_left_1": 0.25})

    assert (style.table.shape, style.table.dtype) == ((10, 4), np.float32)  # to the largest number
    assert style.table[4].tolist() == [1, 0, 0, 1]
    assert style.table[9].tolist() == [0, 0.5, 1, 0.25]


def test_labels_without_a_given_colour_keep_that_of_the_picture_and_are_opaque():
    table = LabelStyle.of(LABELS, {"L2": "red", 9: (0, 0.5, 1)}).table
    assert (table[[0, 1, 2, 3], :3] == FROM_THE_PICTURE).all()
    assert (table[[0, 2], 3] == 1).all()


def test_style_of_labels_is_opaque_without_an_opacity_below_1():
    assert LabelStyle.of(LABELS).is_opaque
    assert not LabelStyle.of(LABELS, opacity={"rib_left_1": 0.25}).is_opaque


def test_labels_have_different_colours_where_none_is_given():
    table = LabelStyle.of(LABELS).table

    colors = table[[2, 4, 9], :3]  # the numbers in the map
    assert (colors >= 0).all()
    assert (np.linalg.norm(colors[:, None] - colors, axis=-1) + np.eye(3) > 0.3).all()  # 0.54 was measured
    assert (table[[0, 1, 3], :3] == FROM_THE_PICTURE).all()


def test_labels_keep_the_colours_of_the_picture_where_an_empty_mapping_is_given():
    assert (LabelStyle.of(LABELS, {}).table[:, :3] == FROM_THE_PICTURE).all()


def test_opacity_of_a_label_changes_no_colour_and_no_other_label():
    plain, faint = LabelStyle.of(LABELS).table, LabelStyle.of(LABELS, opacity={"L2": 0.2, 0: 0.0}).table

    assert np.array_equal(plain[:, :3], faint[:, :3])
    opacities = np.ones(10, np.float32)
    opacities[[0, 4]] = 0.0, 0.2  # what has no label, and L2
    assert np.array_equal(faint[:, 3], opacities)


def test_opacity_of_what_has_no_label_is_given_by_the_text_0_too():
    table = LabelStyle.of(LABELS, opacity={"0": 0.5}).table
    assert table[0].tolist() == [*[FROM_THE_PICTURE] * 3, 0.5]


def test_thirty_labels_have_colours_apart_from_each_other():
    colors = distinct_colors(30)
    assert (colors >= 0).all() and (colors <= 1).all()
    assert (np.linalg.norm(colors[:, None] - colors, axis=-1) + np.eye(30) > 0.02).all()  # 0.11 was measured


def test_colours_of_labels_do_not_depend_on_how_many_there_are():
    assert np.array_equal(distinct_colors(30)[:7], distinct_colors(7))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"colors": {"L7": "red"}}, "'L7' is not in the label map; there are: 2 label_2, 4 vertebrae_L2, 9 rib_left_1"),
        ({"colors": {"heart": "red"}}, "has no voxel"),
        ({"colors": {"L2": "crimsonish"}}, "unknown colour 'crimsonish'"),
        ({"colors": ["red"]}, "mapping"),
        ({"opacity": {"L2": 1.5}}, "the opacity of label vertebrae_L2 is a number from 0 to 1, not 1.5"),
        ({"opacity": {"L2": "thin"}}, "from 0 to 1, not 'thin'"),
        ({"opacity": {"L2": float("nan")}}, "from 0 to 1"),
        ({"colors": {0: "red"}}, r"what has no label \(0\) keeps the colours"),
        ({"opacity": {"0": 0.5, 0: 0.6}}, "label 0 is named twice"),
        ({"opacity": {0: 1.5}}, "the opacity of label 0 is a number from 0 to 1, not 1.5"),
        ({"opacity": {"L2": 0.5, 4: 0.6}}, "label 4 vertebrae_L2 is named twice"),
    ],
)
def test_wrong_colour_or_opacity_of_a_label_is_refused(wrong, says):
    with pytest.raises(UsageError, match=says):
        LabelStyle.of(LABELS, **wrong)


def test_style_of_an_array_in_place_of_a_label_map_is_refused():
    with refused(UsageError, "LabelMap"):
        LabelStyle.of(LABELS.voxels)
