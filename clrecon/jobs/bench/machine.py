"""Facts about the computer for readers of measured times, without anything that identifies it."""

from __future__ import annotations

import os
import platform
import threading
import time
import zlib
from pathlib import Path

_CPUINFO = Path("/proc/cpuinfo")


def usable_cores() -> int:
    """Number of cores that this process may use; the computer can have more."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor_name(cpuinfo: Path = _CPUINFO) -> str:
    """Model of the processor, or its architecture if the system does not tell the model."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(filter(None, models), "") or platform.processor() or platform.machine()


def free_cores(seconds: float = 0.2) -> float:
    """Number of cores that are free now: the work of all threads together, divided by the work of one thread alone.

    The threads compute checksums of memory that fits the cache, so that memory bandwidth has no influence.  On a quiet
    computer a core that shares its units with another (hyperthreads) counts as about 0.6.
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
