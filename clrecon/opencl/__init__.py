"""OpenCL devices: what is there, which one is used, and how much memory it has. The only layer that finds drivers."""

from clrecon.opencl.context import Device
from clrecon.opencl.memory import check_budget
from clrecon.opencl.select import choose_device, list_devices, list_platforms

__all__ = ["Device", "check_budget", "choose_device", "list_devices", "list_platforms"]
