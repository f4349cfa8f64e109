"""Long work: functions that receive its progress, Ctrl-C while kernels are built, and the time limit of a device.

LLVM, the compiler within PoCL, answers a SIGINT by taking its unfinished files away and complaining on the console,
whatever thread is meant.  A signal that all threads hold back reaches nobody: the one that waits for it asks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from clrecon.errors import UsageError

Progress = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)`` in the thread of the caller; ``total`` is 0 where the end is not known.

It is called between stages, slabs, frames, labels and files.  What it raises ends the work and reaches the caller as it
is; `clrecon.errors.Cancelled` is there for that."""


def ignore_progress(stage: str, done: int = 0, total: int = 0) -> None:
    """Do nothing."""


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
