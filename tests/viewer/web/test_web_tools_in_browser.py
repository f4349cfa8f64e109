"""Parts, measures, curves and clips on the page in a real browser, by clicks and by keys under the pointer."""

from __future__ import annotations

import re

import numpy as np
import pytest
import tolerances
import view_scenes as scenes
from browser import wait_for
from open_views import search_for_ever
from view_pages import (
    click_point,
    drag,
    facts,
    open_view_page,
    point_at,
    press_keys,
    run_command,
    screenshot,
    share_of_changed_pixels,
    wait_until_drawn,
)

from clrecon.viewer.drawing.painter import Painter

pytestmark = [pytest.mark.slow, pytest.mark.opencl]


@pytest.fixture
def page(view_browser, view_server):
    """The page of a scan of three balls and a mesh."""
    with open_view_page(view_browser, view_server) as opened:
        yield opened


# Parts


@pytest.fixture
def page_with_parts(page):
    """The page once each ball of the scan is listed as a part: number 0 as "part 1", and so on."""
    wait_for(page, "return clrecon.facts.parts.filter((part) => part.kind === 'cluster').length === 3")
    wait_until_drawn(page)
    return page


def hide_second_ball(page) -> None:
    page.find_element("id", "hide").click()
    click_point(page, "scene", scenes.middle(1))
    wait_for(page, "return clrecon.facts.parts.some((part) => !part.visible)")


def hidden_parts(page) -> list[str]:
    return [part["name"] for part in facts(page)["parts"] if not part["visible"]]


def test_click_with_the_tool_hide_takes_a_part_out_of_the_picture(page_with_parts) -> None:
    before = screenshot(page_with_parts)

    hide_second_ball(page_with_parts)

    wait_until_drawn(page_with_parts)
    assert hidden_parts(page_with_parts) == ["part 2"]
    assert share_of_changed_pixels(before, screenshot(page_with_parts)) > tolerances.VIEW_CHANGED_SHARE


def test_button_all_shows_hidden_parts_again(page_with_parts) -> None:
    hide_second_ball(page_with_parts)

    page_with_parts.find_element("id", "all").click()

    assert wait_for(page_with_parts, "return clrecon.facts.parts.every((part) => part.visible)")


def test_balls_are_listed_with_their_ml(page_with_parts) -> None:
    said = [row.text for row in page_with_parts.find_elements("css selector", "#parts .ml")]
    listed = [float(text.removesuffix(" ml")) for text in said if text.endswith(" ml")]

    balls = [4 / 3 * np.pi * radius**3 / 1000 for _, radius in scenes.BALLS]
    assert listed[:3] == pytest.approx(balls, rel=tolerances.VIEW_PART_ML)


@pytest.fixture
def page_with_chosen_ball(page_with_parts):
    """The page after a click with Shift on the second ball, once it says what was clicked."""
    from selenium.webdriver.common.keys import Keys

    click_point(page_with_parts, "scene", scenes.middle(1), Keys.SHIFT)
    wait_for(page_with_parts, "return document.getElementById('hint').textContent.endsWith('mm LPS')")
    return page_with_parts


def chosen_rows(page) -> list:
    return page.find_elements("css selector", "#parts li.chosen")


def test_click_with_shift_says_part_ml_and_hu_of_the_surface(page_with_chosen_ball) -> None:
    said = page_with_chosen_ball.find_element("id", "hint").text

    assert re.match(r"part 2, 0\.\d+ ml, (299|300|301) HU, ", said), said  # the surface lies at 300 HU


def test_click_with_shift_moves_the_slices_to_the_surface_that_was_met(page_with_chosen_ball) -> None:
    from_middle = np.array(facts(page_with_chosen_ball)["cross"]) - scenes.middle(1)

    assert np.linalg.norm(from_middle) == pytest.approx(scenes.BALLS[1].radius_mm, abs=tolerances.VIEW_CLICK_MM)


def test_click_with_shift_chooses_the_row_of_the_part(page_with_chosen_ball) -> None:
    (row,) = chosen_rows(page_with_chosen_ball)

    assert "part 2" in row.text


def test_click_on_the_name_of_the_chosen_part_chooses_none(page_with_chosen_ball) -> None:
    from selenium.webdriver.common.keys import Keys

    (row,) = chosen_rows(page_with_chosen_ball)
    page_with_chosen_ball.find_element("id", "level").send_keys(Keys.TAB)  # the pointer stays, the focus goes

    row.find_element("css selector", ".name").click()

    assert chosen_rows(page_with_chosen_ball) == []


def test_key_e_marks_the_place_under_the_pointer_without_a_tool(page_with_parts) -> None:
    point_at(page_with_parts, "scene", scenes.middle(1))

    press_keys(page_with_parts, "e")

    wait_for(page_with_parts, "return clrecon.facts.measures.length === 1")
    (place,) = facts(page_with_parts)["measures"]
    assert (place["kind"], place["name"]) == ("seed", "place 1")
    assert facts(page_with_parts)["tool"] is None


