"""The server: who gets in, what a browser gets, how much at a time, and how it ends."""

from __future__ import annotations

import asyncio
import base64
import dataclasses
import hashlib
import http.client
import json
import logging
import re
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused
from web_views import PATIENCE, Views, browsing, serving

from clrecon.errors import UsageError
from clrecon.viewer.web import connection, server
from clrecon.viewer.web.server import WebServer, bind_port

pytestmark = pytest.mark.unit


@pytest.fixture
def views() -> Views:
    return Views()


@pytest.fixture
def served(views: Views):
    with serving(views.open) as running:
        yield running


def get(running: WebServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], str]:
    """Ask for a path; headers take the place of those of a browser."""
    connection = http.client.HTTPConnection("127.0.0.1", running.port, timeout=PATIENCE)
    connection.putrequest(method, path, skip_host=True)
    for name, value in {"Host": f"127.0.0.1:{running.port}", **headers}.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, dict(answer.headers), answer.read().decode()
    connection.close()
    return found


def secret_of(running: WebServer) -> str:
    return running.address.partition("secret=")[2]


@pytest.mark.parametrize("path", ["/?secret={}", "/saved/x?secret={}"])
def test_nothing_but_get_is_answered(served: WebServer, path: str) -> None:
    asked = path.format(secret_of(served))
    assert [get(served, asked, method)[0] for method in ("HEAD", "POST")] == [405, 405]


def grey(picture: tuple[dict[str, Any], Any]) -> int:
    """The iso value that a picture of the painter shows."""
    return int(np.asarray(picture[1])[5, 5, 0])


# The door


def test_the_page_comes_with_its_policy_and_without_the_secret(served: WebServer) -> None:
    status, headers, page = get(served, f"/?secret={secret_of(served)}")
    assert status == 200
    assert secret_of(served) not in page and "Set-Cookie" not in headers
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; ") and f"ws://127.0.0.1:{served.port};" in policy
    for name in ("script", "style"):
        (own,) = re.findall(f"<{name}>(.*?)</{name}>", page, re.DOTALL)
        assert f"'sha256-{base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()}'" in policy
    assert not re.search(r"""(src|href)=(?!"data:,")|url\(|@import|\bon\w+=["']""", page.partition("<script>")[0])
    assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
    assert headers["Server"] == "clrecon"


@pytest.mark.parametrize("path", ["/", "/?secret=", "/?secret=wrong", "/socket?secret=wrong", "/nothing", "/page.js"])
def test_without_the_secret_there_is_one_plain_line(served: WebServer, path: str) -> None:
    status, headers, said = get(served, path, Origin=f"http://127.0.0.1:{served.port}")
    assert status == 403 and headers["Content-Type"].startswith("text/plain")
    assert said == "refused: the secret is missing or wrong, open the whole address that clrecon printed\n"


@pytest.mark.parametrize("path", ["/", "/socket", "/saved/x"])
def test_a_foreign_page_is_refused_with_the_right_secret(served: WebServer, path: str) -> None:
    whole = f"{path}?secret={secret_of(served)}"
    for origin in ("http://evil.example", "null", f"http://localhost:{served.port}"):
        assert get(served, whole, Origin=origin)[0] == 403
    assert get(served, whole, Host=f"evil.example:{served.port}")[0] == 403  # DNS rebinding
    assert get(served, whole, Host=f"evil.example:{served.port}", Origin=f"http://evil.example:{served.port}")[0] == 403


def test_a_socket_needs_an_origin(served: WebServer, views: Views) -> None:
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": "13"}
    key = {"Sec_WebSocket_Key": base64.b64encode(b"0123456789abcdef").decode()}
    path = f"/socket?secret={secret_of(served)}"
    assert get(served, path, **upgrade, **key)[0] == 403
    assert views.sessions == []


def test_page_behind_a_tunnel_may_have_another_port(served: WebServer) -> None:
    assert get(served, f"/?secret={secret_of(served)}", Host="localhost:9999", Origin="http://localhost:9999")[0] == 200


def test_other_paths_are_not_found(served: WebServer) -> None:
    for path in ("/nothing", "/../etc/passwd", "/saved/", "/saved/wrong"):
        assert get(served, f"{path}?secret={secret_of(served)}")[0] == 404


def test_server_listens_on_the_loopback_address_alone() -> None:
    with bind_port() as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


