"""Every exception that a driver or pyopencl needs, each with its reason, in this one place."""

from __future__ import annotations

import os
from typing import Any

__all__ = [
    "SIMULATOR_PLATFORMS",
    "has_event_times",
    "import_pyopencl",
    "is_simulator",
    "is_software_gpu",
    "shares_host_memory",
]

SIMULATOR_PLATFORMS = ("oclgrind",)
"""Simulators claim to be fast devices (Oclgrind: CPU, GPU and accelerator at once) and are 1000 times slower."""


def import_pyopencl() -> Any:
    """Import pyopencl once its environment is safe.

    pyopencl 2026.1 reads PYOPENCL_CACHE_FAILURE_FATAL without a default when its binary cache cannot be used
    (read-only home, Oclgrind): the KeyError then hides the cause.
    """
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    import pyopencl

    return pyopencl


def is_simulator(platform_name: str) -> bool:
    """True for platforms that check or simulate and must never be chosen silently."""
    return any(name in platform_name.lower() for name in SIMULATOR_PLATFORMS)


def is_software_gpu(device_name: str) -> bool:
    """True for Mesa's llvmpipe: a graphics rasteriser on the CPU, 5 times slower than PoCL on the same cores."""
    return "llvmpipe" in device_name.lower()


def shares_host_memory(platform_name: str, device_type: str) -> bool:
    """True when a kernel may work in numpy's own memory without a copy.

    CPU drivers do.  Rusticl on llvmpipe keeps a shadow copy of host pointers and simulators check bounds of
    buffers that they own, so both get buffers and copies like a GPU.
    """
    return device_type == "cpu" and not is_simulator(platform_name) and "rusticl" not in platform_name.lower()


def has_event_times(platform_name: str) -> bool:
    """False where profiling events say nothing: rusticl of Mesa 22 reports some nanoseconds for any kernel."""
    return "rusticl" not in platform_name.lower()
