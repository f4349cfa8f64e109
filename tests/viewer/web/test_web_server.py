"""The server: what a browser gets, how much at a time, and how it ends."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import os
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_facts
from web_views import PATIENCE, Views, browsing, get_path, serving

from clrecon.viewer.web import connection, server
from clrecon.viewer.web.server import WebServer

pytestmark = pytest.mark.unit

JPEG_GREYS = 2  # what a flat grey changes by in a picture for the browser


@pytest.fixture
def views() -> Views:
    return Views()


@pytest.fixture
def served(views: Views):
    with serving(views.open) as running:
        yield running


def grey(picture: tuple[dict[str, Any], Any]) -> int:
    """The iso value that a picture of the painter shows."""
    return int(np.asarray(picture[1])[5, 5, 0])


# Pictures and facts


def test_browser_gets_the_facts_of_its_view(served: WebServer) -> None:
    async def look() -> tuple[dict[str, Any], dict[str, Any]]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures and client.facts["settled"])
            return client.facts, client.fixed

    facts, fixed = asyncio.run(look())

    assert (facts["iso"]["hu"], facts["device"]) == (200.0, "no device")  # of the painter of web_views
    assert fixed["formats"]["mesh"][0] == ".stl"


def test_browser_gets_a_picture_of_the_size_that_each_of_its_views_has(served: WebServer) -> None:
    sizes = {"scene": [120, 90], "axial": [40, 30]}

    async def look() -> list:
        async with browsing(served) as client:
            await client.lay_out(**sizes)
            await client.until(lambda: {head["view"] for head, _ in client.pictures} == set(sizes))
            return client.pictures

    pictures = asyncio.run(look())

    assert {head["view"]: list(image.size) for head, image in pictures} == sizes
    assert {head["view"]: list(head["size"]) for head, _ in pictures} == sizes


def test_browser_gets_pictures_of_the_iso_value_and_their_camera(served: WebServer) -> None:
    async def look() -> tuple[dict[str, Any], Any]:
        async with browsing(served) as client:
            await client.lay_out(scene=[120, 90])
            await client.until(lambda: client.pictures)
            return client.pictures[0]

    picture = asyncio.run(look())

    assert picture[0]["camera"]["parallel"]
    assert grey(picture) == pytest.approx(200, abs=JPEG_GREYS)


def test_colours_of_a_fitted_surface_come_with_their_scale_and_a_picture(served: WebServer) -> None:
    async def look() -> dict[str, Any]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: client.facts.get("fitted"))
            await client.until(lambda: client.facts["settled"])
            before = len(client.pictures)
            await client.tell(do="set_color_by", name="thickness")
            await client.until(lambda: client.facts["scale"] is not None and len(client.pictures) > before)
            return client.facts["scale"]

    assert asyncio.run(look())["ticks"] == [0.0, 0.5, 1.0, 1.5, 2.0]


def test_unknown_quantity_of_a_fitted_surface_is_said(served: WebServer) -> None:
    async def look() -> list[str]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: client.facts.get("fitted"))
            await client.tell(do="set_color_by", name="hardness")
            await client.until(lambda: any("error" in note for note in client.notes))
            return [note["error"] for note in client.notes if "error" in note]

    (said,) = asyncio.run(look())

    assert_facts(said, "hardness")


def test_fit_that_fails_is_said_and_leaves_the_surface_as_it_is(served: WebServer, views: Views) -> None:
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
            assert grey(client.pictures[-1]) == pytest.approx(250, abs=JPEG_GREYS)

    asyncio.run(look())


def test_browser_that_shows_nothing_gets_one_picture_and_the_newest_once_it_shows_that(
    served: WebServer, views: Views
) -> None:
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
            assert grey(client.pictures[-1]) == pytest.approx(240, abs=JPEG_GREYS)

    asyncio.run(look())


def test_browser_that_turns_its_view_leaves_that_of_another(served: WebServer, views: Views) -> None:
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


def test_picture_that_fails_is_said_and_the_next_one_comes(served: WebServer, views: Views) -> None:
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
def test_wrong_message_is_answered_and_the_connection_goes_on(served: WebServer, message: object, said: str) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.socket.send_str(json.dumps(message))
            await client.until(lambda: client.notes)
            assert said in client.notes[0]["error"]
            await client.tell(do="set_iso", hu=210)
            await client.until(lambda: client.facts and client.facts["iso"]["hu"] == 210)

    asyncio.run(look())


def test_clicks_of_a_distance_tell_their_hu_and_make_a_measure(served: WebServer) -> None:
    async def look() -> None:
        async with browsing(served) as client:
            await client.tell(do="start_tool", name="distance")
            for x in (10, 40):
                await client.tell(do="add_point", x=x, y=20, size=[120, 90], plane=None)
            await client.until(lambda: client.facts and client.facts["measures"] and len(client.notes) == 2)
            assert client.facts["measures"][0]["text"] == "30.0 mm"
            assert [note["pick"]["hu"] for note in client.notes] == [50.0, 50.0]

    asyncio.run(look())


def test_cross_that_moves_and_parts_that_look_plain_leave_the_picture(served: WebServer, views: Views) -> None:
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


SAVED_BYTES = 700_000  # more than a buffer of the server


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files that sessions save, each SAVED_BYTES long."""
    paths: list[Path] = []

    def save(self, path, then, size=None) -> None:
        path.write_bytes(b"x" * SAVED_BYTES)
        paths.append(path)
        then(["written"])

    monkeypatch.setattr("clrecon.viewer.session.session.ViewSession.save", save)
    return paths


