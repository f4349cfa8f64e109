"""Memory for voxels, checked before it is taken: a small file that claims huge dimensions cannot fill the computer.

A container or service (Linux control groups) has a limit too.  Voxels in a memory-mapped file can be released from
memory, and found in their file; what is larger than the free memory goes to such a file, which has no name.
"""

from __future__ import annotations

import math
import mmap
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import RefusedInputError
from clrecon.system.light_dataclass import dataclass

_MEMORY_SHARE = 0.9
"""Share of the free memory that voxels may take; the rest is for what is computed beside the volume."""

_DISK_SHARE = 0.9
"""Share of the free disk that a temporary file may take."""


def available_memory_bytes(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> float:
    """Return the bytes that can be taken without swapping: all memory, or infinity, where the system does not tell.

    Linux shows a container all memory of the computer, and kills a process that exceeds the container's own limit.
    """
    container = min(_group_bytes(proc, groups), default=math.inf)
    try:
        with open(proc / "meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return min(float(line.split()[1]) * 1024, container)
    except (OSError, ValueError):
        pass  # not Linux
    return min(physical_memory_bytes(), container)


def physical_memory_bytes() -> float:
    """Return the memory of this computer in bytes; infinity where the system does not tell (Windows)."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return math.inf


def allocate_voxels(shape: Sequence[int], dtype: DTypeLike, name: str = "", *, may_map: bool = False) -> NDArray[Any]:
    """Return an uninitialised array for a volume (nk, nj, ni), see `aligned_empty`; `name` is that of the file.

    If it `may_map`, an array that is larger than the free memory is mapped from a temporary file.
    """
    needed = math.prod(shape) * np.dtype(dtype).itemsize
    available = available_memory_bytes()
    size = " x ".join(map(str, reversed(shape)))
    need = f"{name}{': ' * bool(name)}the volume of {size} voxels needs {needed / 2**30:.2f} GiB of memory"
    if needed > _MEMORY_SHARE * available:
        problem = f"{need}, {available / 2**30:.2f} GiB are free"
        if not may_map:
            raise RefusedInputError(problem)
        return _map_temporary(shape, np.dtype(dtype), needed, problem)
    try:
        return aligned_empty(shape, dtype)
    except MemoryError as error:
        raise RefusedInputError(f"{need}, which cannot be had") from error


def _map_temporary(shape: Sequence[int], dtype: np.dtype[Any], needed: int, problem: str) -> NDArray[Any]:
    """Map a new file without a name, whose room on the disk is taken before anything is written."""
    folder = tempfile.gettempdir()
    advice = "and the folder for temporary files has no room for it: name another with TMPDIR"
    if needed > _DISK_SHARE * shutil.disk_usage(folder).free:
        raise RefusedInputError(f"{problem}, {advice}")
    try:
        with tempfile.TemporaryFile(prefix="clrecon-", dir=folder) as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, needed)
            return np.memmap(file, dtype, "r+", shape=tuple(shape))
    except OSError as error:
        raise RefusedInputError(f"{problem}, {advice} ({error.strerror or error})") from error


_MAP_NORESERVE = 0x4000
"""Of Linux on x86 and ARM; Python names it from 3.13 on."""


def unreserved_zeros(shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of zeros of which only written pages take memory; on Linux it may be larger than the memory."""
    if sys.platform != "linux":
        return np.zeros(shape, dtype)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE
    pages = mmap.mmap(-1, math.prod(shape) * np.dtype(dtype).itemsize, flags=flags)
    return np.frombuffer(pages, dtype).reshape(shape)


_READ_BYTES, _MOST_READ_BYTES = 2**26, 2**29
"""Bytes of whole layers of chunks that are read at a time, and of parts of a layer; parts unpack a chunk again."""


def iterate_layers(source: Any, axis: int = 0) -> Iterator[tuple[int, int]]:
    """Yield first and end of the slices along an axis of an array of zarr, Dask or h5py that are read at a time."""
    count = source.shape[axis]
    slice_bytes = max(1, math.prod(source.shape) * source.dtype.itemsize // count)
    along = (getattr(source, "shards", None) or source.chunks)[axis]
    thickness = along if isinstance(along, int) else max(along)
    step = min(thickness * max(1, _READ_BYTES // (thickness * slice_bytes)), max(1, _MOST_READ_BYTES // slice_bytes))
    for first in range(0, count, step):
        yield first, min(first + step, count)


_FILES = {  # Of a version of control groups: the files of limit and use, and the reclaimable field of memory.stat.
    2: ("memory.max", "memory.current", "inactive_file"),
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def _group_bytes(proc: Path, groups: Path) -> Iterator[int]:
    """Free bytes in the control group of this process and in each group around it."""
    try:
        lines = (proc / "self" / "cgroup").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0":
            version, root = 2, groups
        elif "memory" in controllers.split(","):
            version, root = 1, groups / "memory"
        else:
            continue
        group_folder = root / path.lstrip("/")
        for folder in (group_folder, *group_folder.parents):  # A container may see its own group as the root.
            free = _free_in(folder, *_FILES[version])
            if free is not None:
                yield free
            if folder == root:
                break


def _free_in(folder: Path, limit: str, used: str, reclaimable: str) -> int | None:
    try:
        free = int((folder / limit).read_text()) - int((folder / used).read_text())
        fields = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return max(free + int(fields.get(reclaimable, 0)), 0)
    except (OSError, ValueError):
        return None  # no limit ("max"), or no group of this name


def aligned_empty(shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
    """Return an uninitialised C-contiguous array at the start of a memory page, which CPU drivers use directly."""
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    raw = np.empty(size + mmap.PAGESIZE, np.uint8)
    first = -raw.ctypes.data % mmap.PAGESIZE
    return raw[first : first + size].view(dtype).reshape(shape)


@dataclass(frozen=True)
class FilePlace:
    """The place of a C-contiguous array in a file, `offset` bytes in, and the file's size and change then."""

    path: str
    offset: int
    dtype: str
    shape: tuple[int, ...]
    file_bytes: int
    changed_ns: int

    def open(self) -> NDArray[Any]:
        """Map the array into memory, read-only."""
        problem = f"voxels were sent as a place in the file {self.path}"
        try:
            status = os.stat(self.path)
            if not stat.S_ISREG(status.st_mode) or (status.st_size, status.st_mtime_ns) != (
                self.file_bytes,
                self.changed_ns,
            ):
                raise RefusedInputError(f"{problem}, which has changed since then: send the volume again")
            return np.memmap(self.path, np.dtype(self.dtype), "r", self.offset, self.shape)
        except OSError as error:
            raise RefusedInputError(
                f"{problem}, which cannot be read here ({error.strerror or error}): keep it until all have read it, or"
                " send a volume that is not memory-mapped"
            ) from error


@dataclass(frozen=True)
class Mapping:
    """A memory mapping of a file, from its first byte on; `identity`: device and number, when it was found."""

    file: mmap.mmap
    address: int
    path: str | None
    start: int
    identity: tuple[int, int] | None
    writeable: bool

    def release(self, part: NDArray[Any]) -> None:
        """Let the whole pages of `part`, a C-contiguous view, leave memory; they are read again when they are used."""
        begin = part.ctypes.data - self.address
        first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
        end = (begin + part.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE
        if end > first and hasattr(mmap, "MADV_DONTNEED"):
            self.file.madvise(mmap.MADV_DONTNEED, first, end - first)

    def place(self, part: NDArray[Any]) -> FilePlace | None:
        """Return where `part`, C-contiguous, is in the file, after writing changes; None if the path names another."""
        if self.path is None or self.identity is None:
            return None
        if self.writeable:
            self.file.flush()
        try:
            status = os.stat(self.path)
        except OSError:
            return None
        if (status.st_dev, status.st_ino) != self.identity:
            return None
        offset = self.start + part.ctypes.data - self.address
        return FilePlace(self.path, offset, part.dtype.str, part.shape, status.st_size, status.st_mtime_ns)


def find_mapping(array: NDArray[Any]) -> Mapping | None:
    """Return the mapping that `array` views, None for ordinary memory or one whose changes do not reach its file."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        base: Any = owner.base
        if isinstance(owner, np.memmap) and isinstance(base, mmap.mmap):
            return None if owner.mode == "c" else _describe_mapping(owner, base)
        owner = base
    return None


def _describe_mapping(owner: np.memmap[Any, Any], file: mmap.mmap) -> Mapping:
    path = None if owner.filename is None else os.path.abspath(owner.filename)
    identity = None
    if path is not None:
        try:
            status = os.stat(path)
            identity = status.st_dev, status.st_ino
        except OSError:  # removed since it was mapped
            path = None
    start = owner.offset - owner.offset % mmap.ALLOCATIONGRANULARITY  # numpy maps from a multiple of this
    address = np.frombuffer(file, np.uint8, 1).ctypes.data
    return Mapping(file, address, path, start, identity, owner.mode != "r")
