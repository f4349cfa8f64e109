"""The server of a view: one page, one WebSocket a browser, and downloads, on 127.0.0.1 behind a secret."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import ClreconError
from clrecon.system.log import get_logger
from clrecon.viewer.web.admission import LOOPBACK, make_secret, refuse_request
from clrecon.viewer.web.connection import Connection, Session, ignore_line
from clrecon.viewer.web.downloads import Download
from clrecon.viewer.web.listening import bind_port
from clrecon.viewer.web.page import compose_page

if TYPE_CHECKING:
    from aiohttp import web

log = get_logger(__name__)

MOST_BROWSERS = 16
"""At a time; each has a thread and a state of its own."""

_PING_SECONDS = 15.0
"""A browser that does not answer a ping within half of it is gone."""

_MOST_MESSAGE = 1 << 16
_PIECE = 1 << 18
_SECONDS_TO_END = 0.4
_MOST_REASON = 120
"""Bytes of the reason for closing a WebSocket."""

Handler = Callable[[Any], Awaitable[Any]]
OpenSession = Callable[[Callable[[], None]], Session]


class WebServer:
    """The server of a view.

    The port is taken at once, so that one that is not free is said before a scan is read.  Use it in a ``with`` block.

    port: Default: a free one.
    save_as, wrote: See `Connection`.

    address: To be opened in a browser; it holds the secret.
    """

    def __init__(
        self, port: int | None = None, *, save_as: Sequence[str] = (), wrote: Callable[[str], object] = ignore_line
    ) -> None:
        self._save_as, self._wrote = save_as, wrote
        self._listener = bind_port(port)
        self._secret = make_secret()
        self.port: int = self._listener.getsockname()[1]
        self.address = f"http://{LOOPBACK}:{self.port}/?secret={self._secret}"
        self._connections: dict[Connection, Any] = {}
        self._downloads: Path = Path()
        self._end: Callable[[], object] | None = None

    def __enter__(self) -> WebServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()

    def serve(self, open_session: OpenSession, ready: Callable[[Path], object] = lambda folder: None) -> None:
        """Serve until `stop`, or SIGINT (Ctrl-C), SIGTERM or SIGHUP, which end it within a second.

        open_session: Makes the session of a browser, see `Connection`; called in the thread of the server.
        ready: Called once when the page can be opened, with a folder for private files that is removed at the end.
        """
        with tempfile.TemporaryDirectory(prefix="clrecon-") as folder, contextlib.suppress(KeyboardInterrupt):
            self._downloads = Path(folder)
            asyncio.run(self._serve(open_session, ready))

    def stop(self) -> None:
        """End `serve`, from any thread."""
        with contextlib.suppress(RuntimeError):  # it has ended by itself
            if self._end is not None:
                self._end()

    async def _serve(self, open_session: OpenSession, ready: Callable[[Path], object]) -> None:
        from aiohttp import web

        self._open_session = open_session
        silent = logging.getLogger("clrecon.viewer.web.requests")
        silent.propagate = False  # what a stranger sends is no news, and addresses hold the secret
        silent.addHandler(logging.NullHandler())

        @web.middleware
        async def admit(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self._admit(request, handler)

        application = web.Application(middlewares=[admit], logger=silent)
        application.on_response_prepare.append(_add_header)
        application.router.add_get("/", self._send_page, allow_head=False)
        application.router.add_get("/socket", self._connect, allow_head=False)
        application.router.add_get("/saved/{ticket}", self._send_saved, allow_head=False)
        runner = web.AppRunner(
            application, access_log=None, logger=silent, handle_signals=False, shutdown_timeout=_SECONDS_TO_END
        )
        await runner.setup()
        with _ended_by_signals() as ended:
            loop = asyncio.get_running_loop()
            self._end = lambda: loop.call_soon_threadsafe(ended.set)
            await web.SockSite(runner, self._listener).start()
            ready(self._downloads)
            await ended.wait()
            leaving = [asyncio.ensure_future(self._leave(*pair)) for pair in list(self._connections.items())]
            if leaving:
                await asyncio.wait(leaving, timeout=_SECONDS_TO_END)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(runner.cleanup(), 2 * _SECONDS_TO_END)

    async def _leave(self, connection: Connection, socket: Any) -> None:
        await connection.close()
        await socket.close(code=1001, message=b"the server has ended")

    async def _admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse a request that may not come in, before anything else looks at it."""
        from aiohttp import web

        # A ticket is a secret of its own, see `Downloads`.
        given = self._secret if request.path.startswith("/saved/") else request.query.get("secret")
        refused = refuse_request(
            request.headers.get("Host"),
            request.headers.get("Origin"),
            given,
            self._secret,
            by_page=request.path == "/socket",
        )
        if refused is not None:
            return web.Response(status=403, text=refused + "\n")
        try:
            return await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.status}: there is nothing here\n")

    async def _send_page(self, request: web.Request) -> web.Response:
        from aiohttp import web

        page = compose_page(request.headers["Host"])
        return web.Response(
            body=page.content,
            content_type="text/html",
            charset="utf-8",
            headers={"Content-Security-Policy": page.policy},
        )

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        socket = web.WebSocketResponse(heartbeat=_PING_SECONDS, compress=False, max_msg_size=_MOST_MESSAGE)
        await socket.prepare(request)
        if len(self._connections) >= MOST_BROWSERS:
            await socket.close(code=1013, message=f"{MOST_BROWSERS} browsers are open already".encode())
            return socket
        try:
            connection = Connection(
                self._open_session, socket, self._downloads, save_as=self._save_as, wrote=self._wrote, quit=self.stop
            )
        except ClreconError as error:
            await socket.close(code=1011, message=str(error).encode()[:_MOST_REASON])
            return socket
        self._connections[connection] = socket
        try:
            await connection.serve()
        finally:
            self._connections.pop(connection, None)
            await connection.close()
        return socket

    async def _send_saved(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        ticket = request.match_info["ticket"]
        for connection in list(self._connections):
            download = connection.downloads.take(ticket)
            if download is not None:
                try:
                    return await _stream(request, download)
                finally:
                    connection.downloads.drop(download)
        raise web.HTTPNotFound


async def _stream(request: web.Request, download: Download) -> web.StreamResponse:
    """Send a file piece by piece: it may be larger than the memory."""
    from aiohttp import web

    response = web.StreamResponse(headers={"Content-Disposition": f'attachment; filename="{download.path.name}"'})
    response.content_type = "application/octet-stream"
    response.content_length = download.size
    await response.prepare(request)
    with open(download.path, "rb") as file:
        while piece := await asyncio.to_thread(file.read, _PIECE):
            await response.write(piece)
    await response.write_eof()
    return response


async def _add_header(request: web.Request, response: web.StreamResponse) -> None:
    """Add what browsers are told with every answer."""
    response.headers.update(
        {
            "Server": "clrecon",
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
    )


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[asyncio.Event]:
    """An event that is set by the signals that end a program; where asyncio takes none, `KeyboardInterrupt` does it."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    names = () if sys.platform == "win32" else ("SIGINT", "SIGTERM", "SIGHUP")
    before = {}
    for name in names:
        number = getattr(signal, name)
        if signal.getsignal(number) == signal.SIG_IGN:  # under nohup
            continue
        with contextlib.suppress(ValueError, RuntimeError):  # not in the main thread: the caller has its own ways
            before[number] = signal.getsignal(number)
            loop.add_signal_handler(number, ended.set)
    try:
        yield ended
    finally:
        for number, handler in before.items():
            with contextlib.suppress(ValueError, RuntimeError):
                loop.remove_signal_handler(number)
                signal.signal(number, handler)
