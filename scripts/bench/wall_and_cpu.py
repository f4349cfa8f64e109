"""Pairs of runs timed twice: in wall seconds, and in processor seconds of all threads and of child processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from measure import alternate, busy_seconds, summarise


def alternate_twice(
    candidate: Callable[[], Any], peer: Callable[[], Any], pairs: int, limit_s: float | None = None
) -> dict[str, dict[str, Any]]:
    """Run two functions in turn, once untimed first.

    Returns ``wall`` and ``cpu``, each as `summarise` gives it.  Idle threads of OpenBLAS count as processor time, and
    slow whatever comes next: set OPENBLAS_NUM_THREADS=1.
    """
    cpu: dict[str, list[float]] = {"ours": [], "theirs": []}

    def timed(run: Callable[[], Any], side: str) -> Callable[[], float]:
        def once() -> float:
            wall, busy = time.perf_counter(), busy_seconds()
            run()
            cpu[side].append(busy_seconds() - busy)
            return time.perf_counter() - wall

        return once

    ours, theirs = alternate(timed(candidate, "ours"), timed(peer, "theirs"), pairs, limit_s=limit_s)
    return {"wall": summarise(ours, theirs), "cpu": summarise(cpu["ours"][1:], cpu["theirs"][1:])}
