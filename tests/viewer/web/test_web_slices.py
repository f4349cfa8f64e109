"""Slices on the page in a real browser: zoom, move, full size, what they say, by mouse, touch and keys."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
import tolerances
import view_scenes as scenes
from browser import wait_for
from PIL import Image
from view_pages import SETTLED, facts, open_view_page, point_at, press_keys, run_command, share_of_changed_pixels

pytestmark = [pytest.mark.slow, pytest.mark.opencl]

VIEWS = ["scene", "axial", "coronal", "sagittal"]
HU_IN_A_BALL = "1000 HU"  # of view_scenes


@pytest.fixture
def page(view_browser, view_server):
    """The page with its slices through the middle of the largest ball of bone."""
    with open_view_page(view_browser, view_server) as opened:
        middle = scenes.middle(0)
        run_command(opened, "set_cross", point=middle.tolist())
        wait_for(opened, f"return Math.abs(clrecon.facts.cross[0] - {middle[0]}) < 0.01")  # mm
        wait_for(opened, SETTLED)
        yield opened


def shown_views(page) -> list[str]:
    return page.execute_script(
        "return [...document.querySelectorAll('.view')].filter((box) => box.clientWidth).map((box) => box.id)"
    )


def words_on(page, view: str) -> list[str]:
    return page.execute_script(
        "return [...document.querySelectorAll(`#${arguments[0]} svg text`)].map((one) => one.textContent)", view
    )


def drawn_pixels(page, view: str) -> np.ndarray:
    """The picture of a view, (h, w, 3), without the words over it."""
    url = page.execute_script("return document.querySelector(`#${arguments[0]} canvas`).toDataURL()", view)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB")).astype(int)


def wait_for_zoom(page, plane: str) -> None:
    wait_for(page, f"return clrecon.facts.settled && clrecon.facts.undo === 'the zoom of the {plane} slice'")


def mm_of_pixel(page, view: str) -> float:
    """By where the ends of 10 mm towards the patient's left are drawn."""
    ends = [scenes.middle(0).tolist(), (scenes.middle(0) + (10.0, 0.0, 0.0)).tolist()]
    pixels = page.execute_script("return arguments[1].map((end) => clrecon.project(arguments[0], end))", view, ends)
    return 10.0 / float(np.linalg.norm(np.subtract(*pixels)))


# What a slice says


def test_slice_says_its_number_place_and_window(page) -> None:
    shown = facts(page)["slices"]["axial"]

    said = words_on(page, "axial")

    assert said[:2] == ["axial", f"{shown['number']} / {shown['count']} · {shown['place']}"]
    assert "L 300 W 1500" in said  # the window that a view begins with


@pytest.mark.parametrize("stage_width", [330, 700, 1200])
def test_name_of_a_slice_ends_left_of_the_letter_of_its_upper_side(page, stage_width: int) -> None:
    page.execute_script("document.getElementById('stage').style.maxWidth = `${arguments[0]}px`", stage_width)
    wait_for(page, f"return coronal.clientWidth < {stage_width / 2} && clrecon.facts.settled")

    name, letter = page.execute_script(
        "const [name, letter] = ['name', 'side'].map((kind) => coronal.querySelector(`text.${kind}`));"
        "return [name.getBoundingClientRect().right, letter.getBoundingClientRect().left];"
    )

    assert name < letter


def test_slice_says_hu_and_place_of_the_point_under_the_mouse(page) -> None:
    point = scenes.middle(0) + (3.0, 0.0, 0.0)  # within the ball of 9 mm

    point_at(page, "axial", point)

    wait_for(page, "return document.querySelectorAll('#axial .probe').length === 2")
    hu, place = (each.text for each in page.find_elements("css selector", "#axial .probe"))
    assert hu == HU_IN_A_BALL
    said_mm = [float(value) for value in re.findall(r"-?[0-9.]+", place)]
    assert said_mm == pytest.approx(point.tolist(), abs=tolerances.VIEW_POINTED_MM)


def test_mouse_over_a_slice_leaves_the_cross(page) -> None:
    cross = facts(page)["cross"]

    point_at(page, "axial", scenes.middle(0) + (3.0, 0.0, 0.0))

    wait_for(page, "return document.querySelector('#axial .probe')")
    assert facts(page)["cross"] == cross


