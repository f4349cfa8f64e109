"""The server of a view: one page, one WebSocket a browser, and downloads, on 127.0.0.1 behind a secret.

It listens on the loopback address alone, where every user and every program of the machine can reach it, and so can the
pages that a browser has open.  Three checks, each of which a request has to pass:

- *Host* is a loopback name.  A page whose own name was turned to 127.0.0.1 (DNS rebinding) sends that name.  The port
  is not compared: behind a tunnel it is another one.
- *Origin*, which browsers send with what a page asks for, is the server itself.
- The *secret* of 256 random bits is in the address.  There is no cookie: a browser would send it to every other port of
  the machine as well, where servers of other users may listen.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import logging
import os
import re
import secrets
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.exchange.page import hash_code, read_page_code
from clrecon.jobs.view import ViewSettings
from clrecon.jobs.view.inputs import check_view_settings
from clrecon.opencl import Device
from clrecon.operators import take_device
from clrecon.system.arguments import name_parameter
from clrecon.system.log import get_logger
from clrecon.system.progress import Progress
from clrecon.viewer.drawing.saving import check_names
from clrecon.viewer.model.state import ViewState
from clrecon.viewer.session.opening import open_view
from clrecon.viewer.session.session import ViewSession
from clrecon.viewer.web.connection import Connection, Download, ignore_line
from clrecon.viewer.web.start_page import StartDoors, StartRoom

if TYPE_CHECKING:
    from aiohttp import web


_LOOPBACK = "127.0.0.1"

_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)


def make_secret() -> str:
    """Return 256 random bits as text for an address."""
    return secrets.token_urlsafe(32)


def refuse_request(
    host: str | None, origin: str | None, given: str | None, secret: str, *, by_page: bool = False
) -> str | None:
    """Return why a request is refused, without anything of it, or None for one that is let in.

    given, secret: The secret of its address, and the right one.
    by_page: True for what only scripts of pages ask for: a request without an Origin is refused too.
    """
    if host is None or not _OWN_HOST.fullmatch(host):
        return "refused: this server answers to 127.0.0.1 and localhost alone"
    if (origin is not None or by_page) and origin != f"http://{host}":
        return "refused: the request comes from a page of another server"
    if not hmac.compare_digest((given or "").encode("utf-8", "replace"), secret.encode()):
        return "refused: the secret is missing or wrong, open the whole address that clrecon printed"
    return None


class Page(NamedTuple):
    """The document and its Content-Security-Policy, which goes into the header of the answer."""

    content: bytes
    policy: str


_NOTEBOOKS = "http://127.0.0.1:* http://localhost:* vscode-webview:"
_VIEW, _START = ("page", ("page.js", "panes.js")), ("start", ("start.js",))
"""Pages: the name of their document and style, and their scripts."""


def compose_page(host: str, *, start: bool = False, is_framed: bool = False) -> Page:
    """Return the page for a server under `host`, with port: own script and style, pictures, this server alone.

    is_framed: Notebooks of this machine may show it in a frame.
    """
    content, script, style = _compose(*(_START if start else _VIEW))
    frames = _NOTEBOOKS if is_framed else "'none'"
    policy = (
        f"default-src 'none'; script-src '{script}'; style-src '{style}'; img-src blob: data:; connect-src 'self'"
        f" ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors {frames}"
    )
    return Page(content, policy)


@cache
def _compose(name: str, scripts: tuple[str, ...]) -> tuple[bytes, str, str]:
    """Return the document and the hashes of its script and style."""
    parts = "\n".join(read_page_code(each, __package__) for each in scripts)
    script = f"{read_page_code('page_shared.js')}\n(() => {{\n{parts}}})();\n"
    style = "\n".join((read_page_code("page.css"), read_page_code(f"{name}.css", __package__)))
    filled = {"STYLE": style, "SCRIPT": script}
    document = re.sub("@([A-Z]+)@", lambda place: filled[place[1]], read_page_code(f"{name}.html", __package__) + "\n")
    return document.encode(), hash_code(script), hash_code(style)


_LARGEST_PORT = 65535
_WAITING = 64


def bind_port(port: int | None = None) -> socket.socket:
    """Return a socket that listens on a port (default: a free one) of 127.0.0.1; it is closed by the caller."""
    if port is not None and (isinstance(port, bool) or not 1 <= port <= _LARGEST_PORT):
        raise UsageError(f"a port is a whole number from 1 to {_LARGEST_PORT}, not {port!r}")
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if sys.platform == "win32":  # there the other option would let two programs share a port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:  # a server that has just ended does not block its port for a minute
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((_LOOPBACK, port or 0))
        listener.listen(_WAITING)
    except OSError as error:
        listener.close()
        advice = f"name another with {name_parameter('port', 'N')}, or leave it out for a free one"
        if error.errno == errno.EADDRINUSE:
            raise UsageError(f"port {port} of {_LOOPBACK} is taken by another program: {advice}") from error
        if error.errno == errno.EACCES:
            raise UsageError(f"port {port} is reserved by the system: {advice}") from error
        raise UsageError(f"port {port or 'any'} of {_LOOPBACK} cannot be used ({error.strerror}): {advice}") from error
    return listener


def has_screen() -> bool:
    """False where a browser would have to open in the terminal, or nowhere."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_browser(address: str, folder: Path) -> None:
    """Open an address in the user's browser, without waiting for it.

    The browser gets the name of a file in `folder` that leads to the address: other users of the machine can see the
    words with which a program was started, and the address holds the secret.
    """
    with tempfile.NamedTemporaryFile(
        "w", encoding="utf-8", suffix=".html", dir=folder, delete=False
    ) as file:  # only its owner can read it
        shown = escape(address)
        file.write(
            f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={shown}"><a href="{shown}">clrecon</a>\n'
        )

    def start_browser() -> None:
        with contextlib.suppress(Exception):  # the address was printed
            webbrowser.open(Path(file.name).as_uri())

    threading.Thread(target=start_browser, name="clrecon-open-browser", daemon=True).start()


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

