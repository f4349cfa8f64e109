"""Measurements of benches: processes, page faults, cores in use, and facts about the machine."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from clrecon.proof.timing import alternate, free_cores, processor_name, spread, summarise, usable_cores
from clrecon.version import package_version

__all__ = [
    "Costs",
    "alternate",
    "busy_seconds",
    "describe_machine",
    "medians",
    "run_program",
    "seconds_of",
    "spread",
    "summarise",
    "time_in_turns",
    "write_json",
]

ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = (
    "numpy",
    "pyopencl",
    "vtk",
    "SimpleITK",
    "scipy",
    "connected-components-3d",
    "napf",
    "small_gicp",
    "open3d",
)


def run_program(command: Sequence[str], timeout_s: float = 600.0) -> tuple[float, str]:
    """Run a program to its end; returns the wall seconds of the whole process and its output.

    Python keeps what it compiles, as pip does when it installs a program, whatever the environment says: else each
    process compiles this folder anew.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    start = time.perf_counter()
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=timeout_s)
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"{' '.join(command)} took more than {timeout_s:g} s") from error
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} exited with {done.returncode}: {done.stderr.strip()[-2000:]}")
    return seconds, done.stdout


class Costs:
    """Costs of the runs of one side besides seconds: page faults, and the number of cores in use."""

    def __init__(self) -> None:
        self.page_faults: list[int] = []
        self.cores_used: list[float] = []

    def measure(self, run: Callable[[], Any]) -> Any:
        """Run a function and keep its costs."""
        before, start = _usage(), time.perf_counter()
        result = run()
        wall, after = time.perf_counter() - start, _usage()
        self.page_faults.append(int(after[0] - before[0]))
        self.cores_used.append((after[1] - before[1]) / wall)
        return result

    def describe(self) -> dict[str, float]:
        """Return the medians over all runs."""
        return {"page_faults": spread(self.page_faults)["median"], "cores_used": spread(self.cores_used)["median"]}


def _usage() -> tuple[int, float]:
    """Page faults and processor seconds of this process so far (0 faults if the system does not count them)."""
    try:
        import resource
    except ImportError:  # Windows
        return 0, time.process_time()
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_minflt + usage.ru_majflt, usage.ru_utime + usage.ru_stime


def seconds_of(run: Callable[[], object]) -> float:
    """Wall seconds of a call."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def time_in_turns(own: Callable[[], object], peer: Callable[[], object], pairs: int, limit_s: float) -> dict[str, Any]:
    """Time a function and its peer in turn, see `alternate`, and return `summarise` of both."""
    return summarise(*alternate(lambda: seconds_of(own), lambda: seconds_of(peer), pairs, limit_s=limit_s))


def busy_seconds() -> float:
    """Processor seconds so far of this process and of all its child processes that have ended."""
    own = os.times()
    try:
        import resource
    except ImportError:  # Windows, where children are not counted
        return own.user + own.system
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def medians(runs: Sequence[dict[str, float]]) -> dict[str, float]:
    """Median over runs of each named number."""
    names = dict.fromkeys(name for run in runs for name in run)
    return {name: spread([run[name] for run in runs if name in run])["median"] for name in names}


def describe_machine() -> dict[str, Any]:
    """Describe the machine and the versions, for readers of the figures."""
    versions = {"clrecon": package_version()}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "kernel": platform.release(),
        "processor": processor_name(),
        "cores": usable_cores(),
        "free_cores": round(free_cores(), 2),
        "load_average": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "caches": _caches(),
        "python": platform.python_version(),
        "packages": versions,
        "revision": _revision(),
    }


def _caches(folder: Path = Path("/sys/devices/system/cpu/cpu0/cache")) -> dict[str, str] | None:
    """Size of each cache as the system reports it; None if it does not."""
    caches = {}
    for entry in sorted(folder.glob("index*")):
        try:
            level, kind, size = ((entry / name).read_text().strip() for name in ("level", "type", "size"))
        except OSError:
            continue
        caches[f"L{level} {kind.lower()}"] = size
    return caches or None


def _revision() -> str | None:
    """Git revision of the measured code, with a + if files differ from it."""
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--exclude=*"], cwd=ROOT, capture_output=True, text=True
        )
    except OSError:
        return None
    return done.stdout.strip() or None


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Write a result as JSON that is readable and stable under diff."""
    from clrecon.jobs.run import to_json

    plain = json.loads(to_json(result))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain, indent=2, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    json.dump(describe_machine(), sys.stdout, indent=2)
