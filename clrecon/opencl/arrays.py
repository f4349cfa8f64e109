"""Arrays on a device, its memory budget, and pages for results.

All buffers of an operator are summed and compared with the device before any is allocated.  On a CPU device they use
numpy's memory without a copy, and on a part of a processor volumes and results do.

When a kernel first writes to a new page, the system has to find and clear it, which for the mesh of a CT series takes
as long as computing it.  So arrays made here return their pages when their last view is gone, for a later result.
"""

from __future__ import annotations

import math
import mmap
import threading
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import DeviceError, DeviceFailedError, DeviceLostError, DeviceMemoryError, UsageError
from clrecon.opencl import buffers
from clrecon.opencl.buffers import raw
from clrecon.opencl.device import Device, describe_error, kind_of_error
from clrecon.opencl.launching import wait
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.transfers import LEAST_BYTES, Landed, read_buffers, write_buffer
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.memory import aligned_empty


def _mib(size: int, *, up: bool = False) -> str:
    if size < 2**20:
        return f"{size:,} bytes"
    return f"{-(-size // 2**20) if up else round(size / 2**20):,} MiB"


@dataclass(frozen=True)
class MemoryLimits:
    """The memory that may be taken on a device: all buffers together, the largest one, and what the user allows."""

    label: str
    device_bytes: int
    device_buffer_bytes: int
    asked_bytes: int | None

    @property
    def total_bytes(self) -> int:
        """Bytes that all buffers together may take."""
        return self.device_bytes if self.asked_bytes is None else self.asked_bytes

    @property
    def buffer_bytes(self) -> int:
        """Bytes that a single buffer may take."""
        return min(self.device_buffer_bytes, self.total_bytes)

    def device_fits(self, buffers: Mapping[str, int]) -> bool:
        """True where the device has room for `buffers`, regardless of the user's limit."""
        sizes = buffers.values()
        return sum(sizes) <= self.device_bytes and max(sizes, default=0) <= self.device_buffer_bytes

    def describe(self) -> str:
        if self.asked_bytes is not None:
            return f"{_mib(self.asked_bytes)} are allowed on {self.label} by {name_parameter('memory')}"
        return f"{self.label} has {_mib(self.device_bytes)}, at most {_mib(self.device_buffer_bytes)} in one buffer"

    def refusal(self, problem: str, advice: str = "") -> DeviceError:
        """Return the error where room is missing: a failure of the device, unless the user allows too little."""
        if self.asked_bytes is None:
            return DeviceFailedError(f"{problem}: {self.describe()}; {advice or 'use another device'}")
        return DeviceError(f"{problem}: {self.describe()}; {advice or 'allow more'}")


def check_memory(memory: int | None) -> None:
    """Refuse a value that is not a byte count of at least 1; None stands for all memory of the device."""
    if memory is not None and (isinstance(memory, bool) or not isinstance(memory, int) or memory < 1):
        raise UsageError(f"memory is a whole number of bytes, not {memory!r}")


def memory_limits(device: Device, memory: int | None = None) -> MemoryLimits:
    """Return the device's own limits, or `memory` bytes if that is less."""
    usable = device.usable_bytes
    asked = int(memory) if memory is not None and memory < usable else None
    return MemoryLimits(device.label, usable, min(device.max_allocation_bytes, usable), asked)


def describe_shortage(limits: MemoryLimits, buffers: Mapping[str, int]) -> str:
    """Return why `buffers` do not fit together, or one of them does not fit alone; empty if they fit."""
    for buffer, size in buffers.items():
        if size > limits.device_buffer_bytes:
            most = _mib(limits.device_buffer_bytes)
            return f"the {buffer} needs a buffer of {_mib(size)}, {limits.label} allows {most}"
    total = sum(buffers.values())
    if total <= limits.total_bytes:
        return ""
    if not limits.device_fits(buffers):
        limits = replace(limits, asked_bytes=None)  # a higher limit would not help
    parts = ", ".join(f"{what} {_mib(size)}" for what, size in buffers.items())
    return f"this needs {_mib(total, up=True)} on the device ({parts}): {limits.describe()}"


def require_room(limits: MemoryLimits, buffers: Mapping[str, int], consequence: str) -> None:
    """Refuse work whose `buffers` do not fit; `consequence` says what cannot be done."""
    shortage = describe_shortage(limits, buffers)
    if shortage:
        raise DeviceMemoryError(f"{consequence}: {shortage}")


def check_budget(
    device: Device, buffers: Mapping[str, int], memory: int | None = None, *, less_may_fit: bool = False
) -> int:
    """Check that `buffers`, bytes by name, fit the device, together and alone; return the sum."""
    limits = memory_limits(device, memory)
    shortage = describe_shortage(limits, buffers)
    if shortage:
        if limits.device_fits(buffers):
            kind = DeviceMemoryError if less_may_fit else DeviceError
            raise kind(f"{shortage}: allow that much or ask for less")
        kind = DeviceMemoryError if less_may_fit else DeviceFailedError
        raise kind(f"{shortage}: use a device with more memory or a smaller volume")
    return sum(buffers.values())


