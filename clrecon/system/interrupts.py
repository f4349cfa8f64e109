"""Ctrl-C, held back while threads build kernels.

LLVM, the compiler within PoCL, answers a SIGINT by taking its unfinished files away and complaining on the console,
whatever thread is meant.  A signal that all threads hold back reaches nobody: the one that waits for it asks.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def held_interrupts() -> Iterator[None]:
    """Hold SIGINT back in this thread and in those that it starts within the block; on Windows nothing is held."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def take_interrupt() -> bool:
    """True, once, where SIGINT has come while it was held back."""
    if not hasattr(signal, "sigpending") or signal.SIGINT not in signal.sigpending():
        return False
    signal.sigwait({signal.SIGINT})
    return True
