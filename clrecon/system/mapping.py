"""Voxels in a memory-mapped file: releasing their pages from memory, and finding their place in the file."""

from __future__ import annotations

import mmap
import os
import stat
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError


@dataclass(frozen=True)
class FilePlace:
    """The place of a C-contiguous array in a file, and the state of the file at that time.

    path: Absolute.
    offset: Bytes before the first value.
    dtype: With the byte order, as ``numpy.dtype.str`` has it.
    file_bytes, changed_ns: Size of the file, and when it was changed last (ns since 1970).
    """

    path: str
    offset: int
    dtype: str
    shape: tuple[int, ...]
    file_bytes: int
    changed_ns: int

    def open(self) -> NDArray[Any]:
        """Map the array into memory, read-only."""
        what = f"voxels were sent as a place in the file {self.path}"
        try:
            found = os.stat(self.path)
            if not stat.S_ISREG(found.st_mode) or (found.st_size, found.st_mtime_ns) != (
                self.file_bytes,
                self.changed_ns,
            ):
                raise RefusedInputError(f"{what}, which has changed since then: send the volume again")
            return np.memmap(self.path, np.dtype(self.dtype), "r", self.offset, self.shape)
        except OSError as error:
            raise RefusedInputError(
                f"{what}, which cannot be read here ({error.strerror or error}): keep it until all have read it, or"
                " send a volume that is not memory-mapped"
            ) from error


@dataclass(frozen=True)
class Mapping:
    """A memory mapping of a file.

    address: Address of its first byte in memory.
    path: Path of the file, if it is known.
    start: Offset in the file at which the mapping begins, bytes.
    identity: Device and number of the file when the mapping was found: another file may take its name later.
    """

    file: mmap.mmap
    address: int
    path: str | None
    start: int
    identity: tuple[int, int] | None
    writeable: bool

    def release(self, part: NDArray[Any]) -> None:
        """Let the whole pages of `part`, a C-contiguous view of the mapping, leave memory.

        They stay in the system's file cache while it has room, and are read again when they are used.
        """
        begin = part.ctypes.data - self.address
        first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
        end = (begin + part.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE
        if end > first and hasattr(mmap, "MADV_DONTNEED"):
            self.file.madvise(mmap.MADV_DONTNEED, first, end - first)

    def place(self, part: NDArray[Any]) -> FilePlace | None:
        """Return where `part`, a C-contiguous view of the mapping, is in the file; changes are written to the file
        first.

        Returns: None where the path no longer names the mapped file.
        """
        if self.path is None or self.identity is None:
            return None
        if self.writeable:
            self.file.flush()
        try:
            found = os.stat(self.path)
        except OSError:
            return None
        if (found.st_dev, found.st_ino) != self.identity:
            return None
        offset = self.start + part.ctypes.data - self.address
        return FilePlace(self.path, offset, part.dtype.str, part.shape, found.st_size, found.st_mtime_ns)


def find_mapping(array: NDArray[Any]) -> Mapping | None:
    """Return the file mapping that `array` is a view of, None where its values are ordinary memory.

    Only a `numpy.memmap` that is shared with its file is accepted: changes to any other mapping would be lost.
    """
    owner: Any = array
    while isinstance(owner, np.ndarray):
        base: Any = owner.base
        if isinstance(owner, np.memmap) and isinstance(base, mmap.mmap):
            return None if owner.mode == "c" else _describe(owner, base)
        owner = base
    return None


def _describe(owner: np.memmap[Any, Any], file: mmap.mmap) -> Mapping:
    path = None if owner.filename is None else os.path.abspath(owner.filename)
    identity = None
    if path is not None:
        try:
            found = os.stat(path)
            identity = found.st_dev, found.st_ino
        except OSError:  # removed since it was mapped
            path = None
    start = owner.offset - owner.offset % mmap.ALLOCATIONGRANULARITY  # numpy maps from a multiple of this
    address = np.frombuffer(file, np.uint8, 1).ctypes.data
    return Mapping(file, address, path, start, identity, owner.mode != "r")
