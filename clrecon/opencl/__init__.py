"""OpenCL devices: what is there, which one is used, and how much memory it has. The only layer that finds drivers."""

from clrecon.opencl.context import Device
from clrecon.opencl.memory import MemoryLimits, check_budget, check_memory, describe_shortage, memory_limits
from clrecon.opencl.select import choose_device, list_devices, list_platforms

__all__ = [
    "Device",
    "MemoryLimits",
    "check_budget",
    "check_memory",
    "choose_device",
    "describe_shortage",
    "list_devices",
    "list_platforms",
    "memory_limits",
]