def test_slice_says_nothing_of_a_point_once_the_mouse_has_left_it(page) -> None:
    point_at(page, "axial", scenes.middle(0))
    wait_for(page, "return document.querySelector('#axial .probe')")

    point_at(page, "scene", scenes.middle(0))

    assert wait_for(page, "return !document.querySelector('#axial .probe')")


@pytest.mark.parametrize(
    ("stage_width", "lines"),
    [pytest.param(700, 2, id="room for HU and place"), pytest.param(400, 1, id="room for HU alone")],
)
def test_narrow_slice_says_hu_and_the_place_only_where_it_has_room(page, stage_width: int, lines: int) -> None:
    page.execute_script("document.getElementById('stage').style.maxWidth = `${arguments[0]}px`", stage_width)
    wait_for(page, f"return axial.clientWidth < {stage_width / 2} && clrecon.facts.settled")

    point_at(page, "axial", scenes.middle(0))

    wait_for(page, f"return document.querySelectorAll('#axial .probe').length === {lines}")
    assert {HU_IN_A_BALL, "axial"} <= set(words_on(page, "axial"))


# Zoom and move


def zoom_axial_by_the_wheel(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
    from selenium.webdriver.common.keys import Keys

    origin = ScrollOrigin.from_element(page.find_element("id", "axial"), x_offset=30, y_offset=10)
    actions = ActionChains(page).key_down(Keys.CONTROL).scroll_from_origin(origin, delta_x=0, delta_y=-400)
    actions.key_up(Keys.CONTROL).perform()
    wait_for_zoom(page, "axial")


def test_wheel_with_ctrl_zooms_a_slice_and_its_picture(page) -> None:
    before, picture = mm_of_pixel(page, "axial"), drawn_pixels(page, "axial")

    zoom_axial_by_the_wheel(page)

    assert before / mm_of_pixel(page, "axial") > 1.1  # by a turn of several notches
    assert share_of_changed_pixels(picture, drawn_pixels(page, "axial")) > tolerances.VIEW_CHANGED_SHARE


def test_wheel_with_ctrl_leaves_the_cross(page) -> None:
    cross = facts(page)["cross"]

    zoom_axial_by_the_wheel(page)

    assert facts(page)["cross"] == cross


def test_key_0_fits_a_zoomed_slice_again(page) -> None:
    fitted = mm_of_pixel(page, "axial")
    zoom_axial_by_the_wheel(page)
    drawn = page.execute_script("return clrecon.pictures")

    page.execute_script("document.dispatchEvent(new KeyboardEvent('keydown', { key: '0' }))")

    wait_for(page, f"return clrecon.pictures > {drawn} && clrecon.facts.settled")
    assert mm_of_pixel(page, "axial") == pytest.approx(fitted)


def test_drag_with_shift_moves_a_slice_by_as_many_pixels_and_leaves_the_cross(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    pixel_of_ball, ball = "return clrecon.project('coronal', arguments[0])", scenes.middle(0).tolist()
    cross, before = facts(page)["cross"], page.execute_script(pixel_of_ball, ball)

    actions = ActionChains(page, duration=15).move_to_element(page.find_element("id", "coronal"))
    actions.key_down(Keys.SHIFT).click_and_hold()
    for _ in range(8):
        actions.move_by_offset(5, 3)
    actions.release().key_up(Keys.SHIFT).perform()

    wait_for_zoom(page, "coronal")
    moved = np.subtract(page.execute_script(pixel_of_ball, ball), before)
    assert moved == pytest.approx((8 * 5, 8 * 3), abs=tolerances.VIEW_MOVED_PIXELS)
    assert facts(page)["cross"] == cross


def test_two_fingers_at_three_times_their_distance_zoom_a_slice_about_threefold(page) -> None:
    box = page.find_element("id", "axial").rect
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = mm_of_pixel(page, "axial")

    def touch(kind: str, *half_distances: int) -> None:
        fingers = [
            {"x": x + side * half, "y": y, "id": number}
            for half in half_distances
            for number, side in enumerate((-1, 1))
        ]
        page.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    touch("touchStart", 20)
    for half in range(25, 61, 5):
        touch("touchMove", half)
    touch("touchEnd")

    wait_for_zoom(page, "axial")
    assert before / mm_of_pixel(page, "axial") == pytest.approx(60 / 20, rel=tolerances.PAGE_TOUCH_ZOOM)


# Full size


def test_double_click_shows_a_slice_alone_at_more_than_twice_its_width(page) -> None:
    from selenium.webdriver import ActionChains

    axial = page.find_element("id", "axial")
    width = axial.size["width"]

    ActionChains(page).double_click(axial).perform()

    wait_for(page, f"return axial.clientWidth > {2 * width} && clrecon.facts.settled")
    assert shown_views(page) == ["axial"]


def test_double_click_on_a_slice_at_full_size_brings_all_views_back(page) -> None:
    from selenium.webdriver import ActionChains

    axial = page.find_element("id", "axial")
    width = axial.size["width"]
    page.find_element("css selector", "#axial .enlarge").click()
    wait_for(page, "return document.querySelector('#axial.large') && clrecon.facts.settled")

    ActionChains(page).double_click(axial).perform()

    wait_for(page, f"return axial.clientWidth === {width}")
    assert shown_views(page) == VIEWS


def test_double_click_with_a_tool_sets_two_points_and_enlarges_nothing(page) -> None:
    from selenium.webdriver import ActionChains

    page.find_element("id", "trace").click()
    wait_for(page, "return clrecon.facts.tool === 'curve'")

    ActionChains(page).double_click(page.find_element("id", "axial")).perform()

    wait_for(page, "return clrecon.facts.points.length === 2")
    assert shown_views(page) == [*VIEWS, "curve"]


def test_button_that_enlarges_a_slice_is_named_and_not_pressed_at_first(page) -> None:
    button = page.find_element("css selector", "#sagittal .enlarge")

    assert button.accessible_name == "sagittal at full size"
    assert button.get_attribute("aria-pressed") == "false"


def enlarge_sagittal(page) -> None:
    page.find_element("css selector", "#sagittal .enlarge").click()
    wait_for(page, "return document.querySelector('#sagittal .enlarge').getAttribute('aria-pressed') === 'true'")


def test_button_of_a_slice_shows_it_alone_and_leaves_the_cross(page) -> None:
    cross = facts(page)["cross"]

    enlarge_sagittal(page)

    assert shown_views(page) == ["sagittal"]
    assert facts(page)["cross"] == cross


def test_scene_is_shown_in_place_of_a_slice_at_full_size_in_the_layout_of_one(page) -> None:
    enlarge_sagittal(page)

    page.find_element("css selector", "#layouts [data-layout='1']").click()

    wait_for(page, "return document.querySelector('#sagittal .enlarge').getAttribute('aria-pressed') === 'false'")
    assert shown_views(page) == ["scene"]


# Layouts, and the cross that is turned


def test_layout_of_four_gives_each_view_the_size_of_the_others(page) -> None:
    page.find_element("css selector", "#layouts [data-layout='4']").click()

    wait_for(page, "return clrecon.facts.layout === '4' && clrecon.facts.settled")
    sizes = [page.find_element("id", view).size for view in VIEWS]
    pixels = np.array([(each["width"], each["height"]) for each in sizes])
    assert np.ptp(pixels, axis=0).max() <= 1  # pixel, of a division


def test_key_g_goes_from_slices_beside_the_picture_to_four_views(page) -> None:
    press_keys(page, "g")

    assert wait_for(page, "return clrecon.facts.layout === '4'")


def test_drag_of_an_end_of_the_cross_by_a_quarter_turns_the_two_other_slices(page) -> None:
    from selenium.webdriver import ActionChains

    axial = page.find_element("id", "axial")
    x, y = page.execute_script("return clrecon.project('axial', clrecon.facts.cross)")
    point_at(page, "axial", scenes.middle(0))
    ends = "[...document.querySelectorAll('#axial .handle')]"
    right = max(page.execute_script(f"return {ends}.map(({{ cx, cy }}) => [cx.baseVal.value, cy.baseVal.value])"))
    middle = (axial.size["width"] / 2, axial.size["height"] / 2)
    far = right[0] - x

    ActionChains(page).move_to_element_with_offset(
        axial, round(right[0] - middle[0]), round(right[1] - middle[1])
    ).click_and_hold().move_by_offset(-5, round(far / 2)).move_by_offset(
        round(-far) + 5, round(far / 2)
    ).release().perform()

    wait_for(page, "return clrecon.facts.turned && clrecon.facts.settled")
    assert facts(page)["slices"]["axial"]["place"][0] in "IS"
    degrees = float(facts(page)["slices"]["coronal"]["place"].split()[1].rstrip("°"))
    assert degrees == pytest.approx(90.0, abs=3.0)  # of a drag in whole pixels that begins after the first four


def test_key_r_straightens_turned_slices(page) -> None:
    run_command(page, "turn_cross", plane="axial", degrees=30)
    wait_for(page, "return clrecon.facts.turned")

    press_keys(page, "r")

    assert wait_for(page, "return !clrecon.facts.turned && straighten.hidden")


def test_bracket_turns_the_cross_on_the_slice_under_the_mouse_by_five_degrees(page) -> None:
    point_at(page, "axial", scenes.middle(0))

    press_keys(page, "]")

    assert wait_for(page, "return clrecon.facts.slices.coronal.place === 'turned 5.0°'")


def test_thickness_that_is_typed_makes_thick_slices_that_say_it(page) -> None:
    from selenium.webdriver.common.keys import Keys

    before = drawn_pixels(page, "axial")

    page.find_element("id", "thick").send_keys(Keys.CONTROL, "a")
    page.find_element("id", "thick").send_keys("12", Keys.ENTER)

    wait_for(page, "return clrecon.facts.slab.mm === 12 && clrecon.facts.settled")
    wait_for(page, SETTLED)
    assert "mean of 12 mm" in words_on(page, "axial")
    assert share_of_changed_pixels(before, drawn_pixels(page, "axial")) > tolerances.VIEW_REDRAWN_SHARE


# Keys


@pytest.fixture
def page_with_focus_on_coronal(page):
    """The mouse lies over the axial slice, which does not take the keys from the coronal one."""
    from selenium.webdriver.common.keys import Keys

    point_at(page, "axial", scenes.middle(0))
    page.find_element("id", "scene").send_keys(4 * Keys.TAB)  # scene, its button, axial, its button, coronal
    return page


def test_page_down_shows_the_next_slice_of_the_view_with_the_focus(page_with_focus_on_coronal) -> None:
    from selenium.webdriver.common.keys import Keys

    number = facts(page_with_focus_on_coronal)["slices"]["coronal"]["number"]

    press_keys(page_with_focus_on_coronal, Keys.PAGE_DOWN)

    assert wait_for(page_with_focus_on_coronal, f"return clrecon.facts.slices.coronal.number === {number + 1}")


def test_plus_zooms_the_slice_with_the_focus_by_a_quarter(page_with_focus_on_coronal) -> None:
    before = mm_of_pixel(page_with_focus_on_coronal, "coronal")

    press_keys(page_with_focus_on_coronal, "+")

    wait_for_zoom(page_with_focus_on_coronal, "coronal")
    assert before / mm_of_pixel(page_with_focus_on_coronal, "coronal") == pytest.approx(1.25)


def test_slice_is_described_for_screen_readers_after_it_was_scrolled(page_with_focus_on_coronal) -> None:
    from selenium.webdriver.common.keys import Keys

    page = page_with_focus_on_coronal
    number = facts(page)["slices"]["coronal"]["number"]

    press_keys(page, Keys.PAGE_DOWN)

    wait_for(page, f"return clrecon.facts.slices.coronal.number === {number + 1}")
    wait_for(page, SETTLED)
    shown = facts(page)["slices"]["coronal"]
    label = page.find_element("css selector", "#coronal canvas").get_attribute("aria-label")
    window = "level 300, width 1500 HU"  # the one that a view begins with
    assert label == f"coronal slice {number + 1} of {shown['count']}, {shown['place']}, {window}"


def test_key_z_shows_the_slice_with_the_focus_at_full_size_and_back(page_with_focus_on_coronal) -> None:
    press_keys(page_with_focus_on_coronal, "z")
    wait_for(page_with_focus_on_coronal, "return document.querySelector('#coronal.large')")

    press_keys(page_with_focus_on_coronal, "z")
    assert wait_for(page_with_focus_on_coronal, "return !document.querySelector('.large')")
