"""Long work: functions that receive its progress, threads that do the latest of each kind, Ctrl-C while kernels are
built, and the time limit of a device.

LLVM, the compiler within PoCL, answers a SIGINT by taking its unfinished files away and complaining on the console,
whatever thread is meant.  A signal that all threads hold back reaches nobody: the one that waits for it asks.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from clrecon.errors import Cancelled, ClreconError, UsageError
from clrecon.system.light_dataclass import dataclass, field

Progress = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)`` in the thread of the caller; ``total`` is 0 where the end is not known.

It is called between stages, slabs, frames, labels and files.  What it raises ends the work and reaches the caller as it
is; `clrecon.errors.Cancelled` is there for that."""


def ignore_progress(stage: str, done: int = 0, total: int = 0) -> None:
    """A progress function that does nothing."""


class Steps:
    """Counts the steps of work that several functions share, `total` in all, and reports each."""

    def __init__(self, progress: Progress | None, stage: str, total: int) -> None:
        self.done, self.total = 0, total
        self._progress, self._stage = progress or ignore_progress, stage
        self._progress(stage, 0, total)

    def take(self, count: int = 1) -> None:
        self.done = min(self.done + count, self.total)  # work that another device takes over is counted again
        self._progress(self._stage, self.done, self.total)

    def take_slice(self, piece: slice) -> None:
        """Report the steps of a slice of a range, for `clrecon.system.pieces.in_threads`."""
        self.take(piece.stop - piece.start)


DEFAULT_SECONDS = 600.0
"""Far above any launch: a kernel of clrecon takes seconds at most, on a slow CPU with a large scan a minute."""

NO_LIMIT = 1e9
"""Thirty years, and more than a system can wait for."""

_seconds = DEFAULT_SECONDS


def device_seconds() -> float:
    """Seconds that a device may be without progress; infinite without a limit."""
    return _seconds


def check_time_limit(seconds: float) -> float:
    """Return the seconds of a time limit, infinite for 0."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not seconds >= 0.0:
        raise UsageError(f"a time limit is a number of seconds, 0 for none, not {seconds!r}")
    return float(seconds) if 0.0 < seconds < NO_LIMIT else math.inf


@contextmanager
def time_limit(timeout: float) -> Iterator[None]:
    """Limit the time that a device may take without any progress within a block, in all threads of the process.

    A device makes progress whenever a kernel or a transfer ends.  One that makes none for longer has most likely hung:
    `DeviceError` names the kernel, and the device gets a fresh context for later work.

    >>> with clrecon.time_limit(30):
    ...     mesh = clrecon.extract_isosurface(volume, 200)

    Parameters
    ----------
    timeout : float
        Seconds; 0: no limit.  Outside of all blocks it is 600.

    Raises
    ------
    UsageError
        ``timeout`` is not a number from 0 on.
    """
    global _seconds
    before, _seconds = _seconds, check_time_limit(timeout)
    try:
        yield
    finally:
        _seconds = before


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
                from clrecon.system.log import get_logger

                get_logger(__name__).exception("%s failed", job.kind)
                self._on_error(job.kind, f"{type(error).__name__}: {error} (a fault of clrecon: please report it)")
            finally:
                with self._wake:
                    self._running = None
                    self._wake.notify_all()
                self._on_change()
