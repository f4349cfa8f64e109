"""One browser: commands go to its session; of pictures one at most is under way, and one waits.

Small pictures come while something moves, sharp ones at rest, the views by turns.  Of the facts those are sent that
changed.  The message of a picture is a line of facts as JSON, behind its length (4 bytes, lowest first), and a JPEG.
JPEG has no opacity: the picture lies over the page's ground.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import secrets
import shutil
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError, UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.views.camera import Camera
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger
from clrecon.viewer.drawing.saving import KINDS, free_name
from clrecon.viewer.model.state import SCENE, SLICES, VIEWS, ViewState
from clrecon.viewer.session.choices import to_address
from clrecon.viewer.session.commands import page_words
from clrecon.viewer.session.session import REST_SECONDS

if TYPE_CHECKING:
    from aiohttp import web

    from clrecon.viewer.session.session import ViewSession


class Asked(NamedTuple):
    view: str
    size: tuple[int, int]
    moving: bool


class Pace:
    """What is stale in one browser; `moving` from a `change` to the next `rest`."""

    def __init__(self) -> None:
        self.moving = False
        self._sizes: dict[str, tuple[int, int]] = {}
        # Both in the order in which the views are to be drawn.
        self._stale: dict[str, None] = {}
        self._coarse: dict[str, None] = {}

    def resize(self, sizes: dict[str, tuple[int, int]]) -> None:
        """Take the sizes in pixels of the views that the page shows; a new size makes a view stale."""
        for view in VIEWS:
            size = sizes.get(view)
            if size is None:
                self._sizes.pop(view, None)
                self._stale.pop(view, None)
                self._coarse.pop(view, None)
            elif size != self._sizes.get(view):
                self._sizes[view] = size
                self._stale[view] = None

    def change(self, views: Iterable[str]) -> None:
        """Note that these views show what is no longer so."""
        self.moving = True
        for view in views:
            if view in self._sizes:
                self._stale.setdefault(view)
                self._coarse.pop(view, None)

    def rest(self) -> None:
        """Note that nothing moves any more: what was drawn coarsely is drawn sharp."""
        self.moving = False

    def next(self) -> Asked | None:
        """Return what to draw now, and count it as drawn; None where everything is as it should be."""
        if self._stale:
            return self._take(next(iter(self._stale)))
        if self._coarse and not self.moving:
            return self._take(next(iter(self._coarse)))
        return None

    @property
    def is_done(self) -> bool:
        """True where nothing is left to draw."""
        return not (self._stale or self._coarse or self.moving)

    def instead(self, drawn: Asked) -> Asked | None:
        """Return what to draw in place of a picture that is being drawn: only of a sharp one that is stale again."""
        return self._take(drawn.view) if not drawn.moving and self.moving and drawn.view in self._stale else None

    def _take(self, view: str) -> Asked:
        self._stale.pop(view, None)
        self._coarse.pop(view, None)
        if self.moving:
            self._coarse[view] = None
        return Asked(view, self._sizes[view], self.moving)


_MOVING_QUALITY, _SHARP_QUALITY = 70, 92
"""Of JPEG.  Above 90 the colours are not halved: edges of labels stay where they are."""


def encode_picture(picture: Rendering, ground: tuple[int, int, int], sharp: bool, facts: dict[str, Any]) -> bytes:
    """Return the message of a picture over a ground of red, green and blue; a `sharp` one is in high quality."""
    stream = io.BytesIO()
    quality = {"quality": _SHARP_QUALITY, "subsampling": 0} if sharp else {"quality": _MOVING_QUALITY, "subsampling": 2}
    _lay_over(picture.image, ground).save(stream, "JPEG", optimize=sharp, **quality)
    width, height = picture.size
    head_facts = {**facts, "sharp": sharp, "size": [width, height], "camera": facts_of_camera(picture.camera)}
    head = json.dumps(head_facts, separators=(",", ":"), allow_nan=False).encode()
    return len(head).to_bytes(4, "little") + head + stream.getvalue()


def facts_of_camera(camera: Camera | None) -> dict[str, Any] | None:
    """Return what a page needs to draw points; ``half_height`` in mm, or per mm of distance; None: no camera."""
    if camera is None:
        return None
    right, up, forward = (vector.tolist() for vector in camera.basis())
    return {
        "position": list(camera.position),
        "right": right,
        "up": up,
        "forward": forward,
        "half_height": camera.half_height(),
        "parallel": camera.is_parallel,
    }


def _lay_over(image: NDArray[np.uint8], ground: tuple[int, int, int]) -> Any:
    """Return a picture of Pillow of an image with opacity over a colour, rounded to whole numbers."""
    load_pillow()
    from PIL import Image

    picture = Image.fromarray(image)
    whole = Image.new("RGB", picture.size, ground)
    whole.paste(picture, mask=picture)
    return whole


@dataclass(frozen=True)
class Download:
    """A finished file in a folder of its own; its random `ticket` is part of its address, and a secret of its own."""

    ticket: str
    path: Path


class Downloads:
    """The finished files of one browser; `folder` is one that only the owner of the process can read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._waiting: dict[str, Download] = {}

    def reserve(self, name: str) -> Download:
        """Return a place for a file of this name; it can be fetched after `offer`."""
        ticket = secrets.token_urlsafe(24)
        own_folder = self._folder / ticket
        own_folder.mkdir(mode=0o700)
        return Download(ticket, own_folder / name)

    def offer(self, download: Download) -> None:
        """Let a finished file be fetched, and remove those that were not."""
        for older in list(self._waiting):
            self.drop(self._waiting.pop(older))
        self._waiting[download.ticket] = download

    def take(self, ticket: str) -> Download | None:
        """Return the file of a ticket, which is void from now on."""
        return self._waiting.pop(ticket, None)

    def drop(self, download: Download) -> None:
        shutil.rmtree(download.path.parent, ignore_errors=True)

    def close(self) -> None:
        for ticket in list(self._waiting):
            self.drop(self._waiting.pop(ticket))


