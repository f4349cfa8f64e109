"""The start page of a view without inputs: files are dropped into a private folder, and what they hold is opened.

Uploads are bounded in bytes, files and depth of folders, and a new drop takes the place of the last one.  Everything is
removed when the server ends.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Awaitable, Callable, Sequence
from contextlib import ExitStack
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import ClreconError, UsageError
from clrecon.jobs.view import ViewSettings
from clrecon.reading.common.selection import Selection
from clrecon.system.base_classes import Closing
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger
from clrecon.system.progress import ignore_progress
from clrecon.system.text import escape_text
from clrecon.viewer.model.saved_view import VIEW_FORMAT, read_view, say_source
from clrecon.viewer.session.choices import Choice, checked_choice, find_choices, find_saved_view
from clrecon.viewer.session.opening import OpenedView, open_view
from clrecon.viewer.session.session import ViewSession

if TYPE_CHECKING:
    from aiohttp import web

log = get_logger(__name__)

_PIECE = 1 << 20

_LONGEST_NAME, _DEEPEST = 200, 16
"""Bytes of a name, and names of a path, that is dropped."""

_SPARE = 1 << 29
"""Bytes of the disk that uploads leave free."""


@dataclass(frozen=True)
class Limits:
    """What may be dropped at a time."""

    total_bytes: int = 4 << 30
    files: int = 20_000


class StartRoom(Closing):
    """What was dropped, what can be opened of it, and the view that was opened.

    settings: With which views begin; the choice adds the part that is read.  Their saved view waits for its scan.
    """

    def __init__(self, settings: ViewSettings, limits: Limits = Limits()) -> None:  # noqa: B008 (it is frozen)
        self.settings, self.limits = replace(settings, state=None), limits
        self._waiting: str | None = None
        self.waiting = ""  # words of the saved view that waits for its scan
        if settings.state is not None:
            self._wait_with(settings.state)
        self.view: OpenedView | None = None
        self.progress: tuple[str, int, int] = ("", 0, 0)
        self.choices: list[Choice] = []
        self._first: ViewSession | None = None
        self._archives = ExitStack()
        self.folder: Path | None = None
        self._drop = 0
        self._bytes = self._files = 0

    @classmethod
    def of_folder(cls, inputs: Sequence[str | Path], settings: ViewSettings) -> StartRoom | None:
        """Return a room that offers what one folder holds; None where there is less than two to choose from."""
        if len(inputs) != 1 or not Path(inputs[0]).is_dir():
            return None
        room = cls(settings)
        room.choices = find_choices(Path(inputs[0]), room._archives, ignore_progress)
        if sum(not choice.is_refused for choice in room.choices) > 1:
            return room
        room.close()
        return None

    def settle(self, folder: Path) -> None:
        """Take a private folder for what is dropped."""
        self.folder = folder

    def _wait_with(self, path: str) -> None:
        self._waiting, self.waiting = path, say_source(read_view(path))

    def forget(self) -> None:
        """Open what comes next without the saved view that waits."""
        self._waiting, self.waiting = None, ""

    def close(self) -> None:
        _close_all((self._first, self.view))
        self.view = self._first = None
        self._archives.close()

    def open_session(self, on_change: Callable[[], None]) -> ViewSession:
        if self.view is None:
            raise UsageError("nothing was opened yet: load the page again")
        return self.view.session(on_change)

    def begin(self) -> int:
        """Forget what was dropped before; returns the number of the new drop."""
        self._archives.close()
        self.choices = []
        if self._drop:
            shutil.rmtree(self._place(), ignore_errors=True)
        self._drop += 1
        self._bytes = self._files = 0
        self._place().mkdir(mode=0o700)
        return self._drop

    def reserve(self, drop: Any, path: str) -> Path:
        """Return where a file of the drop goes, in folders of its own that lie within the private one."""
        if not self._drop or drop != str(self._drop):
            raise UsageError("these files belong to an earlier drop: drop them again")
        if self._files >= self.limits.files:
            raise UsageError(f"more than {self.limits.files:,} files: name their folder, clrecon view FOLDER")
        self._files += 1
        target = self._place().joinpath(*_checked_names(path))
        target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        return target

    def count(self, size: int) -> None:
        """Count bytes that are about to be written."""
        self._bytes += size
        if self._bytes > self.limits.total_bytes:
            most = self.limits.total_bytes / (1 << 30)
            raise UsageError(f"more than {most:.3g} GB: name their folder instead, clrecon view FOLDER")
        if shutil.disk_usage(self._place()).free < size + _SPARE:
            raise UsageError("the disk of temporary files is full: name another folder for them with TMPDIR")

    def list_choices(self) -> list[dict[str, Any]]:
        """List what can be opened of the drop; it takes a while.  A saved view that comes alone waits for its scan."""
        if not self._drop:
            return [choice.describe() for choice in self.choices]
        self._archives.close()
        self.choices = find_choices(self._place(), self._archives, self._tell)
        saved = find_saved_view(self._place())
        if saved is not None and not self.choices:
            self._wait_with(str(saved.replace(self._place().with_name(f"waiting{VIEW_FORMAT}"))))
        return [choice.describe() for choice in self.choices]

    def open(self, number: Any) -> Callable[[], None]:
        """Open a choice, by the saved view that waits or was dropped with it; returns what closes the one before."""
        choice = checked_choice(self.choices, number)
        saved = self._waiting or find_saved_view(self._place())
        part = {field.name: getattr(choice.selection, field.name) for field in fields(Selection)}
        given = {name: value for name, value in part.items() if value not in (None, False)}
        settings = replace(self.settings, scan=replace(self.settings.scan, **given))
        if saved is not None:
            settings = replace(settings, state=str(saved))
        view = open_view([choice.path], settings, progress=self._tell)
        try:
            first = view.session()  # a saved view that does not fit is refused here
        except ClreconError:
            view.close()
            raise
        before = (self._first, self.view)
        self.view, self._first = view, first
        self.forget()
        first.prepare()
        return lambda: _close_all(before)

    def _place(self) -> Path:
        assert self.folder is not None
        return self.folder / f"drop-{self._drop}"

    def _tell(self, stage: str, done: int, total: int) -> None:
        self.progress = (stage, done, total)


def _close_all(opened: tuple[Closing | None, ...]) -> None:
    for item in opened:
        if item is not None:
            item.close()


def _checked_names(path: str) -> list[str]:
    """Return the names of a relative path; refuse one that could lead elsewhere, or that no file should have."""
    names = path.split("/")
    if len(names) > _DEEPEST or not all(map(_is_name, names)):
        raise UsageError(f"the name {escape_text(path, 80)} cannot be taken: rename it, or name the folder instead")
    return names


def _is_name(name: str) -> bool:
    known = name not in ("", ".", "..") and len(name.encode("utf-8", "replace")) <= _LONGEST_NAME
    return known and name.isprintable() and not set(name) & set('\\:*?"<>|')


class StartDoors:
    """The requests of the start page, of which those that take a while are done one at a time.

    leave: Lets the browsers that show the view before go, when another was opened.
    """

    def __init__(self, room: StartRoom, leave: Callable[[], Awaitable[None]]) -> None:
        self._room, self._leave = room, leave
        self._lock = asyncio.Lock()

    def add_to(self, application: web.Application) -> None:
        for name in ("begin", "upload", "list", "open", "forget"):
            application.router.add_post(f"/start/{name}", getattr(self, f"_{name}"))
        application.router.add_get("/start/progress", self._progress, allow_head=False)

    async def _begin(self, request: web.Request) -> web.Response:
        limits = self._room.limits
        async with self._lock:
            drop = await asyncio.to_thread(self._room.begin)
        return _answer({"drop": drop, "total_bytes": limits.total_bytes, "files": limits.files})

    async def _upload(self, request: web.Request) -> web.Response:
        """Write a file piece by piece; what is not whole, or too much, is removed."""
        try:
            target = self._room.reserve(request.query.get("drop"), request.query.get("path", ""))
            file = target.open("xb")
        except (ClreconError, OSError) as error:
            return _refuse(error)
        is_whole = False
        try:
            with file:
                async for piece in request.content.iter_chunked(_PIECE):
                    self._room.count(len(piece))
                    await asyncio.to_thread(file.write, piece)
            is_whole = True
        except (ClreconError, OSError) as error:
            return _refuse(error)
        finally:
            if not is_whole:
                target.unlink(missing_ok=True)
        return _answer({})

    async def _list(self, request: web.Request) -> web.Response:
        async def list_choices() -> dict[str, Any]:
            return {"choices": await asyncio.to_thread(self._room.list_choices), "waiting": self._room.waiting}

        return await self._work(list_choices)

    async def _forget(self, request: web.Request) -> web.Response:
        self._room.forget()
        return _answer({})

    async def _open(self, request: web.Request) -> web.Response:
        number = request.query.get("choice", "")

        async def open_choice() -> dict[str, Any]:
            close_last = await asyncio.to_thread(self._room.open, int(number) if number.isdecimal() else number)
            await self._leave()
            await asyncio.to_thread(close_last)
            return {}

        return await self._work(open_choice)

    async def _work(self, function: Callable[[], Awaitable[dict[str, Any]]]) -> web.Response:
        async with self._lock:
            try:
                return _answer(await function())
            except ClreconError as error:
                return _refuse(error)
            except Exception as error:  # a fault of ours: the page goes on
                log.exception("the start page failed")
                return _refuse(UsageError(f"{type(error).__name__}: a fault of clrecon, please report it"))
            finally:
                self._room.progress = ("", 0, 0)

    async def _progress(self, request: web.Request) -> web.Response:
        stage, done, total = self._room.progress
        room = self._room
        known = {"waiting": room.waiting, "listed": bool(room.choices)}
        return _answer({"stage": stage, "done": done, "total": total, **known})


def _answer(content: dict[str, Any]) -> web.Response:
    from aiohttp import web

    return web.json_response(content)


def _refuse(error: Exception) -> web.Response:
    from aiohttp import web

    reason = getattr(error, "strerror", None) or str(error)
    words = str(error) if isinstance(error, ClreconError) else f"this file cannot be written: {reason}"
    return web.json_response({"error": words}, status=422)
