"""Guards against faults of PoCL, above all of 3.0: damaged files that it keeps, and CPUs newer than its compiler.

What PoCL keeps of built programs is checked before PoCL loads it.  PoCL ends the process when a kept file is damaged:
cut by a full disk, overwritten, swapped.  So the files of each program are written down when a process has worked with
them and comes to its end (or works on for some seconds): size, time and hash, in a record under the hash of what was
built.  Before the next process lets PoCL look for that program, its files are compared with the record, and a program
with a difference is removed, which makes PoCL build it again. Files that no record mentions come from a process that
runs, or from one that died while it built.  They are removed when no other process uses the folder: each holds a lock
on it.

Two processes that build the same program at once write the same files: the one that ends first records them, and the
other replaces them until it ends and records its own.  So a difference is called damage only when no other process uses
the folder; the program is built again in any case.

Not covered: contents that change while size and time stay the same, and damage between the check and PoCL's reading.

On a CPU that is newer than PoCL's compiler, the nearest one that the compiler knows is named.  The PoCL of PyPI (3.0,
LLVM 14) asks LLVM for the name of the CPU, gets "generic" for any that came out after it (AMD's Zen 5, Intel since
Meteor Lake), and clang then refuses that name: no kernel builds (pocl issue 1049). PoCL 3.1 takes the name from what
the CPU can do.  Earlier versions have no option for it, so this module does the same from outside. The name is a string
of 7 letters in the driver's memory, beside the name of its target; it is overwritten there before a kernel is built.
If the strings are not found exactly so, nothing is changed, and the device is reported as unusable."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import platform
import re
import shutil
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

from clrecon.opencl.cache import make_private, prepare_caches
from clrecon.system.log import get_logger

if sys.platform != "win32":
    import fcntl

log = get_logger(__name__)

DAMAGED = "kept kernels are damaged: they are not used, and built anew"
UNFINISHED = "the last process that built kernels died: what it built is not used, and built anew"

_LAST_USE = "last_accessed"
"""Empty file of each of PoCL's programs, written whenever the program is built or found."""

_SECONDS_BEFORE_RECORD = 5.0
"""Time after which kernels that were built are taken to work, in a process that runs on."""

_Files = dict[str, list[Any]]
"""Files of one program, below its folder: size, time of change in ns, hash."""


