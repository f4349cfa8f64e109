"""OpenCL: devices and their memory, kernel sources and programs, arrays and launches; drivers are found here alone."""

from clrecon.opencl.arrays import (
    MemoryLimits,
    allocate,
    check_budget,
    check_memory,
    copy_buffer,
    describe_shortage,
    download,
    download_all,
    empty_output,
    memory_limits,
    require_room,
    result_pages,
    upload,
)
from clrecon.opencl.cache import cache_warnings
from clrecon.opencl.device import Device, has_hung_commands, keep_for_hung_commands
from clrecon.opencl.launching import Stopwatch, launch, launcher, settle, wait
from clrecon.opencl.program import Kernel, Program, building_together, load_program
from clrecon.opencl.select import (
    Attempt,
    choose_device,
    choose_remembered,
    choose_unchecked,
    list_devices,
    list_platforms,
    remembered_fault,
    take_device,
    with_fallback,
)
from clrecon.opencl.sources import kernel_constant, kernel_files, kernel_number, read_kernel_source
from clrecon.opencl.transfers import Landed
