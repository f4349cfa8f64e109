"""OpenCL: devices and their memory, kernel sources and programs, arrays and launches.

Only this package searches for drivers and knows where the kernel files are.
"""

from clrecon.opencl.arrays import allocate, copy_buffer, download, empty_output, upload
from clrecon.opencl.cache.folders import cache_warnings
from clrecon.opencl.commands import has_hung_commands, keep_for_hung_commands
from clrecon.opencl.context import Device
from clrecon.opencl.first_use import remembered_fault
from clrecon.opencl.launching import Stopwatch, launch
from clrecon.opencl.memory import MemoryLimits, check_budget, check_memory, describe_shortage, memory_limits
from clrecon.opencl.pages import result_pages
from clrecon.opencl.program import Kernel, Program, load_program
from clrecon.opencl.select import choose_device, choose_remembered, choose_unchecked, list_devices, list_platforms
from clrecon.opencl.sources import kernel_constant, kernel_files, kernel_number, read_kernel_source
from clrecon.opencl.stand_in import take_device, work_on
from clrecon.opencl.waiting import settle, wait

__all__ = [
    "Device",
    "Kernel",
    "MemoryLimits",
    "Program",
    "Stopwatch",
    "allocate",
    "cache_warnings",
    "check_budget",
    "check_memory",
    "choose_device",
    "choose_remembered",
    "choose_unchecked",
    "copy_buffer",
    "describe_shortage",
    "download",
    "empty_output",
    "has_hung_commands",
    "keep_for_hung_commands",
    "kernel_constant",
    "kernel_files",
    "kernel_number",
    "launch",
    "list_devices",
    "list_platforms",
    "load_program",
    "memory_limits",
    "read_kernel_source",
    "remembered_fault",
    "result_pages",
    "settle",
    "take_device",
    "upload",
    "wait",
    "work_on",
]
