"""What a reader of measured times must know of the computer, and nothing that names it."""

from __future__ import annotations

import os
import platform
import threading
import time
import zlib
from pathlib import Path

__all__ = ["free_cores", "processor_name", "usable_cores"]

_CPUINFO = Path("/proc/cpuinfo")


def usable_cores() -> int:
    """Cores that this process may use, which can be fewer than the computer has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor_name(cpuinfo: Path = _CPUINFO) -> str:
    """The processor's model; where the system does not say it, its architecture."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(filter(None, models), "") or platform.processor() or platform.machine()


def free_cores(seconds: float = 0.2) -> float:
    """How many cores are really free now: the work that threads do together, by what one does alone.

    The threads make checksums of memory that fits the cache, so that bandwidth does not count.  Of cores that share
    their units (hyperthreads) a quiet computer has about 0.6 each.
    """
    block = bytes(1 << 20)

    def work(done: list[int]) -> None:
        end, count = time.perf_counter() + seconds, 0
        while time.perf_counter() < end:
            zlib.crc32(block)  # lets other threads run
            count += 1
        done.append(count)

    alone: list[int] = []
    together: list[int] = []
    work(alone)
    threads = [threading.Thread(target=work, args=(together,)) for _ in range(usable_cores())]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(together) / max(alone[0], 1)
