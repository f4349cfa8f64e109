"""The page in a real browser: it loads, asks for nothing, switches parts, clips, turns and measures in mm."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from browser import open_browser, open_page, outside_requests, severe_lines, wait_for
from PIL import Image

from clrecon.mesh import Mesh

pytestmark = pytest.mark.slow

CENTRE = np.array([-40.0, 25.0, -300.0])
RADIUS = 30.0
BOX_CORNER, BOX_SIZE = CENTRE + (50.0, -20.0, -20.0), (20.0, 40.0, 40.0)


@pytest.fixture(scope="module")
def browser():
    """A browser for all tests of this file."""
    with open_browser() as driver:
        yield driver


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A page of a sphere of `RADIUS` about `CENTRE`, and a box to the left of it."""
    sphere = samples.sphere(tuple(CENTRE), radius=RADIUS, rounds=5)
    path = tmp_path_factory.mktemp("page") / "page.html"
    mesh = Mesh(*samples.join(sphere, samples.box(tuple(BOX_CORNER), size=BOX_SIZE)), report={"iso_value_hu": 300.0})
    mesh.save(path)
    return path


@pytest.fixture
def page(browser, path):
    """The page, just opened; after the test it has logged no error and asked for nothing."""
    severe_lines(browser), outside_requests(browser)
    open_page(browser, path)
    yield browser
    assert severe_lines(browser) == []
    assert outside_requests(browser) == []


