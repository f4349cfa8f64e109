"""Quirks: every exception that a driver or pyopencl needs, each with its reason.

One has its own file: `clrecon.opencl.unknown_cpu`.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

__all__ = [
    "SIMULATOR_PLATFORMS",
    "cache_warnings",
    "has_event_times",
    "import_pyopencl",
    "is_simulator",
    "is_slow_from_its_cache",
    "is_software_gpu",
    "kernel_variants",
    "shares_host_memory",
]

SIMULATOR_PLATFORMS = ("oclgrind",)
"""Platforms of simulators, which claim to be fast devices (Oclgrind: CPU, GPU and accelerator at once) and are 1000
times slower."""

_NO_CACHES = {"PYOPENCL_NO_CACHE": "1", "MESA_SHADER_CACHE_DISABLE": "true", "MESA_GLSL_CACHE_DISABLE": "true"}
"""Environment that switches caches off where no folder can be written.  Mesa (before 22.1 under the last name) writes
its cache from a thread of its own, even into a folder that is being removed.  PoCL cannot do without a cache."""


@cache
def import_pyopencl() -> Any:
    """Import pyopencl after its environment has been made safe.

    pyopencl 2026.1 reads PYOPENCL_CACHE_FAILURE_FATAL without a default when its binary cache cannot be used
    (read-only home, Oclgrind): the KeyError then hides the cause.
    """
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    cache_warnings()
    import pyopencl

    return pyopencl


def _is_usable(folder: Path) -> bool:
    """True when a file of 4 KiB can be written in `folder`, which is made where it is not there."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 12))
    except OSError:
        return False
    return True


def _remove_tree(folder: str) -> None:
    """Remove a folder into which threads of a driver may still be writing, so that a first attempt may fail."""
    for pause in (0.0, 0.01, 0.03, 0.1, 0.3):
        time.sleep(pause)
        shutil.rmtree(folder, ignore_errors=True)
        if not os.path.lexists(folder):
            return


@cache
def cache_warnings() -> tuple[str, ...]:
    """Make sure that drivers can keep built kernels; return warnings for the user if they cannot.

    Without a writable folder (no HOME, a read-only one, a full disk) PoCL shows no device at all and pyopencl fails to
    import.  They then get a temporary folder that is removed at the end of the process.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    pocl = os.environ.get("POCL_CACHE_DIR")
    if _is_usable(home) and (pocl is None or _is_usable(Path(pocl))):
        return ()
    try:
        folder = tempfile.mkdtemp(prefix="clrecon-")
    except OSError:
        return ("no folder for built kernels can be written: OpenCL drivers may show no device",)
    atexit.register(_remove_tree, folder)
    os.environ.update(_NO_CACHES, POCL_CACHE_DIR=folder, XDG_CACHE_HOME=folder)
    return ("the cache folder cannot be written: kernels are built anew by every process",)


def is_simulator(platform_name: str) -> bool:
    """True for platforms that check or simulate and must never be chosen silently."""
    return any(name in platform_name.lower() for name in SIMULATOR_PLATFORMS)


def is_slow_from_its_cache(platform_name: str) -> bool:
    """True for PoCL: to find a built program it preprocesses the whole source, builtins included."""
    return "portable computing language" in platform_name.lower()


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
    """False where profiling events are useless: rusticl of Mesa 22 reports some nanoseconds for any kernel."""
    return "rusticl" not in platform_name.lower()


def kernel_variants(platform_name: str, device_type: str) -> dict[str, str]:
    """Return definitions for kernels with special code for CPUs, whose compilers do not turn work-items into vectors.

    LANES is the length of their vectors: 8 is one AVX register; half an AVX-512 register or two NEON registers cost
    little.  WORDS_PER_ITEM is the number of neighbouring words of a mask for each work-item, so that its vectors are
    full.  OpenCL's prefetch() has no effect in PoCL; the builtin of its compiler, clang, has.
    """
    if device_type != "cpu" or is_simulator(platform_name):
        return {"LANES": "1", "WORDS_PER_ITEM": "1"}
    variants = {"LANES": "8", "WORDS_PER_ITEM": "8"}
    if "portable computing language" in platform_name.lower():
        variants["HAS_BUILTIN_PREFETCH"] = "1"
    return variants
