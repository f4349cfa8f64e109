"""Measures on the page in a real browser: named, listed, renamed, removed, and saved as files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tolerances
import view_scenes as scenes
from browser import wait_for
from view_pages import click_point, facts, open_view_page, point_at, press_keys, run_command, screenshot, wait_for_file

pytestmark = [pytest.mark.slow, pytest.mark.opencl]


@pytest.fixture
def page_with_two_places(view_browser, view_server):
    """The page with "place 1" in the middle of the axial slice, and "place 2" beside it."""
    with open_view_page(view_browser, view_server) as opened:
        height, width = screenshot(opened, "axial").shape[:2]
        for count, share_of_width in enumerate((0.5, 0.6), 1):
            run_command(
                opened, "mark_at", x=share_of_width * width, y=0.5 * height, size=[width, height], plane="axial"
            )
            wait_for(opened, f"return clrecon.facts.measures.length === {count}")
        yield opened


def listed_names(page) -> list[str]:
    return page.execute_script("return [...document.querySelectorAll('#measures input')].map((one) => one.value)")


def test_measures_are_listed_by_names_that_are_fields_to_change(page_with_two_places) -> None:
    fields = page_with_two_places.find_elements("css selector", "#measures input")

    assert [field.get_attribute("value") for field in fields] == ["place 1", "place 2"]
    assert [field.accessible_name for field in fields] == ["name of place 1", "name of place 2"]


def test_name_of_a_measure_is_changed_as_typed_in_its_row_and_on_the_slice(page_with_two_places) -> None:
    from selenium.webdriver.common.keys import Keys

    page, name = page_with_two_places, "<b>L3</b> & entry"
    field = page.find_element("css selector", "#measures li:nth-child(2) input")

    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(name, Keys.ENTER)

    wait_for(page, f"return clrecon.facts.measures[1].name === '{name}'")
    assert listed_names(page) == ["place 1", name]
    wait_for(page, f"return document.querySelector('#axial svg').textContent.includes('{name}')")


def test_escape_and_an_empty_name_leave_the_name(page_with_two_places) -> None:
    from selenium.webdriver.common.keys import Keys

    page = page_with_two_places
    field = page.find_element("css selector", "#measures input")

    for keys in (("other", Keys.ESCAPE), (Keys.CONTROL, "a", Keys.NULL, Keys.DELETE, Keys.ENTER)):
        field.send_keys(*keys)
        wait_for(page, "return document.querySelector('#measures input').value === 'place 1'")

    assert [measure["name"] for measure in facts(page)["measures"]] == ["place 1", "place 2"]


def remove_first_place(page) -> None:
    from selenium.webdriver.common.keys import Keys

    (first, _) = page.find_elements("css selector", "#measures button[aria-label^='remove']")
    assert first.accessible_name == "remove place 1"
    first.send_keys(Keys.ENTER)
    wait_for(page, "return clrecon.facts.measures.length === 1")


def test_measure_is_removed_by_the_button_of_its_row(page_with_two_places) -> None:
    remove_first_place(page_with_two_places)

    assert listed_names(page_with_two_places) == ["place 2"]


def test_focus_goes_to_the_next_button_when_a_measure_is_removed(page_with_two_places) -> None:
    remove_first_place(page_with_two_places)

    assert page_with_two_places.switch_to.active_element.accessible_name == "remove place 2"


def test_key_u_brings_a_removed_measure_back_in_its_place(page_with_two_places) -> None:
    remove_first_place(page_with_two_places)

    press_keys(page_with_two_places, "u")

    wait_for(page_with_two_places, "return clrecon.facts.measures.length === 2")
    assert listed_names(page_with_two_places) == ["place 1", "place 2"]


def test_click_on_a_measure_of_the_list_moves_the_slices_to_it(page_with_two_places) -> None:
    page = page_with_two_places
    run_command(page, "set_cross", point=scenes.middle(1).tolist())  # away from both places
    wait_for(page, f"return Math.abs(clrecon.facts.cross[0] - {scenes.middle(1)[0]}) < 0.01")  # mm
    place = facts(page)["measures"][1]["points"][0]

    page.find_element("css selector", "#measures li:nth-child(2) button").click()

    wait_for(page, f"return Math.abs(clrecon.facts.cross[0] - {place[0]}) < 0.01")
    assert facts(page)["cross"] == pytest.approx(place, abs=tolerances.VIEW_BOX_MM)


def test_measures_are_saved_as_markups_at_their_points(page_with_two_places, downloads: Path) -> None:
    page_with_two_places.find_element("css selector", "#exports [data-format='.mrk.json']").click()

    wait_for_file(page_with_two_places, downloads / "view.mrk.json")
    markups = json.loads((downloads / "view.mrk.json").read_text(encoding="utf-8"))["markups"]
    points = [measure["points"][0] for measure in facts(page_with_two_places)["measures"]]
    assert [each["controlPoints"][0]["position"] for each in markups] == points


def test_buttons_that_save_measures_go_with_the_last_measure(page_with_two_places) -> None:
    assert page_with_two_places.find_element("id", "exports").is_displayed()

    page_with_two_places.find_element("id", "clear").click()

    wait_for(page_with_two_places, "return document.getElementById('exports').hidden")


def test_circle_of_two_clicks_on_a_slice_is_listed_with_its_mean_and_a_closed_line(page_with_two_places) -> None:
    page, middle = page_with_two_places, scenes.middle(0)
    run_command(page, "clear_measures")
    run_command(page, "set_cross", point=middle.tolist())
    wait_for(page, f"return Math.abs(clrecon.facts.cross[0] - {middle[0]}) < 0.01 && clrecon.facts.settled")  # mm

    press_keys(page, "d")
    wait_for(page, "return clrecon.facts.tool === 'circle'")
    click_point(page, "axial", middle)
    wait_for(page, "return clrecon.facts.points.length === 1")
    click_point(page, "axial", middle + (5.0, 0.0, 0.0))  # in a ball of 9 mm

    wait_for(page, "return clrecon.facts.measures.length === 1")
    assert page.execute_script("return measures.querySelector('button').textContent") == "1000 ± 0 HU"
    line = page.execute_script(
        "return document.querySelector('#axial polyline.line').getAttribute('points').split(' ')"
    )
    assert line[0] == line[-1]
    assert len(set(line)) > 20  # the outline has 48 places, of which several may be one pixel


def test_box_that_is_drawn_follows_the_mouse_from_its_first_corner(page_with_two_places) -> None:
    page, middle = page_with_two_places, scenes.middle(0)
    page.find_element("id", "square").click()
    wait_for(page, "return clrecon.facts.tool === 'box'")
    click_point(page, "axial", middle)
    wait_for(page, "return clrecon.facts.points.length === 1")

    point_at(page, "axial", middle + (6.0, 0.0, 0.0))

    assert wait_for(page, "return document.querySelector('#axial rect.line').width.baseVal.value > 10")  # pixels


def test_circle_is_not_drawn_in_the_picture(page_with_two_places) -> None:
    page = page_with_two_places
    page.find_element("id", "circle").click()
    wait_for(page, "return clrecon.facts.tool === 'circle'")

    click_point(page, "scene", scenes.middle(0))

    assert wait_for(page, "return hint.textContent.includes('click in one')")
    assert facts(page)["points"] == []
