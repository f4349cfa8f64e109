"""How many threads to work with."""

from __future__ import annotations

import os


def count_readers(slices: int, most: int) -> int:
    """Return the number of reading threads: the number of cores that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(most, cores, slices))
