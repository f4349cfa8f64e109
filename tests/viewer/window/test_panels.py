"""Panels of the window as pictures, and what a click on them gives."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.viewer.window.layout import PLANES, lay_out
from clrecon.viewer.window.panels import (
    ACCENT,
    describe_size,
    draw_help,
    draw_side,
    draw_slider,
    draw_status,
    draw_words,
    scale_marks,
    slider_track,
    slider_value,
)
from clrecon.viewer.window.window_keys import KEYS, help_sections, side_buttons

PARTS = [
    {"key": f"1/{n}", "name": f"part {n}", "kind": "cluster", "ml": 100.0 / n, "count": 5, "color": None,
     "opacity": 0.5, "visible": n != 2}
    for n in range(1, 31)
]  # fmt: skip
FACTS = {
    "modes": [{"name": "surface", "words": ""}, {"name": "mip", "words": ""}, {"name": "drr", "words": ""}],
    "mode": "surface", "parts": PARTS, "clips": [{"name": "left", "share": 0.25}], "clip_box": [[0, 0, 0], [1, 1, 1]],
    "clip_box_shares": [(0.1, 0.9), (0.2, 0.8), (0.0, 1.0)], "tool": "angle", "table": True,
    "iso": {"hu": 200.0, "low": -100.0, "high": 900.0},
}  # fmt: skip


@pytest.mark.parametrize("size", [(1280, 860), (700, 500), (320, 240), (64, 64), (1920, 300)])
@pytest.mark.parametrize("slices", [True, False])
def test_boxes_lie_within_the_window_and_beside_each_other(size, slices):
    layout = lay_out(size, slices=slices)
    taken = np.zeros(size[::-1], int)
    for box in layout.boxes.values():
        assert box.left >= 0 and box.top >= 0 and min(box.size) > 0
        assert box.left + box.width <= size[0] and box.top + box.height <= size[1]
        taken[box.top : box.top + box.height, box.left : box.left + box.width] += 1
    assert taken.max() == 1
    assert "picture" in layout.boxes
    assert slices or not set(PLANES) & set(layout.boxes)


def test_the_picture_is_the_largest_box_and_a_wide_window_has_all():
    boxes = lay_out((1280, 860)).boxes
    assert set(boxes) == {"picture", "side", "slider", "status", *PLANES}
    assert max(boxes.values(), key=lambda box: box.width * box.height) == boxes["picture"]


def test_a_viewport_is_the_share_of_the_window_from_its_bottom():
    box = lay_out((1000, 500)).boxes["status"]
    left, bottom, right, top = box.viewport((1000, 500))
    assert (left, bottom, right) == (0.0, 0.0, 1.0) and top == pytest.approx(box.height / 500)


def test_the_slider_gives_whole_hu_from_end_to_end():
    track = slider_track((800, 62))
    ends = [slider_value((800, 62), x, (-100.0, 900.0)) for x in (track.left - 50, track.left + track.width + 50)]
    assert ends == [-100.0, 900.0]
    middle = slider_value((800, 62), track.left + (track.width - 1) / 2, (-100.0, 900.0))
    assert middle == 400.0


def test_the_handle_of_the_slider_stands_where_a_click_gives_its_value():
    for hu in (-100.0, 120.0, 900.0):
        image = draw_slider((800, 62), hu, (-100.0, 900.0)).image
        row = image[slider_track((800, 62)).top + 4, :, :3]  # above the bar: the handle alone
        columns = np.flatnonzero((row == ACCENT).all(axis=1))
        assert slider_value((800, 62), float(columns.mean()), (-100.0, 900.0)) == pytest.approx(hu, abs=2.0)


def test_a_slider_without_a_scan_answers_nothing():
    assert draw_slider((800, 62), 0.0, (-1000.0, 2000.0), active=False).hits == []


@pytest.mark.parametrize(("low", "high", "marks"), [(-1000, 2000, 7), (0, 1, 6), (5.0, 5.0, 0)])
def test_marks_of_a_scale_are_round_and_few(low, high, marks):
    found = scale_marks(low, high, 500.0, 80.0)
    assert len(found) == marks
    assert all(low <= value <= high for value in found)


def find(panel, **action):
    return next(hit for hit in panel.hits if action.items() <= hit.action.items())


def test_clicks_on_the_list_are_commands():
    panel = draw_side((214, 770), FACTS, tools=side_buttons(FACTS))
    mode = find(panel, do="set_mode", name="mip")
    assert panel.find(mode.box.left + 3, mode.box.top + 3) is mode
    assert find(panel, do="show", key="1/1").action["visible"] is False
    assert find(panel, do="show", key="1/2").action["visible"] is True
    bar = find(panel, do="set_opacity", key="1/3")
    assert bar.command(bar.box.left)["value"] == 0.0
    assert bar.command(bar.box.left + bar.box.width + 9)["value"] == 1.0
    clip = find(panel, do="move_clip", n=0)
    assert clip.command(clip.box.left + (clip.box.width - 1) / 2)["share"] == pytest.approx(0.5)
    assert {hit.action["clip_box"] for hit in panel.hits if "clip_box" in hit.action} == {0, 1, 2}
    assert find(panel, key="m") and find(panel, recolor="1/4") and find(panel, select="1/5")


def test_a_long_list_is_scrolled_to_its_end_and_no_further():
    shown = [
        {hit.action["select"] for hit in draw_side((214, 500), FACTS, first=first).hits if "select" in hit.action}
        for first in (0, 3, 1000)
    ]
    assert "1/1" in shown[0] and "1/3" not in shown[1] and "1/4" in shown[1] and "1/30" in shown[2]
    assert len(shown[0]) == len(shown[2]) < 30


def test_hits_lie_within_their_panel():
    for size in ((214, 770), (214, 300), (214, 90)):
        for hit in draw_side(size, FACTS, tools=side_buttons(FACTS)).hits:
            assert 0 <= hit.box.left and hit.box.left + hit.box.width <= size[0]


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"ml": 1234.5}, "1,234"),
        ({"ml": 12.34}, "12.3"),
        ({"ml": 0.123}, "0.12"),
        ({"ml": None, "count": 12_345}, "12,345"),
        ({"ml": None, "count": 1_550_000}, "1.55 M"),
        ({"ml": None, "count": None}, ""),
    ],
)
def test_the_size_of_a_part_is_short(part, words):
    assert describe_size(part) == words


def test_panels_have_the_size_that_is_asked_for_and_are_opaque():
    made = [
        draw_words((300, 200), ["clrecon", "a line that is much too long for a box of three hundred pixels"]),
        draw_status((500, 26), "said " * 60, "facts " * 60, warning=True),
        draw_help((640, 480), help_sections()),
        draw_side((214, 400), {}),
    ]
    for panel, size in zip(made, [(300, 200), (500, 26), (640, 480), (214, 400)], strict=True):
        assert panel.image.shape == (size[1], size[0], 4)
        assert (panel.image[..., 3] == 255).all()


def test_the_help_names_every_key():
    named = {name for _, rows in help_sections() for name, _ in rows}
    silent = {name for name, key in KEYS.items() if not key.words}
    assert silent == {"O", "Right"}  # said with the key beside them
    assert set(KEYS) - silent <= named
