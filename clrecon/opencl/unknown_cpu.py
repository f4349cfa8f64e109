"""PoCL on a CPU that is newer than its compiler: name the nearest one that the compiler knows.

The PoCL of PyPI (3.0, LLVM 14) asks LLVM for the name of the CPU, gets "generic" for any that came out after it (AMD's
Zen 5, Intel since Meteor Lake), and clang then refuses that name: no kernel builds (pocl issue 1049). PoCL 3.1 takes
the name from what the CPU can do.  Earlier versions have no option for it, so this module does the same from outside.
The name is a string of 7 letters in the driver's memory, beside the name of its target; it is overwritten there before
a kernel is built.  If the strings are not found exactly so, nothing is changed, and the device is reported as unusable.
"""

from __future__ import annotations

import os
import platform
import re
import struct
import sys
from pathlib import Path

UNKNOWN = b"generic"

CPU_NAMES: tuple[tuple[str, frozenset[str]], ...] = (
    ("skx", frozenset("avx512f avx512bw avx512cd avx512dq avx512vl adx avx2 bmi1 bmi2 abm f16c fma movbe".split())),
    ("haswell", frozenset("avx2 bmi1 bmi2 abm f16c fma movbe popcnt".split())),
    ("x86-64", frozenset()),
)
"""LLVM's names of CPUs, no longer than `UNKNOWN`, and the flags that each needs, as in /proc/cpuinfo; best first.  The
kernels only distinguish AVX-512 and AVX2 (`cl/rays/window.h`), so more names would bring nothing.
"""

_STRUCT_BYTES = 2048
_POINTER = struct.Struct("<Q")


def has_unknown_cpu(platform_name: str, device_version: str) -> bool:
    """True where PoCL reports, for a device on x86-64 Linux, that its compiler does not know it."""
    return (
        sys.platform == "linux"
        and platform.machine() == "x86_64"
        and "portable computing language" in platform_name.lower()
        and re.search(r"HSTR: [a-z]+-x86_64-[a-z0-9_-]*-generic$", device_version.strip()) is not None
    )


def choose_name(cpuinfo: str) -> str:
    """Return the best of `CPU_NAMES` whose flags are all in the text of /proc/cpuinfo."""
    found = re.search(r"^flags\s*:(.*)$", cpuinfo, re.MULTILINE)
    flags = set(found.group(1).split()) if found else set()
    return next(name for name, needs in CPU_NAMES if needs <= flags)


class NameOfCpu:
    """The place where a PoCL device keeps the name of its CPU, and the name to write there.

    address: Address of the driver's structure of the device (its ``cl_device_id``).

    name: One of `CPU_NAMES`.
    """

    def __init__(self, address: int):
        try:
            self.name = choose_name(Path("/proc/cpuinfo").read_text())
            with _Memory() as memory:
                self._place = _find_name(memory, address)
        except OSError as error:
            raise LookupError(str(error)) from error

    def write(self) -> None:
        """Write the name, if it is not there yet."""
        try:
            with _Memory() as memory:
                if memory.read_text(self._place) != self.name.encode():
                    if memory.read_text(self._place) != UNKNOWN:
                        raise LookupError("the name of the CPU has changed")
                    memory.write(self._place, self.name.encode().ljust(len(UNKNOWN), b"\0"))
        except OSError as error:
            raise LookupError(str(error)) from error


class _Memory:
    """Memory of this process, read through the system, which reports an error where a wrong pointer would end the
    process.
    """

    def __enter__(self) -> _Memory:
        self._file = os.open("/proc/self/mem", os.O_RDWR | os.O_CLOEXEC)
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def read(self, address: int, count: int) -> bytes:
        return os.pread(self._file, count, address)

    def read_text(self, address: int) -> bytes:
        """Return the bytes up to a 0 at an address; empty if nothing is mapped there."""
        try:
            return self.read(address, 32).split(b"\0", 1)[0]
        except (OSError, OverflowError):
            return b""

    def write(self, address: int, content: bytes) -> None:
        if os.pwrite(self._file, content, address) != len(content):
            raise LookupError("the name of the CPU cannot be written")


def _find_name(memory: _Memory, address: int) -> int:
    """Return the address of the only string of the structure that is a CPU's name after a target's name."""
    names = (UNKNOWN, *(name.encode() for name, _ in CPU_NAMES))
    pointers = [place for (place,) in _POINTER.iter_unpack(_whole_words(memory.read(address, _STRUCT_BYTES)))]
    places = [
        cpu
        for target, cpu in zip(pointers, pointers[1:], strict=False)
        if memory.read_text(target).startswith(b"x86_64-") and memory.read_text(cpu) in names
    ]
    if len(places) != 1:
        raise LookupError(f"{len(places)} names of CPUs were found in its memory, not one")
    return places[0]


def _whole_words(content: bytes) -> bytes:
    return content[: len(content) // _POINTER.size * _POINTER.size]
