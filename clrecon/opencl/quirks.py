"""Quirks: every exception that a driver or pyopencl needs, each with its reason; PoCL's own are in `pocl`."""

from __future__ import annotations

import os
import re
from functools import cache
from typing import Any

from clrecon.errors import DeviceError
from clrecon.opencl.cache import prepare_caches

_SIMULATOR_PLATFORMS = ("oclgrind",)
"""Platforms of simulators, which claim to be fast devices (Oclgrind: CPU, GPU and accelerator) and are not."""

_THREAD_COUNTS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
"""Variables for the number of PoCL's threads, before version 4 and since."""

_MOST_THREADS = 4096
"""Threads that PoCL may be asked for, more than any processor has; a device may get two for one that is asked for."""


@cache
def import_pyopencl() -> Any:
    """Import pyopencl after its environment has been made safe.

    pyopencl 2026.1 reads PYOPENCL_CACHE_FAILURE_FATAL without a default when its binary cache cannot be used
    (read-only home, Oclgrind): the KeyError then hides the cause.  It does not know what PYOPENCL_NO_CACHE set to
    nothing means.
    """
    _check_thread_counts()
    os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
    if not os.environ.get("PYOPENCL_NO_CACHE", "").strip():
        os.environ.pop("PYOPENCL_NO_CACHE", None)
    prepare_caches()
    try:
        import pyopencl
    except ValueError as error:
        setting = os.environ.get("PYOPENCL_NO_CACHE", "")
        raise DeviceError(f"PYOPENCL_NO_CACHE is {setting!r}: unset it, or write 1 or 0 ({error})") from error
    return pyopencl


def _check_thread_counts() -> None:
    """Refuse what PoCL makes nothing good of: -1 ends the process when the platform is loaded, words are one thread."""
    for name in _THREAD_COUNTS:
        setting = os.environ.get(name, "").strip()
        if not setting:
            os.environ.pop(name, None)
        elif not re.fullmatch(r"\+?[0-9]{1,9}", setting) or int(setting) > _MOST_THREADS:
            raise DeviceError(
                f"{name} is {setting!r:.60}, and PoCL needs a number of threads: unset it, or write a whole number, at"
                f" most {_MOST_THREADS}"
            )


def is_simulator(platform_name: str) -> bool:
    """True for platforms that check or simulate and must never be chosen silently."""
    return any(name in platform_name.lower() for name in _SIMULATOR_PLATFORMS)


def is_pocl(platform_name: str) -> bool:
    """True for PoCL, which keeps what it builds, and ends the process when a file of it is damaged."""
    return "portable computing language" in platform_name.lower()


def first_header(platform_name: str, driver: tuple[int, ...]) -> str:
    """Return the header that stands before every kernel file: for PoCL 3.0 one with the simple functions of OpenCL.

    PoCL 3.0 calls a function for each min() and vload8(): its functions are compiled for one processor of each
    generation, such as "haswell", kernels for the very processor, and LLVM 14 does not inline between the two.
    PoCL 3.1 compiles both for the same one.
    """
    return "include/inlined.h" if is_pocl(platform_name) and driver[:2] == (3, 0) else ""


def keeps_programs(platform_name: str) -> bool:
    """True for drivers that keep built programs themselves, and for simulators.

    Mesa finds its own programs as fast as it takes binaries, and ends the process on one that it does not know.  To
    get PoCL's binaries costs a second build of each kernel, for groups of any size: 2.8 s of processor time for a
    first surface, and then 0.02 s less for each program.
    """
    of_drivers = any(name in platform_name.lower() for name in ("nvidia", "rusticl", "clover"))
    return of_drivers or is_pocl(platform_name) or is_simulator(platform_name)


def is_software_gpu(device_name: str) -> bool:
    """True for Mesa's llvmpipe: a graphics rasteriser on the CPU, 5 times slower than PoCL on the same cores."""
    return "llvmpipe" in device_name.lower()


def shares_host_memory(platform_name: str, device_type: str) -> bool:
    """True when a kernel may work in numpy's own memory without a copy: CPU drivers, not Rusticl or simulators."""
    return device_type == "cpu" and not is_simulator(platform_name) and "rusticl" not in platform_name.lower()


def rounding_options(cl_device: Any) -> tuple[str, ...]:
    """Return the option for quotients and roots that are the nearest float32, where the driver has it.

    Without it OpenCL allows an error of 2.5 and 3 units in the last place, and NVIDIA's compiler makes use of that.
    """
    rounds = cl_device.single_fp_config & import_pyopencl().device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
    return ("-cl-fp32-correctly-rounded-divide-sqrt",) if rounds else ()


def language_option(platform_name: str, device_type: str, driver: tuple[int, ...]) -> str:
    """Return the option for the version of OpenCL C: 2.0 for Intel's GPU drivers before 23.

    The compiler of driver 22.43 crashes, and the process with it, when it builds rays/surface.cl as version 1.2.
    """
    is_old = "intel" in platform_name.lower() and device_type == "gpu" and driver[:1] < (23,)
    return f"-cl-std=CL{'2.0' if is_old else '1.2'}"


def has_own_memory(cl_device: Any, device_type: str) -> bool:
    """True for graphics cards; GPUs that are parts of a processor, and Mesa's llvmpipe, use the computer's memory."""
    is_unified = bool(getattr(cl_device, "host_unified_memory", False))
    return device_type == "gpu" and not is_unified and not is_software_gpu(cl_device.name)


def has_event_times(platform_name: str) -> bool:
    """False where profiling events are useless.

    Rusticl of Mesa 22 reports some nanoseconds for any kernel, Apple's drivers a unit of their own.
    """
    return not any(name in platform_name.lower() for name in ("rusticl", "apple"))


def most_steps(device_name: str) -> int | None:
    """Return after how many steps of its loops, all together, a work-item goes on behind them; None for never.

    Mesa's llvmpipe does so after 65,535, measured with Mesa 22.3 and LLVM 15, and tells nobody.
    """
    return 65535 if is_software_gpu(device_name) else None


def kernel_variants(platform_name: str, device_type: str, driver: tuple[int, ...] = ()) -> dict[str, str]:
    """Return definitions for kernels with special code for CPUs, whose compilers do not turn work-items into vectors.

    LANES is the length of their vectors: 8 is one AVX register; half an AVX-512 register or two NEON registers cost
    little.  Kernel files that ask for it take whole ones where HAS_WIDE_LANES is 1: PoCL 3.0 computes them wrong.
    WORDS_PER_ITEM is the number of neighbouring words of a mask for each work-item, so that its vectors are full.
    OpenCL's prefetch() has no effect in PoCL; the builtin of its compiler, clang, has.
    """
    if device_type != "cpu" or is_simulator(platform_name):
        return {"LANES": "1", "WORDS_PER_ITEM": "1"}
    variants = {"LANES": "8", "WORDS_PER_ITEM": "8"}
    if is_pocl(platform_name):
        variants["HAS_BUILTIN_PREFETCH"] = "1"
        variants["HAS_WIDE_LANES"] = str(int(driver >= (3, 1)))
    return variants