def hide_first_ball_by_key_in_the_axial_slice(page) -> None:
    ball = scenes.middle(0)
    run_command(page, "set_cross", point=ball.tolist())
    wait_for(page, f"return Math.abs(clrecon.facts.cross[2] - {ball[2]}) < 0.01")  # mm
    wait_until_drawn(page)
    point_at(page, "axial", ball)
    press_keys(page, "x")
    wait_for(page, "return clrecon.facts.parts.some((part) => !part.visible)")


def test_key_x_hides_the_part_under_the_pointer_in_a_slice(page_with_parts) -> None:
    hide_first_ball_by_key_in_the_axial_slice(page_with_parts)

    assert hidden_parts(page_with_parts) == ["part 1"]


def test_key_capital_a_shows_hidden_parts_again(page_with_parts) -> None:
    hide_first_ball_by_key_in_the_axial_slice(page_with_parts)

    press_keys(page_with_parts, "A")

    assert wait_for(page_with_parts, "return clrecon.facts.parts.every((part) => part.visible)")


def test_key_capital_x_away_from_the_pictures_leaves_the_chosen_part_of_the_list_alone(page_with_parts) -> None:
    page_with_parts.find_element("xpath", "//ul[@id='parts']//span[text()='part 2']").click()

    press_keys(page_with_parts, "X")

    visible = "clrecon.facts.parts.filter((part) => part.kind === 'cluster' && part.visible)"
    wait_for(page_with_parts, f"return {visible}.length === 1")
    assert page_with_parts.execute_script(f"return {visible}.map((part) => part.name)") == ["part 2"]


def row_of_the_mesh(page):
    (row,) = [each for each in page.find_elements("css selector", "#parts li") if "mesh" in each.text]
    return row


def test_mesh_is_listed_with_its_number_of_triangles(page) -> None:
    assert f"{scenes.make_mesh().triangle_count:,}" in row_of_the_mesh(page).text


def test_button_plain_takes_the_colour_of_a_part_away(page) -> None:
    run_command(page, "set_color", key="2", rgb=[1, 0, 0])  # the second object, which is the mesh
    wait_for(page, "return clrecon.facts.parts.find(({ key }) => key === '2').color")

    row_of_the_mesh(page).find_element("xpath", ".//button[text()='plain']").click()

    assert wait_for(page, "return !clrecon.facts.parts.find(({ key }) => key === '2').color")


def test_escape_stops_the_search_for_parts(page_with_parts, monkeypatch) -> None:
    from selenium.webdriver.common.keys import Keys

    monkeypatch.setattr(Painter, "find_parts", lambda self, state, progress: search_for_ever(state, progress))
    run_command(page_with_parts, "set_iso", hu=310)  # the parts of another surface are sought
    wait_for(page_with_parts, "return clrecon.facts.busy.includes('finding parts')")

    press_keys(page_with_parts, Keys.ESCAPE)

    wait_for(page_with_parts, "return !clrecon.facts.busy.length")
    assert not facts(page_with_parts)["parts_known"]


# Distances


def measure_distance(page, *, first: int, second: int) -> tuple[np.ndarray, np.ndarray, str]:
    """Measure by clicks on the middles of two balls, and return the two points and the text."""
    page.find_element("id", "distance").click()
    click_point(page, "scene", scenes.middle(first))
    wait_for(page, "return clrecon.facts.points.length === 1")
    click_point(page, "scene", scenes.middle(second))
    wait_for(page, "return clrecon.facts.measures.length === 1")
    (measure,) = facts(page)["measures"]
    one, other = (np.array(point) for point in measure["points"])
    return one, other, measure["text"]


@pytest.mark.release
def test_clicks_of_a_distance_meet_the_balls_that_they_point_at(page) -> None:
    first, second, _ = measure_distance(page, first=1, second=2)

    from_middles = [np.linalg.norm(first - scenes.middle(1)), np.linalg.norm(second - scenes.middle(2))]
    radii = [scenes.BALLS[1].radius_mm, scenes.BALLS[2].radius_mm]
    assert from_middles == pytest.approx(radii, abs=tolerances.VIEW_CLICK_MM)


@pytest.mark.release
def test_distance_of_two_clicks_is_written_into_the_picture_in_mm(page) -> None:
    first, second, text = measure_distance(page, first=1, second=2)

    wait_until_drawn(page)
    assert text == f"{np.linalg.norm(second - first):.1f} mm"
    assert text in page.find_element("css selector", "#scene svg").text


@pytest.mark.release
def test_button_clear_removes_a_distance(page) -> None:
    measure_distance(page, first=1, second=2)

    page.find_element("id", "clear").click()

    assert wait_for(page, "return !clrecon.facts.measures.length")


