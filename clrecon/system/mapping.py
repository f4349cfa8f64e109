"""Voxels in a memory-mapped file: which of their pages stay in memory, and where in the file they are."""

from __future__ import annotations

import mmap
import os
import stat
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError

__all__ = ["FilePlace", "Mapping", "find_mapping"]


@dataclass(frozen=True)
class FilePlace:
    """A C-contiguous array in a file, and what the file was when the array was there.

    Attributes
    ----------
    path : str
        Absolute.
    offset : int
        Bytes before the first value.
    dtype : str
        With the byte order, as ``numpy.dtype.str`` has it.
    shape : tuple of int
    file_bytes, changed_ns : int
        Size of the file, and when it was changed last (ns since 1970).
    """

    path: str
    offset: int
    dtype: str
    shape: tuple[int, ...]
    file_bytes: int
    changed_ns: int

    def open(self) -> NDArray[Any]:
        """Map the array into memory, read-only.

        Raises
        ------
        RefusedInputError
            The file is not there, cannot be read, or is not what it was.
        """
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
    """A file mapping.

    Attributes
    ----------
    file : mmap
    address : int
        Of its first byte in memory.
    path : str or None
        Of the file, where it is known.
    start : int
        Byte of the file that the mapping begins with.
    identity : (int, int) or None
        Device and number of the file when the mapping was found: another file may take its name later.
    writeable : bool
    """

    file: mmap.mmap
    address: int
    path: str | None
    start: int
    identity: tuple[int, int] | None
    writeable: bool

    def release(self, part: NDArray[Any]) -> None:
        """Let the whole pages of `part`, a C-contiguous view of the mapping, leave memory.

        They stay in the system's file cache as long as it has room, and are read again when they are used.
        """
        begin = part.ctypes.data - self.address
        first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
        end = (begin + part.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE
        if end > first and hasattr(mmap, "MADV_DONTNEED"):
            self.file.madvise(mmap.MADV_DONTNEED, first, end - first)

    def place(self, part: NDArray[Any]) -> FilePlace | None:
        """Where `part`, a C-contiguous view of the mapping, is in the file; what was changed is written there first.

        Returns
        -------
        FilePlace or None
            None where the name leads to the mapped file no more.
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

    Only a `numpy.memmap` that is shared with its file is taken: what was written to any other mapping would be lost.
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
    start = owner.offset - owner.offset % mmap.ALLOCATIONGRANULARITY  # where numpy lets the mapping begin
    address = np.frombuffer(file, np.uint8, 1).ctypes.data
    return Mapping(file, address, path, start, identity, owner.mode != "r")
