"""The start page: what may be dropped, where it goes, what is listed of it, and that it is removed."""

from __future__ import annotations

import asyncio
import base64
import http.client
import io
import json
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
import view_scenes as scenes
from browser import severe_lines, wait_for
from dicom_series import Plan, write_series
from PIL import Image
from refusals import refused
from web_views import PATIENCE, browsing, get_path, secret_of, serving

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.view import ViewSettings
from clrecon.reading.grids.write_volume import write_volume
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.saved_view import encode_view
from clrecon.viewer.session.choices import draw_thumbnail
from clrecon.viewer.web.server import WebServer
from clrecon.viewer.web.start_page import Limits, StartRoom

SMALL = Limits(total_bytes=1000, files=3)


class Dropper:
    """A browser that drops files, one request after the other."""

    def __init__(self, server: WebServer, room: StartRoom) -> None:
        self.server, self.room = server, room

    def ask(self, name: str, body: bytes = b"", *, origin: str | None = "own", **query: Any) -> tuple[int, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=PATIENCE)
        host = f"127.0.0.1:{self.server.port}"
        headers = {"Host": host} if origin is None else {"Origin": f"http://{host}" if origin == "own" else origin}
        address = f"/start/{name}?{urlencode({'secret': secret_of(self.server), **query})}"
        connection.request("POST", address, body, headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, json.loads(text) if text.startswith("{") else text

    def begin(self) -> int:
        return int(self.ask("begin")[1]["drop"])

    def drop(self, *paths: Path) -> list[dict[str, Any]]:
        """Drop files and folders, and return what is listed of them."""
        drop = self.begin()
        for path in paths:
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                status, told = self.ask("upload", file.read_bytes(), drop=drop, path=str(file.relative_to(path.parent)))
                assert (status, told) == (200, {})
        return list(self.ask("list")[1]["choices"])

    def files(self) -> list[Path]:
        folder = self.room.folder
        assert folder is not None
        return [path for path in folder.rglob("*") if path.is_file()]


@pytest.fixture
def open_room() -> Iterator[Any]:
    """A function that opens the start page of a server, in the end closed."""
    rooms = []

    def make(limits: Limits = Limits(), settings: ViewSettings | None = None) -> StartRoom:  # noqa: B008
        rooms.append(StartRoom(settings or ViewSettings(), limits))
        return rooms[-1]

    yield make
    for room in rooms:
        room.close()


@pytest.fixture
def dropper(open_room) -> Iterator[Dropper]:
    """A browser at the start page of a server that takes three files of 1000 bytes in all."""
    room = open_room(limits=SMALL)
    with serving(room.open_session, start=room) as server:
        yield Dropper(server, room)


@pytest.fixture
def large_dropper(open_room) -> Iterator[Dropper]:
    """A browser at the start page of a server with the usual limits."""
    room = open_room()
    with serving(room.open_session, start=room) as server:
        yield Dropper(server, room)


def test_server_without_a_view_sends_the_start_page_with_its_policy(dropper: Dropper) -> None:
    status, headers, text = get_path(dropper.server, f"/?secret={secret_of(dropper.server)}")

    assert status == 200
    assert 'id="drop"' in text
    assert "default-src 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize("origin", [None, "http://evil.example"])
@pytest.mark.parametrize("name", ["begin", "upload", "list", "open"])
def test_request_that_no_page_of_the_server_makes_is_refused(dropper: Dropper, name: str, origin: str | None) -> None:
    status, _ = dropper.ask(name, b"x", origin=origin)

    assert status == 403


def test_request_without_the_secret_is_refused(dropper: Dropper) -> None:
    status, _ = dropper.ask("begin", secret="wrong")

    assert status == 403


def test_dropped_file_lies_in_the_private_folder_under_its_name(dropper: Dropper) -> None:
    drop = dropper.begin()

    dropper.ask("upload", b"content", drop=drop, path="CT/scan 1.dcm")

    (file,) = dropper.files()
    assert file.parts[-2:] == ("CT", "scan 1.dcm")
    assert file.read_bytes() == b"content"


OUTSIDE = {
    "parent": "../x.stl",
    "parent within": "CT/../../x.stl",
    "from the root": "/tmp/x.stl",
    "backslashes": "..\\x.stl",
    "drive": "C:x.stl",
    "no name": "",
    "this folder": "./x.stl",
    "end of line": "x\n.stl",
    "zero": "x\0.stl",
    "long name": "x" * 201,  # letters, up to 200
    "deep folders": "/".join("x" * 17),  # up to 16
}


@pytest.mark.parametrize("path", OUTSIDE.values(), ids=OUTSIDE)
def test_name_that_leads_out_of_the_folder_or_is_none_is_refused_and_nothing_is_written(
    dropper: Dropper, path: str
) -> None:
    drop = dropper.begin()

    status, told = dropper.ask("upload", b"content", drop=drop, path=path)

    assert (status, list(told)) == (422, ["error"])
    assert dropper.files() == []


def test_file_with_which_a_drop_is_too_large_is_refused_and_removed(dropper: Dropper) -> None:
    drop = dropper.begin()
    dropper.ask("upload", b"x" * (SMALL.total_bytes - 1), drop=drop, path="one")

    status, told = dropper.ask("upload", b"xx", drop=drop, path="two")

    assert status == 422
    assert "clrecon view FOLDER" in told["error"]
    assert [file.name for file in dropper.files()] == ["one"]


def test_file_beyond_the_most_files_is_refused(dropper: Dropper) -> None:
    drop = dropper.begin()
    answers = [dropper.ask("upload", b"x", drop=drop, path=f"file {number}") for number in range(SMALL.files + 1)]

    assert [status for status, _ in answers] == [200] * SMALL.files + [422]


def test_second_file_of_a_name_is_refused_and_leaves_the_first(dropper: Dropper) -> None:
    drop = dropper.begin()
    dropper.ask("upload", b"first", drop=drop, path="one")

    status, _ = dropper.ask("upload", b"second", drop=drop, path="one")

    assert status == 422
    assert [file.read_bytes() for file in dropper.files()] == [b"first"]


def test_new_drop_removes_what_was_dropped_before_and_takes_its_files_no_more(dropper: Dropper) -> None:
    old = dropper.begin()
    dropper.ask("upload", b"x", drop=old, path="one")

    dropper.begin()

    assert dropper.files() == []
    status, _ = dropper.ask("upload", b"x", drop=old, path="two")
    assert status == 422


def test_upload_that_breaks_off_leaves_no_file(dropper: Dropper) -> None:
    drop, host = dropper.begin(), f"127.0.0.1:{dropper.server.port}"
    query = urlencode({"secret": secret_of(dropper.server), "drop": drop, "path": "half"})
    with socket.create_connection(("127.0.0.1", dropper.server.port)) as browser:
        browser.sendall(f"POST /start/upload?{query} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n".encode())
        browser.sendall(b"Content-Length: 500\r\n\r\n" + b"x" * 100)
        end = time.monotonic() + PATIENCE
        while not dropper.files():
            assert time.monotonic() < end
            time.sleep(0.01)

    while dropper.files():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_dropped_files_are_removed_when_the_server_ends(open_room) -> None:
    room = open_room()
    with serving(room.open_session, start=room) as server:
        dropper = Dropper(server, room)
        dropper.ask("upload", b"x", drop=dropper.begin(), path="one")
        assert len(dropper.files()) == 1

    assert not room.folder.exists()


def test_series_is_listed_with_its_size_and_a_picture(large_dropper: Dropper, tmp_path: Path) -> None:
    write_series(tmp_path / "CT", Plan(shape=(7, 30, 40), pixel_spacing=(0.7, 0.5), gap=1.25))

    (choice,) = large_dropper.drop(tmp_path / "CT")

    assert choice["words"] == "7 slices · 40 × 30 · 0.5 × 0.7 × 1.25 mm"
    assert choice["thumbnail"].startswith("data:image/jpeg;base64,")
    assert (choice["button"], choice["is_refused"]) == ("Open", False)


FLAT = {
    "low contrast below the window": np.linspace(-1000, -900, 1600),
    "above the window": np.linspace(900, 1000, 1600),
    "one value": np.full(1600, -700),
    "one value of 0": np.zeros(1600),
}


@pytest.mark.parametrize("values", FLAT.values(), ids=FLAT)
def test_thumbnail_of_a_flat_scan_is_neither_black_nor_white(values: np.ndarray) -> None:
    slices = np.tile(values.reshape(40, 40).astype(np.int16), (3, 1, 1))

    picture = draw_thumbnail(Volume(slices, np.eye(4)))

    grey = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2]))))
    assert 100 < grey.mean() < 155  # of 0 to 255: around the middle


