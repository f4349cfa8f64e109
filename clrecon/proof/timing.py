"""Timing of two programs in turn, and facts about the computer that do not identify it."""

from __future__ import annotations

import platform
import statistics
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from clrecon.system.processes import list_cores

_CPUINFO = Path("/proc/cpuinfo")


def usable_cores() -> int:
    return len(list_cores())


def processor_name(cpuinfo: Path = _CPUINFO) -> str:
    """Model of the processor, or its architecture if the system does not tell the model."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(filter(None, models), "") or platform.processor() or platform.machine()


def free_cores(seconds: float = 0.2) -> float:
    """Number of cores that are free now: the work of all threads together, divided by that of one thread alone."""
    block = bytes(1 << 20)

    def count_loops(done: list[int]) -> None:
        end, count = time.perf_counter() + seconds, 0
        while time.perf_counter() < end:
            zlib.crc32(block)  # lets other threads run
            count += 1
        done.append(count)

    alone: list[int] = []
    together: list[int] = []
    count_loops(alone)
    threads = [threading.Thread(target=count_loops, args=(together,)) for _ in range(usable_cores())]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(together) / max(alone[0], 1)


FEWEST_PAIRS = 3
"""Pairs that are run in spite of the time limit: fewer give no spread."""


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, quartiles (between the values, inclusive method), minimum and maximum of at least one value."""
    if len(values) == 1:
        q1 = median = q3 = float(values[0])
    else:
        q1, median, q3 = statistics.quantiles(values, n=4, method="inclusive")
    return {"median": median, "q1": q1, "q3": q3, "min": float(min(values)), "max": float(max(values))}


def alternate(
    candidate: Callable[[], float],
    peer: Callable[[], float],
    pairs: int,
    *,
    warm: bool = True,
    limit_s: float | None = None,
    clock: Callable[[], float] = perf_counter,
) -> tuple[list[float], list[float]]:
    """Run two programs, which return their seconds, in turn, first untimed if `warm`; their order changes with every
    pair, so that neither profits from its place.

    pairs: Number of timed runs of each.
    limit_s: Start no further pair after so many seconds of the clock, warm-up included; `FEWEST_PAIRS` are always run.
    """
    start = clock()
    if warm:
        candidate(), peer()
    ours: list[float] = []
    theirs: list[float] = []
    for number in range(pairs):
        if limit_s is not None and number >= FEWEST_PAIRS and clock() - start > limit_s:
            break
        if number % 2:
            theirs.append(peer())
            ours.append(candidate())
        else:
            ours.append(candidate())
            theirs.append(peer())
    return ours, theirs


def summarise(ours: Sequence[float], theirs: Sequence[float]) -> dict[str, Any]:
    """Number of pairs, and spreads of both sides and of the ratio of each pair (above 1: clrecon is faster)."""
    ratios = [theirs_s / ours_s for ours_s, theirs_s in zip(ours, theirs, strict=True)]
    return {"pairs": len(ratios), "clrecon_s": spread(ours), "peer_s": spread(theirs), "ratio": spread(ratios)}
