"""The page of a view of a scan and a mesh, open in a real browser."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import view_scenes as scenes
from browser import open_browser, outside_requests, severe_lines, wait_for
from view_pages import SETTLED
from web_views import serving

from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.session import ViewSession


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
    objects[1] = dataclasses.replace(objects[1], said=("a ball of triangles",))
    with (
        Painter(objects, device=device) as painter,
        serving(lambda heard: ViewSession(objects, painter, iso_value=scenes.ISO, on_change=heard)) as running,
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