async def save_view(client) -> dict[str, Any]:
    """Have the view saved as .stl, and return what the browser is told of the file."""
    await client.tell(save=".stl")
    await client.until(lambda: client.notes)
    return client.notes[0]["saved"]


def test_browser_is_told_the_name_and_size_of_a_saved_file(served: WebServer, written: list[Path]) -> None:
    async def look() -> dict[str, Any]:
        async with browsing(served) as client:
            return await save_view(client)

    told = asyncio.run(look())

    assert (told["name"], told["bytes"]) == ("view.stl", SAVED_BYTES)


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_saved_file_is_hidden_from_other_users(served: WebServer, written: list[Path]) -> None:
    async def look() -> list[int]:
        async with browsing(served) as client:
            await save_view(client)
            return [path.stat().st_mode & 0o077 for path in (written[0], written[0].parent)]

    assert 0 in asyncio.run(look())  # the file or its folder


def test_saved_file_is_fetched_as_a_download_once(served: WebServer, written: list[Path]) -> None:
    async def look() -> list[tuple[int, dict[str, str], str]]:
        async with browsing(served) as client:
            path = f"/saved/{(await save_view(client))['ticket']}"
            return [await asyncio.to_thread(get_path, served, path) for _ in range(2)]

    (status, headers, content), (again, _, _) = asyncio.run(look())

    assert (status, again) == (200, 404)
    assert content == "x" * SAVED_BYTES
    assert headers["Content-Disposition"] == 'attachment; filename="view.stl"'


def test_saved_file_is_refused_to_a_foreign_page(served: WebServer, written: list[Path]) -> None:
    async def look() -> int:
        async with browsing(served) as client:
            path = f"/saved/{(await save_view(client))['ticket']}"
            return (await asyncio.to_thread(get_path, served, path, Origin="http://evil.example"))[0]

    assert asyncio.run(look()) == 403


def test_saved_file_is_removed_once_it_is_fetched(served: WebServer, written: list[Path]) -> None:
    async def look() -> bool:
        async with browsing(served) as client:
            path = f"/saved/{(await save_view(client))['ticket']}"
            await asyncio.to_thread(get_path, served, path)
            await client.until(lambda: not written[0].exists())
            return written[0].exists()

    assert asyncio.run(look()) is False


def test_saved_files_that_are_not_fetched_are_removed_with_the_server(views: Views, written: list[Path]) -> None:
    async def look(running: WebServer) -> None:
        async with browsing(running) as client:
            await save_view(client)

    with serving(views.open) as running:
        asyncio.run(look(running))

    assert [path.parent.exists() for path in written] == [False]


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


def test_session_of_a_browser_that_dies_is_closed(served: WebServer, views: Views) -> None:
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


def test_browsers_are_told_when_the_server_ends(views: Views) -> None:
    async def look(running: WebServer) -> None:
        async with browsing(running) as client:
            await client.until(lambda: client.facts)
            running.stop()
            await client.until(lambda: client.close_code is not None)
            assert client.close_code == 1001

    with serving(views.open) as running:
        asyncio.run(look(running))
    assert views.sessions[0]._closed


def test_server_that_a_browser_ends_tells_every_browser(views: Views) -> None:
    async def look(running: WebServer) -> None:
        async with browsing(running) as one, browsing(running) as other:
            await other.until(lambda: other.facts)
            await one.tell(quit=True)
            for client in (one, other):
                await client.until(lambda client=client: client.close_code is not None)
            assert (one.close_code, other.close_code) == (1001, 1001)

    with serving(views.open) as running:
        asyncio.run(look(running))


def test_browser_beyond_the_most_is_turned_away_and_the_others_go_on(views: Views) -> None:
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
