"""The OpenCL devices of this machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from clrecon.errors import DeviceError
from clrecon.system.records import name_schema

if TYPE_CHECKING:
    from clrecon.opencl import Device


def list_usable() -> list[Device]:
    """Return the devices of this machine without simulators, unusable ones and those found to compute wrongly."""
    from clrecon.opencl import list_devices, remembered_fault

    devices = [
        device
        for device in list_devices()
        if not (device.shortcoming or device.is_simulator or remembered_fault(device))
    ]
    if not devices:
        raise DeviceError("there is no usable OpenCL device on this machine")
    return devices


def check_indexes(text: str, named_by: str) -> None:
    """Refuse indexes of devices that are not there; a worker would find out, and not know who named them."""
    from clrecon.opencl import list_devices

    known = [str(device.index) for device in list_devices()]
    unknown = [index for index in map(str.strip, text.split(",")) if index not in known]
    if unknown:
        raise DeviceError(f"{named_by}: no device {', '.join(unknown)}; there are {', '.join(known) or 'none'}")


def survey_devices(name: str | None = None) -> tuple[dict[str, Any], DeviceError | None]:
    """List every OpenCL platform and device, as docs/contract.md says, and which would be used, or why none would."""
    from clrecon.opencl import cache_warnings, choose_remembered, list_devices, list_platforms, remembered_fault
    from clrecon.opencl.select import explain_choice

    devices = list_devices()
    device: Device | None = None
    reason = problem = None
    try:
        device, reason = choose_remembered(name), explain_choice(name)
    except DeviceError as error:
        problem = error
    chosen = None if device is None else device.index
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
            "warnings": list(cache_warnings() if device is None else device.warnings),
        },
    )
    return survey, problem
