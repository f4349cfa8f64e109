"""What every job does beside its own work: its times, the device that opens beside the input, and the report.

The report is strict JSON and the commit mark of a job: when it exists, all files that it describes are complete.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO

from clrecon.errors import Cancelled, ClreconError
from clrecon.system.log import get_logger
from clrecon.system.records import Record

if TYPE_CHECKING:
    from clrecon.opencl import Device
    from clrecon.system.files import StagedFile


log = get_logger(__name__)


class Laps:
    """Seconds by part of a job, on the wall clock."""

    def __init__(self) -> None:
        self._start = self._lap = perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, part: str) -> float:
        """Add the time since the last lap to `part` and return it."""
        now = perf_counter()
        elapsed = now - self._lap
        self._lap = now
        self.seconds[part] = self.seconds.get(part, 0.0) + elapsed
        log.debug("%s: %.3f s", part, elapsed)
        return elapsed

    def total(self) -> float:
        """Seconds since the first lap began."""
        return perf_counter() - self._start


def _choose_device(name: str | int | Device | None) -> Device:
    from clrecon.operators import take_device

    return take_device(name)


def _prepare_device(chosen: Future[Device], prepare: Callable[[Device], None]) -> None:
    from clrecon.opencl import with_fallback

    for attempt in with_fallback(chosen.result()):
        with attempt as (device, _):
            prepare(device)


class DeviceOpening:
    """A device that is chosen, opened and given its kernels beside the work of a ``with`` block.

    The order of errors does not depend on which side is faster: if both the block and the device fail, the device's
    error is raised.  Only a cancellation by the caller is passed on in any case.

    name: As `clrecon.device` takes it.
    prepare: Function that builds the kernels on a device.
    """

    def __init__(self, name: str | int | Device | None, prepare: Callable[[Device], None]):
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="device")
        self._chosen = self._pool.submit(_choose_device, name)
        self._prepared = self._pool.submit(_prepare_device, self._chosen, prepare)

    def wait(self) -> Device:
        """Return the device, ready to work; its stand-in may have taken over."""
        device = self._chosen.result()
        self._prepared.result()
        return device

    def __enter__(self) -> DeviceOpening:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        is_interrupted = error is not None and not isinstance(error, Exception)  # nobody waits for a compiler then
        try:
            if isinstance(error, Exception) and not isinstance(error, Cancelled):
                self._chosen.result()
        finally:
            self._pool.shutdown(wait=not is_interrupted, cancel_futures=True)


def to_json(value: Any, indent: int | None = 2) -> str:
    """Return strict JSON (ASCII): numpy values become plain ones, NaN and infinities become null."""
    return json.dumps(_as_plain(value), indent=indent, allow_nan=False)


def _as_plain(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _as_plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_as_plain(entry) for entry in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays, without importing numpy
        return _as_plain(value.tolist())
    raise TypeError(f"{type(value).__name__} has no place in a report")


def stage_report(path: str | Path, report: Mapping[str, Any]) -> AbstractContextManager[StagedFile]:
    """Write `report` as JSON under a temporary name, to be committed after the files that it describes."""
    from clrecon.system.files import stage_file

    content = (to_json(report) + "\n").encode("ascii")

    def write(stream: BinaryIO) -> None:
        stream.write(content)

    return stage_file(path, write)


def error_as_dict(error: ClreconError) -> dict[str, Any]:
    """Return the JSON form of an error: ``{"error": {"kind", "exit_code", "message"}}``."""
    return {"error": {"kind": type(error).__name__, "exit_code": error.exit_code, "message": str(error)}}


def platform_name() -> str:
    """Return operating system, machine and Python, without the name of the computer."""
    import platform

    return f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"


_OWN_STATUS = Path("/proc/self/status")


def peak_memory_bytes(status: Path = _OWN_STATUS) -> int | None:
    """Return the largest resident memory of this process so far, None if the system does not tell.

    Linux tells it of this program alone; in its usage of resources the memory of the process that started it counts.
    """
    try:
        lines = status.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    peaks = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
    if peaks:
        return 1024 * int(peaks[0])
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak) if sys.platform == "darwin" else int(peak) * 1024


class RunReport(Record):
    """The entries that all reports share; each report is a dataclass with these fields and its own, in JSON order.

    affine_ijk_to_lps_mm: nested list (4, 4)
    memory_allowed_bytes: Most bytes that may be taken on the device; None: all.
    version, platform: Version of clrecon; system, machine and Python.
    warnings: Those of the volume first, each once.
    volume: The `Certificate` of the volume without its warnings.
    seconds: Seconds by part of the job, with ``other`` and ``total``.
    """

    affine_ijk_to_lps_mm: list[list[float]]
    device: str
    driver: str
    memory_allowed_bytes: int | None
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None
