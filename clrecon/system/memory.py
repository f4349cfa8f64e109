"""Memory for voxels, checked before it is taken: a small file that claims huge dimensions cannot fill the computer."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import RefusedInputError
from clrecon.system.aligned import aligned_empty
from clrecon.system.control_groups import free_bytes_of_container

MEMORY_SHARE = 0.9
"""Share of the free memory that voxels may take; the rest is for what is computed beside the volume."""


def available_memory_bytes(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> float:
    """Return the bytes that can be taken without swapping: all memory, or infinity, where the system does not tell.

    Linux shows a container the memory of the whole computer, but kills a process that exceeds the container's own
    limit; the smaller of both counts.
    """
    container = free_bytes_of_container(proc, groups)
    try:
        with open(proc / "meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return min(float(line.split()[1]) * 1024, container)
    except (OSError, ValueError):
        pass  # not Linux
    return min(physical_memory_bytes(), container)


def physical_memory_bytes() -> float:
    """Return the memory of this computer in bytes; infinity where the system does not tell (Windows)."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return math.inf


def allocate_voxels(shape: Sequence[int], dtype: DTypeLike, name: str = "") -> NDArray[Any]:
    """Return an uninitialised array for a volume, see `aligned_empty`.

    shape: (nk, nj, ni)
    name: Name of the file, for the message.
    """
    needed = math.prod(shape) * np.dtype(dtype).itemsize
    available = available_memory_bytes()
    size = " x ".join(map(str, reversed(shape)))
    what = f"{name}{': ' * bool(name)}the volume of {size} voxels needs {needed / 2**30:.2f} GiB of memory"
    if needed > MEMORY_SHARE * available:
        raise RefusedInputError(f"{what}, {available / 2**30:.2f} GiB are free")
    try:
        return aligned_empty(shape, dtype)
    except MemoryError as error:
        raise RefusedInputError(f"{what}, which cannot be had") from error