def test_a_port_that_is_taken_is_said_in_one_line() -> None:
    with bind_port() as listener:
        port = listener.getsockname()[1]
        with refused(UsageError, port):
            WebServer(port)
    with WebServer(port) as again:  # and is free afterwards
        assert again.port == port


@pytest.mark.parametrize("port", [0, -1, 65536, True])
def test_a_number_that_is_no_port_is_refused(port: int) -> None:
    with refused(UsageError, 1, 65535):
        bind_port(port)


def test_nothing_is_logged_that_holds_the_secret(views: Views, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), serving(views.open) as running:
        get(running, f"/?secret={secret_of(running)}")
        get(running, "/?secret=wrong")
        asyncio.run(leave_at_once(running))
    assert secret_of(running) not in caplog.text


async def leave_at_once(running: WebServer) -> None:
    async with browsing(running) as client:
        await client.until(lambda: client.facts)


# Pictures and facts


def test_a_browser_gets_facts_and_pictures_of_the_size_that_it_has(served: WebServer) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.lay_out(scene=[120, 90], axial=[40, 30])
            await client.until(lambda: {head["view"] for head, _ in client.pictures} == {"scene", "axial"})
            assert client.facts["iso"]["hu"] == 200.0 and client.facts["device"] == "no device"
            assert client.fixed["formats"]["mesh"][0] == ".stl"
            head, image = client.pictures[0]
            assert image.size == (120, 90) == tuple(head["size"]) and head["camera"]["parallel"]
            assert abs(grey(client.pictures[0]) - 200) <= 2

    asyncio.run(look())


def test_a_fitted_surface_and_its_scale_come_through_the_socket(served: WebServer) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: client.facts.get("fitted"))
            await client.until(lambda: client.facts["settled"])
            before = len(client.pictures)
            await client.tell(do="set_color_by", name="thickness")
            await client.until(lambda: client.facts["scale"] is not None and len(client.pictures) > before)
            assert client.facts["scale"]["ticks"] == [0.0, 0.5, 1.0, 1.5, 2.0]
            await client.tell(do="set_color_by", name="hardness")
            await client.until(lambda: any("hardness" in note.get("error", "") for note in client.notes))

    asyncio.run(look())


def test_a_fit_that_fails_is_said_and_the_surface_stays(served: WebServer, views: Views) -> None:
    views.painter.has_bone = False

    async def look() -> None:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: any("walls" in note.get("error", "") for note in client.notes))
            assert client.facts["fitted"] is False

    asyncio.run(look())


def test_moving_view_is_coarse_and_sharp_at_rest(served: WebServer, views: Views) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures and client.pictures[-1][0]["sharp"])
            before = len(client.pictures)
            await client.tell(do="set_iso", hu=250)
            await client.until(lambda: [head["sharp"] for head, _ in client.pictures[before:]] == [False, True])
            assert abs(grey(client.pictures[-1]) - 250) <= 2

    asyncio.run(look())


def test_a_browser_that_shows_nothing_gets_one_picture(served: WebServer, views: Views) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            client.shows = False
            await client.lay_out()
            await client.until(lambda: client.pictures)
            for hu in range(201, 241):
                await client.tell(do="set_iso", hu=hu)
            await client.until(lambda: client.facts["iso"]["hu"] == 240)
            await asyncio.sleep(2 * connection.REST_SECONDS)
            assert len(client.pictures) == 1
            assert len(views.painter.drawn) <= 3  # one is under way, one waits, one may have given way
            client.shows = True
            await client.tell(shown=client.pictures[0][0]["number"])
            await client.until(lambda: client.pictures[-1][0]["sharp"] and len(client.pictures) > 1)
            assert abs(grey(client.pictures[-1]) - 240) <= 2

    asyncio.run(look())


def test_browsers_do_not_disturb_each_other(served: WebServer, views: Views) -> None:
    async def look() -> None:
        async with browsing(served) as one, browsing(served) as other:
            for client in (one, other):
                await client.lay_out()
                await client.until(lambda client=client: client.pictures and client.pictures[-1][0]["sharp"])
            before, camera = len(other.pictures), other.facts["camera"]
            await one.tell(do="set_iso", hu=120)
            await one.tell(do="turn", dx=0.2, dy=0.1)
            await one.until(lambda: one.facts["iso"]["hu"] == 120 and one.facts["camera"] != camera)
            await one.until(lambda: one.pictures[-1][0]["sharp"] and grey(one.pictures[-1]) < 130)
            assert (other.facts["iso"]["hu"], other.facts["camera"]) == (200.0, camera)
            assert len(other.pictures) == before
        assert len(views.sessions) == 2

    asyncio.run(look())


