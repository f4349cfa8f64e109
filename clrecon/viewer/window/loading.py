"""`Loading`: inputs that are read in a thread, for a window that is there already."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from clrecon.errors import Cancelled
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.viewer.session.session import ViewSession

Load = Callable[[Progress], "ViewSession"]
"""Reads the inputs; called in a thread, with a progress function that raises `Cancelled` when nobody waits any more."""


class Loading:
    """A thread that reads, begun at once.

    load: See `Load`.
    describe: Returns the words for a stage of the progress.

    words: What is done just now.
    """

    def __init__(self, load: Load, describe: Callable[[str], str] = str):
        self.words = "looking at what is to be shown"
        self._load, self._describe = load, describe
        self._cancelled = threading.Event()
        self._session: ViewSession | None = None
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="view-load", daemon=True)
        self._thread.start()

    def take(self) -> ViewSession | None:
        """Return the session once it is there, and None before and afterwards."""
        if self._thread.is_alive():
            return None
        if self._failure is not None:
            raise self._failure
        session, self._session = self._session, None
        return session

    def close(self, timeout: float) -> None:
        """Cancel the reading, wait for its end, and close a session that nobody took."""
        self._cancelled.set()
        self._thread.join(timeout)
        if not self._thread.is_alive() and self._session is not None:
            self._session.close(timeout)
            self._session = None

    def _run(self) -> None:
        try:
            self._session = self._load(self._progress)
        except BaseException as error:  # raised again by who takes
            self._failure = error

    def _progress(self, stage: str, done: int, total: int) -> None:
        if self._cancelled.is_set():
            raise Cancelled
        self.words = self._describe(stage) + (f" {done} of {total}" if total > 1 else "")
