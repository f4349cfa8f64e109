"""The time limit of a device: how long it may be without any progress before it counts as hung."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from clrecon.errors import UsageError

DEFAULT_SECONDS = 600.0
"""Far above any launch: a kernel of clrecon takes seconds at most, on a slow CPU with a large scan a minute."""

_seconds = DEFAULT_SECONDS


def device_seconds() -> float:
    """Seconds that a device may be without progress; infinite without a limit."""
    return _seconds


def check_time_limit(seconds: float) -> float:
    """Return the seconds of a time limit, infinite for 0."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not seconds >= 0.0:
        raise UsageError(f"a time limit is a number of seconds, 0 for none, not {seconds!r}")
    return float(seconds) or math.inf


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
