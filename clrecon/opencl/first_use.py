"""The check of a device at its first use: when it runs, and what is remembered of it.

The check itself stands in `clrecon.operators.first_use`, since it needs operators; they hand it in when they are
loaded.  A device that passed is not checked again by this version of clrecon with this driver: a file in the folder of
built kernels says so.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any

from clrecon.opencl.binaries import binary_key, read_binary, store_binary
from clrecon.opencl.context import Device
from clrecon.system.log import get_logger
from clrecon.version import package_version

__all__ = ["VARIABLE", "find_fault", "register"]

log = get_logger(__name__)

VARIABLE = "CLRECON_DEVICE_CHECK"
"""Environment variable that switches the check off: ``off``."""

_PASSED = b"this device has passed its check"

_check: list[Callable[[Device], str]] = []
_lock = threading.RLock()
_under_check: list[Any] = []
"""Devices that this thread checks: what the check asks of them is no first use."""


def register(check: Callable[[Device], str]) -> None:
    """Set the check: a function that returns what is wrong with a device, empty if nothing is."""
    _check[:] = [check]


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


def _find_fault(device: Device) -> str:
    if os.environ.get(VARIABLE, "").strip().lower() == "off":
        device.remark(f"{device.label} was not checked at its first use ({VARIABLE}=off): its results may be wrong")
        return ""
    key = _key(device)
    if read_binary(key) == _PASSED:
        return ""
    fault = _check[0](device)
    log.info("%s checked at its first use: %s", device.label, fault or "it computes rightly")
    if not fault:
        store_binary(key, _PASSED)
    return fault


def _key(device: Device) -> str:
    driver = (device.platform, device.platform_version, device.driver, device.version, device.name)
    variants = (f"{macro}={value}" for macro, value in sorted(device.kernel_variants.items()))
    return binary_key("first use", package_version(), *driver, *device.build_options, *variants)