BLOCK_BYTES = 1 << 21
"""Block sizes are multiples of this, the size of a huge page on most systems."""

SMALLEST_BYTES = 1 << 20
"""Smaller results come from numpy: the allocator of the C library keeps those pages itself."""

_SPARE_BYTES = 1 << 28
"""Most bytes of unused pages that are kept for the next result; more go back to the system."""

_LARGEST_WASTE = 2
"""A spare block serves a request only if it is at most this many times as large."""


_PRIVATE: dict[str, int] = (
    {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_ANONYMOUS") else {}  # Windows has neither
)


class _Loan(np.ndarray[Any, np.dtype[Any]]):
    """The array as which a block is lent: its views keep it alive, and when it is gone the block is free."""


class PagePool:
    """Blocks of memory that are lent as numpy arrays and return automatically."""

    def __init__(self, spare_bytes: int = _SPARE_BYTES):
        self._spare_bytes = spare_bytes
        self._spare: list[mmap.mmap] = []
        self._lock = threading.RLock()  # a loan can end, by garbage collection, while its own thread holds the lock

    @property
    def spare_bytes(self) -> int:
        with self._lock:
            return sum(map(len, self._spare))

    def empty(self, shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
        """Return an uninitialised array, C-contiguous, aligned for every vector type."""
        dtype = np.dtype(dtype)
        size = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if size < SMALLEST_BYTES:
            return np.empty(shape, dtype)
        block = self._take(size)
        # Made directly on the block: views then refer to the loan.  If the loan were a view itself, numpy would skip
        # it.
        loan = _Loan(tuple(shape), dtype, buffer=block)
        weakref.finalize(loan, self._give_back, block).atexit = False
        return loan.view(np.ndarray)

    def _take(self, size: int) -> mmap.mmap:
        with self._lock:
            fitting = [block for block in self._spare if size <= len(block) <= _LARGEST_WASTE * size]
            if fitting:
                block = min(fitting, key=len)
                self._spare.remove(block)
                return block
        try:
            block = mmap.mmap(-1, -(-size // BLOCK_BYTES) * BLOCK_BYTES, **_PRIVATE)
        except (OSError, OverflowError) as error:
            raise MemoryError(f"{size:,} bytes cannot be had: {error}") from error
        if hasattr(mmap, "MADV_HUGEPAGE"):
            try:
                block.madvise(mmap.MADV_HUGEPAGE)
            except OSError:  # a kernel without huge pages
                pass
        return block

    def _give_back(self, block: mmap.mmap) -> None:
        with self._lock:
            self._spare.append(block)
            while sum(map(len, self._spare)) > self._spare_bytes:
                self._spare.pop(0)  # unmapped when nothing refers to it

    def clear(self) -> None:
        """Give all spare memory back to the system."""
        with self._lock:
            self._spare.clear()


result_pages = PagePool()
"""The pool of this process."""


_CACHE_LINE = 64
"""GPUs use arrays in place that are whole lines of a cache and begin with a page; drivers copy all others."""


def _shares_memory(device: Device, array: NDArray[Any]) -> bool:
    """Return whether kernels work in the array itself: a CPU in any, a GPU without memory of its own in whole pages."""
    if device.type != "gpu" or device.has_own_memory or device.is_simulator:
        return device.shares_host_memory
    if array.nbytes < LEAST_BYTES or array.nbytes % _CACHE_LINE or array.ctypes.data % mmap.PAGESIZE:
        return False
    return array.flags.writeable and device.of_context(_works_in_place)


def _works_in_place(device: Device) -> bool:
    """Return whether arrays have what a device writes to buffers in their memory: a driver may keep copies of them."""
    cl = import_pyopencl()
    source, target = aligned_empty((2, LEAST_BYTES), np.uint8)
    source[:], target[:] = 1, 0
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    try:
        source_d, target_d = (buffers.ask_driver(device, flags, len(array), array) for array in (source, target))
    except cl.Error:
        return False
    copy_buffer(device, source_d, target_d, len(source))
    wait(device)
    return bool(target.all())


def _make_buffer(device: Device, flags: Any, size: int, host: NDArray[Any] | None = None) -> Any:
    cl = import_pyopencl()
    try:
        if host is not None or device.shares_host_memory or device.is_simulator:
            return buffers.ask_driver(device, flags, size, host)
        pool = device.of_context(buffers.BufferPool)
        return pool.take(size) if size <= buffers.POOLED_BYTES else pool.ask(size)
    except cl.Error as error:
        if kind_of_error(error) is DeviceLostError:
            raise device.fail(f"{size:,} bytes were not given", error) from error
        raise DeviceMemoryError(f"{size:,} bytes cannot be had on {device.label}: {describe_error(error)}") from error


def allocate(device: Device, size: int) -> Any:
    """Return a buffer of `size` bytes (at least 4, since OpenCL has no empty buffers)."""
    cl = import_pyopencl()
    if device.shares_host_memory and size >= LEAST_BYTES:
        return empty_output(device, (size,), np.uint8)[1]  # pages that an earlier call has already used
    return _make_buffer(device, cl.mem_flags.READ_WRITE, max(size, 4))


def upload(device: Device, array: NDArray[Any], *, writable: bool = False, landed: Landed | None = None) -> Any:
    """Return a buffer with the contents of `array`, which must not change while the buffer is used.

    Kernels may write to a `writable` buffer alone; the array does not get what they write.  `landed` is that of
    `write_buffer`; where the array is used in place, or is small, it is not called.
    """
    cl = import_pyopencl()
    array = np.ascontiguousarray(array)
    flags = cl.mem_flags.READ_WRITE if writable else cl.mem_flags.READ_ONLY
    # float4 and similar types need an alignment that numpy does not guarantee: small tables are copied.
    if array.nbytes >= LEAST_BYTES and not writable and _shares_memory(device, array):
        return _make_buffer(device, flags | cl.mem_flags.USE_HOST_PTR, array.nbytes, array)
    if device.shares_host_memory or device.is_simulator:
        return _make_buffer(device, flags | cl.mem_flags.COPY_HOST_PTR, array.nbytes, array)
    array_d = _make_buffer(device, flags, array.nbytes)
    try:
        write_buffer(device, array, array_d, landed)
    except cl.Error as error:
        raise device.fail("writing failed", error) from error
    return array_d


def copy_buffer(
    device: Device, source_d: Any, target_d: Any, size: int, offset: int = 0, source_offset: int = 0
) -> None:
    """Copy `size` bytes of a buffer, from byte `source_offset` on, to byte `offset` of another on the same device."""
    cl = import_pyopencl()
    try:
        with device.lock:
            queue = device.queue
            event = cl.enqueue_copy(
                queue, raw(target_d), raw(source_d), byte_count=size, src_offset=source_offset, dst_offset=offset
            )
            device.commands.add(f"the copy of {size:,} bytes", event, queue, source_d, target_d)
    except cl.Error as error:
        raise device.fail("copying failed", error) from error


def empty_output(device: Device, shape: tuple[int, ...], dtype: DTypeLike) -> tuple[NDArray[Any], Any]:
    """Return an uninitialised host array and a buffer for the device to write it; `download` fills the array."""
    cl = import_pyopencl()
    size = math.prod(shape) * np.dtype(dtype).itemsize
    try:
        lines = result_pages.empty((-(-size // _CACHE_LINE) * _CACHE_LINE,), np.uint8)
    except MemoryError as error:
        raise DeviceMemoryError(f"the memory of this computer does not suffice: {error}") from error
    array = lines[:size].view(dtype).reshape(shape)
    if size and _shares_memory(device, lines):
        return array, _make_buffer(device, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, len(lines), lines)
    return array, allocate(device, array.nbytes)


def download(device: Device, array: NDArray[Any], array_d: Any, offset: int = 0) -> NDArray[Any]:
    """Wait for the device and return `array` with the contents of `array_d` from byte `offset` on."""
    download_all(device, (array, array_d, offset))
    return array


def download_all(device: Device, *wanted: tuple[NDArray[Any], Any, int]) -> None:
    """Wait once for the device, and fill each array from its buffer, from a byte on."""
    wanted = tuple(each for each in wanted if each[0].nbytes)
    if not wanted:
        return
    try:
        _fill_all(device, wanted)
    except import_pyopencl().Error as error:
        raise device.fail("reading failed", error) from error


def _fill_all(device: Device, wanted: Sequence[tuple[NDArray[Any], Any, int]]) -> None:
    cl = import_pyopencl()
    mapped: list[tuple[NDArray[Any], Any]] = []
    large: list[tuple[NDArray[Any], Any, int]] = []
    for array, array_d, offset in wanted:
        action, queue = f"the transfer of {array.nbytes:,} bytes to the computer", device.queue
        host: Any = None
        if array_d.flags & cl.mem_flags.USE_HOST_PTR:
            # Mapping makes the host memory current; on CPU drivers it moves no data.
            host, event = cl.enqueue_map_buffer(
                queue, array_d, cl.map_flags.READ, offset, array.shape, array.dtype, is_blocking=False
            )
            mapped.append((array, host))
        elif array.nbytes >= LEAST_BYTES and not device.is_simulator:
            large.append((array, array_d, offset))
            continue
        else:
            event = cl.enqueue_copy(queue, array, raw(array_d), src_offset=offset, is_blocking=False)
        device.commands.add(action, event, queue, array, array_d, host)
    if large:
        read_buffers(device, large)
    wait(device)
    for array, host in mapped:
        if host.ctypes.data != array.ctypes.data:
            array[...] = host
        host.base.release(device.queue)
