"""The memory budget: all buffers of an operator are summed and compared with the device before any is allocated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from clrecon.errors import DeviceError, DeviceFailedError, DeviceMemoryError, UsageError
from clrecon.opencl.context import Device
from clrecon.system.wording import name_parameter


def _mib(size: int, up: bool = False) -> str:
    if size < 2**20:
        return f"{size:,} bytes"
    return f"{-(-size // 2**20) if up else round(size / 2**20):,} MiB"


@dataclass(frozen=True)
class MemoryLimits:
    """The memory that may be taken on a device.

    label: Name of the device, for messages.
    device_bytes, device_buffer_bytes: Memory of the device for all buffers together, and for the largest single one.
    asked_bytes: Bytes that the user allows, if less.
    """

    label: str
    device_bytes: int
    device_buffer_bytes: int
    asked_bytes: int | None

    @property
    def total_bytes(self) -> int:
        """Bytes that all buffers together may take."""
        return self.device_bytes if self.asked_bytes is None else self.asked_bytes

    @property
    def buffer_bytes(self) -> int:
        """Bytes that a single buffer may take."""
        return min(self.device_buffer_bytes, self.total_bytes)

    def device_fits(self, buffers: Mapping[str, int]) -> bool:
        """True where the device has room for `buffers`, regardless of the user's limit."""
        sizes = buffers.values()
        return sum(sizes) <= self.device_bytes and max(sizes, default=0) <= self.device_buffer_bytes

    def describe(self) -> str:
        """Describe the available memory for messages."""
        if self.asked_bytes is not None:
            return f"{_mib(self.asked_bytes)} are allowed on {self.label} by {name_parameter('memory')}"
        return f"{self.label} has {_mib(self.device_bytes)}, at most {_mib(self.device_buffer_bytes)} in one buffer"


def check_memory(memory: int | None) -> None:
    """Refuse a value that is not a byte count of at least 1; None stands for all memory of the device."""
    if memory is not None and (isinstance(memory, bool) or not isinstance(memory, int) or memory < 1):
        raise UsageError(f"memory is a whole number of bytes, not {memory!r}")


def memory_limits(device: Device, memory: int | None = None) -> MemoryLimits:
    """Return the device's own limits, or `memory` bytes if that is less."""
    asked = int(memory) if memory is not None and memory < device.memory_bytes else None
    largest = min(device.max_allocation_bytes, device.memory_bytes)
    return MemoryLimits(device.label, device.memory_bytes, largest, asked)


def describe_shortage(limits: MemoryLimits, buffers: Mapping[str, int]) -> str:
    """Return why `buffers` do not fit together, or one of them does not fit alone; empty if they fit."""
    for what, size in buffers.items():
        if size > limits.device_buffer_bytes:
            most = _mib(limits.device_buffer_bytes)
            return f"the {what} needs a buffer of {_mib(size)}, {limits.label} allows {most}"
    total = sum(buffers.values())
    if total <= limits.total_bytes:
        return ""
    if not limits.device_fits(buffers):
        limits = replace(limits, asked_bytes=None)  # a higher limit would not help
    parts = ", ".join(f"{what} {_mib(size)}" for what, size in buffers.items())
    return f"this needs {_mib(total, up=True)} on the device ({parts}): {limits.describe()}"


def check_budget(
    device: Device, buffers: Mapping[str, int], memory: int | None = None, *, less_may_fit: bool = False
) -> int:
    """Check that all `buffers` fit the device together and each alone.

    buffers: Bytes of all buffers that exist at the same time, by description.
    memory: Bytes that may be taken on the device; None is all of its memory.
    less_may_fit: The caller can do the work in smaller parts.

    Returns: The sum in bytes.
    """
    limits = memory_limits(device, memory)
    shortage = describe_shortage(limits, buffers)
    if shortage:
        if limits.device_fits(buffers):
            kind = DeviceMemoryError if less_may_fit else DeviceError
            raise kind(f"{shortage}: allow that much or ask for less")
        kind = DeviceMemoryError if less_may_fit else DeviceFailedError
        raise kind(f"{shortage}: use a device with more memory or a smaller volume")
    return sum(buffers.values())
