"""The OpenCL devices of this machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from clrecon.errors import DeviceError
from clrecon.system.records import name_schema


def survey_devices(name: str | None = None) -> tuple[dict[str, Any], DeviceError | None]:
    """List every OpenCL platform and device, as docs/contract.md says, and which would be used, or why none would."""
    from clrecon.opencl import cache_warnings, choose_remembered, list_devices, list_platforms, remembered_fault
    from clrecon.opencl.select import explain_choice

    devices = list_devices()
    problem: DeviceError | None = None
    chosen: int | None = None
    reason: str | None = None
    warnings: Sequence[str] = cache_warnings()
    try:
        device = choose_remembered(name)
        chosen = device.index
        reason = explain_choice(name)
        warnings = device.warnings
    except DeviceError as error:
        problem = error
    survey = name_schema(
        "devices",
        {
            "platforms": list_platforms(),
            "devices": [
                {**device.describe(), "fault": remembered_fault(device), "chosen": device.index == chosen}
                for device in devices
            ],
            "chosen": chosen,
            "reason": reason,
            "warnings": list(warnings),
        },
    )
    return survey, problem
