"""Times of the parts of a job."""

from __future__ import annotations

from time import perf_counter

from clrecon.system.log import get_logger

log = get_logger(__name__)


class Laps:
    """Seconds by part of a job, on the wall clock."""

    def __init__(self) -> None:
        self._start = self._lap = perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, part: str) -> float:
        """Add the time since the last lap to `part` and return it."""
        now = perf_counter()
        elapsed = now - self._lap
        self._lap = now
        self.seconds[part] = self.seconds.get(part, 0.0) + elapsed
        log.debug("%s: %.3f s", part, elapsed)
        return elapsed

    def total(self) -> float:
        """Seconds since the first lap began."""
        return perf_counter() - self._start
