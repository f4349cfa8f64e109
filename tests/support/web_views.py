"""Views in a browser without a browser and without a device: a painter that paints its state, and a client."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import json
import threading
from collections.abc import AsyncIterator, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import view_scenes as scenes
from PIL import Image

from clrecon.errors import NoSurfaceError
from clrecon.rendering import Rendering
from clrecon.system.color_scale import ColorScale
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.state import Pick
from clrecon.viewer.session.session import ViewSession
from clrecon.viewer.web.server import WebServer

PATIENCE = 120.0
"""Seconds until something has to have happened that takes a moment."""


class FakePainter:
    """Pictures of one grey, which is the iso value; `drawn` has the view and the sharpness of each.

    opacity: Of all pixels, 0 to 255.
    """

    device = SimpleNamespace(label="no device", memory_bytes=1 << 40)
    knows_table = True

    def __init__(self) -> None:
        self.drawn: list[tuple[str, bool]] = []
        self.fault: Exception | None = None
        self.is_fitted, self.has_bone = False, True
        self.opacity = 255

    def _paint(self, state: Any, size: Any, view: str, sharp: bool) -> Rendering:
        self.drawn.append((view, sharp))
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault
        width, height = size
        image = np.full((height, width, 4), self.opacity, np.uint8)
        image[..., :3] = round(state.iso_value) % 256
        empty = np.full((height, width), np.nan, np.float32)
        return Rendering(image, empty, empty, state.camera, None, view, {"ms": 1.0, "sharp": sharp, "warnings": []})

    def picture(self, state: Any, size: Any, *, sharp: bool = True, share: float = 1.0, cancelled: Any = None) -> Any:
        return self._paint(state, size, "scene", sharp)

    def slice(self, state: Any, plane: str, size: Any) -> Rendering:
        return self._paint(state, size, plane, True)

    def curve_picture(self, state: Any, size: Any) -> Rendering:
        return self._paint(state, size, "curve", True)

    def pick(self, state: Any, size: Any, x: float, y: float) -> Pick:
        return Pick(point=(x, y, 0.0), object=1, part="1", hu=50.0)

    def pick_slice(self, state: Any, plane: str, size: Any, x: float, y: float) -> Pick:
        return Pick(point=(x, y, 1.0), hu=60.0)

    def has_parts(self, state: Any) -> bool:
        return True

    def has_fits(self, state: Any) -> bool:
        return self.is_fitted

    def fit_scans(self, state: Any, progress: Any = None) -> list[str]:
        if not self.has_bone:
            raise NoSurfaceError("no walls of bone")
        self.is_fitted = True
        return ["fitted"]

    def find_offset(self, state: Any) -> None:
        pass

    def find_fit_scale(self, state: Any) -> ColorScale | None:
        return ColorScale(2.0, signed=False) if state.color_by else None

    def prepare(self, progress: Any = None) -> None:
        pass

    def make_coarse(self, cancelled: Any = None) -> None:
        pass

    def find_parts(self, state: Any, progress: Any = None) -> list[Any]:
        return []


class Views:
    """The views of a server: one painter, and the sessions that were opened."""

    def __init__(self) -> None:
        self.painter = FakePainter()
        self.objects = show_objects([scenes.make_scan()])
        self.sessions: list[Any] = []

    def open(self, on_change: Any) -> ViewSession:
        session = ViewSession(self.objects, self.painter, iso_value=200.0, on_change=on_change)  # type: ignore[arg-type]
        self.sessions.append(session)
        return session


@contextlib.contextmanager
def serving(open_session: Any, port: int | None = None, **given: Any) -> Iterator[WebServer]:
    """A server in a thread; it has ended when the block is left."""
    with WebServer(port, **given) as server:
        ready = threading.Event()
        thread = threading.Thread(target=server.serve, args=(open_session, lambda folder: ready.set()))
        thread.start()
        try:
            assert ready.wait(PATIENCE)
            yield server
        finally:
            server.stop()
            thread.join(PATIENCE)
            assert not thread.is_alive()


class Client:
    """A browser that keeps what it was told.

    facts: The latest.
    told: Names of the facts in each message.
    fixed: What does not change while it is connected.
    shows: True: it says that it has shown each picture.
    """

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.facts: dict[str, Any] = {}
        self.told: list[set[str]] = []
        self.fixed: dict[str, Any] = {}
        self.notes: list[dict[str, Any]] = []
        self.pictures: list[tuple[dict[str, Any], Image.Image]] = []
        self.shows = True
        self.close_code: int | None = None
        self._news = asyncio.Event()
        self._reader = asyncio.ensure_future(self._read())

    @property
    def is_sharp(self) -> bool:
        """Whether there is a picture, and the latest is sharp."""
        return bool(self.pictures) and bool(self.pictures[-1][0]["sharp"])

    async def tell(self, type: str = "command", **message: Any) -> None:
        await self.socket.send_str(json.dumps({"type": type, **message}))

    async def lay_out(self, **sizes: Any) -> None:
        await self.tell("layout", sizes=sizes or {"scene": [120, 90]}, ground=[10, 20, 30])

    async def until(self, holds: Any) -> None:
        """Wait until something holds, of the messages or of what the server does without one."""
        end = asyncio.get_running_loop().time() + PATIENCE
        while not holds():
            assert asyncio.get_running_loop().time() < end, "what a test waits for has not happened"
            self._news.clear()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._news.wait(), 0.05)

    async def _read(self) -> None:
        async for message in self.socket:
            if isinstance(message.data, bytes):
                length = int.from_bytes(message.data[:4], "little")
                head = json.loads(message.data[4 : 4 + length])
                self.pictures.append((head, Image.open(io.BytesIO(message.data[4 + length :])).convert("RGB")))
                if self.shows:
                    await self.tell("shown", number=head["number"])
            else:
                told = json.loads(message.data)
                self.told.append(set(told.get("facts", ())))
                self.facts |= told.pop("facts", {})
                self.fixed = told.pop("fixed", self.fixed)
                self.notes += [told] if told else []
            self._news.set()
        self.close_code = self.socket.close_code
        self._news.set()


@contextlib.asynccontextmanager
async def browsing(server: WebServer, tab: str = "") -> AsyncIterator[Client]:
    """A client that is connected as the page is, in a tab of the browser."""
    import aiohttp

    base = f"http://127.0.0.1:{server.port}"
    secret = server.address.partition("?")[2]
    async with (
        aiohttp.ClientSession() as web,
        web.ws_connect(f"{base}/socket?{secret}&tab={tab}", headers={"Origin": base}) as socket,
    ):
        yield Client(socket)


def get_path(running: WebServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], str]:
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
    """The secret in the address of a server."""
    return running.address.partition("secret=")[2]
