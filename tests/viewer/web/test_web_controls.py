"""Every control of the page, driven in a real browser: what the server's view is afterwards."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import tolerances
import view_scenes as scenes
from browser import wait_for
from view_pages import SETTLED, open_view_page, run_command

pytestmark = [pytest.mark.slow, pytest.mark.opencl]


class Control(NamedTuple):
    """What is done with a control, and what the page then knows of its view (JavaScript, with `f` for the facts).

    chosen: Value of a list; typed: text of a field; None: a click.
    before: Commands that have to be done before.
    dialog: The one that has to be open; all others are closed.
    """

    holds: str
    chosen: str | None = None
    typed: str | None = None
    before: tuple[tuple[str, dict], ...] = ()
    dialog: str | None = None


SURFACE = ("set_mode", {"name": "surface"})
FITTED = (SURFACE, ("set_fitted", {"shown": True}))
PLACE = ("mark_at", {"x": 50, "y": 50, "size": [100, 100], "plane": "axial"})
CURVE = (
    ("start_tool", {"name": "curve"}),
    ("add_point", {"x": 40, "y": 50, "size": [100, 100], "plane": "axial"}),
    ("add_point", {"x": 60, "y": 50, "size": [100, 100], "plane": "axial"}),
    ("end_tool", {}),
)

CONTROLS = {
    # The specks of the scan are gone with its table.
    "#small": Control(
        "f.small_parts === false",
        before=(("set_table", {"shown": True}), ("set_iso", {"hu": -150}), ("find_parts", {})),
    ),
    "#modes [data-mode='mip']": Control("f.mode === 'mip'"),
    "#table": Control("!f.table", before=(("set_iso", {"hu": 300}), SURFACE, ("set_table", {"shown": True}))),
    "#smooth": Control("f.smooth_mm > 0", before=(("set_smooth", {"on": False}),)),
    "#advice": Control("f.smooth_mm === 0", before=(("set_smooth", {"on": True}),)),
    "#occlusion": Control("f.occlusion"),
    "#perspective": Control("!f.camera.parallel"),
    "#fitted": Control("f.fitted", before=(SURFACE, ("set_fitted", {"shown": False}))),
    "#shade": Control("f.color_by === 'thickness'", chosen="thickness", before=FITTED),
    "#offset": Control(
        "!f.fitted && f.offset && document.getElementById('offset').innerText.includes(' mm ')", before=FITTED
    ),
    "#layouts [data-layout='1']": Control("f.layout === '1'"),
    "#layouts [data-layout='4']": Control("f.layout === '4'"),
    "#layouts [data-layout='1+3']": Control("f.layout === '1+3'"),
    "#undo": Control("f.layout === '1'", before=(("set_layout", {"name": "1"}), ("set_layout", {"name": "4"}))),
    "#help": Control("document.getElementById('keys').open"),
    "#closekeys": Control("!document.getElementById('keys').open", dialog="keys"),
    "#chips button": Control("document.querySelector('#certificate[open]')?.innerText.includes('gaps of 1 to 3 mm')"),
    "#closecertificate": Control("!document.getElementById('certificate').open", dialog="certificate"),
    "#views [title='left']": Control("f.camera.position[0] > f.bounds[1][0]"),
    "#distance": Control("f.tool === 'distance'"),
    "#angle": Control("f.tool === 'angle'"),
    "#circle": Control("f.tool === 'circle'"),
    "#square": Control("f.tool === 'box'"),
    "#seed": Control("f.tool === 'seed'"),
    "#trace": Control("f.tool === 'curve'"),
    "#end": Control("f.tool === null"),
    "#only": Control("document.getElementById('only').ariaPressed === 'true'"),
    "#hide": Control("document.getElementById('hide').ariaPressed === 'true'"),
    "#spine": Control("document.getElementById('hint').textContent.includes('no spine')", before=(("end_tool", {}),)),
    "#along": Control("!document.getElementById('curve').clientWidth", before=CURVE),
    "#measures button": Control("Math.abs(f.cross[0] - f.measures[0].points[0][0]) < 30", before=(PLACE,)),
    "#clear": Control("f.measures.length === 0", before=(PLACE,)),
    "#exports [data-format='.csv']": Control("saved.textContent.includes('view.csv')", before=(PLACE,)),
    "#exports [data-format='.json']": Control("saved.textContent.includes('view.json')", before=(PLACE,)),
    "#exports [data-format='.mrk.json']": Control("saved.textContent.includes('view.mrk.json')", before=(PLACE,)),
    "#all": Control("f.parts.every(({ visible }) => visible)", before=(("show", {"key": "2", "visible": False}),)),
    "#colors": Control("f.parts.some(({ kind, color }) => kind === 'cluster' && color)"),
    "#direction": Control("document.getElementById('direction').value === 'superior'", chosen="superior"),
    "#cut": Control("f.clips.some(({ name }) => name === document.getElementById('direction').value)"),
    "#boxed": Control("f.clip_box"),
    "#level": Control("f.window[0] + f.window[1] === 80", typed="40"),
    "#width": Control("f.window[1] - f.window[0] === 400", typed="400"),
    "#presets button": Control("f.window[0] === -450 && f.window[1] === 1050"),
    "#thick": Control("f.slab.mm === 8", typed="8"),
    "#combine": Control("f.slab.combine === 'max'", chosen="max", before=(("set_slab", {"thickness": 8}),)),
    "#straighten": Control("!f.turned", before=(("turn_cross", {"plane": "axial", "degrees": 20}),)),
    "#hu": Control("f.iso.hu === 305", typed="\ue014"),  # the arrow key to the right moves the slider
    "#exact": Control("f.iso.hu === 333", typed="333"),
    "#format": Control("document.getElementById('format').value === '.view.json'", chosen=".view.json"),
    "#save": Control("saved.textContent.includes('view' + document.getElementById('format').value)"),
    "#photo": Control("saved.textContent.includes('view.png')"),
    "#link": Control("saved.querySelector('a')?.href.includes('view=')"),
    "#compare": Control("f.compare === 0.5", before=(("set_compare", {"share": None}),)),
    "#divide": Control("f.compare === 0.505", typed="\ue014", before=(("set_compare", {"share": 0.5}),)),
}
"""Controls by their place on the page: each brings what it needs, as workers of pytest-xdist share them out."""

OF_OTHER_TESTS = {"another", "pickfiles"}
"""Of the start page."""


@pytest.fixture(scope="module")
def page(view_browser, view_server):
    """The page of a scan of three balls and a mesh, once its parts are found, with the cross in the largest ball."""
    with open_view_page(view_browser, view_server) as opened:
        run_command(opened, "find_parts")
        wait_for(opened, "return clrecon.facts.parts_known && !clrecon.facts.busy.length")
        run_command(opened, "set_iso", hu=300)
        run_command(opened, "set_cross", point=scenes.middle(0).tolist())
        yield opened


ONE_DIALOG = """
for (const one of document.querySelectorAll("dialog"))
  if (one.id !== arguments[0]) one.close();
  else if (!one.open) one.showModal();
