"""A thread that does work of a view in the background: of each kind the latest that was asked for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from clrecon.errors import Cancelled, ClreconError
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.log import get_logger

log = get_logger(__name__)

CLOSE_S = 1.0
"""Longest wait for work that is cancelled; threads that still run then end with the process."""


@dataclass(eq=False)
class Job:
    """Work that was asked for; `cancelled` says whether it is still wanted."""

    kind: str
    work: Callable[[Job], Any]
    rank: int
    gives_way: bool = True
    _stop: threading.Event = field(default_factory=threading.Event, repr=False)

    def cancelled(self) -> bool:
        """True where the result is no longer wanted."""
        return self._stop.is_set()

    def cancel(self) -> None:
        self._stop.set()

    def progress(self, stage: str, done: int = 0, total: int = 0) -> None:
        """A progress function that ends the work where it is no longer wanted."""
        if self.cancelled():
            raise Cancelled


class Worker:
    """A thread with one place for each kind of work; `on_error` gets kind and words of an error."""

    def __init__(self, name: str, on_error: Callable[[str, str], None], on_change: Callable[[], None] = lambda: None):
        self._on_error, self._on_change = on_error, on_change
        self._wake = threading.Condition()
        self._waiting: dict[str, Job] = {}
        self._running: Job | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ask(self, kind: str, work: Callable[[Job], Any], rank: int = 0, *, gives_way: bool = True) -> Job | None:
        """Ask for work; one of the same kind that waits is dropped, and one that runs is cancelled if it gives way.

        rank: Lower ones come first.
        gives_way: False: once it runs it is finished: pictures are seen while requests come faster than pictures.
        Returns: None after `close`.
        """
        job = Job(kind, work, rank, gives_way)
        with self._wake:
            if self._closed:
                return None
            old = self._waiting.pop(kind, None)
            if old is not None:
                old.cancel()
            running = self._running
            if running is not None and running.kind == kind and running.gives_way:
                running.cancel()
            self._waiting[kind] = job
            self._wake.notify_all()
        return job

    def cancel(self, kind: str) -> None:
        with self._wake:
            waiting = self._waiting.pop(kind, None)
            for job in (waiting, self._running):
                if job is not None and job.kind == kind:
                    job.cancel()
            self._wake.notify_all()

    @property
    def busy(self) -> list[str]:
        with self._wake:
            running = [] if self._running is None else [self._running.kind]
            return [*running, *(kind for kind in self._waiting if kind not in running)]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until nothing runs or waits; False where time ran out."""
        with self._wake:
            return self._wake.wait_for(lambda: not self._waiting and self._running is None, timeout)

    def stop(self) -> None:
        """Cancel everything, and take nothing more."""
        with self._wake:
            self._closed = True
            for job in (*self._waiting.values(), self._running):
                if job is not None:
                    job.cancel()
            self._waiting.clear()
            self._wake.notify_all()

    def close(self, timeout: float = CLOSE_S) -> bool:
        """Cancel everything and wait for the thread to end; False where it still runs after `timeout` seconds."""
        self.stop()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                job = min(self._waiting.values(), key=lambda each: each.rank)
                del self._waiting[job.kind]
                self._running = job
            self._on_change()
            try:
                if not job.cancelled():
                    job.work(job)
            except Cancelled:
                pass
            except ClreconError as error:
                self._on_error(job.kind, str(error))
            except Exception as error:  # a fault of ours: the view goes on, and says so
                log.exception("%s failed", job.kind)
                self._on_error(job.kind, f"{type(error).__name__}: {error} (a fault of clrecon: please report it)")
            finally:
                with self._wake:
                    self._running = None
                    self._wake.notify_all()
                self._on_change()
