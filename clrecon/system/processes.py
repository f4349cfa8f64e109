"""The cores and the memory of this process, and processes of the same Python beside it: how they start and end."""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from clrecon.errors import DeviceError

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of the `mallopt` of glibc."""

_KEPT_BYTES = 1 << 28
"""Most bytes of an array whose memory is kept when it is freed; larger ones are few."""

_MOST_SECONDS_TO_END = 1.0
"""Time for the removal of temporary folders after a kernel has hung."""


def list_cores() -> list[int]:
    """Numbers of the cores that this process may use; the computer can have more."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def start_python(
    command: Sequence[str], subject: str, environment: Mapping[str, str | None] | None = None
) -> subprocess.Popen[bytes]:
    """Start this Python with pipes to its input and output; its errors are dropped, since drivers print there.

    subject: What the process is for, for the message where there is no interpreter, or no process can be started.
    environment: Variables beside those of this process; None leaves one of them out.
    """
    if getattr(sys, "frozen", False) or not sys.executable:
        raise DeviceError(f"{subject} in processes of a Python interpreter, and this program has none")
    variables = {**os.environ, **(environment or {})}
    try:
        return subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={name: value for name, value in variables.items() if value is not None},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise DeviceError(f"{subject} in processes, and none can be started: {error.strerror or error}") from error


def start_with(command: Sequence[str], subject: str, data: Mapping[str, Any]) -> subprocess.Popen[bytes]:
    """Start this Python, see `start_python`, with a JSON object as all of its input."""
    process = start_python(command, subject)
    assert process.stdin is not None
    try:
        process.stdin.write(json.dumps(data).encode())
        process.stdin.close()
    except OSError:  # it has ended already: its answer is missing
        pass
    return process


def share_machine(devices: Sequence[str | None], number: int) -> tuple[dict[str, str], list[int] | None]:
    """Return the variables of one of so many workers, and its cores; None where they cannot be shared."""
    cores = list_cores()
    device, workers = devices[number], len(devices)
    environment = {} if device is None else {"CLRECON_DEVICE": device}
    if workers > 1 and "POCL_MAX_PTHREAD_COUNT" not in os.environ:
        environment["POCL_MAX_PTHREAD_COUNT"] = str(max(1, len(cores) // workers))
    is_shared = 1 < workers <= len(cores) and hasattr(os, "sched_setaffinity")
    return environment, cores[number::workers] if is_shared else None


def describe_end(code: int) -> str:
    """Say how a process has ended, by its exit code, or the negative number of a signal."""
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    more = ": out of memory, or ended by somebody" if name == "SIGKILL" else ""
    return f"its process crashed with {name}{more}"


def keep_freed_memory() -> None:
    """Have glibc keep what this process frees for its next arrays: the system clears each page that it gives anew."""
    if sys.platform.startswith("linux"):
        import ctypes

        program = ctypes.CDLL(None)
        if hasattr(program, "mallopt"):  # musl has none
            program.mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
            program.mallopt(_TRIM_THRESHOLD, 4 * _KEPT_BYTES)


def has_hung_device() -> bool:
    """True where a kernel still runs that nobody waits for any more; without a device nothing is imported for it."""
    opencl = sys.modules.get("clrecon.opencl")
    return opencl is not None and bool(opencl.has_hung_commands())


def end_process(code: int = 0) -> NoReturn:
    """Run what is registered for the end of this process, such as the record of built kernels, and end it at once.

    The interpreter would free modules, drivers and voxels one by one, which takes as long as extracting a surface; the
    system frees all at once.  Every file is closed by now.
    """
    if has_hung_device():  # a driver may wait for the kernel when something is freed
        ending = threading.Thread(target=atexit._run_exitfuncs, daemon=True)
        ending.start()
        ending.join(_MOST_SECONDS_TO_END)
    else:
        atexit._run_exitfuncs()
    os._exit(code)
