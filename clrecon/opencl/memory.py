"""The memory budget: everything an operator needs is summed and compared before anything is allocated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from clrecon.errors import DeviceError, UsageError
from clrecon.opencl.context import Device

__all__ = ["MemoryLimits", "check_budget", "check_memory", "describe_shortage", "memory_limits"]


def _mib(size: int) -> str:
    return f"{size / 2**20:,.0f} MiB" if size >= 2**20 else f"{size:,} bytes"


@dataclass(frozen=True)
class MemoryLimits:
    """What may be taken on a device.

    Attributes
    ----------
    label : str
        The device, for messages.
    total_bytes, buffer_bytes : int
        All buffers together, and the largest single one.
    asked : bool
        The total is what the user allows, less than what the device has.
    """

    label: str
    total_bytes: int
    buffer_bytes: int
    asked: bool

    def describe(self) -> str:
        """What there is, for messages."""
        if self.asked:
            return f"{_mib(self.total_bytes)} are allowed on {self.label}"
        return f"{self.label} has {_mib(self.total_bytes)}, at most {_mib(self.buffer_bytes)} in one buffer"


def check_memory(memory: int | None) -> None:
    """Refuse what is no number of bytes that may be taken on a device; None is all of its memory.

    Raises
    ------
    UsageError
    """
    if memory is not None and (isinstance(memory, bool) or not isinstance(memory, int) or memory < 1):
        raise UsageError(f"memory is a whole number of bytes, not {memory!r}")


def memory_limits(device: Device, memory: int | None = None) -> MemoryLimits:
    """The device's own limits, or `memory` bytes where that is less."""
    asked = memory is not None and memory < device.memory_bytes
    total = int(memory) if asked and memory is not None else device.memory_bytes
    return MemoryLimits(device.label, total, min(device.max_allocation_bytes, total), asked)


def describe_shortage(limits: MemoryLimits, buffers: Mapping[str, int]) -> str:
    """Why `buffers` do not fit together or one of them not alone; empty where they do."""
    for what, size in buffers.items():
        if size > limits.buffer_bytes:
            return f"the {what} needs a buffer of {_mib(size)}, {limits.label} allows {_mib(limits.buffer_bytes)}"
    total = sum(buffers.values())
    if total > limits.total_bytes:
        parts = ", ".join(f"{what} {_mib(size)}" for what, size in buffers.items())
        return f"this needs {_mib(total)} on the device ({parts}): {limits.describe()}"
    return ""


def check_budget(device: Device, buffers: Mapping[str, int], memory: int | None = None) -> int:
    """Check that all `buffers` fit the device together and each alone.

    Parameters
    ----------
    device : Device
    buffers : mapping of str to int
        Bytes of every buffer that lives at the same time, by what it is.
    memory : int, optional
        Bytes that may be taken on the device; None is all of its memory.

    Returns
    -------
    int
        The sum in bytes.

    Raises
    ------
    DeviceError
        A buffer is over the device's largest allocation, or the sum is over its memory.
    """
    shortage = describe_shortage(memory_limits(device, memory), buffers)
    if shortage:
        raise DeviceError(f"{shortage}: use a device with more memory or a smaller volume")
    return sum(buffers.values())
