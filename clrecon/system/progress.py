"""Progress of long work: the type of the functions that receive it."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)``; ``total`` is 0 where the end is not known.

It is called between stages, slabs, frames, labels and files, in the thread of the caller.  What it raises ends the work
and reaches the caller as it is; `clrecon.errors.Cancelled` is there for that.
"""


def ignore_progress(stage: str, done: int = 0, total: int = 0) -> None:
    """A progress function that does nothing."""


class Steps:
    """Counts the steps of work that several functions share, and reports each.

    progress: None reports nothing.
    total: All steps.
    """

    def __init__(self, progress: Progress | None, stage: str, total: int) -> None:
        self.done, self.total = 0, total
        self._progress, self._stage = progress or ignore_progress, stage
        self._progress(stage, 0, total)

    def take(self, count: int = 1) -> None:
        """Report that so many more steps are done."""
        self.done = min(self.done + count, self.total)  # work that another device takes over is counted again
        self._progress(self._stage, self.done, self.total)

    def take_slice(self, piece: slice) -> None:
        """Report the steps of a slice of a range, for `clrecon.system.pieces.in_threads`."""
        self.take(piece.stop - piece.start)
