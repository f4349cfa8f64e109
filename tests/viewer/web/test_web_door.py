"""The door of the server: who gets in, with what secret, and what is sent with the page."""

from __future__ import annotations

import asyncio
import base64
import gzip
import hashlib
import logging
import re
import urllib.request

import pytest
from refusals import refused
from web_views import Views, browsing, get_path, secret_of, serving

from clrecon.errors import UsageError
from clrecon.viewer.web.server import WebServer, bind_port

pytestmark = pytest.mark.unit


@pytest.fixture
def views() -> Views:
    """Views of a scan by a painter that paints the iso value, and the sessions that were opened."""
    return Views()


@pytest.fixture
def served(views: Views):
    """A server of these views."""
    with serving(views.open) as running:
        yield running


@pytest.mark.parametrize("method", ["HEAD", "POST"])
@pytest.mark.parametrize("path", ["/?secret={}", "/saved/x?secret={}"], ids=["page", "file"])
def test_method_other_than_get_is_not_allowed(served: WebServer, path: str, method: str) -> None:
    status, _, _ = get_path(served, path.format(secret_of(served)), method=method)

    assert status == 405


@pytest.fixture
def page_headers(served: WebServer) -> dict[str, str]:
    _, headers, _ = get_path(served, f"/?secret={secret_of(served)}")
    return headers


def test_page_is_sent_without_the_secret_and_sets_no_cookie(served: WebServer) -> None:
    status, headers, page = get_path(served, f"/?secret={secret_of(served)}")

    assert status == 200
    assert secret_of(served) not in page
    assert "Set-Cookie" not in headers


def test_policy_of_the_page_allows_its_own_socket_alone(served: WebServer, page_headers: dict[str, str]) -> None:
    policy = page_headers["Content-Security-Policy"]

    assert policy.startswith("default-src 'none'; ")
    assert re.findall(r"wss?://[^ ;]+", policy) == [f"ws://127.0.0.1:{served.port}"]


@pytest.mark.parametrize("name", ["script", "style"])
def test_policy_of_the_page_has_the_hash_of_its_one_script_and_style(served: WebServer, name: str) -> None:
    _, headers, page = get_path(served, f"/?secret={secret_of(served)}")

    (own,) = re.findall(f"<{name}>(.*?)</{name}>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in headers["Content-Security-Policy"]


def test_page_refers_to_nothing_outside_of_it(served: WebServer) -> None:
    _, _, page = get_path(served, f"/?secret={secret_of(served)}")

    markup = page.partition("<script>")[0]
    assert re.findall(r"""(?:src|href)=(?!"data:,")|url\(|@import|\bon\w+=["']""", markup) == []


def test_page_is_not_stored_and_names_no_version_nor_referrer(page_headers: dict[str, str]) -> None:
    assert page_headers["Cache-Control"] == "no-store"
    assert page_headers["Server"] == "clrecon"
    assert page_headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize("path", ["/", "/?secret=", "/?secret=wrong", "/socket?secret=wrong", "/nothing", "/page.js"])
def test_request_without_the_secret_is_answered_with_one_plain_line(served: WebServer, path: str) -> None:
    status, headers, said = get_path(served, path, Origin=f"http://127.0.0.1:{served.port}")

    assert status == 403
    assert headers["Content-Type"].startswith("text/plain")
    assert said == "refused: the secret is missing or wrong, open the whole address that clrecon printed\n"


FOREIGN: dict[str, dict[str, str]] = {
    "another site": {"Origin": "http://evil.example"},
    "a page without an origin": {"Origin": "null"},
    "another name of this machine": {"Origin": "http://localhost:{port}"},
    "DNS rebinding": {"Host": "evil.example:{port}"},
    "DNS rebinding of its own page": {"Host": "evil.example:{port}", "Origin": "http://evil.example:{port}"},
}


@pytest.mark.parametrize("headers", FOREIGN.values(), ids=FOREIGN)
@pytest.mark.parametrize("path", ["/", "/socket", "/saved/x"])
def test_foreign_page_is_refused_with_the_right_secret(served: WebServer, path: str, headers: dict[str, str]) -> None:
    of_this_server = {name: value.format(port=served.port) for name, value in headers.items()}

    status, _, _ = get_path(served, f"{path}?secret={secret_of(served)}", **of_this_server)

    assert status == 403


def test_socket_without_an_origin_is_refused_and_opens_no_session(served: WebServer, views: Views) -> None:
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": "13"}
    key = {"Sec_WebSocket_Key": base64.b64encode(b"0123456789abcdef").decode()}

    status, _, _ = get_path(served, f"/socket?secret={secret_of(served)}", **upgrade, **key)

    assert status == 403
    assert views.sessions == []


def test_page_behind_a_tunnel_may_have_another_port(served: WebServer) -> None:
    other_port = {"Host": "localhost:9999", "Origin": "http://localhost:9999"}
    status, _, _ = get_path(served, f"/?secret={secret_of(served)}", **other_port)
    assert status == 200


@pytest.mark.parametrize("path", ["/nothing", "/../etc/passwd", "/saved/", "/saved/wrong"])
def test_path_of_nothing_is_not_found(served: WebServer, path: str) -> None:
    status, _, _ = get_path(served, f"{path}?secret={secret_of(served)}")

    assert status == 404


def test_server_listens_on_the_loopback_address_alone() -> None:
    with bind_port() as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


def test_port_that_is_taken_is_refused_by_its_number() -> None:
    with bind_port() as listener:
        port = listener.getsockname()[1]

        with refused(UsageError, port):
            WebServer(port)


def test_port_is_free_after_its_listener() -> None:
    with bind_port() as listener:
        port = listener.getsockname()[1]

    with WebServer(port) as again:
        assert again.port == port


@pytest.mark.parametrize("port", [0, -1, 65536, True])
def test_number_that_is_no_port_is_refused(port: int) -> None:
    with refused(UsageError, 1, 65535):
        bind_port(port)


def test_secret_is_not_logged(views: Views, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), serving(views.open) as running:
        get_path(running, f"/?secret={secret_of(running)}")
        get_path(running, "/?secret=wrong")
        asyncio.run(leave_at_once(running))

    assert caplog.text  # of asyncio, at least
    assert secret_of(running) not in caplog.text


async def leave_at_once(running: WebServer) -> None:
    async with browsing(running) as client:
        await client.until(lambda: client.facts)


def test_page_is_sent_in_a_third_of_its_bytes_to_a_browser_that_takes_gzip(served: WebServer) -> None:
    address = f"http://127.0.0.1:{served.port}/?secret={secret_of(served)}"
    with urllib.request.urlopen(urllib.request.Request(address, headers={"Accept-Encoding": "gzip"})) as answer:
        packed = answer.read()

    assert len(packed) < len(gzip.decompress(packed)) / 3  # measured 0.29
