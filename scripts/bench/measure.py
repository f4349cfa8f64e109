"""How benches measure: candidate and peer alternate, medians of pairs, and what the machine is."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

__all__ = ["alternate", "describe_machine", "run_program", "summarise", "write_json"]


def run_program(command: Sequence[str]) -> tuple[float, str]:
    """Run a program to its end; wall seconds of the whole process and what it printed."""
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} exited with {done.returncode}: {done.stderr.strip()}")
    return seconds, done.stdout


def alternate(candidate: Callable[[], float], peer: Callable[[], float], pairs: int) -> tuple[list[float], list[float]]:
    """Warm both up once, then time them in turn `pairs` times."""
    candidate(), peer()
    ours, theirs = [], []
    for _ in range(pairs):
        ours.append(candidate())
        theirs.append(peer())
    return ours, theirs


def summarise(ours: list[float], theirs: list[float]) -> dict[str, Any]:
    """Medians, spreads and the median of the ratios pair by pair (over 1: clrecon is faster)."""
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    return {
        "pairs": len(ours),
        "clrecon_s": {"median": statistics.median(ours), "min": min(ours), "max": max(ours)},
        "peer_s": {"median": statistics.median(theirs), "min": min(theirs), "max": max(theirs)},
        "ratio": {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)},
    }


def describe_machine() -> dict[str, Any]:
    """What a reader needs to place the figures."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Keep a result, readable and stable under diff."""
    path.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n")
