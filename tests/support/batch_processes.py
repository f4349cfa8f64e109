"""Batches that run in a process of their own: their workers, and waiting for what they do."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path


def children_of(parent: int) -> list[int]:
    """Numbers of the processes that a process has started."""
    tasks = Path(f"/proc/{parent}/task")
    return [int(word) for task in tasks.iterdir() for word in (task / "children").read_text().split()]


def wait_until(process: subprocess.Popen[str], has_happened: Callable[[], bool]) -> None:
    """Wait for an event while a process runs; it fails where the process ends before, or after two minutes."""
    end = time.monotonic() + 120.0
    while not has_happened():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.002)
