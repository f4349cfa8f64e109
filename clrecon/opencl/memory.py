"""The memory budget: everything an operator needs is summed and compared before anything is allocated."""

from __future__ import annotations

from collections.abc import Mapping

from clrecon.errors import DeviceError
from clrecon.opencl.context import Device

__all__ = ["check_budget"]


def _mib(size: int) -> str:
    return f"{size / 2**20:,.0f} MiB"


def check_budget(device: Device, buffers: Mapping[str, int]) -> int:
    """Check that all `buffers` fit the device together and each alone.

    Parameters
    ----------
    device : Device
    buffers : mapping of str to int
        Bytes of every buffer that lives at the same time, by what it is.

    Returns
    -------
    int
        The sum in bytes.

    Raises
    ------
    DeviceError
        A buffer is over the device's largest allocation, or the sum is over its memory.
    """
    for what, size in buffers.items():
        if size > device.max_allocation_bytes:
            raise DeviceError(
                f"the {what} needs a buffer of {_mib(size)}, device {device.label} allows"
                f" {_mib(device.max_allocation_bytes)}: use a device with more memory or a smaller volume"
            )
    total = sum(buffers.values())
    if total > device.memory_bytes:
        parts = ", ".join(f"{what} {_mib(size)}" for what, size in buffers.items())
        raise DeviceError(
            f"this needs {_mib(total)} on the device ({parts}), {device.label} has {_mib(device.memory_bytes)}:"
            " use a device with more memory or a smaller volume"
        )
    return total
