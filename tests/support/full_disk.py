"""A file on a disk that becomes full."""

from __future__ import annotations

import errno
import io
from typing import Any


class FullDisk(io.RawIOBase):
    """Takes some bytes and then says what a full disk says."""

    def __init__(self, room: int):
        self.room = room

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.room -= memoryview(data).nbytes
        if self.room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return memoryview(data).nbytes
