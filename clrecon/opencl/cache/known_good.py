"""What PoCL keeps of built programs, checked before PoCL loads it.

PoCL ends the process when a kept file is damaged: cut by a full disk, overwritten, swapped.  So the files of each
program are written down when a process has worked with them and comes to its end (or works on for some seconds): size,
time and hash, in a record under the hash of what was built.  Before the next process lets PoCL look for that program,
its files are compared with the record, and a program with a difference is removed, which makes PoCL build it again.
Files that no record mentions come from a process that runs, or from one that died while it built.  They are removed
when no other process uses the folder: each holds a lock on it.

Two processes that build the same program at once write the same files: the one that ends first records them, and the
other replaces them until it ends and records its own.  So a difference is called damage only when no other process uses
the folder; the program is built again in any case.

Not covered: contents that change while size and time stay the same, and damage between the check and PoCL's reading.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from clrecon.opencl.cache.folders import make_private, prepare_caches
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
    """The records of one folder of PoCL.

    folder: PoCL's folder; only this class and PoCL write to it.

    warnings: What was found and removed.
    """

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
            start = self._now()
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
                if now and now != before:
                    self._write(key, now)

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
            known: dict[str, set[str]] = {name: set() for names in self._used.values() for name in names}
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

    def _now(self) -> int:
        """Return the present time in ns, by the clock of the files."""
        os.utime(self._handle if os.utime in os.supports_fd else self._folder / "in-use")
        return os.fstat(self._handle).st_mtime_ns

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _share(self) -> None:
        """Hold the lock together with other processes; file systems without locks are taken to have other users."""
        if sys.platform != "win32":
            with suppress(OSError):
                fcntl.flock(self._handle, fcntl.LOCK_SH)

    def _is_alone(self) -> bool:
        if sys.platform == "win32":
            return False
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._share()  # a lock that cannot be changed is lost
            return False
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
