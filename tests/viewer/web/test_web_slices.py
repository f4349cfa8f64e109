"""Slices on the page in a real browser: zoom, move, full size, what they say, by mouse, touch and keys."""

from __future__ import annotations

import re

import numpy as np
import pytest
import view_scenes as scenes
from browser import wait_for
from view_pages import SETTLED, changed_share, facts, open_view_page, picture, point_at, press

pytestmark = [pytest.mark.slow, pytest.mark.opencl]


@pytest.fixture
def page(view_browser, view_server):
    with open_view_page(view_browser, view_server) as opened:
        yield opened


SHOWN = "return [...document.querySelectorAll('.view')].filter((box) => box.clientWidth).map((box) => box.id)"


def words_of(page, name: str) -> list[str]:
    return page.execute_script(
        "return [...document.querySelectorAll(`#${arguments[0]} svg text`)].map((one) => one.textContent)", name
    )


def wait_for_picture(page, change: str) -> None:
    """Run a command and wait until a slice is drawn anew."""
    count = page.execute_script(f"const count = clrecon.pictures; {change}; return count")
    wait_for(page, f"return clrecon.pictures > {count} && clrecon.facts.settled")


def go_to(page, point: np.ndarray) -> None:
    page.execute_script("clrecon.run('set_cross', { point: arguments[0] })", point.tolist())
    wait_for(page, f"return Math.abs(clrecon.facts.cross[0] - {point[0]}) < 0.01")
    wait_for(page, SETTLED)


def mm_of_pixel(page, name: str) -> float:
    ends = [scenes.middle(0).tolist(), (scenes.middle(0) + (10.0, 0.0, 0.0)).tolist()]
    pixels = page.execute_script("return arguments[1].map((end) => clrecon.project(arguments[0], end))", name, ends)
    return 10.0 / float(np.linalg.norm(np.subtract(*pixels)))


def test_slice_says_number_place_window_and_what_is_under_the_mouse(page) -> None:
    go_to(page, scenes.middle(0))
    shown = facts(page)["slices"]["axial"]
    assert f"axial {shown['number']} / {shown['count']}" in words_of(page, "axial")
    assert shown["place"] in words_of(page, "axial") and "L 300 W 1500" in words_of(page, "axial")
    cross = facts(page)["cross"]
    point_at(page, "axial", scenes.middle(0) + (3.0, 0.0, 0.0))
    wait_for(page, "return document.querySelectorAll('#axial .probe').length === 2")
    hu, place = (each.text for each in page.find_elements("css selector", "#axial .probe"))
    x, y, z = (float(value) for value in re.findall(r"-?[0-9.]+", place))
    assert (x, y, z) == pytest.approx(tuple(scenes.middle(0) + (3.0, 0.0, 0.0)), abs=0.6)
    assert hu == "1000 HU" and facts(page)["cross"] == cross
    point_at(page, "scene", scenes.middle(0))
    wait_for(page, "return !document.querySelector('#axial .probe')")


@pytest.mark.parametrize(("stage", "lines"), [(700, 2), (400, 1)])
def test_narrow_slice_says_hu_and_what_else_has_room(page, stage: int, lines: int) -> None:
    go_to(page, scenes.middle(0))
    page.execute_script("document.getElementById('stage').style.maxWidth = `${arguments[0]}px`", stage)
    wait_for(page, f"return axial.clientWidth < {stage / 3} && clrecon.facts.settled")
    point_at(page, "axial", scenes.middle(0))
    wait_for(page, f"return document.querySelectorAll('#axial .probe').length === {lines}")
    assert "1000 HU" in words_of(page, "axial") and "axial" in words_of(page, "axial")