_MOST_LINKS = 64
"""Copied views that are kept."""

_MOST_TAB = 64
"""Characters of the name that a page gives its tab."""

Handler = Callable[[Any], Awaitable[Any]]
OpenSession = Callable[[Callable[[], None]], ViewSession]


class WebServer:
    """The server of a view, a context manager; its port is taken at once, its `address` holds the secret.

    start: What the start page drops and opens; None: there is a view from the beginning.
    is_framed: The page may stand in a frame of a notebook of this machine.
    """

    def __init__(
        self,
        port: int | None = None,
        *,
        save_as: Sequence[str] = (),
        wrote: Callable[[str], object] = ignore_line,
        start: StartRoom | None = None,
        is_framed: bool = False,
    ) -> None:
        self.start = start
        self._is_framed = is_framed
        self._save_as, self._wrote = save_as, wrote
        self._listener = bind_port(port)
        self._secret = make_secret()
        self.port: int = self._listener.getsockname()[1]
        self.address = f"http://{_LOOPBACK}:{self.port}/?secret={self._secret}"
        self._connections: dict[Connection, Any] = {}
        self._left: OrderedDict[str, ViewState] = OrderedDict()  # what tabs showed that closed, or load again
        self._linked: OrderedDict[str, ViewState] = OrderedDict()
        self._downloads: Path = Path()
        self._end: Callable[[], object] | None = None

    def __enter__(self) -> WebServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()

    def serve(self, open_session: OpenSession, ready: Callable[[Path], object] = lambda folder: None) -> None:
        """Serve until `stop`, or SIGINT (Ctrl-C), SIGTERM or SIGHUP, which end it within a second.

        open_session: Called in the thread of the server, see `Connection`.
        ready: Called once when the page can be opened, with a folder for private files that is removed at the end.
        """
        with tempfile.TemporaryDirectory(prefix="clrecon-") as folder, contextlib.suppress(KeyboardInterrupt):
            self._downloads = Path(folder)
            if self.start is not None:
                self.start.settle(self._downloads)
            asyncio.run(self._serve(open_session, ready))

    def stop(self) -> None:
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
        if self.start is not None:
            StartDoors(self.start, self._leave_all).add_to(application)
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
            await self._leave_all()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(runner.cleanup(), 2 * _SECONDS_TO_END)

    async def _leave_all(self) -> None:
        leaving = [asyncio.ensure_future(self._leave(*pair)) for pair in list(self._connections.items())]
        self._left.clear()
        self._linked.clear()
        if leaving:
            await asyncio.wait(leaving, timeout=_SECONDS_TO_END)

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
            by_page=request.path == "/socket" or (request.method == "POST" and request.path.startswith("/start/")),
        )
        if refused is not None:
            return web.Response(status=403, text=refused + "\n")
        try:
            return await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.status}: there is nothing here\n")

    async def _send_page(self, request: web.Request) -> web.Response:
        from aiohttp import web

        start = self.start is not None and (self.start.view is None or "start" in request.query)
        page = compose_page(request.headers["Host"], start=start, is_framed=self._is_framed)
        policy = {"Content-Security-Policy": page.policy}
        response = web.Response(body=page.content, content_type="text/html", charset="utf-8", headers=policy)
        response.enable_compression()  # a third of the bytes, for browsers that take it
        return response

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        socket = web.WebSocketResponse(heartbeat=_PING_SECONDS, compress=False, max_msg_size=_MOST_MESSAGE)
        await socket.prepare(request)
        if len(self._connections) >= MOST_BROWSERS:
            await socket.close(code=1013, message=f"{MOST_BROWSERS} browsers are open already".encode())
            return socket
        try:
            connection = Connection(
                self._open_session, socket, self._downloads, save_as=self._save_as, wrote=self._wrote, quit=self.stop,
            )  # fmt: skip
            connection.has_start, connection.link = self.start is not None, self._keep_link
            tab = request.query.get("tab", "")[:_MOST_TAB]
            connection.resume(self._left.get(tab) or self._linked.get(request.query.get("view", "")))
        except ClreconError as error:
            await socket.close(code=1011, message=str(error).encode()[:_MOST_REASON])
            return socket
        self._connections[connection] = socket
        try:
            await connection.serve()
        finally:
            self._connections.pop(connection, None)
            self._keep(tab, connection.state)
            await connection.close()
        return socket

    def _keep(self, tab: str, state: ViewState) -> None:
        """Keep what a tab showed, and forget the tab that left first of too many."""
        if tab:
            self._left[tab] = state
            self._left.move_to_end(tab)
        while len(self._left) > MOST_BROWSERS:
            self._left.popitem(last=False)

    def _keep_link(self, state: ViewState) -> str:
        """Keep a state for pages of a link, and forget the oldest of too many; returns the word of the link."""
        word = secrets.token_urlsafe(12)
        self._linked[word] = state
        while len(self._linked) > _MOST_LINKS:
            self._linked.popitem(last=False)
        return word

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
    response.content_length = download.path.stat().st_size
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


