"""The server: what a browser gets, how much at a time, and how it ends."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import os
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import assert_facts
from web_views import PATIENCE, Client, Views, browsing, get_path, serving

from clrecon.viewer.web import connection, server
from clrecon.viewer.web.server import WebServer

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


def grey(picture: tuple[dict[str, Any], Any]) -> int:
    """The iso value that a picture of the painter shows."""
    return int(np.asarray(picture[1])[5, 5, 0])


# Pictures and facts


def test_browser_gets_the_facts_of_its_view(served: WebServer) -> None:
    async def browse() -> tuple[dict[str, Any], dict[str, Any]]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures and client.facts["settled"])
            return client.facts, client.fixed

    facts, fixed = asyncio.run(browse())

    assert (facts["iso"]["hu"], facts["device"]) == (200.0, "no device")  # of the painter of web_views
    assert fixed["formats"]["mesh"][0] == ".stl"


def test_browser_gets_a_picture_of_the_size_that_each_of_its_views_has(served: WebServer) -> None:
    sizes = {"scene": [120, 90], "axial": [40, 30]}

    async def browse() -> list:
        async with browsing(served) as client:
            await client.lay_out(**sizes)
            await client.until(lambda: {head["view"] for head, _ in client.pictures} == set(sizes))
            return client.pictures

    pictures = asyncio.run(browse())

    assert {head["view"]: list(image.size) for head, image in pictures} == sizes
    assert {head["view"]: list(head["size"]) for head, _ in pictures} == sizes


def test_browser_gets_pictures_of_the_iso_value_and_their_camera(served: WebServer) -> None:
    async def browse() -> tuple[dict[str, Any], Any]:
        async with browsing(served) as client:
            await client.lay_out(scene=[120, 90])
            await client.until(lambda: client.pictures)
            return client.pictures[0]

    picture = asyncio.run(browse())

    assert picture[0]["camera"]["parallel"]
    assert grey(picture) == pytest.approx(200, abs=tolerances.JPEG_GREYS)  # the iso value that Views begin with


def test_colours_of_a_fitted_surface_come_with_their_scale_and_a_picture(served: WebServer) -> None:
    async def browse() -> dict[str, Any]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: client.facts.get("fitted"))
            await client.until(lambda: client.facts["settled"])
            before = len(client.pictures)
            await client.tell(do="set_color_by", name="thickness")
            await client.until(lambda: client.facts["scale"] is not None and len(client.pictures) > before)
            return client.facts["scale"]

    assert asyncio.run(browse())["ticks"] == [0.0, 0.5, 1.0, 1.5, 2.0]  # the painter of web_views ends it at 2 mm


def test_unknown_quantity_of_a_fitted_surface_is_said(served: WebServer) -> None:
    async def browse() -> list[str]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: client.facts.get("fitted"))
            await client.tell(do="set_color_by", name="hardness")
            await client.until(lambda: any("error" in note for note in client.notes))
            return [note["error"] for note in client.notes if "error" in note]

    (said,) = asyncio.run(browse())

    assert_facts(said, "hardness")


def test_fit_that_fails_is_said_and_leaves_the_surface_as_it_is(served: WebServer, views: Views) -> None:
    views.painter.has_bone = False  # its fit says "no walls of bone"

    async def browse() -> tuple[str, bool]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.tell(do="set_fitted", shown=True)
            await client.until(lambda: any("error" in note for note in client.notes))
            return client.notes[-1]["error"], client.facts["fitted"]

    error, is_fitted = asyncio.run(browse())

    assert_facts(error, "walls", "bone")
    assert is_fitted is False


def test_view_that_changes_is_drawn_coarse_and_then_sharp_at_rest(served: WebServer) -> None:
    async def browse() -> list[tuple[dict[str, Any], Any]]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.is_sharp)
            before = len(client.pictures)
            await client.tell(do="set_iso", hu=250)
            await client.until(lambda: len(client.pictures) > before and client.is_sharp)
            return client.pictures[before:]

    pictures = asyncio.run(browse())

    assert [head["sharp"] for head, _ in pictures] == [False, True]
    assert grey(pictures[-1]) == pytest.approx(250, abs=tolerances.JPEG_GREYS)


async def change_iso_40_times_unshown(client: Client) -> None:
    """Change the iso value from 200 to 240 HU for a browser that does not say that it has shown its first picture."""
    client.shows = False
    await client.lay_out()
    await client.until(lambda: client.pictures)
    for hu in range(201, 241):
        await client.tell(do="set_iso", hu=hu)
    await client.until(lambda: client.facts["iso"]["hu"] == 240)
    await asyncio.sleep(2 * connection.REST_SECONDS)


def test_browser_that_shows_no_picture_gets_no_second_one(served: WebServer, views: Views) -> None:
    async def browse() -> int:
        async with browsing(served) as client:
            await change_iso_40_times_unshown(client)
            return len(client.pictures)

    assert asyncio.run(browse()) == 1
    assert len(views.painter.drawn) <= 3  # of 41: one is under way, one waits, one may have given way


def test_browser_that_shows_its_picture_late_gets_the_newest(served: WebServer) -> None:
    async def browse() -> tuple[dict[str, Any], Any]:
        async with browsing(served) as client:
            await change_iso_40_times_unshown(client)
            client.shows = True
            [(head, _)] = client.pictures
            await client.tell("shown", number=head["number"])
            await client.until(lambda: client.is_sharp and len(client.pictures) > 1)
            return client.pictures[-1]

    assert grey(asyncio.run(browse())) == pytest.approx(240, abs=tolerances.JPEG_GREYS)


def test_browser_that_changes_its_view_leaves_that_of_another(served: WebServer) -> None:
    def seen(client: Client) -> tuple[float, dict[str, Any], int]:
        return client.facts["iso"]["hu"], client.facts["camera"], len(client.pictures)

    async def browse() -> list[tuple[float, dict[str, Any], int]]:
        async with browsing(served) as one, browsing(served) as other:
            for client in (one, other):
                await client.lay_out()
                await client.until(lambda client=client: client.is_sharp)
            before = seen(other)
            await one.tell(do="set_iso", hu=120)
            await one.tell(do="turn", dx=0.2, dy=0.1)
            await one.until(lambda: one.facts["iso"]["hu"] == 120 and one.facts["camera"] != before[1])
            await one.until(lambda: one.is_sharp and grey(one.pictures[-1]) < 130)  # of 120 HU
            return [before, seen(other)]

    before, after = asyncio.run(browse())

    assert after == before


def test_fault_of_a_picture_is_said(served: WebServer, views: Views) -> None:
    views.painter.fault = RuntimeError("the device burns")

    async def browse() -> str:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.notes)
            return client.notes[0]["error"]

    assert "the device burns" in asyncio.run(browse())


def test_picture_after_one_that_failed_is_shown(served: WebServer, views: Views) -> None:
    views.painter.fault = RuntimeError("the device burns")  # once

    async def browse() -> tuple[dict[str, Any], Any]:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.notes)
            await client.tell(do="set_iso", hu=222)
            await client.until(lambda: client.is_sharp)
            return client.pictures[-1]

    assert grey(asyncio.run(browse())) == pytest.approx(222, abs=tolerances.JPEG_GREYS)


WRONG_MESSAGES: dict[str, tuple[object, str]] = {
    "command of files": ({"type": "command", "do": "save", "path": "x.stl"}, "the command save is not for browsers"),
    "unknown command": ({"type": "command", "do": "dance"}, "unknown command 'dance'"),
    "no iso value": ({"type": "command", "do": "set_iso"}, "needs hu"),
    "iso value beyond HU": ({"type": "command", "do": "set_iso", "hu": 1e9}, "the iso value runs from"),
    "path as a format": ({"type": "save", "format": "../../x"}, "a format is an extension"),
    "unknown format": ({"type": "save", "format": ".exe"}, "the extension says as what"),
    "size of a view as text": ({"type": "layout", "sizes": {"scene": "large"}, "ground": [0, 0, 0]}, "a size is width"),
    "size of a file of one number": ({"type": "save", "format": ".png", "size": 7}, "a size is width and height"),
    "size of a file in words": ({"type": "save", "format": ".png", "size": ["wide", None]}, "a size is width"),
    "size of a file of three": ({"type": "save", "format": ".png", "size": [1, 2, 3]}, "a size is width and height"),
    "background in words": ({"type": "layout", "sizes": {}, "ground": "red"}, "the ground of the views is red, green"),
    "endless background": ({"type": "layout", "sizes": {}, "ground": [0, math.inf, 0]}, "the ground of the views is"),
    "size beyond all numbers": ({"type": "layout", "sizes": {"axial": [10**400, 1]}, "ground": [0, 0, 0]}, "a size is"),
    "list as a command": ({"type": "command", "do": [1]}, "unknown command"),
    "command without a type": ({"do": "undo"}, "its type is unknown"),
    "list": ([1, 2], "cannot be read"),
}


@pytest.mark.parametrize(("message", "said"), WRONG_MESSAGES.values(), ids=WRONG_MESSAGES)
def test_wrong_message_is_answered_with_its_fault(served: WebServer, message: object, said: str) -> None:
    async def browse() -> str:
        async with browsing(served) as client:
            await client.socket.send_str(json.dumps(message))
            await client.until(lambda: client.notes)
            return client.notes[0]["error"]

    assert said in asyncio.run(browse())


@pytest.mark.parametrize("message", [message for message, _ in WRONG_MESSAGES.values()], ids=WRONG_MESSAGES)
def test_command_after_a_wrong_message_is_obeyed(served: WebServer, message: object) -> None:
    async def browse() -> float:
        async with browsing(served) as client:
            await client.socket.send_str(json.dumps(message))
            await client.until(lambda: client.notes)
            await client.tell(do="set_iso", hu=210)
            await client.until(lambda: client.facts and client.facts["iso"]["hu"] != ISO_AT_FIRST)
            return client.facts["iso"]["hu"]

    assert asyncio.run(browse()) == 210


async def measure_distance_of_30_mm(client: Client) -> None:
    """Click at two pixels 30 apart: the painter of web_views takes pixels for mm, and finds 50 HU everywhere."""
    await client.tell(do="start_tool", name="distance")
    for x in (10, 40):
        await client.tell(do="add_point", x=x, y=20, size=[120, 90], plane=None)
    await client.until(lambda: client.facts and client.facts["measures"] and len(client.notes) == 2)


def test_two_clicks_of_a_distance_make_a_measure_in_mm(served: WebServer) -> None:
    async def browse() -> list[str]:
        async with browsing(served) as client:
            await measure_distance_of_30_mm(client)
            return [measure["text"] for measure in client.facts["measures"]]

    assert asyncio.run(browse()) == ["30.0 mm"]


def test_each_click_of_a_distance_is_answered_with_its_hu(served: WebServer) -> None:
    async def browse() -> list[float]:
        async with browsing(served) as client:
            await measure_distance_of_30_mm(client)
            return [note["pick"]["hu"] for note in client.notes]

    assert asyncio.run(browse()) == [50.0, 50.0]


async def show_slices_in_space(client: Client, views: Views) -> None:
    """Wait until the scene and the axial slice are drawn, and forget how often."""
    await client.tell(do="set_mode", name="slices")
    await client.lay_out(scene=[120, 90], axial=[40, 30])
    await client.until(lambda: client.facts and client.facts["settled"] and len(client.pictures) >= 2)
    views.painter.drawn.clear()


def test_slice_that_is_scrolled_is_drawn_alone(served: WebServer, views: Views) -> None:
    async def browse() -> None:
        async with browsing(served) as client:
            await show_slices_in_space(client, views)
            await client.tell(do="scroll", plane="axial", steps=1)
            await client.until(lambda: ("axial", True) in views.painter.drawn and client.facts["settled"])

    asyncio.run(browse())

    assert {view for view, _ in views.painter.drawn} == {"axial"}


def test_parts_that_are_known_and_a_tool_that_starts_leave_the_pictures(served: WebServer, views: Views) -> None:
    async def browse() -> str:
        async with browsing(served) as client:
            await show_slices_in_space(client, views)
            views.sessions[0].model.state = dataclasses.replace(views.sessions[0].model.state, parts_at=200.0)
            await client.tell(do="dismiss")
            await client.tell(do="start_tool", name="seed")
            await client.until(lambda: client.facts["tool"] == "seed" and client.facts["settled"])
            return client.facts["tool"]

    assert asyncio.run(browse()) == "seed"
    assert views.painter.drawn == []


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

    async def browse(running: WebServer) -> list[str]:
        async with browsing(running) as client:
            await client.tell("save", format=None)
            await client.until(lambda: len(client.notes) == 2)
            await client.tell("save", format=None)
            await client.until(lambda: len(client.notes) == 4)
            return list(client.fixed["save_as"])

    with serving(views.open, save_as=names, wrote=wrote.append) as running:
        told = asyncio.run(browse(running))

    assert told == names
    assert wrote == ["wrote a.stl", "wrote b.png", "wrote a-2.stl", "wrote b-2.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-2.stl", "a.stl", "b-2.png", "b.png"]


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
    await client.tell("save", format=".stl")
    await client.until(lambda: client.notes)
    return client.notes[0]["saved"]


def test_browser_is_told_the_name_and_size_of_a_saved_file(served: WebServer, written: list[Path]) -> None:
    async def browse() -> dict[str, Any]:
        async with browsing(served) as client:
            return await save_view(client)

    told = asyncio.run(browse())

    assert (told["name"], told["bytes"]) == ("view.stl", SAVED_BYTES)


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_saved_file_is_hidden_from_other_users(served: WebServer, written: list[Path]) -> None:
    async def browse() -> list[int]:
        async with browsing(served) as client:
            await save_view(client)
            return [path.stat().st_mode & 0o077 for path in (written[0], written[0].parent)]

    assert 0 in asyncio.run(browse())  # the file or its folder


def test_saved_file_is_fetched_as_a_download_once(served: WebServer, written: list[Path]) -> None:
    async def browse() -> list[tuple[int, dict[str, str], str]]:
        async with browsing(served) as client:
            path = f"/saved/{(await save_view(client))['ticket']}"
            return [await asyncio.to_thread(get_path, served, path) for _ in range(2)]

    (status, headers, content), (again, _, _) = asyncio.run(browse())

    assert (status, again) == (200, 404)
    assert content == "x" * SAVED_BYTES
    assert headers["Content-Disposition"] == 'attachment; filename="view.stl"'


def test_saved_file_is_refused_to_a_foreign_page(served: WebServer, written: list[Path]) -> None:
    async def browse() -> int:
        async with browsing(served) as client:
            path = f"/saved/{(await save_view(client))['ticket']}"
            return (await asyncio.to_thread(get_path, served, path, Origin="http://evil.example"))[0]

    assert asyncio.run(browse()) == 403


def test_saved_file_is_removed_once_it_is_fetched(served: WebServer, written: list[Path]) -> None:
    async def browse() -> bool:
        async with browsing(served) as client:
            path = f"/saved/{(await save_view(client))['ticket']}"
            await asyncio.to_thread(get_path, served, path)
            await client.until(lambda: not written[0].exists())
            return written[0].exists()

    assert asyncio.run(browse()) is False


def test_saved_files_that_are_not_fetched_are_removed_with_the_server(views: Views, written: list[Path]) -> None:
    async def browse(running: WebServer) -> None:
        async with browsing(running) as client:
            await save_view(client)

    with serving(views.open) as running:
        asyncio.run(browse(running))

    assert [path.parent.exists() for path in written] == [False]


ISO_AT_FIRST = 200.0  # HU, of a view that Views open


def read_iso_of(served: WebServer, tab: str, change: float | None = None) -> float:
    """Connect as a tab, change the iso value if asked to, and return it as the tab leaves."""

    async def browse() -> float:
        async with browsing(served, tab) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures)
            if change is not None:
                await client.tell(do="set_iso", hu=change)
                await client.until(lambda: client.facts["iso"]["hu"] == change)
            return float(client.facts["iso"]["hu"])

    return asyncio.run(browse())


def test_a_tab_that_loads_the_page_again_goes_on_with_its_view(served: WebServer) -> None:
    read_iso_of(served, "one", change=120.0)

    assert read_iso_of(served, "one") == 120.0


@pytest.mark.parametrize("tab", ["other", ""], ids=["another tab", "a page without a tab"])
def test_another_tab_begins_anew(served: WebServer, tab: str) -> None:
    read_iso_of(served, "one", change=120.0)

    assert read_iso_of(served, tab) == ISO_AT_FIRST


def test_views_of_as_many_tabs_are_kept_as_browsers_may_be_open(served: WebServer) -> None:
    for number in range(server.MOST_BROWSERS + 1):
        read_iso_of(served, f"tab {number}", change=120.0 + number)

    assert read_iso_of(served, "tab 1") == 121.0
    assert read_iso_of(served, "tab 0") == ISO_AT_FIRST


# Ends


def test_session_of_a_browser_that_dies_is_closed(served: WebServer, views: Views) -> None:
    async def browse() -> None:
        async with browsing(served) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures)
            client.socket._response.connection.transport.abort()
        end = asyncio.get_running_loop().time() + PATIENCE
        while not views.sessions[0]._closed and asyncio.get_running_loop().time() < end:
            await asyncio.sleep(0.05)

    asyncio.run(browse())
    assert views.sessions[0]._closed


GOING_AWAY, TRY_AGAIN_LATER = 1001, 1013  # codes with which a WebSocket is closed


def test_browser_is_told_when_the_server_ends_and_its_session_is_closed(views: Views) -> None:
    async def browse(running: WebServer) -> int | None:
        async with browsing(running) as client:
            await client.until(lambda: client.facts)
            running.stop()
            await client.until(lambda: client.close_code is not None)
            return client.close_code

    with serving(views.open) as running:
        code = asyncio.run(browse(running))

    assert code == GOING_AWAY
    assert views.sessions[0]._closed


def test_server_that_a_browser_ends_tells_every_browser(views: Views) -> None:
    async def browse(running: WebServer) -> list[int | None]:
        async with browsing(running) as one, browsing(running) as other:
            await other.until(lambda: other.facts)
            await one.tell("quit")
            for client in (one, other):
                await client.until(lambda client=client: client.close_code is not None)
            return [one.close_code, other.close_code]

    with serving(views.open) as running:
        codes = asyncio.run(browse(running))

    assert codes == [GOING_AWAY, GOING_AWAY]


async def open_as_many_as_may(stack: AsyncExitStack, running: WebServer) -> list[Client]:
    browsers = [await stack.enter_async_context(browsing(running)) for _ in range(server.MOST_BROWSERS)]
    for one in browsers:
        await one.until(lambda one=one: one.facts)
    return browsers


def test_browser_beyond_the_most_is_turned_away(served: WebServer) -> None:
    async def browse() -> int | None:
        async with AsyncExitStack() as stack:
            await open_as_many_as_may(stack, served)
            async with browsing(served) as one_more:
                await one_more.until(lambda: one_more.close_code is not None)
                return one_more.close_code

    assert asyncio.run(browse()) == TRY_AGAIN_LATER


def test_browsers_go_on_when_one_beyond_the_most_is_turned_away(served: WebServer) -> None:
    async def browse() -> float:
        async with AsyncExitStack() as stack:
            browsers = await open_as_many_as_may(stack, served)
            async with browsing(served) as one_more:
                await one_more.until(lambda: one_more.close_code is not None)
            await browsers[-1].tell(do="set_iso", hu=230)
            await browsers[-1].until(lambda: browsers[-1].facts["iso"]["hu"] != ISO_AT_FIRST)
            return browsers[-1].facts["iso"]["hu"]

    assert asyncio.run(browse()) == 230


def test_link_that_is_copied_begins_with_the_view_that_it_was_copied_from(served: WebServer) -> None:
    async def browse() -> tuple[float, float]:
        async with browsing(served) as client:
            await client.tell(do="set_iso", hu=240)
            await client.until(lambda: client.facts and client.facts["iso"]["hu"] == 240)
            await client.tell("link")
            await client.until(lambda: any("link" in note for note in client.notes))
            word = next(note["link"] for note in client.notes if "link" in note)
            await client.tell(do="set_iso", hu=210)  # what happens later is not in the link
            await client.until(lambda: client.facts["iso"]["hu"] == 210)
        begun = []
        for tab in (f"&view={word}", "&view=unknown"):
            async with browsing(served, tab) as other:
                await other.until(lambda: other.facts)  # noqa: B023 (it is called in this turn)
                begun.append(other.facts["iso"]["hu"])
        return begun[0], begun[1]

    assert asyncio.run(browse()) == (240, 200)  # a view begins at 200 HU
