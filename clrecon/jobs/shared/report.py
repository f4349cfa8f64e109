"""Reports: strict JSON, written last.

The report is the commit mark of a job: when it exists, all files that it describes are complete.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from clrecon.errors import ClreconError

if TYPE_CHECKING:
    from clrecon.system.files import StagedFile


def to_json(value: Any, indent: int | None = 2) -> str:
    """Return strict JSON (ASCII): numpy values become plain ones, NaN and infinities become null."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays, without importing numpy
        return _plain(value.tolist())
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
