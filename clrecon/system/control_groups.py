"""Memory that this process may still take in its container or service (Linux control groups)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

_FILES = {  # Of a version of control groups: the files of limit and use, and the reclaimable field of memory.stat.
    2: ("memory.max", "memory.current", "inactive_file"),
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def free_bytes_of_container(proc: Path, groups: Path) -> float:
    """Return the bytes that this process may still take before it is killed; infinity without a limit.

    proc, groups: Folders of processes and of control groups: ``/proc`` and ``/sys/fs/cgroup``.
    """
    return min(_group_bytes(proc, groups), default=math.inf)


def _group_bytes(proc: Path, groups: Path) -> Iterator[int]:
    """Free bytes in the control group of this process and in each group around it."""
    try:
        lines = (proc / "self" / "cgroup").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0":
            version, root = 2, groups
        elif "memory" in controllers.split(","):
            version, root = 1, groups / "memory"
        else:
            continue
        own = root / path.lstrip("/")
        for folder in (own, *own.parents):  # A container may see its own group as the root.
            free = _free_in(folder, *_FILES[version])
            if free is not None:
                yield free
            if folder == root:
                break


def _free_in(folder: Path, limit: str, used: str, reclaimable: str) -> int | None:
    try:
        free = int((folder / limit).read_text()) - int((folder / used).read_text())
        fields = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return max(free + int(fields.get(reclaimable, 0)), 0)
    except (OSError, ValueError):
        return None  # no limit ("max"), or no group of this name