class KnownGood:
    """The records of one folder of PoCL, to which only this class and PoCL write."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._records = folder / "records"
        make_private(self._records)
        self._lock = threading.RLock()
        self._used: dict[str, set[str]] = {}
        self._due: float | None = None
        self._is_swept = False
        self.warnings: list[str] = []
        self._handle = os.open(folder / "in-use", os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o600)
        self._share()
        self._remove_leftovers()
        atexit.register(self.record)

    @contextmanager
    def building(self, key: str) -> Iterator[None]:
        """Check what PoCL keeps of the program `key`, and note what it uses in the ``with`` block."""
        with self._lock:
            recorded = self._read(key)
            with suppress(OSError):  # a folder that was removed meanwhile holds nothing to check
                self._check(recorded)
            os.utime(self._handle if os.utime in os.supports_fd else self._folder / "in-use")
            start = os.fstat(self._handle).st_mtime_ns
            yield
            with suppress(OSError):
                self._used.setdefault(key, set()).update(self._find_used(recorded, start))
            if not recorded:
                self._due = time.perf_counter() + _SECONDS_BEFORE_RECORD

    def forget(self, key: str) -> None:
        """Remove what PoCL keeps of the program `key`, which turned out to be wrong."""
        with self._lock:
            for name in {*self._read(key), *self._used.pop(key, ())}:
                shutil.rmtree(self._folder / name, ignore_errors=True)
            with suppress(OSError):
                (self._records / key).unlink()

    def record(self) -> None:
        """Write down the files of all programs that this process has used."""
        with self._lock, suppress(OSError):
            self._due = None
            for key, names in self._used.items():
                before = self._read(key)
                now = {name: self._describe(name, before.get(name, {})) for name in sorted(names)}
                now |= self._of_others(key, before.keys() - names, before)
                if names and now != before:
                    self._write(key, now)

    def _of_others(self, key: str, names: set[str], before: dict[str, _Files]) -> dict[str, _Files]:
        """Return the files of programs that stay in a record although this process did not use them.

        Another environment's PoCL keeps what it builds of the same text in another program.  What has a record of its
        own was only built at the same time.
        """
        names = {name for name in names if self._list(name)}
        if names:
            names -= set(chain(*(self._read(path.name) for path in self._records.iterdir() if path.name != key)))
        return {name: before[name] for name in sorted(names)}

    def record_when_due(self) -> None:
        """Write the files down when kernels have been at work for some seconds."""
        if self._due is not None and time.perf_counter() > self._due:
            self.record()

    def _check(self, recorded: dict[str, _Files]) -> None:
        """Remove what is damaged, and what was left by a process that died."""
        for name, files in recorded.items():
            if not self._is_intact(name, files):
                log.info("kept program %s differs from its record", name)
                shutil.rmtree(self._folder / name, ignore_errors=True)
                if not self._is_shared():
                    self._warn(DAMAGED)
        strange = any(self._list(name) - files.keys() for name, files in recorded.items())
        if (strange or not recorded) and not self._is_swept:
            self.sweep()

    def _is_intact(self, name: str, files: _Files) -> bool:
        for file, (size, changed, digest) in files.items():
            try:
                state = os.lstat(self._folder / name / file)
                if (state.st_size, state.st_mtime_ns) == (size, changed):
                    continue
                if state.st_size != size or _hash(self._folder / name / file) != digest:
                    return False
            except FileNotFoundError:  # PoCL builds it again
                continue
            except OSError:
                return False
        return True

    def sweep(self) -> None:
        """Remove files without a record, unless another process may be building them."""
        self._is_swept = True
        if not self._is_alone():
            return
        try:
            known: dict[str, set[str]] = {name: set() for name in chain(*self._used.values())}
            for path in self._records.iterdir():
                for name, files in self._read(path.name).items():
                    known.setdefault(name, set()).update(files)
            for name in self._programs():
                if name not in known or (known[name] and self._list(name) - known[name]):
                    log.info("kept program %s was not finished", name)
                    shutil.rmtree(self._folder / name, ignore_errors=True)
                    self._warn(UNFINISHED)
        finally:
            self._share()

    def _remove_leftovers(self) -> None:
        """Remove PoCL's temporary files, some of which each process leaves, unless another process may use them."""
        leftovers = [name for name in os.listdir(self._folder) if name.startswith("tempfile_")]
        if leftovers and self._is_alone():
            for name in leftovers:
                with suppress(OSError):
                    os.unlink(self._folder / name)
            self._share()

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _share(self) -> None:
        """Hold the lock together with other processes; file systems without locks are taken to have other users."""
        if sys.platform != "win32":
            with suppress(OSError):
                fcntl.flock(self._handle, fcntl.LOCK_SH)

    def _is_alone(self) -> bool:
        """Return whether no other process uses the folder; its lock is then this one's until `_share` is called.

        A lock that is changed is lost for a moment, in which another process could take this one, at work, for gone:
        so one process at a time may try.
        """
        if sys.platform == "win32":
            return False
        handle = os.open(self._folder / "trying", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            try:
                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self._share()
                return False
        except OSError:
            return False
        finally:
            os.close(handle)
        return True

    def _is_shared(self) -> bool:
        """Return whether another process uses the folder; False where there are no locks to tell."""
        if sys.platform == "win32":
            return False
        if self._is_alone():
            self._share()
            return False
        return True

    # PoCL's files: AB/CDEF.../program.bc and AB/CDEF.../kernel/size/kernel.so

    def _programs(self) -> Iterator[str]:
        for group in self._folder.iterdir():
            if len(group.name) == 2 and group.is_dir():
                for program in group.iterdir():
                    yield f"{group.name}/{program.name}"

    def _find_used(self, recorded: dict[str, _Files], start: int) -> list[str]:
        """Return the programs that PoCL has built or found since `start`.

        Of those that are recorded the used ones: others that are recorded with them were built beside them by another
        process.  Only if none was used, all programs are looked at.
        """
        used = [name for name in recorded if self._is_used(name, start)]
        if used:
            return used
        return [name for name in self._programs() if self._is_used(name, start)] or list(recorded)

    def _is_used(self, name: str, start: int) -> bool:
        for file in (_LAST_USE, "program.bc"):
            with suppress(OSError):
                if os.stat(self._folder / name / file).st_mtime_ns >= start:
                    return True
        return False

    def _list(self, name: str) -> set[str]:
        program = self._folder / name
        return {
            os.path.relpath(os.path.join(folder, file), program)
            for folder, _, files in os.walk(program)
            for file in files
            if file != _LAST_USE
        }

    def _describe(self, name: str, before: _Files) -> _Files:
        described: _Files = {}
        for file in sorted(self._list(name)):
            path = self._folder / name / file
            state = os.lstat(path)
            same = before.get(file, [None])[:2] == [state.st_size, state.st_mtime_ns]
            described[file] = before[file] if same else [state.st_size, state.st_mtime_ns, _hash(path)]
        return described

    # Records

    def _read(self, key: str) -> dict[str, _Files]:
        """Return the files of each of PoCL's programs for `key`; empty without a record that can be read."""
        try:
            content = json.loads((self._records / key).read_bytes())
            return {
                str(name): {str(file): [int(facts[0]), int(facts[1]), str(facts[2])] for file, facts in files.items()}
                for name, files in content.items()
            }
        except (OSError, ValueError, TypeError, AttributeError, LookupError):
            return {}

    def _write(self, key: str, files: dict[str, _Files]) -> None:
        temporary = self._records / f".{key}.{os.getpid()}"
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(handle, "w") as file:
            json.dump(files, file)
        os.replace(temporary, self._records / key)


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@cache
def known_good() -> KnownGood | None:
    """Return the records of this process's folder of PoCL; None where it is not kept."""
    caches = prepare_caches()
    try:
        return KnownGood(caches.pocl) if caches.is_lasting else None
    except OSError as error:
        log.info("kept kernels cannot be checked: %s", error.strerror)
        return None


UNKNOWN = b"generic"

CPU_NAMES: tuple[tuple[str, frozenset[str]], ...] = (
    ("skx", frozenset("avx512f avx512bw avx512cd avx512dq avx512vl adx avx2 bmi1 bmi2 abm f16c fma movbe".split())),
    ("haswell", frozenset("avx2 bmi1 bmi2 abm f16c fma movbe popcnt".split())),
    ("x86-64", frozenset()),
)
"""LLVM's names of CPUs, no longer than `UNKNOWN`, and the flags that each needs, as in /proc/cpuinfo; best first.  The
kernels only distinguish AVX-512 and AVX2 (`cl/rays/window.h`).
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
    match = re.search(r"^flags\s*:(.*)$", cpuinfo, re.MULTILINE)
    flags = set(match.group(1).split()) if match else set()
    return next(name for name, needs in CPU_NAMES if needs <= flags)


class NameOfCpu:
    """The `address` where a PoCL device keeps the name of its CPU, and the name to write there."""

    def __init__(self, address: int):
        try:
            self.name = choose_name(Path("/proc/cpuinfo").read_text())
            with _Memory() as memory:
                self._place = _find_name(memory, address)
        except OSError as error:
            raise LookupError(str(error)) from error

    def write(self) -> None:
        try:
            with _Memory() as memory:
                if memory.read_text(self._place) != self.name.encode():
                    if memory.read_text(self._place) != UNKNOWN:
                        raise LookupError("the name of the CPU has changed")
                    memory.write(self._place, self.name.encode().ljust(len(UNKNOWN), b"\0"))
        except OSError as error:
            raise LookupError(str(error)) from error


class _Memory:
    """Memory of this process, read through the system, which reports an error for a wrong pointer."""

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
    content = memory.read(address, _STRUCT_BYTES)
    pointers = [place for (place,) in _POINTER.iter_unpack(content[: len(content) // _POINTER.size * _POINTER.size])]
    places = {
        cpu
        for target, cpu in zip(pointers, pointers[1:], strict=False)
        if memory.read_text(target).startswith(b"x86_64-") and memory.read_text(cpu) in names
    }
    if len(places) != 1:
        raise LookupError(f"{len(places)} names of CPUs were found in its memory, not one")
    return places.pop()