def test_a_picture_that_fails_is_said_and_the_next_one_comes(served: WebServer, views: Views) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            views.painter.fault = RuntimeError("the device burns")
            await client.lay_out()
            await client.until(lambda: client.notes)
            assert "the device burns" in client.notes[0]["error"]
            await client.tell(do="set_iso", hu=222)
            await client.until(lambda: client.pictures)

    asyncio.run(look())


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"do": "save", "path": "/tmp/x.stl"}, "the command save is not for browsers"),
        ({"do": "dance"}, "unknown command 'dance'"),
        ({"do": "set_iso"}, "needs hu"),
        ({"do": "set_iso", "hu": 1e9}, "the iso value runs from"),
        ({"save": "../../x"}, "a format is an extension"),
        ({"save": ".exe"}, "the extension says as what"),
        ({"sizes": {"scene": "large"}, "ground": [0, 0, 0]}, "a size is width and height"),
        ({"save": ".png", "size": 7}, "a size is width and height"),
        ({"save": ".png", "size": ["wide", None]}, "a size is width and height"),
        ({"save": ".png", "size": [1, 2, 3]}, "a size is width and height"),
        ({"sizes": {}, "ground": "red"}, "cannot be read"),
        ([1, 2], "cannot be read"),
    ],
)
def test_a_wrong_message_is_answered_and_the_connection_goes_on(served: WebServer, message: object, said: str) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.socket.send_str(json.dumps(message))
            await client.until(lambda: client.notes)
            assert said in client.notes[0]["error"]
            await client.tell(do="set_iso", hu=210)
            await client.until(lambda: client.facts and client.facts["iso"]["hu"] == 210)

    asyncio.run(look())


def test_a_click_tells_what_was_picked(served: WebServer) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.tell(do="start_tool", name="distance")
            for x in (10, 40):
                await client.tell(do="add_point", x=x, y=20, size=[120, 90], plane=None)
            await client.until(lambda: client.facts and client.facts["measures"] and len(client.notes) == 2)
            assert client.facts["measures"][0]["text"] == "30.0 mm"
            assert [note["pick"]["hu"] for note in client.notes] == [50.0, 50.0]

    asyncio.run(look())


def test_a_cross_that_moves_and_parts_that_look_plain_leave_the_picture(served: WebServer, views: Views) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.tell(do="set_mode", name="slices")
            await client.lay_out(scene=[120, 90], axial=[40, 30])
            await client.until(lambda: client.facts and client.facts["settled"] and len(client.pictures) >= 2)
            views.painter.drawn.clear()
            await client.tell(do="scroll", plane="axial", steps=1)
            await client.until(lambda: ("axial", True) in views.painter.drawn and client.facts["settled"])
            views.sessions[0].model.state = dataclasses.replace(views.sessions[0].model.state, parts_at=200.0)
            await client.tell(do="dismiss")
            await client.tell(do="start_tool", name="seed")
            await client.until(lambda: client.facts["tool"] == "seed" and client.facts["settled"])
            assert {view for view, _ in views.painter.drawn} == {"axial"}

    asyncio.run(look())


# Files


