"""Gestures of the mouse as commands, without a window."""

from __future__ import annotations

import pytest

from clrecon.viewer.window.layout import lay_out
from clrecon.viewer.window.panels import draw_slider
from clrecon.viewer.window.pointer import WHEEL_FACTOR, Pointer

LAYOUT = lay_out((1280, 860))
PANELS = {"slider": draw_slider(LAYOUT.boxes["slider"].size, 200.0, (-100.0, 900.0))}


def spot(name: str, x: float = 0.5, y: float = 0.5) -> tuple[float, float]:
    box = LAYOUT.boxes[name]
    return box.left + x * box.width, box.top + y * box.height


def drag(start, by, button="left", **held):
    """What a press, a far move and a release give."""
    pointer = Pointer()
    end = (start[0] + by[0], start[1] + by[1])
    pressed = pointer.press(button, LAYOUT, PANELS, start, **held)
    moved = pointer.move(LAYOUT, end)
    released = pointer.release(LAYOUT, end)
    assert not pointer.is_busy
    return pressed, moved, released


HEIGHT = LAYOUT.boxes["picture"].height


@pytest.mark.parametrize(
    ("button", "held", "command"),
    [
        ("left", {}, {"do": "turn", "dx": 40 / HEIGHT, "dy": -20 / HEIGHT}),
        ("left", {"shift": True}, {"do": "pan", "dx": 40 / HEIGHT, "dy": -20 / HEIGHT}),
        ("middle", {}, {"do": "pan", "dx": 40 / HEIGHT, "dy": -20 / HEIGHT}),
        ("left", {"control": True}, {"do": "roll", "degrees": 180.0 * (40 / HEIGHT)}),
    ],
)
def test_drags_on_the_picture_are_those_of_pyvista(button, held, command):
    pressed, moved, released = drag(spot("picture"), (40, -20), button, **held)
    assert (pressed, moved, released) == ([], [command], [])


def test_a_right_drag_upwards_shows_larger():
    _, ((zoom),), _ = drag(spot("picture"), (0, -50), "right")
    assert zoom["do"] == "zoom" and zoom["factor"] > 1.0


def test_a_click_is_a_point_and_with_shift_a_pick():
    for shift in (False, True):
        pressed, moved, released = drag(spot("picture", 0.25), (1, 2), shift=shift)
        assert (pressed, moved) == ([], [])
        x, y = spot("picture", 0.25)
        box = LAYOUT.boxes["picture"]
        assert released == [{"at": "picture", "place": (x + 1 - box.left, y + 2 - box.top), "pick": shift}]


def test_the_wheel_zooms_about_the_pointer_and_scrolls_slices():
    ((zoom),) = Pointer().wheel(LAYOUT, spot("picture", 0.5, 0.75), 1)
    assert zoom["factor"] == WHEEL_FACTOR
    assert zoom["at"] == pytest.approx([0.0, 0.25])
    assert Pointer().wheel(LAYOUT, spot("coronal"), -1) == [{"do": "scroll", "plane": "coronal", "steps": -1}]
    assert Pointer().wheel(LAYOUT, spot("slider"), 1) == [{"nudge": 1}]
    assert Pointer().wheel(LAYOUT, spot("side"), 1) == [{"scroll": -3}]


def test_on_a_slice_the_left_button_moves_the_cross_and_the_right_one_the_window():
    pressed, moved, released = drag(spot("axial"), (12, 0))
    assert [action["at"] for action in (*pressed, *moved)] == ["axial", "axial"]
    assert (pressed[0]["drag"], moved[0]["drag"], released) == (False, True, [])
    pressed, moved, released = drag(spot("axial"), (10, -5), "right")
    assert (pressed, moved, released) == ([], [{"window": (40.0, -20.0)}], [])


def test_a_drag_that_leaves_a_slice_stays_within_it():
    _, moved, _ = drag(spot("axial"), (-5000, 5000))
    box = LAYOUT.boxes["axial"]
    assert moved[0]["place"] == (0, box.height - 1)


def test_the_slider_follows_from_the_press_on():
    pressed, moved, released = drag(spot("slider"), (30, 0))
    assert (pressed, moved, released) == ([{"slider": "iso"}], [{"slider": "iso"}], [])


def test_a_second_button_and_places_between_the_boxes_mean_nothing():
    pointer = Pointer()
    pointer.press("left", LAYOUT, PANELS, spot("picture"))
    assert pointer.press("right", LAYOUT, PANELS, spot("axial")) == []
    assert pointer.button == "left"
    pointer.release(LAYOUT, spot("picture"))
    between = (LAYOUT.boxes["side"].width + 1, 100)
    assert LAYOUT.find(*between) is None
    assert pointer.press("left", LAYOUT, PANELS, between) == [] and not pointer.is_busy
