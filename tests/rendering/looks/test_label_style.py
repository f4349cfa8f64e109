"""Colours and opacities of labels."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.errors import UsageError
from clrecon.labels import LabelMap
from clrecon.rendering.pictures.label_style import LabelStyle, distinct_colors

LABELS = LabelMap(
    np.array([0, 4, 9, 9, 2, 0, 0, 4]).reshape(2, 2, 2), np.eye(4), {4: "vertebrae_L2", 9: "rib_left_1", 7: "heart"}
)


def test_named_labels_have_their_colours_and_the_others_keep_the_pictures():
    style = LabelStyle.of(LABELS, {"L2": "red", 9: (0, 0.5, 1)}, {"rib_left_1": 0.25})
    assert style.table.shape == (10, 4) and style.table.dtype == np.float32
    assert style.table[4].tolist() == [1, 0, 0, 1] and style.table[9].tolist() == [0, 0.5, 1, 0.25]
    assert (style.table[[0, 1, 2, 3], :3] < 0).all() and (style.table[[0, 2], 3] == 1).all()
    assert not style.is_opaque and LabelStyle.of(LABELS).is_opaque


def test_without_colours_each_label_has_its_own():
    table = LabelStyle.of(LABELS).table
    colors = table[[2, 4, 9], :3]
    assert (colors >= 0).all() and (table[[0, 1, 3], :3] < 0).all()
    assert (np.linalg.norm(colors[:, None] - colors, axis=-1) + np.eye(3) > 0.3).all()
    assert (LabelStyle.of(LABELS, {}).table[:, :3] < 0).all()


def test_an_opacity_leaves_all_colours_as_they_are():
    plain, faint = LabelStyle.of(LABELS).table, LabelStyle.of(LABELS, opacity={"L2": 0.2, 0: 0.0}).table
    assert np.array_equal(plain[:, :3], faint[:, :3])
    assert faint[:, 3].tolist() == [0.0, 1.0, 1.0, 1.0, np.float32(0.2), 1.0, 1.0, 1.0, 1.0, 1.0]
    assert np.array_equal(LabelStyle.of(LABELS, opacity={"0": 0.5}).table[0], np.array([-1, -1, -1, 0.5], np.float32))


def test_many_labels_keep_colours_apart():
    colors = distinct_colors(30)
    assert (colors >= 0).all() and (colors <= 1).all()
    assert (np.linalg.norm(colors[:, None] - colors, axis=-1) + np.eye(30) > 0.02).all()
    assert np.array_equal(colors[:7], distinct_colors(7))


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
def test_bad_input_is_refused(wrong, says):
    with pytest.raises(UsageError, match=says):
        LabelStyle.of(LABELS, **wrong)
    with pytest.raises(UsageError, match="LabelMap"):
        LabelStyle.of(LABELS.voxels)
