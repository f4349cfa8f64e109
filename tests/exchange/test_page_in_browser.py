"""The page in a real browser: it loads, asks for nothing, switches parts, clips, turns and measures in mm."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
import sample_meshes as samples
from browser import open_browser, open_page, outside_requests, severe_lines, wait_for

from clrecon.mesh import Mesh

pytestmark = pytest.mark.slow

CENTRE = np.array([-40.0, 25.0, -300.0])
RADIUS = 30.0
BOX_CORNER, BOX_SIZE = CENTRE + (50.0, -20.0, -20.0), (20.0, 40.0, 40.0)


@pytest.fixture(scope="module")
def browser():
    with open_browser() as driver:
        yield driver


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    sphere = samples.sphere(tuple(CENTRE), RADIUS, 5)
    path = tmp_path_factory.mktemp("page") / "page.html"
    mesh = Mesh(*samples.join(sphere, samples.box(tuple(BOX_CORNER), BOX_SIZE)), report={"iso_value_hu": 300.0})
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


def picture(page) -> np.ndarray:
    """What is drawn, (h, w, 3) uint8, after the next frame."""
    from PIL import Image

    page.execute_async_script(
        "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()));"
    )
    content = page.find_element("tag name", "main").screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def changed_share(one: np.ndarray, other: np.ndarray) -> float:
    return float((np.abs(one - other).max(axis=2) > 24).mean())


def click(page, x: float, y: float) -> None:
    """Click a place of the picture, in CSS pixels from its upper left corner."""
    from selenium.webdriver import ActionChains

    scene = page.find_element("id", "scene")
    size = scene.size
    ActionChains(page, duration=0).move_to_element_with_offset(
        scene, round(x) - size["width"] // 2, round(y) - size["height"] // 2
    ).click().perform()


def click_point(page, point) -> None:
    click(page, *page.execute_script("return clrecon.project(arguments[0])", [float(value) for value in point]))


def measures(page) -> list[float]:
    rows = page.find_elements("css selector", "#measures li")
    return [float(re.search(r"[\d.]+", row.text)[0]) for row in rows]


def test_page_shows_the_surface_its_parts_and_facts(page):
    shown = picture(page)
    assert changed_share(shown, np.full_like(shown, shown[3, 3])) > 0.15
    assert len(page.find_elements("css selector", "#parts li")) == 2
    assert page.find_element("css selector", "#parts .ml").text == "112.9 ml"  # of the polyhedron; 113.1 of the sphere
    assert "iso value 300 HU" in page.find_element("id", "about").text
    assert page.find_element("id", "message").is_displayed() is False


def test_switching_a_part_changes_what_is_shown(page):
    both = picture(page)
    boxes = page.find_elements("css selector", "#parts input[type=checkbox]")
    boxes[1].click()
    one = picture(page)
    width = both.shape[1]
    changed = np.abs(one - both).max(axis=2) > 24
    assert changed.mean() > 0.03
    assert np.flatnonzero(changed.any(axis=0)).min() > width // 2  # the box is the patient's left, right in the view
    boxes[1].click()
    assert changed_share(picture(page), both) == 0.0
    page.find_element("id", "none").click()
    assert changed_share(picture(page), both) > 0.15


def test_opacity_and_colour_of_a_part_change_the_picture(page):
    before = picture(page)
    set_value = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'));"
    page.execute_script(set_value, page.find_element("css selector", "#parts input[type=range]"), "0.4")
    translucent = picture(page)
    assert changed_share(translucent, before) > 0.05
    page.execute_script(set_value, page.find_element("css selector", "#parts input[type=color]"), "#ff0000")
    red = picture(page)
    assert (red[..., 0] - red[..., 2] > 60).mean() > 0.05


@pytest.mark.parametrize(
    ("letter", "sides"), [("A", "SIRL"), ("P", "SILR"), ("L", "SIAP"), ("R", "SIPA"), ("S", "APLR"), ("I", "APRL")]
)
def test_the_six_views_show_their_sides(page, letter, sides):
    """Up, down, left and right of each view, by where points of the patient come to lie."""
    page.find_element("css selector", f"#views button:nth-of-type({'APLRSI'.index(letter) + 1})").click()
    ways = {"L": (1, 0, 0), "R": (-1, 0, 0), "P": (0, 1, 0), "A": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
    project = "return clrecon.project(arguments[0])"
    middle = page.execute_script(project, CENTRE.tolist())
    for side, way in zip(sides, ((0, -1), (0, 1), (-1, 0), (1, 0)), strict=True):
        there = page.execute_script(project, (CENTRE + 10.0 * np.array(ways[side])).tolist())
        moved = np.subtract(there, middle)
        assert moved @ way == pytest.approx(np.linalg.norm(moved))
        assert np.linalg.norm(moved) > 1.0


def test_distances_and_angles_are_those_of_the_surface(page):
    """Two and three clicks; expected values by the exact sphere under the middle of each clicked pixel."""
    page.find_element("id", "distance").click()
    for turn in ((-0.6, -0.3), (0.5, 0.55)):  # along L and S, in radii
        click_point(page, sphere_point(*turn))
    (found,) = measures(page)
    assert found == pytest.approx(np.linalg.norm(sphere_point(-0.6, -0.3) - sphere_point(0.5, 0.55)), abs=0.3)
    # An edge of the box: two corners of its anterior face, a millimetre inside each.
    low = BOX_CORNER + (1.0, 0.0, 1.0)
    high = BOX_CORNER + (19.0, 0.0, 39.0)
    click_point(page, low)
    click_point(page, high)
    assert measures(page)[1] == pytest.approx(np.hypot(18.0, 38.0), abs=0.3)
    page.find_element("id", "angle").click()
    for corner in ((1.0, 0.0, 39.0), (1.0, 0.0, 1.0), (19.0, 0.0, 1.0)):
        click_point(page, BOX_CORNER + corner)
    assert measures(page)[2] == pytest.approx(90.0, abs=1.0)
    page.find_element("id", "clear").click()
    assert measures(page) == []


def sphere_point(left: float, up: float) -> np.ndarray:
    """The anterior point of the sphere at these shares of its radius."""
    return CENTRE + RADIUS * np.array([left, -np.sqrt(1.0 - left**2 - up**2), up])


def test_picks_lie_on_the_surface_after_turning(page):
    """A drag turns; 60 picks over the picture lie on the sphere or on a face of the box."""
    from selenium.webdriver import ActionChains

    scene = page.find_element("id", "scene")
    before = picture(page)
    drag = ActionChains(page, duration=0).move_to_element(scene).click_and_hold()
    for _ in range(12):
        drag.move_by_offset(7, 4)
    drag.release().perform()
    assert changed_share(picture(page), before) > 0.05
    size = scene.size
    places = [(x, y) for x in np.linspace(0, 1, 14)[1:-1] for y in np.linspace(0, 1, 9)[1:-1]]
    picks = "return arguments[0].map(([x, y]) => clrecon.pick(x, y))"
    found = page.execute_script(picks, [[x * size["width"], y * size["height"]] for x, y in places])
    points = np.array([hit["point"] for hit in found if hit])
    parts = np.array([hit["part"] for hit in found if hit])
    assert len(points) > 12 and set(parts) == {0, 1}
    off_sphere = np.abs(np.linalg.norm(points[parts == 0] - CENTRE, axis=1) - RADIUS)
    assert off_sphere.max() < 0.3
    inside = points[parts == 1] - BOX_CORNER
    assert np.abs(np.minimum(np.abs(inside), np.abs(inside - BOX_SIZE)).min(axis=1)).max() < 0.01


def test_the_clip_plane_takes_one_side_away(page):
    whole = picture(page)
    page.execute_script(
        "const clip = document.getElementById('clip'); clip.value = '0'; clip.dispatchEvent(new Event('change'));"
    )
    half = picture(page)
    changed = np.abs(half - whole).max(axis=2) > 24
    assert changed.mean() > 0.03
    assert np.flatnonzero(changed.any(axis=0)).min() >= whole.shape[1] // 2 - 2
    page.find_element("id", "flip").click()
    other = np.abs(picture(page) - whole).max(axis=2) > 24
    assert np.flatnonzero(other.any(axis=0)).max() <= whole.shape[1] // 2 + 2


def test_wheel_zooms_and_keys_turn_the_page(page):
    from selenium.webdriver.common.action_chains import ActionChains, ScrollOrigin

    scene = page.find_element("id", "scene")
    project = "return clrecon.project(arguments[0])"
    apart = lambda: np.subtract(  # noqa: E731
        page.execute_script(project, (CENTRE + (10, 0, 0)).tolist()), page.execute_script(project, CENTRE.tolist())
    )
    before = apart()[0]
    ActionChains(page).scroll_from_origin(ScrollOrigin.from_element(scene), 0, -300).perform()
    wait_for(page, f"return clrecon.project({(CENTRE + (10, 0, 0)).tolist()})[0] !== 0")
    assert apart()[0] > 1.2 * before
    scene.send_keys("2")  # from behind: left is on the left
    assert apart()[0] == pytest.approx(-before)


def test_two_fingers_zoom_and_move(page):
    """Touch: the distance of two fingers doubles, and so does the picture."""
    scene = page.find_element("id", "scene")
    y = scene.rect["y"] + scene.rect["height"] / 2
    x = scene.rect["x"] + scene.rect["width"] / 2
    project = f"return clrecon.project({(CENTRE + (10, 0, 0)).tolist()})[0] - clrecon.project({CENTRE.tolist()})[0]"
    before = page.execute_script(project)

    def touch(kind: str, *apart: float) -> None:
        points = [{"x": x + way * half, "y": y, "id": n} for half in apart for n, way in enumerate((-1, 1))]
        page.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 60)
    for half in np.linspace(65, 120, 12):
        touch("touchMove", float(half))
    touch("touchEnd")
    assert page.execute_script(project) == pytest.approx(2.0 * before, rel=0.1)


@pytest.mark.release
def test_a_page_whose_surface_is_harmed_says_so(browser, path, tmp_path):
    """The browser logs the error, and the page says it in words."""
    text = path.read_text(encoding="utf-8")
    start = text.index('type="text/plain">') + 60
    harmed = tmp_path / "harmed.html"
    harmed.write_text(text[:start] + "AAAAAAAA" + text[start + 8 :], encoding="utf-8")
    browser.get(harmed.as_uri())
    found = (
        "const text = document.getElementById('message').textContent; return text.includes('cannot be shown') && text"
    )
    assert wait_for(browser, found)
    severe_lines(browser)
