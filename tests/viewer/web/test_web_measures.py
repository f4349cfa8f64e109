"""Measures on the page in a real browser: named, listed, renamed, removed, and saved as files."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
import view_scenes as scenes
from browser import wait_for
from view_pages import facts, open_view_page, picture, press
from web_views import PATIENCE

pytestmark = [pytest.mark.slow, pytest.mark.opencl]


@pytest.fixture
def page(view_browser, view_server):
    """The page with two places: in the middle of an axial slice, and beside it."""
    with open_view_page(view_browser, view_server) as opened:
        size = picture(opened, "axial").shape[1::-1]
        for count, share in enumerate((0.5, 0.6), 1):
            at = {"x": share * size[0], "y": 0.5 * size[1], "size": list(size), "plane": "axial"}
            opened.execute_script("clrecon.run('mark_at', arguments[0])", at)
            wait_for(opened, f"return clrecon.facts.measures.length === {count}")
        yield opened


def names(page) -> list[str]:
    return page.execute_script("return [...document.querySelectorAll('#measures input')].map((one) => one.value)")


def test_measure_is_renamed_in_its_row_and_on_the_slice(page) -> None:
    from selenium.webdriver.common.keys import Keys

    field = page.find_element("css selector", "#measures li:nth-child(2) input")
    assert (names(page), field.accessible_name) == (["place 1", "place 2"], "name of place 2")
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys("<b>L3</b> & entry", Keys.ENTER)
    wait_for(page, "return clrecon.facts.measures[1].name === '<b>L3</b> & entry'")
    assert names(page) == ["place 1", "<b>L3</b> & entry"]
    wait_for(page, "return document.querySelector('#axial svg').textContent.includes('<b>L3</b> & entry')")


def test_escape_and_an_empty_name_leave_the_name(page) -> None:
    from selenium.webdriver.common.keys import Keys

    field = page.find_element("css selector", "#measures input")
    for keys in (("other", Keys.ESCAPE), (Keys.CONTROL, "a", Keys.NULL, Keys.DELETE, Keys.ENTER)):
        field.send_keys(*keys)
        wait_for(page, "return document.querySelector('#measures input').value === 'place 1'")
    assert [measure["name"] for measure in facts(page)["measures"]] == ["place 1", "place 2"]


def test_measure_is_removed_and_brought_back_and_the_focus_stays_in_the_list(page) -> None:
    from selenium.webdriver.common.keys import Keys

    (first, _) = page.find_elements("css selector", "#measures button[aria-label^='remove']")
    assert first.accessible_name == "remove place 1"
    first.send_keys(Keys.ENTER)
    wait_for(page, "return clrecon.facts.measures.length === 1")
    assert names(page) == ["place 2"]
    assert page.switch_to.active_element.accessible_name == "remove place 2"
    press(page, "u")
    wait_for(page, "return clrecon.facts.measures.length === 2")
    assert names(page) == ["place 1", "place 2"]


def test_slices_go_to_a_measure_of_the_list(page) -> None:
    page.execute_script("clrecon.run('set_cross', { point: arguments[0] })", scenes.middle(1).tolist())
    wait_for(page, f"return Math.abs(clrecon.facts.cross[0] - {scenes.middle(1)[0]}) < 0.01")
    point = facts(page)["measures"][1]["points"][0]
    page.find_element("css selector", "#measures li:nth-child(2) button").click()
    wait_for(page, f"return Math.abs(clrecon.facts.cross[0] - {point[0]}) < 0.01")
    assert np.allclose(facts(page)["cross"], point, atol=0.01)


def test_measures_are_saved_as_markups_and_the_buttons_go_with_the_last(page, downloads: Path) -> None:
    page.find_element("css selector", "#exports [data-format='.mrk.json']").click()
    end = time.monotonic() + PATIENCE
    while not (downloads / "view.mrk.json").exists():
        assert time.monotonic() < end, page.find_element("id", "saved").text
        time.sleep(0.05)
    content = json.loads((downloads / "view.mrk.json").read_text(encoding="utf-8"))
    assert [each["controlPoints"][0]["position"] for each in content["markups"]] == [
        measure["points"][0] for measure in facts(page)["measures"]
    ]
    page.find_element("id", "clear").click()
    wait_for(page, "return document.getElementById('exports').hidden")