def test_thumbnail_of_a_few_voxels_of_a_label_beside_the_middle_slice_shows_them() -> None:
    slices = np.zeros((5, 40, 40), np.uint8)
    slices[1, 20:22, 20:22] = 3

    picture = draw_thumbnail(Volume(slices, np.eye(4)))

    grey = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2])))).astype(int)
    assert grey[84, 84] - grey[10, 10] > 100  # four pixels of the picture to a voxel


def test_thumbnail_of_soft_tissue_keeps_its_window() -> None:
    slices = np.full((3, 40, 40), -1000, np.int16)
    slices[:, :, 20:] = 50

    picture = draw_thumbnail(Volume(slices, np.eye(4)))

    grey = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2]))))
    assert abs(int(grey[20, 10])) < 8 and abs(int(grey[20, 150]) - 127) < 8  # 50 HU of -150 to 250; JPEG


def test_series_with_a_gap_is_offered_with_the_gap_and_the_reason(large_dropper: Dropper, tmp_path: Path) -> None:
    write_series(tmp_path / "CT", Plan(shape=(9, 30, 40), leave_out=(4,)))

    (choice,) = large_dropper.drop(tmp_path / "CT")

    assert choice["button"] == "Open with gaps"
    assert "missing" in choice["verdict"]


def test_zip_of_a_series_is_listed_as_the_series(large_dropper: Dropper, tmp_path: Path) -> None:
    write_series(tmp_path / "CT", Plan(shape=(7, 30, 40)))
    packed = Path(shutil.make_archive(str(tmp_path / "scan"), "zip", tmp_path / "CT"))

    (choice,) = large_dropper.drop(packed)

    assert choice["words"].startswith("7 slices")