def serve_view(
    inputs: Sequence[str | Path],
    settings: ViewSettings | None = None,
    *,
    port: int | None = None,
    opens: bool = True,
    save_as: Sequence[str] = (),
    wrote: Callable[[str], object] = ignore_line,
    progress: Progress | None = None,
    ready: Callable[[WebServer, Device, list[str]], object] = lambda server, device, warnings: None,
) -> None:
    """Show inputs in browsers, until SIGINT (Ctrl-C), SIGTERM or SIGHUP; without inputs a page where they are dropped.

    save_as: Files that a save writes into the current folder, in place of a download; numbered where they exist.
    wrote: Called with a line for each of these.
    ready: Called with the server, the device and warnings, once the address can be opened.
    """
    settings = settings or ViewSettings()
    check_view_settings(settings)
    check_names(save_as)
    if settings.scan.labels is not None and not inputs:
        raise UsageError(f"{name_parameter('labels')} belongs to an input: name a scan or a mesh too")
    with ExitStack() as stack:
        room = None if inputs else StartRoom(settings)
        server = stack.enter_context(WebServer(port, save_as=save_as, wrote=wrote, start=room))
        notes: list[str] = []
        try:
            view = stack.enter_context(open_view(inputs, settings, progress=progress)) if room is None else None
        except RefusedInputError as error:  # several series, of which none is the one to show
            room, view = StartRoom.of_folder(inputs, settings), None
            if room is None:
                raise
            server.start = room
            notes = [f"{error}; or choose it on the page"]
        if view is None:
            assert room is not None
            device = take_device(settings.scan.device)
            open_session: OpenSession = stack.enter_context(room).open_session
        else:
            first = stack.enter_context(view.session())  # nobody looks through it: it builds kernels meanwhile
            device, notes = view.painter.device, view.said
            open_session = view.session

        def begin(folder: Path) -> None:
            if view is not None:
                first.prepare()
            warnings = list(notes)
            if opens and has_screen():
                open_browser(server.address, folder)
            elif opens:
                warnings.append(
                    "no browser was opened: there is no screen; open the address on a computer that has one"
                )
            ready(server, device, warnings)

        server.serve(open_session, begin)