def test_named_files_are_written_one_after_the_other_and_said(
    views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(self, path, then, size=None) -> None:
        path.write_bytes(b"x")
        then([f"wrote {path.name}"])

    monkeypatch.setattr("clrecon.viewer.session.session.ViewSession.save", save)
    wrote: list[str] = []
    names = [str(tmp_path / name) for name in ("a.stl", "b.png")]

    async def look(running: WebServer) -> None:
        async with browsing(running) as client:
            await client.tell(save=None)
            await client.until(lambda: len(client.notes) == 2)
            assert list(client.fixed["save_as"]) == names
            await client.tell(save=None)
            await client.until(lambda: len(client.notes) == 4)

    with serving(views.open, save_as=names, wrote=wrote.append) as running:
        asyncio.run(look(running))
    assert wrote == ["wrote a.stl", "wrote b.png", "wrote a-2.stl", "wrote b-2.png"]
    assert len(list(tmp_path.iterdir())) == 4


def test_a_file_is_fetched_once_with_its_ticket(views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Path] = []

    def save(self, path, then, size=None) -> None:
        path.write_bytes(b"x" * 700_000)
        written.append(path)
        then(["written"])

    monkeypatch.setattr("clrecon.viewer.session.session.ViewSession.save", save)

    async def look(running: WebServer) -> None:
        async with browsing(running) as client:
            await client.tell(save=".stl")
            await client.until(lambda: client.notes)
            told = client.notes[0]["saved"]
            assert (told["name"], told["bytes"]) == ("view.stl", 700_000)
            assert written[0].stat().st_mode & 0o077 == 0 or written[0].parent.stat().st_mode & 0o077 == 0
            path = f"/saved/{told['ticket']}"
            assert (await asyncio.to_thread(get, running, path, Origin="http://evil.example"))[0] == 403
            status, headers, content = await asyncio.to_thread(get, running, path)
            assert status == 200 and content == "x" * 700_000
            assert headers["Content-Disposition"] == 'attachment; filename="view.stl"'
            assert (await asyncio.to_thread(get, running, path))[0] == 404
            await client.until(lambda: not written[0].exists())
            await client.tell(save=".ply")
            await client.until(lambda: len(client.notes) == 2)

    with serving(views.open) as running:
        asyncio.run(look(running))
    assert len(written) == 2 and not any(path.parent.exists() for path in written)


def read_iso_of(served: WebServer, tab: str, change: float | None = None) -> float:
    """Connect as a tab, change the iso value if asked to, and return it as the tab leaves."""

    async def look() -> float:
        async with browsing(served, tab) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures)
            if change is not None:
                await client.tell(do="set_iso", hu=change)
                await client.until(lambda: client.facts["iso"]["hu"] == change)
            return float(client.facts["iso"]["hu"])

    return asyncio.run(look())


def test_a_tab_that_loads_the_page_again_goes_on_with_its_view(served: WebServer) -> None:
    read_iso_of(served, "one", change=120.0)

    assert read_iso_of(served, "one") == 120.0


@pytest.mark.parametrize("tab", ["other", ""], ids=["another tab", "a page without a tab"])
def test_another_tab_begins_anew(served: WebServer, tab: str) -> None:
    read_iso_of(served, "one", change=120.0)

    assert read_iso_of(served, tab) == 200.0


def test_views_of_as_many_tabs_are_kept_as_browsers_may_be_open(served: WebServer) -> None:
    for number in range(server.MOST_BROWSERS + 1):
        read_iso_of(served, f"tab {number}", change=120.0 + number)

    assert read_iso_of(served, "tab 1") == 121.0
    assert read_iso_of(served, "tab 0") == 200.0


# Ends


def test_a_browser_that_dies_has_its_session_closed(served: WebServer, views: Views) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures)
            client.socket._response.connection.transport.abort()
        end = asyncio.get_running_loop().time() + PATIENCE
        while not views.sessions[0]._closed and asyncio.get_running_loop().time() < end:
            await asyncio.sleep(0.05)

    asyncio.run(look())
    assert views.sessions[0]._closed


def test_when_the_server_ends_browsers_are_told(views: Views) -> None:
    async def look(running: WebServer) -> None:
        async with browsing(running) as client:
            await client.until(lambda: client.facts)
            running.stop()
            await client.until(lambda: client.close_code is not None)
            assert client.close_code == 1001

    with serving(views.open) as running:
        asyncio.run(look(running))
    assert views.sessions[0]._closed


def test_a_browser_can_end_the_server(views: Views) -> None:
    async def look(running: WebServer) -> None:
        async with browsing(running) as one, browsing(running) as other:
            await other.until(lambda: other.facts)
            await one.tell(quit=True)
            for client in (one, other):
                await client.until(lambda client=client: client.close_code is not None)
            assert (one.close_code, other.close_code) == (1001, 1001)

    with serving(views.open) as running:
        asyncio.run(look(running))


def test_too_many_browsers_are_told_so(views: Views) -> None:
    async def look(running: WebServer) -> None:
        async with AsyncExitStack() as stack:
            browsers = [await stack.enter_async_context(browsing(running)) for _ in range(server.MOST_BROWSERS)]
            for one in browsers:
                await one.until(lambda one=one: one.facts)
            async with browsing(running) as other:
                await other.until(lambda: other.close_code is not None)
                assert other.close_code == 1013
            await one.tell(do="set_iso", hu=230)
            await one.until(lambda: one.facts["iso"]["hu"] == 230)

    with serving(views.open) as running:
        asyncio.run(look(running))
