"""`Device`: one OpenCL device with its context, its queue and what is known of it."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from clrecon.errors import DeviceError
from clrecon.opencl import quirks

__all__ = ["GROUP_SIZE", "Device", "describe_error"]

GROUP_SIZE = 64
"""A whole wavefront of every GPU, and small enough to give a CPU's cores equal shares."""


def describe_error(error: Exception) -> str:
    """First line of what a driver said."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0]


class Device:
    """An OpenCL device; context and queue are made at first use.

    Attributes
    ----------
    index : int
        Place in `list_devices`, the number that ``--device`` takes.
    name, platform, type, version, driver : str
        `type` is "gpu", "accelerator", "cpu" or "custom"; `platform` is the platform's name.
    memory_bytes, max_allocation_bytes : int
        All memory of the device, and the largest single buffer.
    compute_units : int
    is_simulator : bool
        A checking simulator such as Oclgrind: used only when it is named.
    """

    def __init__(self, index: int, cl_platform: Any, cl_device: Any):
        cl = quirks.import_pyopencl()
        self.index = index
        self.cl_device = cl_device
        self.name: str = cl_device.name.strip()
        self.platform: str = cl_platform.name.strip()
        kinds = cl.device_type
        flags = ((kinds.GPU, "gpu"), (kinds.ACCELERATOR, "accelerator"), (kinds.CPU, "cpu"))
        self.type: str = next((name for flag, name in flags if cl_device.type & flag), "custom")
        self.version: str = cl_device.version.strip()
        self.driver: str = cl_device.driver_version.strip()
        self.platform_version: str = cl_platform.version.strip()
        self.memory_bytes: int = cl_device.global_mem_size
        self.max_allocation_bytes: int = cl_device.max_mem_alloc_size
        self.compute_units: int = cl_device.max_compute_units
        self.max_work_group_size: int = cl_device.max_work_group_size
        self.is_simulator: bool = quirks.is_simulator(self.platform)
        self.shares_host_memory: bool = quirks.shares_host_memory(self.platform, self.type)
        self.has_event_times: bool = quirks.has_event_times(self.platform)
        self.programs: dict[tuple[str, tuple[str, ...]], Any] = {}

    @property
    def score(self) -> tuple[int, int, str, int]:
        """Sort key of the automatic choice: type, then memory, then driver version, then the order found."""
        rank = {"gpu": 3, "accelerator": 2, "cpu": 1}.get(self.type, 0)
        if quirks.is_software_gpu(self.name):
            rank = 0
        return rank, self.memory_bytes, self.driver, -self.index

    @property
    def group_size(self) -> int:
        """Work-group size of all launches: 64, or what the device allows where that is less (Apple's CPU: 1)."""
        return min(GROUP_SIZE, self.max_work_group_size)

    @property
    def label(self) -> str:
        """Platform and device name, for messages and reports."""
        return f"{self.name} ({self.platform})"

    @cached_property
    def context(self) -> Any:
        """The pyopencl context of this device alone.

        Raises
        ------
        DeviceError
            The driver refuses.
        """
        cl = quirks.import_pyopencl()
        try:
            return cl.Context([self.cl_device])
        except cl.Error as error:
            raise DeviceError(f"device {self.label} cannot be opened: {describe_error(error)}") from error

    @cached_property
    def queue(self) -> Any:
        """The in-order command queue, with profiling."""
        cl = quirks.import_pyopencl()
        try:
            return cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        except cl.Error as error:
            raise DeviceError(f"device {self.label} gives no queue: {describe_error(error)}") from error

    def describe(self) -> dict[str, Any]:
        """Facts for ``clrecon devices --json`` and reports."""
        return {
            "index": self.index,
            "name": self.name,
            "platform": self.platform,
            "type": self.type,
            "version": self.version,
            "driver": self.driver,
            "platform_version": self.platform_version,
            "memory_bytes": self.memory_bytes,
            "max_allocation_bytes": self.max_allocation_bytes,
            "compute_units": self.compute_units,
            "simulator": self.is_simulator,
        }

    def __repr__(self) -> str:
        return f"Device({self.index}: {self.label}, {self.type})"
