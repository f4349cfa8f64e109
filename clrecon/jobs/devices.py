"""The OpenCL devices of this machine, and a test of the operators on one of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from clrecon.errors import DeviceError
from clrecon.system.progress import Progress, device_seconds, ignore_progress


def survey_devices(name: str | None = None) -> tuple[dict[str, Any], DeviceError | None]:
    """List every OpenCL platform and device, and say which device would be used.

    name: Value of `device` for a job.

    Returns:
    survey: ``{"platforms": [{"name", "version", "note"}], "devices": [{"index", "name", "platform", "type", "version",
        "driver", "memory_bytes", "max_allocation_bytes", "compute_units", "simulator", "fault", "chosen", ...}],
        "chosen": index or None, "warnings": [text]}``.  A fault is what is remembered of the check at the first use of
        a device, empty where it passed or was not checked yet; nothing runs on any device.
    problem: Why no device would be used.
    """
    from clrecon.opencl import cache_warnings, choose_remembered, list_devices, list_platforms, remembered_fault

    devices = list_devices()
    problem: DeviceError | None = None
    chosen: int | None = None
    warnings: Sequence[str] = cache_warnings()
    try:
        device = choose_remembered(name)
        chosen, warnings = device.index, device.warnings
    except DeviceError as error:
        problem = error
    survey = {
        "platforms": list_platforms(),
        "devices": [
            {**device.describe(), "fault": remembered_fault(device), "chosen": device.index == chosen}
            for device in devices
        ],
        "chosen": chosen,
        "warnings": list(warnings),
    }
    return survey, problem


def run_device_selftest(
    name: str | None = None,
    *,
    progress: Progress | None = None,
    tell: Callable[[dict[str, Any], dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Compare every kernel with its twin, in a process of its own.

    name: Device name or index.
    progress: Called as ``progress("selftest", checks done, all checks)``.
    tell: Called with the device and each result, as they are returned, as soon as it is there.

    Returns: ``{"device": {...}, "passed": bool, "operators": [{"operator", "passed", "detail", "seconds"}], "warnings":
        [text]}``.
    """
    from clrecon.jobs.selftest.run import run_selftest
    from clrecon.jobs.selftest.table import CHECKS
    from clrecon.opencl import choose_unchecked

    progress = progress or ignore_progress
    device = choose_unchecked(name)
    results: list[dict[str, Any]] = []
    progress("selftest", 0, len(CHECKS))
    for result in run_selftest(device, CHECKS, silent_seconds=min(device_seconds(), threading.TIMEOUT_MAX)):
        results.append(result)
        if tell is not None:
            tell(device.describe(), result)
        progress("selftest", len(results), len(CHECKS))
    place = {check.name: n for n, check in enumerate(CHECKS)}
    results.sort(key=lambda result: place.get(result["operator"], len(place)))  # processes run side by side
    passed = bool(results) and all(result["passed"] for result in results)
    return {
        "device": device.describe(),
        "passed": passed,
        "operators": results,
        "warnings": device.warnings,
    }