log = get_logger(__name__)

LARGEST_SIDE = 2048
"""Pixels of a picture; larger views get one with fewer pixels."""

_MOST_WAITING = 256
"""Messages of a browser that wait; more are left in the connection."""

_SAID_ONCE = ("pick", "probe", "measure", "undone")
"""What the answer to a command holds beside the facts."""


def ignore_line(line: str) -> None:
    """Drop a line that is said."""


class Connection:
    """One browser.

    open_session: Makes its session; called with a function that the session calls when something happened.
    save_as: Files on this computer that it may have written; numbered where they exist.
    wrote: Called with a line for each of these.
    quit: Ends the server.
    link: Keeps a state, and returns the word by which another page begins with it.
    has_start: There is a start page, where something else can be opened.
    """

    def __init__(
        self,
        open_session: Callable[[Callable[[], None]], ViewSession],
        socket: web.WebSocketResponse,
        folder: Path,
        *,
        save_as: Sequence[str] = (),
        wrote: Callable[[str], object] = ignore_line,
        quit: Callable[[], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._socket = socket
        self._session = open_session(lambda: self._later(self._hear))
        self.downloads = Downloads(folder)
        self._save_as = tuple(save_as)
        self._wrote, self._quit = wrote, quit
        self.has_start = False
        self.link: Callable[[ViewState], str] = lambda state: ""
        self._pace = Pace()
        self._keys: dict[str, Any] = {}
        self._ground = (0, 0, 0)
        self._number = 0
        self._drawing: Asked | None = None
        self._ready: bytes | None = None
        self._under_way = False
        self._notes: list[dict[str, Any]] = []
        self._told: dict[str, str] = {}
        self._resting: asyncio.TimerHandle | None = None
        self._wake = asyncio.Event()
        self._waiting: asyncio.Queue[Any] = asyncio.Queue(_MOST_WAITING)
        # Commands wait for the device where they ask what is seen at a pixel: not in the thread of the server.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="view-commands")
        self._closed = False

    @property
    def state(self) -> ViewState:
        return self._session.model.state

    def resume(self, state: ViewState | None) -> None:
        """Go on with what the browser showed before it loaded the page again; None: it begins."""
        if state is not None:
            self._session.resume(state)

    async def serve(self) -> None:
        """Serve the browser until it leaves."""
        from aiohttp import WSMsgType

        model = self._session.model
        kinds = [kind for kind in ("mesh", "cloud", "volume", "picture", "view") if model.scans or kind != "volume"]
        fixed = {
            **page_words(),
            "formats": {kind: list(KINDS[kind]) for kind in kinds},
            "save_as": self._save_as,
            "has_start": self.has_start,
            "scans": [scan.describe_scan(*model.iso_range) for scan in model.scans],
        }
        await self._socket.send_str(json.dumps({"fixed": fixed}))
        tasks = [asyncio.ensure_future(work()) for work in (self._write, self._command)]
        try:
            self._look_again()
            async for message in self._socket:
                if message.type != WSMsgType.TEXT:
                    break
                try:
                    await self._take(json.loads(message.data))
                except UsageError as error:
                    self._say(error=str(error))
                except (ValueError, RecursionError):
                    self._say(error="this message cannot be read, it is no JSON: load the page again")
        finally:
            for task in tasks:
                task.cancel()

    async def close(self) -> None:
        """Close the session, whose work is cancelled, without waiting in the thread of the server."""
        if self._closed:
            return
        self._closed = True
        self.downloads.close()
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._resting is not None:
            self._resting.cancel()
        ended = asyncio.Event()

        def end() -> None:
            try:
                self._session.close()
            finally:
                with contextlib.suppress(RuntimeError):  # the server has ended meanwhile
                    self._loop.call_soon_threadsafe(ended.set)

        threading.Thread(target=end, name="view-close", daemon=True).start()
        await ended.wait()

    # From the browser

    async def _take(self, message: Any) -> None:
        """Take a message: what concerns the connection at once, commands and files one after the other."""
        kind = message.get("type") if isinstance(message, Mapping) else None
        if kind == "shown":
            self._under_way = False
            self._wake.set()
            self._draw()
        elif kind == "layout":
            self._lay_out(message.get("sizes"), message.get("ground"))
        elif kind == "quit":
            self._quit()
        elif kind == "thumbnails":
            self._session.draw_modes(self._send_thumbnail)
        elif kind == "link":
            self._say(link=self.link(self.state))
        elif kind in ("command", "save"):
            await self._waiting.put(message)
        else:
            raise UsageError("this message cannot be read, its type is unknown: load the page again")

    def _lay_out(self, sizes: Any, ground: Any) -> None:
        """Take the sizes of the views of the page, and the colour behind them."""
        color = _check_color(ground)
        if not isinstance(sizes, Mapping):
            raise UsageError(f"the sizes of the views go by their names, not {sizes!r:.60}")
        fitting = {view: _fit_size(size) for view, size in sizes.items() if view in VIEWS}
        if color != self._ground:
            self._ground = color
            self._keys.clear()
        if SCENE in fitting:
            self._session.fit(fitting[SCENE])
        self._pace.resize(fitting)
        self._look_again()

    async def _command(self) -> None:
        while True:
            message = await self._waiting.get()
            try:
                if message["type"] == "save":
                    self._save(message.get("format"), _fit_size(message.get("size") or (1024, 1024)))
                    continue
                command = {key: value for key, value in message.items() if key != "type"}
                if command.get("do") == "save":  # with a path on this computer
                    raise UsageError("the command save is not for browsers: they get a file as a download")
                answer = await self._loop.run_in_executor(self._thread, self._session.do, command)
            except ClreconError as error:
                self._say(error=str(error))
            except Exception as error:  # a fault of ours: the other browsers, and this one, go on
                log.exception("a command failed")
                self._say(error=f"{type(error).__name__}: a fault of clrecon, please report it")
            else:
                once = {name: answer.pop(name) for name in _SAID_ONCE if name in answer}
                if once:
                    self._say(**once)
            self._look_again()

    def _save(self, format: Any, size: tuple[int, int]) -> None:
        """Let a file be made, and offer it when it is finished; without a format those of `save_as`."""
        if format is None:
            self._save_here(list(self._save_as), size)
            return
        if not isinstance(format, str) or not format.startswith(".") or not format[1:].replace(".", "").isalnum():
            raise UsageError("a format is an extension such as .stl")
        download = self.downloads.reserve(f"view{format}")

        def finish_file(lines: list[str]) -> None:
            self._later(self._offer, download)

        try:
            self._session.save(download.path, finish_file, size)
        except ClreconError:
            self.downloads.drop(download)
            raise

    def _save_here(self, names: list[str], size: tuple[int, int]) -> None:
        """Write files on this computer, one after the other: the session takes one at a time."""
        if not names:
            return

        def written(lines: list[str]) -> None:
            for line in lines:
                self._wrote(line)
            self._say(written="; ".join(lines))
            self._save_here(names[1:], size)

        try:
            self._session.save(free_name(names[0]), lambda lines: self._later(written, lines), size)
        except ClreconError as error:
            self._say(error=str(error))

    def _offer(self, download: Any) -> None:
        self.downloads.offer(download)
        self._say(saved={"ticket": download.ticket, "name": download.path.name, "bytes": download.path.stat().st_size})

    # To the browser

    def _say(self, **note: Any) -> None:
        """Send a note of its own, beside the facts."""
        if len(self._notes) < _MOST_WAITING:
            self._notes.append(note)
        self._wake.set()

    def _send_thumbnail(self, mode: str, picture: Rendering) -> None:
        address = to_address(_lay_over(picture.image, (0, 0, 0)))
        self._later(partial(self._say, thumbnail={"mode": mode, "address": address}))

    def _hear(self) -> None:
        """Take the news of the session: work began or ended, parts were found, something failed."""
        error = self._session.facts()["error"]
        if error is not None:  # it may be that of a picture, which never comes then
            self._session.dismiss()
            self._drawing = None
            self._say(error=error)
        self._look_again()

    def _look_again(self) -> None:
        keys = {view: self._session.picture_key(view) for view in VIEWS}
        changed = [view for view, key in keys.items() if self._keys.get(view, self) != key]
        if changed:
            self._keys = keys
            self._pace.change(changed)
            if self._resting is not None:
                self._resting.cancel()
            self._resting = self._loop.call_later(REST_SECONDS, self._rest)
        self._wake.set()
        self._draw()

    def _rest(self) -> None:
        self._pace.rest()
        self._session.rest()
        self._wake.set()
        self._draw()

    def _draw(self) -> None:
        """Ask for the next picture, if none is being drawn or waits to be sent."""
        if self._closed or self._ready is not None:
            return
        # Of one view the session gives a sharp picture up for the next one.
        asked = self._pace.next() if self._drawing is None else self._pace.instead(self._drawing)
        if asked is None:
            return
        self._drawing = asked

        def then(picture: Rendering) -> None:
            self._number += 1
            facts = {"view": asked.view, "number": self._number, "ms": float(picture.report.get("ms", 0.0))}
            is_dark = asked.view == SCENE and self._session.model.modes[self.state.mode].is_dark
            message = encode_picture(picture, (0, 0, 0) if is_dark else self._ground, not asked.moving, facts)
            self._later(self._deliver, asked, message)

        try:
            if asked.view == SCENE:
                self._session.picture(asked.size, asked.moving, then)
            elif asked.view in SLICES:
                self._session.slice(asked.view, asked.size, then)
            else:
                self._session.curve_picture(asked.size, then)
        except ClreconError as error:
            self._drawing = None
            self._say(error=str(error))

    def _deliver(self, asked: Asked, message: bytes) -> None:
        if self._drawing is asked:
            self._drawing = None
        self._ready = message
        self._wake.set()

    async def _write(self) -> None:
        """Send what there is to send; this is the only place that does."""
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                facts = {name: json.dumps(fact, separators=(",", ":")) for name, fact in self._facts().items()}
                if news := [f'"{name}":{text}' for name, text in facts.items() if self._told.get(name) != text]:
                    self._told = facts
                    await self._socket.send_str(f'{{"facts":{{{",".join(news)}}}}}')
                while self._notes:
                    await self._socket.send_str(json.dumps(self._notes.pop(0)))
                if self._ready is not None and not self._under_way:
                    message = self._ready
                    self._ready = None
                    self._under_way = True
                    await self._socket.send_bytes(message)
                    self._draw()
        except (ConnectionError, RuntimeError):  # the browser has left
            await self._socket.close()

    def _facts(self) -> dict[str, Any]:
        """Return what the page shows: of the last picture the device alone, as the pictures say the rest themselves."""
        facts = self._session.facts()
        facts["device"] = facts.pop("timing").get("device")
        facts["settled"] = self._pace.is_done and not (self._drawing or self._ready or self._under_way)
        return facts

    def _later(self, function: Callable[..., None], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # it has ended meanwhile
            self._loop.call_soon_threadsafe(self._if_open, function, *arguments)

    def _if_open(self, function: Callable[..., None], *arguments: Any) -> None:
        if not self._closed:
            function(*arguments)


def _fit_size(size: Any) -> tuple[int, int]:
    """Return a size that a picture may have, of the same shape."""
    try:
        width, height = (min(max(1.0, float(value)), 1e6) for value in size)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"a size is width and height in pixels, not {size!r:.60}") from error
    share = min(1.0, LARGEST_SIDE / max(width, height))
    return max(1, round(share * width)), max(1, round(share * height))


def _check_color(ground: Any) -> tuple[int, int, int]:
    try:
        red, green, blue = (min(255, max(0, int(value))) for value in ground)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"the ground of the views is red, green and blue from 0 to 255, not {ground!r:.60}") from error
    return red, green, blue
