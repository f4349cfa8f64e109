"""Progress of long work: the type of the functions that receive it."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Progress", "ignore_progress"]

Progress = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)``; ``total`` is 0 where the end is not known.

It is called between stages, slabs, frames, labels and files, in the thread of the caller.  What it raises ends the work
and reaches the caller as it is; `clrecon.errors.Cancelled` is there for that.
"""


def ignore_progress(stage: str, done: int = 0, total: int = 0) -> None:
    """A progress function that does nothing."""
