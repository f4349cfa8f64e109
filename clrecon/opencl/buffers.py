"""Buffers of devices with memory of their own, lent by a pool."""

from __future__ import annotations

import threading
import weakref
from typing import Any

from numpy.typing import NDArray

from clrecon.opencl.device import Device
from clrecon.opencl.quirks import import_pyopencl

POOLED_BYTES = 1 << 26
"""Larger buffers are given back to the driver at once."""

_SPARE_BUFFER_BYTES = 1 << 28
"""Most bytes of a device that are kept in unused buffers."""


class LentBuffer:
    """A buffer of a pool, which has it again when nothing refers to this object."""

    def __init__(self, buffer: Any):
        self.buffer = buffer

    @property
    def flags(self) -> int:
        return int(self.buffer.flags)


class BufferPool:
    """Buffers of a device with memory of its own; pyopencl's own pool fails with several threads."""

    def __init__(self, device: Device):
        self._device = device
        self._spare: list[Any] = []
        self._lock = threading.RLock()  # a loan can end, by garbage collection, while its own thread holds the lock

    @property
    def spare_bytes(self) -> int:
        with self._lock:
            return sum(buffer.size for buffer in self._spare)

    def take(self, size: int) -> LentBuffer:
        """Return a buffer of `size` bytes, or a little more."""
        step = max(1 << max(size.bit_length() - 4, 0), 256)
        size = -(-size // step) * step
        with self._lock:
            position = next((n for n, buffer in enumerate(self._spare) if buffer.size == size), None)
            buffer = None if position is None else self._spare.pop(position)
        if buffer is None:
            buffer = self.ask(size)
        lent = LentBuffer(buffer)
        weakref.finalize(lent, self._give_back, buffer).atexit = False
        return lent

    def ask(self, size: int) -> Any:
        """Ask the driver for a buffer, and again without unused ones where it has no room."""
        cl = import_pyopencl()
        try:
            return ask_driver(self._device, cl.mem_flags.READ_WRITE, size, None)
        except cl.MemoryError:
            with self._lock:
                self._spare.clear()
            return ask_driver(self._device, cl.mem_flags.READ_WRITE, size, None)

    def _give_back(self, buffer: Any) -> None:
        with self._lock:
            self._spare.append(buffer)
            while self.spare_bytes > _SPARE_BUFFER_BYTES:
                self._spare.pop(0)


def ask_driver(device: Device, flags: Any, size: int, host: NDArray[Any] | None) -> Any:
    """Return a new buffer: of a size, or with or in the memory of a host array."""
    cl = import_pyopencl()
    return cl.Buffer(device.context, flags, 0 if host is not None else size, hostbuf=host)


def raw(buffer: Any) -> Any:
    """Return a buffer as pyopencl takes it, also where a pool lends it."""
    return buffer.buffer if isinstance(buffer, LentBuffer) else buffer
