"""How jobs tell what they are doing."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

__all__ = ["Progress", "Stopwatch", "ignore_progress"]

Progress = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)``; ``total`` is 0 where the end is not known."""


def ignore_progress(stage: str, done: int = 0, total: int = 0) -> None:
    """Take a step of progress and do nothing with it."""


class Stopwatch:
    """Seconds by part of a job, on the wall clock."""

    def __init__(self) -> None:
        self._start = self._lap = perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, part: str) -> float:
        """Book the time since the last lap on `part` and return it."""
        now = perf_counter()
        elapsed = now - self._lap
        self._lap = now
        self.seconds[part] = self.seconds.get(part, 0.0) + elapsed
        return elapsed

    def total(self) -> float:
        """Seconds since this stopwatch was made."""
        return perf_counter() - self._start
