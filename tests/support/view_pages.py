"""What tests do with the page of a view in a real browser: point, click, drag, press, and look at it."""

from __future__ import annotations

import dataclasses
import io
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import view_scenes as scenes
from browser import outside_requests, severe_lines, wait_for
from web_views import PATIENCE, serving

from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.session import ViewSession
from clrecon.viewer.web.server import WebServer

SETTLED = "return clrecon.facts && clrecon.facts.settled && clrecon.pictures > 0"


@contextmanager
def serve_scene(device: Any) -> Iterator[WebServer]:
    """Serve a scan and a mesh; the scan has 40 specks of -100 HU, below the iso value."""
    scan = scenes.make_scan()
    scan.voxels[1, 1:5:2, 1:41:2] = -100
    scan.report["gates"] = [
        {"name": "spacing", "ok": False, "text": "gaps of 1 to 3 mm"},
        {"name": "units", "ok": True},
    ]
    objects = show_objects([scan, scenes.make_mesh()])
    objects[1] = dataclasses.replace(objects[1], said=("a ball of triangles",))
    with (
        Painter(objects, device=device) as painter,
        serving(lambda heard: ViewSession(objects, painter, iso_value=scenes.ISO, on_change=heard)) as running,
    ):
        yield running


@contextmanager
def open_view_page(browser: Any, served: WebServer) -> Iterator[Any]:
    """Open the page and wait until it is drawn; in the end it has logged no error and asked nobody else."""
    severe_lines(browser), outside_requests(browser)
    browser.get(served.address)
    wait_for(browser, SETTLED)
    yield browser
    browser.execute_script("sessionStorage.clear()")  # the next test begins anew
    assert severe_lines(browser) == []
    own = (f"http://127.0.0.1:{served.port}/", f"ws://127.0.0.1:{served.port}/")
    assert [address for address in outside_requests(browser) if not address.startswith(own)] == []


def screenshot(page: Any, view: str = "scene") -> np.ndarray:
    """What a view shows, (h, w, 3), with what lies over it."""
    from PIL import Image

    content = page.find_element("id", view).screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def share_of_changed_pixels(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels whose colour differs by more than 24 of 255, which is more than what JPEG loses."""
    return float((np.abs(one - other).max(axis=2) > 24).mean())


def facts(page: Any) -> dict[str, Any]:
    """What the server has told the page of its view."""
    return json.loads(page.execute_script("return JSON.stringify(clrecon.facts)"))


def run_command(page: Any, name: str, **named: Any) -> None:
    """Have the page send a command to its view."""
    page.execute_script("clrecon.run(arguments[0], arguments[1])", name, named)


def wait_until_drawn(page: Any) -> None:
    """Wait until everything is shown as it is after what was done."""
    time.sleep(0.3)  # a change needs a frame and the way to the server
    wait_for(page, SETTLED)


def drag(page: Any, element: Any, *, dx: int, dy: int, steps: int = 15) -> None:
    """Drag from the middle of an element by some pixels, in small moves."""
    from selenium.webdriver import ActionChains

    actions = ActionChains(page, duration=15).move_to_element(element).click_and_hold()
    for _ in range(steps):
        actions = actions.move_by_offset(round(dx / steps), round(dy / steps))
    actions.release().perform()


def wait_for_file(page: Any, path: Path) -> None:
    """Wait until a file is there; fail with what the page says of its saving."""
    end = time.monotonic() + PATIENCE
    while not path.exists():
        assert time.monotonic() < end, page.find_element("id", "saved").text
        time.sleep(0.05)


def point_at(page: Any, view: str, point: np.ndarray) -> None:
    """Move the pointer to the place of a point of the patient."""
    from selenium.webdriver import ActionChains

    element = page.find_element("id", view)
    x, y = page.execute_script("return clrecon.project(arguments[0], arguments[1])", view, [float(v) for v in point])
    ActionChains(page).move_to_element_with_offset(
        element, round(x - element.size["width"] / 2), round(y - element.size["height"] / 2)
    ).perform()


def click_point(page: Any, view: str, point: np.ndarray, *held: str) -> None:
    """Click at the place of a point of the patient, with keys held."""
    from selenium.webdriver import ActionChains

    point_at(page, view, point)
    actions = ActionChains(page)
    for key in held:
        actions.key_down(key)
    actions.click()
    for key in held:
        actions.key_up(key)
    actions.perform()


def press_keys(page: Any, *keys: str) -> None:
    """Press keys with the pointer where it is."""
    from selenium.webdriver import ActionChains

    ActionChains(page).send_keys(*keys).perform()
