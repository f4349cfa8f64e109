"""Batches that run in a process of their own: their workers, and waiting for what they do."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


def children_of(parent: int) -> list[int]:
    """Numbers of the processes that a process has started."""
    children: list[int] = []
    for task in Path(f"/proc/{parent}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
            children += map(int, (task / "children").read_text().split())
    return children


def wait_until(process: subprocess.Popen[str], has_happened: Callable[[], bool]) -> None:
    """Wait for an event while a process runs; it fails where the process ends before, or after two minutes."""
    end = time.monotonic() + 120.0
    while not has_happened():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.002)
