"""The page of the view in a real browser: it draws, turns, slides, measures, saves, and talks to its server alone."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest
import view_scenes as scenes
from browser import severe_lines, wait_for
from open_views import search_for_ever
from view_pages import SETTLED, changed_share, click, drag, facts, open_view_page, picture, point_at, press, settle
from web_views import PATIENCE, serving

from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.commands import KEYS
from clrecon.viewer.session.session import ViewSession

pytestmark = [pytest.mark.slow, pytest.mark.opencl]

PARTS = "return clrecon.facts.parts.filter((part) => part.kind === 'cluster').length === 3"
ISO = scenes.ISO


@pytest.fixture
def page(view_browser, view_server):
    with open_view_page(view_browser, view_server) as opened:
        yield opened


def test_drag_turns_the_picture_and_leaves_the_slices_and_undo_turns_it_back(page) -> None:
    before, slice_before = picture(page), picture(page, "axial")
    count = page.execute_script("window.first = JSON.stringify(clrecon.facts.camera); return clrecon.pictures")
    drag(page, page.find_element("id", "scene"), 0, 0, 150, 30)
    settle(page)
    assert changed_share(before, picture(page)) > 0.01
    assert changed_share(slice_before, picture(page, "axial")) == 0.0
    assert page.execute_script("return clrecon.pictures") > count + 1  # coarse ones on the way
    page.execute_script("window.shown = clrecon.pictures")
    page.find_element("id", "undo").click()
    wait_for(page, "return JSON.stringify(clrecon.facts.camera) === window.first && clrecon.pictures > window.shown")
    wait_for(page, SETTLED)
    assert changed_share(before, picture(page)) < 0.002


def test_undo_stays_where_it_is_while_lists_grow(page) -> None:
    place = "return document.getElementById('undo').getBoundingClientRect().top"
    before = page.execute_script(place)
    page.execute_script(
        "for (const id of ['measures', 'parts', 'clips'])"
        "  for (let n = 0; n < 5; n++) document.getElementById(id).append(document.createElement('li'));"
        "document.getElementById('hint').textContent = 'a hint of several lines '.repeat(9);"
    )
    assert page.execute_script(place) == before > 0


def test_slider_sets_the_iso_value_and_the_picture_follows(page) -> None:
    before = picture(page)
    drag(page, page.find_element("id", "hu"), 0, 0, 150, 0)
    settle(page)
    hu = facts(page)["iso"]["hu"]
    assert hu != ISO and page.find_element("id", "exact").get_attribute("value") == f"{hu:g}"
    assert changed_share(before, picture(page)) > 0.001
    assert f"{hu:g} HU" in page.find_element("id", "status").text


def test_text_that_is_no_iso_value_is_put_back_and_a_number_is_taken(page) -> None:
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


def test_surface_is_fitted_to_the_bone_and_coloured_with_a_scale(page) -> None:
    before, bars = picture(page), "return document.querySelectorAll('#scene rect').length"
    assert not page.find_element("id", "shade").is_displayed() and page.execute_script(bars) == 0
    press(page, "t")
    wait_for(page, "return clrecon.facts.fitted === true")
    settle(page)
    assert page.find_element("id", "fitted").is_selected()
    assert changed_share(before, picture(page)) > 0.001
    page.find_element("css selector", "#shade option[value=thickness]").click()
    wait_for(page, "return clrecon.facts.scale !== null")
    settle(page)
    assert page.execute_script(bars) == 64
    assert "mm thick" in page.find_element("css selector", "#scene svg").text
    page.find_element("id", "fitted").click()
    wait_for(page, "return clrecon.facts.fitted === false && clrecon.facts.scale === null")
    page.find_element("css selector", "#mode option[value=drr]").click()
    wait_for(page, "return document.getElementById('fitting').hidden")


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


@pytest.mark.release
def test_distance_by_two_clicks_is_that_of_the_places(page) -> None:
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


def test_part_is_hidden_by_a_click_and_listed_with_its_ml(page) -> None:
    wait_for(page, PARTS)
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


def test_shift_click_names_the_part_and_moves_the_slices_there(page) -> None:
    from selenium.webdriver.common.keys import Keys

    wait_for(page, PARTS)
    click(page, "scene", scenes.middle(1), Keys.SHIFT)
    wait_for(page, "return document.getElementById('hint').textContent.endsWith('mm LPS')")
    said = page.find_element("id", "hint").text
    assert re.match(r"part 2, 0\.\d+ ml, (299|300|301) HU, ", said), said
    assert np.linalg.norm(np.array(facts(page)["cross"]) - scenes.middle(1)) == pytest.approx(5.0, abs=0.3)
    (row,) = page.find_elements("css selector", "#parts li.chosen")
    assert "part 2" in row.text
    page.find_element("id", "level").send_keys(Keys.TAB)  # the pointer stays, the focus goes
    row.find_element("css selector", ".name").click()
    assert page.find_elements("css selector", "#parts li.chosen") == []


def test_cross_is_seen_in_the_picture_and_slices_have_names_and_colours(page) -> None:
    def colors(name: str) -> set[str]:
        return set(
            page.execute_script(
                "const lines = document.querySelectorAll(`#${arguments[0]} .cross`);"
                "return [...lines].map((line) => getComputedStyle(line).stroke)",
                name,
            )
        )

    every = colors("scene")
    assert len(every) == 3
    for name in ("axial", "coronal", "sagittal"):
        label = page.find_element("css selector", f"#{name} .name")
        assert label.text.split()[0] == name
        own = page.execute_script("return getComputedStyle(arguments[0]).fill", label)
        assert colors(name) == every - {own}
    marks = page.find_elements("css selector", "#marks span")
    assert 4 < len(marks) < 20 and "0" in [mark.text for mark in marks]


@pytest.mark.release
def test_left_right_and_the_wheel_step_the_iso_value(page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
    from selenium.webdriver.common.keys import Keys

    point_at(page, "scene", scenes.middle(0))
    press(page, Keys.ARROW_RIGHT)
    wait_for(page, f"return clrecon.facts.iso.hu === {ISO + 5}")
    press(page, Keys.ARROW_LEFT, Keys.ARROW_LEFT)
    wait_for(page, f"return clrecon.facts.iso.hu === {ISO - 5}")
    hu = page.find_element("id", "hu")
    ActionChains(page).scroll_from_origin(ScrollOrigin.from_element(hu), 0, -100).perform()
    wait_for(page, f"return clrecon.facts.iso.hu === {ISO}")
    assert hu.get_attribute("value") == f"{ISO:g}"


def test_keys_use_what_lies_under_the_pointer_in_slices_too(page) -> None:
    wait_for(page, PARTS)
    point_at(page, "scene", scenes.middle(1))
    press(page, "e")
    wait_for(page, "return clrecon.facts.measures.length === 1")
    (seed,) = facts(page)["measures"]
    assert (seed["kind"], facts(page)["tool"]) == ("seed", None)
    assert page.find_element("css selector", "#measures input").get_attribute("value") == "place 1"
    page.execute_script("clrecon.run('set_cross', { point: arguments[0] })", scenes.middle(0).tolist())
    wait_for(page, f"return Math.abs(clrecon.facts.cross[2] - {scenes.middle(0)[2]}) < 0.01")
    settle(page)
    point_at(page, "axial", scenes.middle(0))
    press(page, "x")
    wait_for(page, "return clrecon.facts.parts.some((part) => part.name === 'part 1' && !part.visible)")
    press(page, "A")
    wait_for(page, "return clrecon.facts.parts.every((part) => part.visible)")
    page.find_element("xpath", "//ul[@id='parts']//span[text()='part 2']").click()  # away from the pictures
    press(page, "X")
    wait_for(page, "return clrecon.facts.parts.filter((part) => part.kind === 'cluster' && part.visible).length === 1")
    assert [part["name"] for part in facts(page)["parts"] if part["visible"] and part["kind"] == "cluster"] == [
        "part 2"
    ]


def test_line_is_faint_where_bone_lies_before_it(page) -> None:
    page.find_element("id", "distance").click()
    for number in (0, 1):
        click(page, "scene", scenes.middle(number))
        wait_for(page, f"return clrecon.facts.points.length + 2 * clrecon.facts.measures.length === {number + 1}")
    page.execute_script("clrecon.run('look', { view: 'posterior' })")
    settle(page)
    (measure,) = facts(page)["measures"]
    first, last = (np.array(point) for point in measure["points"])
    seen = np.array(facts(page)["seen_lines"])
    assert len(seen) == 1  # between the balls, not behind them
    assert 2.0 < np.linalg.norm(seen[0, 1] - seen[0, 0]) < np.linalg.norm(last - first) - 6.0
    assert len(page.find_elements("css selector", "#scene .line.seen")) == 1
    page.execute_script("clrecon.run('look', { view: 'anterior' })")
    settle(page)
    seen = np.array(facts(page)["seen_lines"])
    assert np.linalg.norm(seen[:, 1] - seen[:, 0], axis=1).sum() > 0.7 * np.linalg.norm(last - first)


def test_clip_box_lies_about_the_cross_and_an_oblique_plane_is_named_by_letters(page) -> None:
    press(page, "C")
    box = np.array(wait_for(page, "return clrecon.facts.clip_box"))
    low, high = np.array(facts(page)["bounds"])
    assert box[1] - box[0] == pytest.approx(0.5 * (high - low), abs=0.01)
    assert box.mean(axis=0) == pytest.approx(facts(page)["cross"], abs=0.01)
    press(page, "C")
    wait_for(page, "return !clrecon.facts.clip_box")
    page.execute_script("clrecon.run('turn', { dx: 0.2, dy: 0 })")
    press(page, "c")
    wait_for(page, "return clrecon.facts.clips.length === 1")
    assert re.match(r"[APLR]{2} side", page.find_element("id", "clips").text)


def test_part_gets_its_own_look_back_and_a_mesh_says_its_triangles(page) -> None:
    page.execute_script("clrecon.run('set_color', { key: '2', rgb: [1, 0, 0] })")
    wait_for(page, "return clrecon.facts.parts.find(({ key }) => key === '2').color")
    (row,) = [each for each in page.find_elements("css selector", "#parts li") if "mesh" in each.text]
    assert re.search(r"\d,\d{3}", row.text)
    row.find_element("xpath", ".//button[text()='plain']").click()
    wait_for(page, "return !clrecon.facts.parts.find(({ key }) => key === '2').color")


def test_k_makes_a_curve_shows_its_picture_and_takes_that_away(page) -> None:
    curve = page.find_element("id", "curve")
    press(page, "k")
    for number in (1, 2):
        click(page, "scene", scenes.middle(number))
        wait_for(page, f"return clrecon.facts.points.length === {number}")
    press(page, "k")
    wait_for(page, "return clrecon.facts.measures.length === 1 && !clrecon.facts.tool")
    settle(page)
    assert curve.is_displayed() and curve.find_element("css selector", ".name").text == "along the curve"
    press(page, "k")
    assert not curve.is_displayed()
    page.find_element("id", "along").click()
    assert curve.is_displayed()


def test_escape_stops_the_work(page, view_server, monkeypatch) -> None:
    from selenium.webdriver.common.keys import Keys

    wait_for(page, PARTS)
    monkeypatch.setattr(Painter, "find_parts", lambda self, state, progress: search_for_ever(state, progress))
    page.execute_script("clrecon.run('set_iso', { hu: 310 })")
    wait_for(page, "return clrecon.facts.busy.includes('finding parts')")
    press(page, Keys.ESCAPE)
    wait_for(page, "return !clrecon.facts.busy.length")
    assert not facts(page)["parts_known"]


def test_page_shows_the_description_and_what_was_removed(page) -> None:
    assert "a ball of triangles" in page.find_element("id", "about").text
    page.find_element("id", "table").click()
    wait_for(page, "return /of the voxels are air now/.test(document.getElementById('hint').textContent)")


def test_list_of_keys_is_that_of_the_session(page) -> None:
    press(page, "h")
    text = page.find_element("id", "keys").text
    for key in KEYS.values():
        assert key.words in text
    press(page, "h")  # keys do nothing while it is open
    page.find_element("id", "closekeys").click()
    assert not page.find_element("id", "keys").is_displayed()


def test_wheel_scrolls_a_slice_and_a_right_drag_is_its_window(page) -> None:
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


@pytest.mark.release
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


def test_shown_view_is_saved_as_a_download(page, downloads: Path) -> None:
    from selenium.webdriver.support.ui import Select

    from clrecon.mesh.mesh_reader import read_mesh

    Select(page.find_element("id", "format")).select_by_value(".stl")
    page.find_element("id", "save").click()
    end = time.monotonic() + PATIENCE
    while not (downloads / "view.stl").exists():
        assert time.monotonic() < end, page.find_element("id", "saved").text
        time.sleep(0.05)
    mesh = read_mesh(downloads / "view.stl", space="lps")
    assert mesh.triangle_count > 1000


def test_files_that_were_named_are_written_here_and_q_ends_it(view_browser, device, tmp_path: Path) -> None:
    from clrecon.mesh.mesh_reader import read_mesh

    objects = show_objects([scenes.make_mesh()])
    wrote: list[str] = []
    names = [str(tmp_path / name) for name in ("shown.ply", "shown.png")]
    with (
        Painter(objects, device=device) as painter,
        serving(lambda heard: ViewSession(objects, painter, on_change=heard), save_as=names, wrote=wrote.append) as own,
    ):
        view_browser.get(own.address)
        wait_for(view_browser, SETTLED)
        for count in (2, 4):
            press(view_browser, "s")
            end = time.monotonic() + PATIENCE
            while len(wrote) < count:
                assert time.monotonic() < end, view_browser.find_element("id", "saved").text
                time.sleep(0.05)
        press(view_browser, "q")
        wait_for(view_browser, "return document.documentElement.dataset.closed === '1001'")
        assert "the server has ended" in view_browser.find_element("id", "message").text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["shown-2.ply", "shown-2.png", "shown.ply", "shown.png"]
    assert read_mesh(tmp_path / "shown-2.ply", space="lps").triangle_count == scenes.make_mesh().triangle_count


@pytest.mark.release
def test_another_tab_has_a_view_of_its_own(page, view_server) -> None:
    page.execute_script("clrecon.run('set_iso', { hu: 350 })")
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
    severe_lines(view_browser)


def test_page_that_is_loaded_again_keeps_its_view(page) -> None:
    page.execute_script("clrecon.run('set_iso', { hu: 250 })")
    wait_for(page, "return clrecon.facts.iso.hu === 250")

    page.refresh()

    wait_for(page, SETTLED)
    assert facts(page)["iso"]["hu"] == 250
