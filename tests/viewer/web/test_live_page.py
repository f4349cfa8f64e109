"""The page of objects in memory: in a frame of a notebook, in a browser, and after it is closed."""

from __future__ import annotations

import gc
import html
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
import view_scenes as scenes
from browser import severe_lines, wait_for
from html_check import PageCheck
from refusals import refused
from view_pages import SETTLED
from web_views import get_path, secret_of

import clrecon
from clrecon.errors import DeviceError
from clrecon.viewer.notebook import LivePage

pytestmark = pytest.mark.opencl


@pytest.fixture
def live_page(device: Any) -> Iterator[LivePage]:
    """The page of a scan of three balls."""
    with scenes.make_scan().view(device=device) as page:
        yield page


def is_listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def serve_cell(content: str) -> Iterator[str]:
    """The address of a page with this content, as a notebook on this machine has one."""

    class Cell(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(f"<!DOCTYPE html><link rel=icon href=data:,>{content}".encode())

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Cell) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}/"
        server.shutdown()


def test_page_in_a_cell_of_a_notebook_on_this_machine_shows_its_pictures(live_page, view_browser):
    with serve_cell(live_page._repr_html_()) as notebook:
        view_browser.get(notebook)
        view_browser.switch_to.frame(0)
        wait_for(view_browser, SETTLED)
        assert view_browser.execute_script("return clrecon.facts.mode") == "bone"
        view_browser.switch_to.default_content()
    assert severe_lines(view_browser) == []


def test_page_may_stand_in_frames_of_this_machine_and_of_an_editor_alone(live_page):
    _, headers, _ = get_path(live_page, f"/?secret={secret_of(live_page)}")
    allowed = re.search("frame-ancestors ([^;]*)", headers["Content-Security-Policy"])[1]
    assert allowed.split() == ["http://127.0.0.1:*", "http://localhost:*", "vscode-webview:"]


def test_cell_of_an_open_page_is_a_frame_and_a_picture(live_page):
    shown = live_page._repr_html_()
    assert shown.count("<img ") == 1
    assert html.unescape(re.search('<iframe src="([^"]*)"', shown)[1]) == live_page.address


def test_closed_page_gives_its_port_back_and_is_a_picture_without_its_secret(live_page):
    was_listening = is_listening(live_page.port)
    live_page.close()
    live_page.close()

    assert (was_listening, is_listening(live_page.port)) == (True, False)
    shown = live_page._repr_html_()
    assert "<iframe" not in shown and secret_of(live_page) not in shown
    assert PageCheck(shown).faults == [] and len(PageCheck(shown).pictures) == 1
    assert repr(live_page) == "LivePage(closed)"


def test_page_that_nobody_holds_is_closed(device):
    page = scenes.make_scan().view(device=device)
    port = page.port
    was_listening = is_listening(port)
    del page
    gc.collect()
    assert (was_listening, is_listening(port)) == (True, False)


def test_page_of_several_objects_begins_with_the_iso_value_that_is_asked_for(device):
    with clrecon.show(scenes.make_scan(), scenes.make_mesh(), iso_value=310.0, device=device, page=True) as page:
        model = page._view.model(aspect=1.0)
    assert model.state.iso_value == 310.0
    assert [shown.kind for shown in model.objects] == ["scan", "mesh"]


def test_page_on_a_device_that_is_not_there_is_refused():
    with refused(DeviceError, "absent"):
        scenes.make_scan().view(device="absent")
