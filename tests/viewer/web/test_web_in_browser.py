"""The page of the view in a real browser: it draws, turns, slides, measures, saves, and talks to its server alone."""

from __future__ import annotations

import io
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
import view_scenes as scenes
from browser import open_browser, outside_requests, severe_lines, wait_for
from web_views import PATIENCE, serving

from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.session import ViewSession

pytestmark = [pytest.mark.slow, pytest.mark.opencl]

SETTLED = "return clrecon.facts && clrecon.facts.settled && clrecon.pictures > 0"
ISO = scenes.ISO


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def browser(folder):
    with open_browser(1200, 800) as driver:
        driver.execute_cdp_cmd("Page.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)})
        yield driver


@pytest.fixture(scope="module")
def served(device):
    objects = show_objects([scenes.make_scan(), scenes.make_mesh()])
    with (
        Painter(objects, device=device) as painter,
        serving(lambda heard: ViewSession(objects, painter, iso_value=ISO, on_change=heard)) as running,
    ):
        yield running


@pytest.fixture
def page(browser, served):
    """The page, just opened and drawn; after the test it has logged no error and asked nobody else for anything."""
    severe_lines(browser), outside_requests(browser)
    browser.get(served.address)
    wait_for(browser, SETTLED)
    yield browser
    assert severe_lines(browser) == []
    own = (f"http://127.0.0.1:{served.port}/", f"ws://127.0.0.1:{served.port}/")
    assert [address for address in outside_requests(browser) if not address.startswith(own)] == []


def picture(page, name: str = "scene") -> np.ndarray:
    """What a view shows, (h, w, 3), with what lies over it."""
    from PIL import Image

    content = page.find_element("id", name).screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def changed_share(one: np.ndarray, other: np.ndarray) -> float:
    return float((np.abs(one - other).max(axis=2) > 24).mean())


def facts(page) -> dict:
    return json.loads(page.execute_script("return JSON.stringify(clrecon.facts)"))


def settle(page) -> None:
    """Wait until everything is shown as it is after what was done."""
    time.sleep(0.3)  # a change needs a frame and the way to the server
    wait_for(page, SETTLED)


def drag(page, element, x: int, y: int, dx: int, dy: int, steps: int = 15) -> None:
    """Drag from a place beside the middle of an element, in small moves."""
    from selenium.webdriver import ActionChains

    actions = ActionChains(page, duration=15).move_to_element_with_offset(element, x, y).click_and_hold()
    for _ in range(steps):
        actions = actions.move_by_offset(round(dx / steps), round(dy / steps))
    actions.release().perform()


def click(page, name: str, point: np.ndarray) -> None:
    """Click at the place of a point of the patient."""
    from selenium.webdriver import ActionChains

    element = page.find_element("id", name)
    x, y = page.execute_script("return clrecon.project(arguments[0], arguments[1])", name, [float(v) for v in point])
    ActionChains(page).move_to_element_with_offset(
        element, round(x - element.size["width"] / 2), round(y - element.size["height"] / 2)
    ).click().perform()


def test_a_drag_turns_the_picture_and_leaves_the_slices(page) -> None:
    before, slice_before, count = picture(page), picture(page, "axial"), page.execute_script("return clrecon.pictures")
    drag(page, page.find_element("id", "scene"), 0, 0, 150, 30)
    settle(page)
    assert changed_share(before, picture(page)) > 0.01
    assert changed_share(slice_before, picture(page, "axial")) == 0.0
    assert page.execute_script("return clrecon.pictures") > count + 1  # coarse ones on the way
    page.find_element("id", "undo").click()
    settle(page)
    assert changed_share(before, picture(page)) < 0.002


def test_the_slider_sets_the_iso_value_and_the_picture_follows(page) -> None:
    before = picture(page)
    drag(page, page.find_element("id", "hu"), 0, 0, 150, 0)
    settle(page)
    hu = facts(page)["iso"]["hu"]
    assert hu != ISO and page.find_element("id", "exact").get_attribute("value") == f"{hu:g}"
    assert changed_share(before, picture(page)) > 0.001
    assert f"{hu:g} HU" in page.find_element("id", "status").text


def test_an_iso_value_that_is_none_changes_nothing(page) -> None:
    from selenium.webdriver.common.keys import Keys

    exact = page.find_element("id", "exact")
    for wrong in ("", "99999", "-5000"):
        exact.send_keys(Keys.CONTROL, "a")
        exact.send_keys(wrong or Keys.DELETE, Keys.ENTER)
        wait_for(page, f"return document.getElementById('exact').value === '{ISO:g}'")
    assert "The iso value runs from" in page.find_element("id", "hint").text
    assert facts(page)["iso"]["hu"] == ISO
    exact.send_keys(Keys.CONTROL, "a")
    exact.send_keys("321", Keys.ENTER)
    wait_for(page, "return clrecon.facts.iso.hu === 321")
    assert page.find_element("id", "hu").get_attribute("value") == "321"


def test_keys_look_from_the_sides_with_their_letters(page) -> None:
    from selenium.webdriver.common.keys import Keys

    def letters() -> list[str]:
        return page.execute_script(
            "return [...document.querySelectorAll('#scene .side')].slice(0, 4).map((one) => one.textContent)"
        )

    page.find_element("id", "scene").send_keys("1")
    settle(page)
    assert letters() == ["S", "I", "R", "L"]  # up, down, left and right edge
    page.find_element("id", "scene").send_keys("3")
    settle(page)
    assert letters() == ["S", "I", "A", "P"]
    page.find_element("id", "scene").send_keys(Keys.ESCAPE)


def test_a_distance_by_two_clicks_is_that_of_the_places(page) -> None:
    page.find_element("id", "distance").click()
    for number in (0, 1):
        click(page, "scene", scenes.middle(number))
        wait_for(page, f"return clrecon.facts.points.length + 2 * clrecon.facts.measures.length === {number + 1}")
    (measure,) = facts(page)["measures"]
    first, last = (np.array(point) for point in measure["points"])
    assert measure["text"] == f"{np.linalg.norm(last - first):.1f} mm"
    for number, point in enumerate((first, last)):  # on the balls, within the roundings of a click to pixels
        away = np.linalg.norm(point - scenes.middle(number))
        assert abs(away - scenes.BALLS[number][1]) < 1.0 or np.abs(point - scenes.middle(number))[1] > 5.0
    settle(page)
    assert measure["text"] in page.find_element("css selector", "#scene svg").text
    page.find_element("id", "clear").click()
    wait_for(page, "return !clrecon.facts.measures.length")


def test_a_part_is_hidden_by_a_click_and_listed_with_its_ml(page) -> None:
    page.find_element("id", "find").click()
    wait_for(page, "return clrecon.facts.parts.filter((part) => part.kind === 'cluster').length === 3")
    settle(page)
    before = picture(page)
    page.find_element("id", "hide").click()
    click(page, "scene", scenes.middle(1))
    wait_for(page, "return clrecon.facts.parts.some((part) => part.kind === 'cluster' && !part.visible)")
    (hidden,) = [part for part in facts(page)["parts"] if not part["visible"]]
    assert hidden["ml"] == pytest.approx(4.0 / 3.0 * np.pi * 5.0**3 / 1000.0, rel=0.1)
    settle(page)
    assert changed_share(before, picture(page)) > 0.001
    assert re.search(r"0\.\d+ ml", page.find_element("id", "parts").text)
    page.find_element("id", "all").click()
    wait_for(page, "return clrecon.facts.parts.every((part) => part.visible)")


def test_the_wheel_scrolls_a_slice_and_a_right_drag_is_its_window(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    axial, before = page.find_element("id", "axial"), facts(page)
    ActionChains(page).scroll_from_origin(ScrollOrigin.from_element(axial), 0, 300).perform()
    wait_for(page, f"return clrecon.facts.cross[2] !== {before['cross'][2]}")
    page.execute_script(
        """const box = arguments[0], at = box.getBoundingClientRect();
        const fire = (name, x, y, buttons) => box.dispatchEvent(new PointerEvent(name,
            { pointerId: 1, clientX: at.left + x, clientY: at.top + y, button: 2, buttons, bubbles: true }));
        box.setPointerCapture = () => {};
        fire("pointerdown", 40, 40, 2);
        for (let n = 1; n < 12; n++) fire("pointermove", 40 + 5 * n, 40, 2);
        fire("pointerup", 95, 40, 0);""",
        axial,
    )
    low, high = before["window"]
    wait_for(page, f"return clrecon.facts.window[1] - clrecon.facts.window[0] > {1.1 * (high - low)}")
    after = facts(page)
    assert sum(after["window"]) == pytest.approx(low + high, abs=1.0)  # a drag to the side leaves the level
    assert after["cross"][:2] == pytest.approx(before["cross"][:2])


def test_clip_planes_and_a_box_cut(page) -> None:
    before = picture(page)
    page.find_element("id", "cut").click()
    wait_for(page, "return clrecon.facts.clips.length === 1")
    settle(page)
    cut = picture(page)
    assert changed_share(before, cut) > 0.005
    drag(page, page.find_element("css selector", "#clips input"), 0, 0, 45, 0)
    settle(page)
    assert facts(page)["clips"][0]["share"] > 0.5
    page.find_element("css selector", "#clips li button:last-of-type").click()
    page.find_element("id", "boxed").click()
    wait_for(page, "return clrecon.facts.clip_box && !clrecon.facts.clips.length")
    assert page.find_element("id", "box").is_displayed()


def test_what_is_shown_is_saved_as_a_download(page, folder: Path) -> None:
    from selenium.webdriver.support.ui import Select

    from clrecon.mesh.mesh_reader import read_mesh

    Select(page.find_element("id", "format")).select_by_value(".stl")
    page.find_element("id", "save").click()
    end = time.monotonic() + PATIENCE
    while not (folder / "view.stl").exists():
        assert time.monotonic() < end, page.find_element("id", "saved").text
        time.sleep(0.05)
    mesh = read_mesh(folder / "view.stl", space="lps")
    assert mesh.triangle_count > 1000


def test_another_browser_has_a_view_of_its_own(page, served) -> None:
    page.execute_script("clrecon.run('set_iso', { hu: 350 })")
    wait_for(page, "return clrecon.facts.iso.hu === 350")
    first = page.current_window_handle
    page.switch_to.new_window("tab")
    page.get(served.address)
    wait_for(page, SETTLED)
    assert facts(page)["iso"]["hu"] == ISO
    page.close()
    page.switch_to.window(first)
    assert facts(page)["iso"]["hu"] == 350


def test_without_the_secret_there_is_no_page(browser, served) -> None:
    browser.get(f"http://127.0.0.1:{served.port}/")
    assert "the secret is missing or wrong" in browser.find_element("tag name", "body").text
    severe_lines(browser)