"""


@pytest.mark.parametrize(("place", "control"), CONTROLS.items(), ids=CONTROLS)
def test_control_of_the_page_does_what_it_says(page, place: str, control: Control) -> None:
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import Select

    page.execute_script(ONE_DIALOG, control.dialog)
    for name, named in control.before:
        page.execute_script("clrecon.run(arguments[0], arguments[1])", name, named)
    wait_for(page, f'const one = document.querySelector("{place}"); return one && !one.disabled && one.offsetWidth')
    wait_for(page, SETTLED)
    element = page.find_element("css selector", place)

    if control.chosen is not None:
        Select(element).select_by_value(control.chosen)
    elif place == "#hu":
        run_command(page, "set_iso", hu=304)
        wait_for(page, "return document.getElementById('hu').value === '304'")
        element.send_keys(control.typed)
    elif control.typed is not None:
        element.send_keys(Keys.CONTROL, "a")
        element.send_keys(control.typed, Keys.ENTER)
    else:
        page.execute_script("arguments[0].scrollIntoView()", element)
        element.click()

    assert wait_for(page, f"const f = clrecon.facts, saved = document.getElementById('saved'); return {control.holds}")


def test_table_of_controls_has_each_of_the_page(page) -> None:
    on_page = page.execute_script(
        "return [...document.querySelectorAll('button[id], input[id], select[id]')].map((one) => one.id)"
    )

    assert {f"#{name}" for name in on_page if name not in OF_OTHER_TESTS} - set(CONTROLS) == set()
    assert len(on_page) > 30  # the pattern finds them


def test_each_control_that_is_seen_has_a_name_for_screen_readers(page) -> None:
    seen = [one for one in page.find_elements("css selector", "button, input, select") if one.is_displayed()]

    assert len(seen) > 40  # with those of the parts
    assert [one.get_attribute("outerHTML") for one in seen if not one.accessible_name.strip()] == []


@pytest.fixture
def phone(page):
    """The page in a window of a phone."""
    size = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        wait_for(page, "return innerWidth === 400")
        yield page
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        wait_for(page, "return innerWidth !== 400")


def test_page_is_no_wider_than_a_narrow_window(phone) -> None:
    assert phone.execute_script("return document.documentElement.scrollWidth") == 400


def seen_views(page) -> list[str]:
    script = "return [...document.querySelectorAll('.view')].filter((one) => one.clientWidth).map((one) => one.id)"
    return page.execute_script(script)


def test_phone_shows_the_view_of_a_tab_alone(phone) -> None:
    wait_for(phone, "return document.querySelectorAll('#tabs button:not([hidden])').length >= 4")
    assert seen_views(phone) == ["scene"]

    phone.find_element("xpath", "//nav[@id='tabs']/button[text()='axial']").click()

    assert seen_views(phone) == ["axial"]
    wait_for(
        phone, "return axial.clientWidth === 400 && document.documentElement.dataset.axial && clrecon.facts.settled"
    )


def test_panel_of_a_phone_shows_one_section_at_a_time_over_the_view(phone) -> None:
    opened = "return [...document.querySelectorAll('details[open] summary')].map((summary) => summary.textContent)"
    assert phone.execute_script(opened) == []

    for name in ("Surface", "Parts"):
        phone.find_element("xpath", f"//summary[text()='{name}']").click()
        wait_for(
            phone, f"return document.querySelectorAll('details[open]').length === 1 && ({opened[7:]})[0] === '{name}'"
        )
        box = phone.find_element("css selector", "details[open] > div").rect
        assert (box["x"], box["width"]) == (0, 400)

    phone.find_element("xpath", "//summary[text()='Parts']").click()
    wait_for(phone, "return !document.querySelector('details[open]')")


SIZES = {"wide": (1100, 250, 230), "tablet": (900, 290, 240), "small tablet": (700, 230, 240)}
"""Width of the window, and least width and height of a slice, pixels: a third of the narrow ones, as wide as high."""


@pytest.mark.parametrize(("width", "least_wide", "least_high"), SIZES.values(), ids=SIZES)
def test_slices_of_a_window_between_phone_and_desktop_are_large_enough_to_read(
    page, width: int, least_wide: int, least_high: int
) -> None:
    page.execute_script("clrecon.run('set_layout', { name: '1+3' })")
    size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        wait_for(page, f"return innerWidth === {width} && clrecon.facts.layout === '1+3'")
        sizes = page.execute_script(
            "return [axial, coronal, sagittal].map((box) => [box.clientWidth, box.clientHeight])"
        )
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        wait_for(page, f"return innerWidth !== {width}")

    assert all(wide >= least_wide and high >= least_high for wide, high in sizes), sizes


def test_wide_window_shows_all_views_again(phone) -> None:
    phone.execute_script("clrecon.run('set_layout', { name: '1+3' })")
    wait_for(phone, "return clrecon.facts.layout === '1+3'")

    phone.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    wait_for(phone, "return innerWidth !== 400")

    assert wait_for(phone, "return document.querySelectorAll('#stage.full').length === 0")
    assert set(seen_views(phone)) >= {"scene", "axial", "coronal", "sagittal"}  # and a curve, if one was made


def test_two_fingers_at_three_times_their_distance_zoom_the_picture_threefold(page) -> None:
    run_command(page, "look", view="left")  # the view of the start would be fitted anew to a window that changed
    wait_for(page, "const f = clrecon.facts; return f.settled && f.camera.position[0] > f.bounds[1][0]")
    box, before = page.find_element("id", "scene").rect, page.execute_script("return clrecon.facts.camera.height_mm")
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def touch(kind: str, *halves: int) -> None:
        fingers = [{"x": x + side * half, "y": y, "id": n} for half in halves for n, side in enumerate((-1, 1))]
        page.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    touch("touchStart", 20)
    for half in range(25, 61, 5):
        touch("touchMove", half)
    touch("touchEnd")

    near = f"{before} / clrecon.facts.camera.height_mm > {3.0 * (1.0 - tolerances.PAGE_TOUCH_ZOOM)}"  # of the last move
    wait_for(page, f"return {near} && clrecon.facts.settled")
    after = page.execute_script("return clrecon.facts.camera.height_mm")
    assert before / after == pytest.approx(3.0, rel=tolerances.PAGE_TOUCH_ZOOM)