def test_choice_that_is_refused_cannot_be_opened(large_dropper: Dropper, tmp_path: Path) -> None:
    (tmp_path / "bad.nii.gz").write_bytes(b"\x1f\x8b no grid at all")
    (choice,) = large_dropper.drop(tmp_path / "bad.nii.gz")
    assert choice["is_refused"]

    status, told = large_dropper.ask("open", choice=0)

    assert status == 422
    assert "bad.nii.gz" in told["error"]


@pytest.mark.parametrize("choice", ["1", "-1", "x", ""])
def test_choice_that_there_is_not_is_refused(large_dropper: Dropper, choice: str) -> None:
    large_dropper.begin()

    status, _ = large_dropper.ask("open", choice=choice)

    assert status == 422


# Saved views that wait for their scan


@pytest.fixture
def saved_view(tmp_path: Path) -> Path:
    """A view of the scan of `scenes` at 321 HU."""
    model = ViewModel(show_objects([scenes.make_scan()]))
    model.set_iso(321.0)
    path = tmp_path / "shown.view.json"
    path.write_bytes(encode_view(model.state, model.objects))
    return path


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    write_volume(scenes.make_scan(), tmp_path / "scan.nii.gz")
    return tmp_path / "scan.nii.gz"


@pytest.fixture
def waiting_dropper(open_room, saved_view: Path, device: Any) -> Iterator[Dropper]:
    """A browser at the start page of a server at which a saved view waits."""
    room = open_room(settings=ViewSettings(scan=MeshSettings(device=device.index), state=str(saved_view)))
    with serving(room.open_session, start=room) as server:
        yield Dropper(server, room)


