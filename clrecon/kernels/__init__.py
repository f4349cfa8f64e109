"""Kernel sources, programs and launches: between the drivers below and the operators above."""

from clrecon.kernels.arrays import allocate, download, empty_output, upload
from clrecon.kernels.launching import Stopwatch, launch
from clrecon.kernels.pages import result_pages
from clrecon.kernels.program import Program, load_program
from clrecon.kernels.sources import kernel_files, read_kernel_source

__all__ = [
    "Program",
    "Stopwatch",
    "allocate",
    "download",
    "empty_output",
    "kernel_files",
    "launch",
    "load_program",
    "read_kernel_source",
    "result_pages",
    "upload",
]