def test_wheel_with_ctrl_zooms_a_slice_and_0_fits_it(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
    from selenium.webdriver.common.keys import Keys

    go_to(page, scenes.middle(0))
    before, cross, first = mm_of_pixel(page, "axial"), facts(page)["cross"], picture(page, "axial")
    axial = page.find_element("id", "axial")
    origin = ScrollOrigin.from_element(axial, 30, 10)
    ActionChains(page).key_down(Keys.CONTROL).scroll_from_origin(origin, 0, -400).key_up(Keys.CONTROL).perform()
    wait_for(page, "return clrecon.facts.settled && clrecon.facts.undo === 'the zoom of the axial slice'")
    assert before / mm_of_pixel(page, "axial") > 1.1
    assert changed_share(first, picture(page, "axial")) > 0.01 and facts(page)["cross"] == cross
    wait_for_picture(page, "document.dispatchEvent(new KeyboardEvent('keydown', { key: '0' }))")
    assert mm_of_pixel(page, "axial") == pytest.approx(before, rel=1e-6)


def test_shift_and_drag_moves_a_slice(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    go_to(page, scenes.middle(0))
    cross = facts(page)["cross"]
    place = "return clrecon.project('coronal', arguments[0])"
    before = page.execute_script(place, scenes.middle(0).tolist())
    actions = ActionChains(page, duration=15).move_to_element(page.find_element("id", "coronal"))
    actions.key_down(Keys.SHIFT).click_and_hold()
    for _ in range(8):
        actions.move_by_offset(5, 3)
    actions.release().key_up(Keys.SHIFT).perform()
    wait_for(page, "return clrecon.facts.settled && clrecon.facts.undo === 'the zoom of the coronal slice'")
    after = page.execute_script(place, scenes.middle(0).tolist())
    assert np.subtract(after, before) == pytest.approx((40.0, 24.0), abs=1.0)
    assert facts(page)["cross"] == cross


def test_two_fingers_zoom_and_move_a_slice(page) -> None:
    go_to(page, scenes.middle(0))
    before = mm_of_pixel(page, "axial")
    box = page.find_element("id", "axial").rect
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for kind, apart in (("touchStart", 20), *(("touchMove", 20 + 5 * n) for n in range(1, 9)), ("touchEnd", 0)):
        points = [{"x": x + sign * apart, "y": y, "id": number} for number, sign in enumerate((-1, 1))]
        page.execute_cdp_cmd(
            "Input.dispatchTouchEvent", {"type": kind, "touchPoints": [] if kind == "touchEnd" else points}
        )
    wait_for(page, "return clrecon.facts.settled && clrecon.facts.undo === 'the zoom of the axial slice'")
    assert before / mm_of_pixel(page, "axial") == pytest.approx(3.0, rel=0.4)


def test_double_click_shows_one_view_at_full_size_and_back(page) -> None:
    from selenium.webdriver import ActionChains

    every = page.execute_script(SHOWN)
    assert every == ["scene", "axial", "coronal", "sagittal"]
    axial = page.find_element("id", "axial")
    width = axial.size["width"]
    ActionChains(page).double_click(axial).perform()
    wait_for(page, f"return axial.clientWidth > {2 * width} && clrecon.facts.settled")
    assert page.execute_script(SHOWN) == ["axial"]
    ActionChains(page).double_click(axial).perform()
    wait_for(page, f"return axial.clientWidth === {width}")
    assert page.execute_script(SHOWN) == every


def test_double_click_with_a_tool_sets_points_alone(page) -> None:
    from selenium.webdriver import ActionChains

    page.find_element("id", "trace").click()
    wait_for(page, "return clrecon.facts.tool === 'curve'")
    ActionChains(page).double_click(page.find_element("id", "axial")).perform()
    wait_for(page, "return clrecon.facts.points.length === 2")
    assert len(page.execute_script(SHOWN)) > 1


def test_button_of_a_view_is_named_and_pressed_at_full_size(page) -> None:
    button = page.find_element("css selector", "#sagittal .enlarge")
    cross = facts(page)["cross"]
    assert (button.accessible_name, button.get_attribute("aria-pressed")) == ("sagittal at full size", "false")
    button.click()
    wait_for(page, "return document.querySelector('#sagittal .enlarge').getAttribute('aria-pressed') === 'true'")
    assert page.execute_script(SHOWN) == ["sagittal"] and facts(page)["cross"] == cross
    page.find_element("id", "sliced").click()  # without slices it has no place
    wait_for(page, "return document.querySelector('#sagittal .enlarge').getAttribute('aria-pressed') === 'false'")
    assert page.execute_script(SHOWN) == ["scene"]


def test_slice_with_the_focus_is_used_by_keys_and_says_what_it_shows(page) -> None:
    from selenium.webdriver.common.keys import Keys

    go_to(page, scenes.middle(0))
    point_at(page, "axial", scenes.middle(0))  # the mouse does not take the keys from it
    coronal = page.find_element("id", "coronal")
    page.find_element("id", "scene").send_keys(4 * Keys.TAB)  # each view is followed by its button
    number, before = facts(page)["slices"]["coronal"]["number"], mm_of_pixel(page, "coronal")
    press(page, Keys.PAGE_DOWN)
    wait_for(page, f"return clrecon.facts.slices.coronal.number === {number + 1}")
    press(page, "+")
    wait_for(page, "return clrecon.facts.settled && clrecon.facts.undo === 'the zoom of the coronal slice'")
    assert before / mm_of_pixel(page, "coronal") == pytest.approx(1.25, rel=1e-3)
    shown = facts(page)["slices"]["coronal"]
    said = f"coronal slice {number + 1} of {shown['count']}, {shown['place']}, level 300, width 1500 HU"
    assert coronal.find_element("tag name", "canvas").get_attribute("aria-label") == said
    press(page, "z")
    wait_for(page, "return document.querySelector('#coronal.large')")
    press(page, "z")
    wait_for(page, "return !document.querySelector('.large')")