def draw_page(page) -> np.ndarray:
    """What is drawn after the next frame, (h, w, 3)."""
    page.execute_async_script(
        "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()));"
    )
    content = page.find_element("tag name", "main").screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def changed_pixels(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pixels whose colour differs by more than 24 of 255, (h, w) bool."""
    return np.abs(one - other).max(axis=2) > 24


def changed_share(one: np.ndarray, other: np.ndarray) -> float:
    return float(changed_pixels(one, other).mean())


def columns_of(pixels: np.ndarray) -> np.ndarray:
    return np.flatnonzero(pixels.any(axis=0))


def project(page, point) -> np.ndarray:
    """Where a point of the patient is drawn, in CSS pixels from the upper left corner."""
    return np.array(page.execute_script("return clrecon.project(arguments[0])", [float(value) for value in point]))


def set_value(page, element, value: str) -> None:
    script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'));"
    page.execute_script(script, element, value)


def click(page, x: float, y: float) -> None:
    """Click a place of the picture, in CSS pixels from its upper left corner."""
    from selenium.webdriver import ActionChains

    scene = page.find_element("id", "scene")
    size = scene.size
    ActionChains(page, duration=0).move_to_element_with_offset(
        scene, round(x) - size["width"] // 2, round(y) - size["height"] // 2
    ).click().perform()


def click_point(page, point) -> None:
    click(page, *project(page, point))


def listed_measures(page) -> list[float]:
    rows = page.find_elements("css selector", "#measures li")
    return [float(re.search(r"[\d.]+", row.text)[0]) for row in rows]


def test_page_shows_the_surface_beside_its_background(page):
    shown = draw_page(page)
    background = np.full_like(shown, shown[3, 3])
    assert changed_share(shown, background) > 0.15  # sphere and box fill about a fifth of the picture


def test_page_lists_the_parts_with_their_ml(page):
    of_polyhedron, of_box = "112.9 ml", "32.00 ml"  # a sphere has 113.1 ml
    assert [part.text for part in page.find_elements("css selector", "#parts li .ml")] == [of_polyhedron, of_box]


def test_page_tells_the_iso_value_and_shows_no_message(page):
    assert "iso value 300 HU" in page.find_element("id", "about").text
    assert not page.find_element("id", "message").is_displayed()


@pytest.fixture
def page_of_walls(browser, tmp_path):
    """A page of a box whose walls are 2 mm thick, on a scale up to 2 mm."""
    box = Mesh(*samples.box(tuple(BOX_CORNER), size=BOX_SIZE))
    box.values = {"thickness_mm": np.full(box.vertex_count, 2.0), "error_mm": np.full(box.vertex_count, np.nan)}
    box.save(tmp_path / "page.html")
    open_page(browser, tmp_path / "page.html")
    return browser


def test_page_of_walls_is_painted_in_the_colour_of_their_thickness(page_of_walls):
    shown = draw_page(page_of_walls)
    red, green, blue = shown[shown.shape[0] // 2, shown.shape[1] // 2]
    assert red > 60 and max(green, blue) < 0.5 * red  # the end of the scale is (128, 0, 38)


def test_click_on_a_page_of_walls_tells_their_thickness(page_of_walls):
    click_point(page_of_walls, BOX_CORNER + (10.0, 0.0, 20.0))  # the middle of the face towards the viewer
    assert page_of_walls.find_element("id", "hint").text.endswith("thickness 2 mm")


def test_page_offers_only_numbers_that_are_known(page_of_walls):
    options = page_of_walls.find_elements("css selector", "#paint option")
    assert [option.text for option in options] == ["of the parts", "thickness"]


def test_page_without_numbers_has_no_choice_of_colours(page):
    assert not page.find_element("id", "numbers").is_displayed()


def test_part_that_is_switched_off_vanishes_from_its_side(page):
    both = draw_page(page)
    _, box_is_shown = page.find_elements("css selector", "#parts input[type=checkbox]")

    box_is_shown.click()
    changed = changed_pixels(draw_page(page), both)
    assert changed.mean() > tolerances.PAGE_VISIBLE_SHARE
    middle = both.shape[1] // 2
    assert columns_of(changed).min() > middle  # the box is the patient's left, right in the view


def test_part_that_is_switched_on_again_comes_back(page):
    both = draw_page(page)
    _, box_is_shown = page.find_elements("css selector", "#parts input[type=checkbox]")

    box_is_shown.click()
    box_is_shown.click()

    assert changed_share(draw_page(page), both) == 0.0


def test_button_none_hides_all_parts(page):
    both = draw_page(page)
    page.find_element("id", "none").click()
    nothing = draw_page(page)
    assert changed_share(nothing, both) > 0.15  # as much as there is on the background
    assert changed_share(nothing, np.full_like(nothing, nothing[3, 3])) < 0.01  # but for marks of sides


def test_opacity_of_a_part_changes_the_picture(page):
    before = draw_page(page)
    set_value(page, page.find_element("css selector", "#parts input[type=range]"), "0.4")
    assert changed_share(draw_page(page), before) > 0.05  # the sphere is more than that


def test_colour_of_a_part_changes_the_picture(page):
    set_value(page, page.find_element("css selector", "#parts input[type=color]"), "#ff0000")
    red = draw_page(page)
    assert (red[..., 0] - red[..., 2] > 60).mean() > 0.05  # of pixels: more red than blue on the sphere


@pytest.mark.parametrize(
    ("letter", "sides"), [("A", "SIRL"), ("P", "SILR"), ("L", "SIAP"), ("R", "SIPA"), ("S", "APLR"), ("I", "APRL")]
)
def test_each_of_the_six_views_has_its_sides_up_down_left_and_right(page, letter, sides):
    """By where points 10 mm from the centre of the sphere towards each side of the patient are drawn."""
    page.find_element("css selector", f"#views button:nth-of-type({'APLRSI'.index(letter) + 1})").click()
    towards = {"L": (1, 0, 0), "R": (-1, 0, 0), "P": (0, 1, 0), "A": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
    up, down, left, right = (0, -1), (0, 1), (-1, 0), (1, 0)  # in pixels
    for side, direction in zip(sides, (up, down, left, right), strict=True):
        moved = project(page, CENTRE + 10.0 * np.array(towards[side])) - project(page, CENTRE)
        assert np.linalg.norm(moved) > 1.0
        assert moved @ direction == pytest.approx(np.linalg.norm(moved))


def test_distance_between_two_clicks_on_the_sphere_is_that_of_its_points(page):
    first, second = sphere_point(left=-0.6, up=-0.3), sphere_point(left=0.5, up=0.55)
    page.find_element("id", "distance").click()
    click_point(page, first)
    click_point(page, second)
    assert listed_measures(page) == pytest.approx([np.linalg.norm(first - second)], abs=tolerances.PAGE_CLICK_MM)


def test_distance_between_two_clicks_on_the_box_is_that_of_its_points(page):
    page.find_element("id", "distance").click()
    for corner in ((1.0, 0.0, 1.0), (19.0, 0.0, 39.0)):  # of its anterior face, a millimetre inside
        click_point(page, BOX_CORNER + corner)
    assert listed_measures(page) == pytest.approx([np.hypot(18.0, 38.0)], abs=tolerances.PAGE_CLICK_MM)


def test_angle_of_three_clicks_at_a_corner_of_the_box_is_90_degrees(page):
    page.find_element("id", "angle").click()
    for corner in ((1.0, 0.0, 39.0), (1.0, 0.0, 1.0), (19.0, 0.0, 1.0)):
        click_point(page, BOX_CORNER + corner)
    assert listed_measures(page) == pytest.approx([90.0], abs=tolerances.PAGE_CLICK_DEGREES)


def test_button_clear_removes_all_measures(page):
    page.find_element("id", "distance").click()
    click_point(page, sphere_point(left=-0.6, up=-0.3))
    click_point(page, sphere_point(left=0.5, up=0.55))
    assert len(listed_measures(page)) == 1
    page.find_element("id", "clear").click()
    assert listed_measures(page) == []


def sphere_point(left: float, up: float) -> np.ndarray:
    """The anterior point of the sphere at these shares of its radius."""
    return CENTRE + RADIUS * np.array([left, -np.sqrt(1.0 - left**2 - up**2), up])


def drag_scene(page) -> None:
    from selenium.webdriver import ActionChains

    drag = ActionChains(page, duration=0).move_to_element(page.find_element("id", "scene")).click_and_hold()
    for _ in range(12):
        drag.move_by_offset(7, 4)
    drag.release().perform()


def test_drag_turns_the_view(page):
    before = draw_page(page)
    drag_scene(page)
    assert changed_share(draw_page(page), before) > 0.05  # of a picture of which a fifth is surface


def test_picks_after_a_drag_lie_on_the_sphere_and_on_faces_of_the_box(page):
    drag_scene(page)
    size = page.find_element("id", "scene").size
    grid = [(x, y) for x in np.linspace(0, 1, 14)[1:-1] for y in np.linspace(0, 1, 9)[1:-1]]  # shares of the picture
    picks = page.execute_script(
        "return arguments[0].map(([x, y]) => clrecon.pick(x, y))",
        [[x * size["width"], y * size["height"]] for x, y in grid],
    )
    hits = [pick for pick in picks if pick]
    points, parts = np.array([hit["point"] for hit in hits]), np.array([hit["part"] for hit in hits])
    assert len(hits) > 12  # of 84
    assert set(parts) == {0, 1}  # sphere and box

    off_sphere = np.abs(np.linalg.norm(points[parts == 0] - CENTRE, axis=1) - RADIUS)
    assert off_sphere.max() < tolerances.PAGE_SPHERE_MM
    in_box = points[parts == 1] - BOX_CORNER
    off_nearest_face = np.minimum(np.abs(in_box), np.abs(in_box - BOX_SIZE)).min(axis=1)
    assert off_nearest_face.max() < tolerances.PAGE_BOX_MM


def clip_at_the_middle(page) -> None:
    page.execute_script(
        "const clip = document.getElementById('clip'); clip.value = '0'; clip.dispatchEvent(new Event('change'));"
    )


def test_clip_plane_in_the_middle_takes_the_right_half_of_the_view_away(page):
    whole = draw_page(page)
    clip_at_the_middle(page)
    changed = changed_pixels(draw_page(page), whole)
    assert changed.mean() > tolerances.PAGE_VISIBLE_SHARE
    middle = whole.shape[1] // 2
    assert columns_of(changed).min() >= middle - 2  # pixels at the edge of the cut


def test_flipped_clip_plane_takes_the_left_half_of_the_view_away(page):
    whole = draw_page(page)
    clip_at_the_middle(page)
    page.find_element("id", "flip").click()
    changed = changed_pixels(draw_page(page), whole)
    assert changed.mean() > tolerances.PAGE_VISIBLE_SHARE
    assert columns_of(changed).max() <= whole.shape[1] // 2 + 2


def pixels_of_10_mm_to_the_left(page) -> float:
    """How far to the right 10 mm towards the patient's left are drawn."""
    x, _ = project(page, CENTRE + (10, 0, 0)) - project(page, CENTRE)
    return x


def test_wheel_zooms_the_view(page):
    from selenium.webdriver.common.action_chains import ActionChains, ScrollOrigin

    before = pixels_of_10_mm_to_the_left(page)
    scene = page.find_element("id", "scene")
    ActionChains(page).scroll_from_origin(ScrollOrigin.from_element(scene), 0, -300).perform()
    wait_for(page, f"return clrecon.project({(CENTRE + (10, 0, 0)).tolist()})[0] !== 0")
    assert pixels_of_10_mm_to_the_left(page) > 1.2 * before  # by some notches of the wheel


def test_key_2_shows_the_view_from_behind(page):
    before = pixels_of_10_mm_to_the_left(page)
    page.find_element("id", "scene").send_keys("2")
    assert pixels_of_10_mm_to_the_left(page) == pytest.approx(-before)


def test_two_fingers_at_twice_their_distance_zoom_to_twice_the_size(page):
    scene = page.find_element("id", "scene")
    x, y = scene.rect["x"] + scene.rect["width"] / 2, scene.rect["y"] + scene.rect["height"] / 2

    def touch(kind: str, *half_distances: float) -> None:
        points = [
            {"x": x + side * half, "y": y, "id": finger}
            for half in half_distances
            for finger, side in enumerate((-1, 1))
        ]
        page.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    before = pixels_of_10_mm_to_the_left(page)
    touch("touchStart", 60)
    for half in np.linspace(65, 120, 12):
        touch("touchMove", float(half))
    touch("touchEnd")
    assert pixels_of_10_mm_to_the_left(page) == pytest.approx(2.0 * before, rel=tolerances.PAGE_TOUCH_ZOOM)


@pytest.mark.release
def test_page_whose_surface_is_harmed_says_that_it_cannot_be_shown(browser, path, tmp_path):
    text = path.read_text(encoding="utf-8")
    start = text.index('type="text/plain">') + 60  # within the surface, which is base64
    harmed = tmp_path / "harmed.html"
    harmed.write_text(text[:start] + "AAAAAAAA" + text[start + 8 :], encoding="utf-8")
    browser.get(harmed.as_uri())
    message = "document.getElementById('message').textContent"
    assert wait_for(browser, f"return {message}.includes('cannot be shown')")
    severe_lines(browser)  # the browser logs the error: no later test is to find it
