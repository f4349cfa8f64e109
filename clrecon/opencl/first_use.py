"""The check of a device at its first use: when it runs, and what is remembered of it.

The check itself stands in `clrecon.operators.first_use`, since it needs operators; they hand it in when they are
loaded.  A device that passed is not checked again by this version of clrecon with this driver: a file in the folder of
built kernels says so.  The file says too that a check has begun: where a driver ends the process, the next process
finds it and leaves the check to a child, whose end becomes words.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from clrecon.opencl.cache.binaries import binary_key, read_binary, store_binary
from clrecon.opencl.context import Device
from clrecon.system.log import get_logger
from clrecon.system.time_limit import device_seconds
from clrecon.version import package_version

log = get_logger(__name__)

VARIABLE = "CLRECON_DEVICE_CHECK"
"""Environment variable that switches the check off: ``off``."""

_PASSED = b"this device has passed its check"
_BEGUN = b"the check of this device has begun"
_WRONG = b"this device computes wrongly: "
_CRASHED = b"this device ended its check: "
"""What the file says; behind the last two follows what is wrong."""

_DIED = "a process ended while it checked this device"

_check: list[Callable[[Device], str]] = []
_command: list[str] = []
_lock = threading.RLock()
_under_check: list[Any] = []
"""Devices that this thread checks: what the check asks of them is no first use."""


def register(check: Callable[[Device], str], *command: str) -> None:
    """Set the check: a function that returns what is wrong with a device, empty if nothing is.

    *command: Arguments of the Python interpreter that make the same check; the index of a device follows.  The last
        line of its output is the answer as JSON.
    """
    _check[:] = [check]
    _command[:] = command


def find_fault(device: Device) -> str:
    """Return what is wrong with a device, empty if nothing is; at the first use of a device this runs the check."""
    if device.fault is not None or not _check or device.is_simulator:
        return device.fault or ""
    with _lock:
        if device in _under_check:
            return ""
        if device.fault is None:
            _under_check.append(device)
            try:
                device.fault = _find_fault(device)
            finally:
                _under_check.remove(device)
        return device.fault


def remembered_fault(device: Device) -> str:
    """Return what earlier processes found wrong with a device, empty if they found nothing; nothing runs on it."""
    if device.is_simulator or _is_off():
        return ""
    known = read_binary(_key(device)) or b""
    if known == _BEGUN:
        return _DIED
    said = next((known[len(start) :] for start in (_WRONG, _CRASHED) if known.startswith(start)), b"")
    return said.decode(errors="replace")


def _is_off() -> bool:
    return os.environ.get(VARIABLE, "").strip().lower() == "off"


def _find_fault(device: Device) -> str:
    if _is_off():
        device.remark(f"{device.label} was not checked at its first use ({VARIABLE}=off): its results may be wrong")
        return ""
    key = _key(device)
    known = read_binary(key) or b""
    if known == _PASSED:
        return ""
    if known == _BEGUN or known.startswith(_CRASHED):
        fault, found = _check_apart(device)
    else:
        store_binary(key, _BEGUN)
        try:
            fault = _check[0](device)
        except BaseException:  # an interrupt or a time limit says nothing
            store_binary(key, b"")
            raise
        found = _WRONG + fault.encode() if fault else _PASSED
    log.info("%s checked at its first use: %s", device.label, fault or "it computes rightly")
    store_binary(key, found)
    return fault


def _check_apart(device: Device) -> tuple[str, bytes]:
    """Check a device in a process of its own; return what is wrong with it, and what to remember."""
    if getattr(sys, "frozen", False) or not sys.executable or not _command:
        return _DIED, _CRASHED + _DIED.encode()
    seconds = min(device_seconds(), threading.TIMEOUT_MAX)
    try:
        ended = subprocess.run(
            [sys.executable, *_command, str(device.index)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=seconds,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        told = f"its check does not end within {seconds:g} s" if isinstance(error, subprocess.TimeoutExpired) else _DIED
        return told, _CRASHED + told.encode()
    if ended.returncode == 0:
        fault = str(json.loads(ended.stdout.splitlines()[-1]))
        return fault, _WRONG + fault.encode() if fault else _PASSED
    names = {-number: number.name for number in signal.Signals}
    how = names.get(ended.returncode, f"exit code {ended.returncode}")
    fault = f"its driver ends the process ({how})"
    return fault, _CRASHED + fault.encode()


def _key(device: Device) -> str:
    driver = (device.platform, device.platform_version, device.driver, device.version, device.name)
    variants = (f"{macro}={value}" for macro, value in sorted(device.kernel_variants.items()))
    return binary_key("first use", package_version(), *driver, *device.build_options, *variants)