def lengths_in_sight(page, view: str) -> np.ndarray:
    """Lengths in mm of those pieces of the measured lines that nothing hides, seen from a side."""
    run_command(page, "look", view=view)
    wait_until_drawn(page)
    ends = np.array(facts(page)["seen_lines"])
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def test_line_between_two_balls_is_in_sight_from_behind_in_one_piece_between_them(page) -> None:
    first, second, _ = measure_distance(page, first=0, second=1)

    (length,) = lengths_in_sight(page, "posterior")  # one piece

    hidden_by_the_first = scenes.BALLS[0].radius_mm  # at least its radius: the line begins on its far side
    assert tolerances.VIEW_LINE_SEEN_MM < length < np.linalg.norm(second - first) - hidden_by_the_first
    assert len(page.find_elements("css selector", "#scene .line.seen")) == 1


def test_line_between_two_balls_is_in_sight_from_the_side_of_the_clicks(page) -> None:
    first, second, _ = measure_distance(page, first=0, second=1)

    lengths = lengths_in_sight(page, "anterior")

    assert lengths.sum() > tolerances.VIEW_LINE_SEEN_SHARE * np.linalg.norm(second - first)


# Curves


@pytest.fixture
def page_with_curve(page):
    """The page after the key k, clicks on two balls, and k again."""
    press_keys(page, "k")
    for clicked, number in enumerate((1, 2), 1):
        click_point(page, "scene", scenes.middle(number))
        wait_for(page, f"return clrecon.facts.points.length === {clicked}")
    press_keys(page, "k")
    wait_for(page, "return clrecon.facts.measures.length === 1 && !clrecon.facts.tool")
    wait_until_drawn(page)
    return page


def test_curve_that_key_k_ends_is_shown_in_a_picture_along_it(page_with_curve) -> None:
    curve = page_with_curve.find_element("id", "curve")

    assert curve.is_displayed()
    assert curve.find_element("css selector", ".name").text == "along the curve"


def test_key_k_takes_the_picture_along_a_curve_away_and_its_button_brings_it_back(page_with_curve) -> None:
    curve = page_with_curve.find_element("id", "curve")

    press_keys(page_with_curve, "k")
    assert not curve.is_displayed()

    page_with_curve.find_element("id", "along").click()
    assert curve.is_displayed()


# Clips


def test_key_capital_c_clips_by_a_box_of_half_the_size_about_the_cross(page) -> None:
    press_keys(page, "C")

    low, high = np.array(wait_for(page, "return clrecon.facts.clip_box"))
    lowest, highest = np.array(facts(page)["bounds"])
    assert high - low == pytest.approx(0.5 * (highest - lowest), abs=tolerances.VIEW_BOX_MM)
    assert 0.5 * (low + high) == pytest.approx(facts(page)["cross"], abs=tolerances.VIEW_BOX_MM)


def test_key_capital_c_takes_its_clip_box_away_again(page) -> None:
    press_keys(page, "C")
    wait_for(page, "return clrecon.facts.clip_box")

    press_keys(page, "C")

    assert wait_for(page, "return !clrecon.facts.clip_box")


def test_oblique_clip_plane_is_named_by_the_two_sides_that_it_lies_between(page) -> None:
    run_command(page, "turn", dx=0.2, dy=0)  # to the side: neither up nor down

    press_keys(page, "c")

    wait_for(page, "return clrecon.facts.clips.length === 1")
    assert re.match(r"[APLR]{2} side", page.find_element("id", "clips").text)


def cut_by_a_plane(page) -> None:
    page.find_element("id", "cut").click()
    wait_for(page, "return clrecon.facts.clips.length === 1")
    wait_until_drawn(page)


@pytest.mark.release
def test_button_cut_clips_the_picture(page) -> None:
    before = screenshot(page)

    cut_by_a_plane(page)

    assert share_of_changed_pixels(before, screenshot(page)) > tolerances.VIEW_CHANGED_SHARE


@pytest.mark.release
def test_slider_of_a_clip_plane_moves_it_on(page) -> None:
    cut_by_a_plane(page)
    half_way = 0.5  # where a new plane lies
    assert facts(page)["clips"][0]["share"] == half_way

    drag(page, page.find_element("css selector", "#clips input"), dx=45, dy=0)

    wait_until_drawn(page)
    assert facts(page)["clips"][0]["share"] > half_way


@pytest.mark.release
def test_clip_plane_is_removed_by_its_button(page) -> None:
    cut_by_a_plane(page)

    page.find_element("css selector", "#clips li button:last-of-type").click()

    assert wait_for(page, "return !clrecon.facts.clips.length")


@pytest.mark.release
def test_button_of_the_clip_box_makes_one_and_shows_its_controls(page) -> None:
    page.find_element("id", "boxed").click()

    wait_for(page, "return clrecon.facts.clip_box")
    assert page.find_element("id", "box").is_displayed()
