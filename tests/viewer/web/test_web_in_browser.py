"""The page of the view in a real browser: it draws, turns, slides, saves, and talks to its server alone."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import tolerances
import view_scenes as scenes
from browser import severe_lines, wait_for
from view_pages import (
    SETTLED,
    drag,
    facts,
    open_view_page,
    point_at,
    press_keys,
    run_command,
    screenshot,
    share_of_changed_pixels,
    wait_for_file,
    wait_until_drawn,
)
from web_views import PATIENCE, serving

from clrecon.mesh.mesh_reader import read_mesh
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.commands import KEYS
from clrecon.viewer.session.session import ViewSession

pytestmark = [pytest.mark.slow, pytest.mark.opencl]

ISO = scenes.ISO


@pytest.fixture
def page(view_browser, view_server):
    """The page of a scan of three balls, whose surface is at `ISO`, and a mesh."""
    with open_view_page(view_browser, view_server) as opened:
        yield opened


# Turning


def drag_scene_to_the_right(page) -> None:
    drag(page, page.find_element("id", "scene"), dx=150, dy=30)


def test_drag_turns_the_picture_and_leaves_the_slices(page) -> None:
    scene, axial = screenshot(page, "scene"), screenshot(page, "axial")

    drag_scene_to_the_right(page)

    wait_until_drawn(page)
    assert share_of_changed_pixels(scene, screenshot(page, "scene")) > tolerances.VIEW_CHANGED_SHARE
    assert share_of_changed_pixels(axial, screenshot(page, "axial")) == 0.0


def test_pictures_are_shown_while_a_drag_goes_on(page) -> None:
    before = page.execute_script("return clrecon.pictures")

    drag_scene_to_the_right(page)

    wait_until_drawn(page)
    assert page.execute_script("return clrecon.pictures") > before + 1  # more than the sharp one at the end


def test_undo_turns_a_dragged_picture_back(page) -> None:
    before = screenshot(page)
    page.execute_script("window.first = JSON.stringify(clrecon.facts.camera)")
    drag_scene_to_the_right(page)
    wait_until_drawn(page)

    page.find_element("id", "undo").click()

    wait_for(page, "return JSON.stringify(clrecon.facts.camera) === window.first")
    wait_until_drawn(page)
    assert share_of_changed_pixels(before, screenshot(page)) < tolerances.VIEW_REDRAWN_SHARE


def test_undo_stays_where_it_is_while_lists_grow(page) -> None:
    top_of_undo = "return document.getElementById('undo').getBoundingClientRect().top"
    before = page.execute_script(top_of_undo)

    page.execute_script(
        "for (const id of ['measures', 'parts', 'clips'])"
        "  for (let n = 0; n < 5; n++) document.getElementById(id).append(document.createElement('li'));"
        "document.getElementById('hint').textContent = 'a hint of several lines '.repeat(9);"
    )

    assert page.execute_script(top_of_undo) == before > 0


@pytest.mark.parametrize(
    ("key", "up_down_left_right"),
    [pytest.param("1", ["S", "I", "R", "L"], id="front"), pytest.param("3", ["S", "I", "A", "P"], id="left side")],
)
def test_number_key_shows_a_side_with_the_letters_of_its_edges(page, key: str, up_down_left_right: list[str]) -> None:
    page.find_element("id", "scene").send_keys(key)

    wait_until_drawn(page)
    letters = page.execute_script(
        "return [...document.querySelectorAll('#scene .side')].slice(0, 4).map((one) => one.textContent)"
    )
    assert letters == up_down_left_right


# The iso value


def drag_slider_of_the_iso_value(page) -> float:
    """Drag the slider to the right, and return the new iso value."""
    drag(page, page.find_element("id", "hu"), dx=150, dy=0)
    wait_until_drawn(page)
    return facts(page)["iso"]["hu"]


def test_slider_sets_the_iso_value_that_its_field_and_the_status_show(page) -> None:
    hu = drag_slider_of_the_iso_value(page)

    assert hu > ISO
    assert page.find_element("id", "exact").get_attribute("value") == f"{hu:g}"
    assert f"{hu:g} HU" in page.find_element("id", "status").text


def test_picture_follows_the_slider_of_the_iso_value(page) -> None:
    before = screenshot(page)

    drag_slider_of_the_iso_value(page)

    assert share_of_changed_pixels(before, screenshot(page)) > tolerances.VIEW_CHANGED_SHARE


def type_iso_value(page, *keys: str) -> None:
    from selenium.webdriver.common.keys import Keys

    exact = page.find_element("id", "exact")
    exact.send_keys(Keys.CONTROL, "a")
    exact.send_keys(*keys, Keys.ENTER)


def test_text_that_is_no_iso_value_is_put_back_and_the_range_is_said(page) -> None:
    from selenium.webdriver.common.keys import Keys

    for wrong in (Keys.DELETE, "99999", "-5000"):  # nothing, above and below every HU
        type_iso_value(page, wrong)
        wait_for(page, f"return document.getElementById('exact').value === '{ISO:g}'")

    assert "The iso value runs from" in page.find_element("id", "hint").text
    assert facts(page)["iso"]["hu"] == ISO


def test_number_that_is_typed_becomes_the_iso_value_of_the_slider(page) -> None:
    type_iso_value(page, "321")

    wait_for(page, "return clrecon.facts.iso.hu === 321")
    assert page.find_element("id", "hu").get_attribute("value") == "321"


HU_OF_ONE_STEP = 5


@pytest.mark.release
def test_arrow_keys_step_the_iso_value_down_and_up(page) -> None:
    from selenium.webdriver.common.keys import Keys

    point_at(page, "scene", scenes.middle(0))

    press_keys(page, Keys.ARROW_RIGHT)
    wait_for(page, f"return clrecon.facts.iso.hu === {ISO + HU_OF_ONE_STEP}")
    press_keys(page, Keys.ARROW_LEFT, Keys.ARROW_LEFT)
    assert wait_for(page, f"return clrecon.facts.iso.hu === {ISO - HU_OF_ONE_STEP}")


@pytest.mark.release
def test_wheel_over_the_slider_steps_it_and_the_iso_value_up(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    slider = page.find_element("id", "hu")

    ActionChains(page).scroll_from_origin(ScrollOrigin.from_element(slider), delta_x=0, delta_y=-100).perform()

    wait_for(page, f"return clrecon.facts.iso.hu === {ISO + HU_OF_ONE_STEP}")
    assert slider.get_attribute("value") == f"{ISO + HU_OF_ONE_STEP:g}"


# The fitted surface

BARS_OF_SCALE = "return document.querySelectorAll('#scene rect').length"


def test_key_t_fits_the_surface_to_the_bone_and_ticks_its_box(page) -> None:
    press_keys(page, "t")

    wait_for(page, "return clrecon.facts.fitted === true")
    wait_until_drawn(page)
    assert page.find_element("id", "fitted").is_selected()


def test_fitted_surface_is_drawn_in_place_of_the_iso_surface(page) -> None:
    before = screenshot(page)

    run_command(page, "set_fitted", shown=True)

    wait_for(page, "return clrecon.facts.fitted === true")
    wait_until_drawn(page)
    assert share_of_changed_pixels(before, screenshot(page)) > tolerances.VIEW_CHANGED_SHARE


def test_surface_that_is_not_fitted_has_no_scale_and_no_choice_of_colours(page) -> None:
    assert page.execute_script(BARS_OF_SCALE) == 0
    assert not page.find_element("id", "shade").is_displayed()


def colour_fitted_surface_by_thickness(page) -> None:
    run_command(page, "set_fitted", shown=True)
    wait_for(page, "return clrecon.facts.fitted === true && document.getElementById('shade').offsetParent")
    page.find_element("css selector", "#shade option[value=thickness]").click()
    wait_for(page, "return clrecon.facts.scale !== null")
    wait_until_drawn(page)


def test_thickness_of_a_fitted_surface_is_shown_with_a_scale_of_64_bars_in_mm(page) -> None:
    colour_fitted_surface_by_thickness(page)

    assert page.execute_script(BARS_OF_SCALE) == 64
    assert "mm thick" in page.find_element("css selector", "#scene svg").text


def test_scale_of_thickness_goes_with_the_fitted_surface(page) -> None:
    colour_fitted_surface_by_thickness(page)

    page.find_element("id", "fitted").click()

    assert wait_for(page, "return clrecon.facts.fitted === false && clrecon.facts.scale === null")


def test_projection_offers_no_fitted_surface(page) -> None:
    page.find_element("css selector", "#modes [data-mode=drr]").click()

    assert wait_for(page, "return document.getElementById('fitting').hidden")


# Slices and the cross


def colors_of_cross(page, view: str) -> set[str]:
    lines = "document.querySelectorAll(`#${arguments[0]} .cross`)"
    return set(page.execute_script(f"return [...{lines}].map((line) => getComputedStyle(line).stroke)", view))


def test_cross_has_three_colours_in_the_picture(page) -> None:
    assert len(colors_of_cross(page, "scene")) == 3


@pytest.mark.parametrize("plane", ["axial", "coronal", "sagittal"])
def test_slice_is_named_in_its_colour_and_crossed_by_the_colours_of_the_others(page, plane: str) -> None:
    label = f"document.querySelector('#{plane} .name')"  # drawn anew with each picture
    name, own = page.execute_script(f"return [{label}.textContent, getComputedStyle({label}).fill]")

    assert name.split()[0] == plane
    assert colors_of_cross(page, plane) == colors_of_cross(page, "scene") - {own}


def test_slider_of_the_iso_value_has_some_marks_one_of_them_at_zero(page) -> None:
    marks = page.find_elements("css selector", "#marks span")

    assert 3 < len(marks) < 20  # enough to read between them
    assert "0" in [mark.text for mark in marks]
    boxes = [mark.rect for mark in marks]
    assert all(one["x"] + one["width"] < other["x"] for one, other in zip(boxes, boxes[1:], strict=False)), "they touch"


def test_wheel_moves_a_slice_along_its_own_axis_alone(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    x, y, z = facts(page)["cross"]
    axial = page.find_element("id", "axial")

    ActionChains(page).scroll_from_origin(ScrollOrigin.from_element(axial), delta_x=0, delta_y=300).perform()

    wait_for(page, f"return clrecon.facts.cross[2] !== {z}")
    assert facts(page)["cross"][:2] == pytest.approx([x, y])


def test_drag_to_the_side_with_the_right_button_widens_the_window_and_leaves_its_level(page) -> None:
    low, high = facts(page)["window"]

    page.execute_script(
        """const box = document.getElementById("axial"), at = box.getBoundingClientRect();
        const fire = (name, x, y, buttons) => box.dispatchEvent(new PointerEvent(name,
            { pointerId: 1, clientX: at.left + x, clientY: at.top + y, button: 2, buttons, bubbles: true }));
        box.setPointerCapture = () => {};
        fire("pointerdown", 40, 40, 2);
        for (let n = 1; n < 12; n++) fire("pointermove", 40 + 5 * n, 40, 2);
        fire("pointerup", 95, 40, 0);"""
    )

    wait_for(page, f"return clrecon.facts.window[1] - clrecon.facts.window[0] > {1.1 * (high - low)}")
    assert sum(facts(page)["window"]) / 2 == pytest.approx((low + high) / 2, abs=tolerances.VIEW_LEVEL_HU)


# What is said


def test_thumbnails_show_what_their_modes_draw(page) -> None:
    modes = [mode["name"] for mode in facts(page)["modes"]]
    brightest = (
        "return Object.fromEntries([...document.querySelectorAll('#modes img')].map((one) => {"
        "  const pen = Object.assign(document.createElement('canvas'), { width: 128, height: 96 }).getContext('2d');"
        "  pen.drawImage(one, 0, 0);"
        "  const colors = pen.getImageData(0, 0, 128, 96).data.filter((_, n) => n % 4 < 3);"
        "  return [one.closest('button').dataset.mode, Math.max(...colors)];"
        "}))"
    )

    wait_for(page, f"return document.querySelectorAll('#modes img').length === {len(modes)}")
    wait_for(page, "return [...document.querySelectorAll('#modes img')].every((one) => one.complete)")
    levels = page.execute_script(brightest)

    assert set(levels) == set(modes)
    assert min(levels[name] for name in ("surface", "bone", "mip", "drr")) > 60  # of 255; balls of 1000 HU on black


def test_chip_of_the_header_says_how_many_gates_failed(page) -> None:
    chips = page.find_elements("css selector", "#chips > :not(#offset)")
    assert [chip.text for chip in chips] == ["1 of 2 gates failed"]  # those of serve_scene


def test_page_shows_the_description_of_its_objects(page) -> None:
    assert "a ball of triangles" in page.find_element("id", "about").text  # said of the mesh by serve_scene


def test_removal_of_the_table_from_balls_without_one_says_so(page) -> None:
    page.find_element("id", "table").click()

    assert wait_for(page, "return /there is no table/.test(document.getElementById('hint').textContent)")


def test_key_h_lists_the_words_of_every_key(page) -> None:
    press_keys(page, "h")

    listed = page.find_element("id", "keys").text
    assert [key.words for key in KEYS.values() if key.words not in listed] == []


def test_list_of_keys_takes_the_keys_until_it_is_closed(page) -> None:
    press_keys(page, "h")
    press_keys(page, "h")
    assert page.find_element("id", "keys").is_displayed()

    page.find_element("id", "closekeys").click()

    assert not page.find_element("id", "keys").is_displayed()


# Files


def test_shown_surface_is_saved_as_a_download(page, downloads: Path) -> None:
    from selenium.webdriver.support.ui import Select

    Select(page.find_element("id", "format")).select_by_value(".stl")
    page.find_element("id", "save").click()

    wait_for_file(page, downloads / "view.stl")
    surface = read_mesh(downloads / "view.stl", space="lps")
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    assert (low <= scenes.middle(0)).all() and (scenes.middle(0) <= high).all()  # the largest ball of the scan


@pytest.fixture
def save_by_key_s(view_browser, device, tmp_path: Path):
    """A function that presses s and waits, in a page of a mesh that was started with --save-as shown.ply shown.png."""
    objects = show_objects([scenes.make_mesh()])
    wrote: list[str] = []
    names = [str(tmp_path / name) for name in ("shown.ply", "shown.png")]
    with (
        Painter(objects, device=device) as painter,
        serving(lambda heard: ViewSession(objects, painter, on_change=heard), save_as=names, wrote=wrote.append) as own,
    ):

        def press_and_wait() -> None:
            wanted, end = len(wrote) + len(names), time.monotonic() + PATIENCE
            press_keys(view_browser, "s")
            while len(wrote) < wanted:
                assert time.monotonic() < end, view_browser.find_element("id", "saved").text
                time.sleep(0.05)

        view_browser.get(own.address)
        wait_for(view_browser, SETTLED)
        yield press_and_wait
        press_keys(view_browser, "q")
        wait_for(view_browser, "return document.documentElement.dataset.closed")
        severe_lines(view_browser)  # no later test is to find what the end of the server logs


def test_key_s_writes_the_named_files_each_time_under_names_of_their_own(save_by_key_s, tmp_path: Path) -> None:
    save_by_key_s()
    save_by_key_s()

    assert sorted(path.name for path in tmp_path.iterdir()) == ["shown-2.ply", "shown-2.png", "shown.ply", "shown.png"]


def test_named_file_of_a_mesh_holds_its_triangles(save_by_key_s, tmp_path: Path) -> None:
    save_by_key_s()

    assert read_mesh(tmp_path / "shown.ply", space="lps").triangle_count == scenes.make_mesh().triangle_count


CLOSED_BY_A_SERVER_THAT_GOES_AWAY = "1001"  # a code of WebSocket, RFC 6455


def test_key_q_ends_the_server_and_the_page_says_so(view_browser, device) -> None:
    objects = show_objects([scenes.make_mesh()])
    with (
        Painter(objects, device=device) as painter,
        serving(lambda heard: ViewSession(objects, painter, on_change=heard)) as own,
    ):
        view_browser.get(own.address)
        wait_for(view_browser, SETTLED)

        press_keys(view_browser, "q")

        closed = wait_for(view_browser, "return document.documentElement.dataset.closed")
        assert closed == CLOSED_BY_A_SERVER_THAT_GOES_AWAY
        assert "the server has ended" in view_browser.find_element("id", "message").text
        severe_lines(view_browser)  # no later test is to find what the end of the server logs


# Tabs and the secret


@pytest.mark.release
def test_another_tab_has_a_view_of_its_own(page, view_server) -> None:
    run_command(page, "set_iso", hu=350)
    wait_for(page, "return clrecon.facts.iso.hu === 350")
    first = page.current_window_handle

    page.switch_to.new_window("tab")
    page.get(view_server.address)

    wait_for(page, SETTLED)
    assert facts(page)["iso"]["hu"] == ISO
    page.close()
    page.switch_to.window(first)
    assert facts(page)["iso"]["hu"] == 350


def test_address_without_the_secret_shows_the_refusal_alone(view_browser, view_server) -> None:
    view_browser.get(f"http://127.0.0.1:{view_server.port}/")

    assert "the secret is missing or wrong" in view_browser.find_element("tag name", "body").text
    assert view_browser.find_elements("id", "scene") == []
    severe_lines(view_browser)  # the browser logs the refusal: no later test is to find it


def test_page_that_is_loaded_again_keeps_its_iso_value(page) -> None:
    run_command(page, "set_iso", hu=250)
    wait_for(page, "return clrecon.facts.iso.hu === 250")

    page.refresh()

    wait_for(page, SETTLED)
    assert facts(page)["iso"]["hu"] == 250