def shown_iso(server: WebServer) -> float:
    """The iso value, HU, that a browser is told by its socket."""

    async def browse() -> float:
        async with browsing(server) as client:
            await client.until(lambda: client.facts)
            return float(client.facts["iso"]["hu"])

    return asyncio.run(browse())


@pytest.mark.opencl
def test_saved_view_that_waits_is_shown_of_the_scan_that_is_dropped(waiting_dropper: Dropper, scan: Path) -> None:
    query = f"secret={secret_of(waiting_dropper.server)}"
    words = json.loads(get_path(waiting_dropper.server, f"/start/progress?{query}")[2])["waiting"]
    waiting_dropper.drop(scan)

    assert waiting_dropper.ask("open", choice=0) == (200, {})

    assert "22 slices of 44 x 40" in words  # scenes.SHAPE
    assert shown_iso(waiting_dropper.server) == 321.0


@pytest.mark.opencl
def test_scan_to_which_the_waiting_view_does_not_belong_is_refused_and_opens_without_it(
    waiting_dropper: Dropper, tmp_path: Path
) -> None:
    write_series(tmp_path / "CT", Plan(shape=(7, 30, 40)))
    waiting_dropper.drop(tmp_path / "CT")

    status, told = waiting_dropper.ask("open", choice=0)
    waiting_dropper.ask("forget")

    assert status == 422
    assert "22 slices of 44 x 40" in told["error"] and "7 slices of 40 x 30" in told["error"]
    assert waiting_dropper.ask("open", choice=0) == (200, {})


@pytest.mark.opencl
def test_saved_view_that_is_dropped_alone_waits_for_the_scan_of_the_next_drop(
    open_room, device: Any, saved_view: Path, scan: Path
) -> None:
    room = open_room(settings=ViewSettings(scan=MeshSettings(device=device.index)))
    with serving(room.open_session, start=room) as server:
        dropper = Dropper(server, room)
        assert dropper.drop(saved_view) == []
        dropper.drop(scan)
        assert dropper.ask("open", choice=0) == (200, {})

        assert shown_iso(server) == 321.0


def test_saved_view_of_two_inputs_is_refused_at_the_start_with_their_kinds(open_room, tmp_path: Path) -> None:
    model = ViewModel(show_objects([scenes.make_scan(), scenes.make_mesh()]))
    (tmp_path / "two.view.json").write_bytes(encode_view(model.state, model.objects))

    with refused(UsageError, "scan", "mesh"):
        open_room(settings=ViewSettings(state=str(tmp_path / "two.view.json")))


@pytest.mark.slow
@pytest.mark.opencl
def test_file_that_is_chosen_on_the_page_is_listed_opened_and_another_one_after_it(
    view_browser, device, open_room, tmp_path: Path
) -> None:
    write_volume(scenes.make_scan(), tmp_path / "scan.nii.gz")
    room = open_room(settings=ViewSettings(scan=MeshSettings(device=device.index)))
    with serving(room.open_session, start=room) as server:
        page = view_browser
        severe_lines(page)
        page.get(server.address)
        page.find_element("id", "pickfiles").send_keys(str(tmp_path / "scan.nii.gz"))
        wait_for(page, "return document.querySelector('#choices button')").click()
        wait_for(page, "return window.clrecon && clrecon.facts && clrecon.pictures > 0")
        shown = page.execute_script("return clrecon.facts.iso")

        page.find_element("id", "another").click()
        wait_for(page, "return document.getElementById('drop')")
        assert severe_lines(page) == []

    assert (shown["low"], shown["high"]) == (-800, 1000)  # HU of the scan
    assert np.isfinite(shown["hu"])
