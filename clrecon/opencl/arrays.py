"""Arrays on a device.  On a CPU device they use numpy's memory without a copy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import DeviceLostError, DeviceMemoryError
from clrecon.opencl.context import Device, describe_error, kind_of_error
from clrecon.opencl.pages import result_pages
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.waiting import wait

SHARED_BYTES = 1 << 20
"""Arrays smaller than this are copied to the device even if it could use them in place."""


def _make_buffer(device: Device, flags: Any, size: int, host: NDArray[Any] | None = None) -> Any:
    cl = import_pyopencl()
    try:
        if host is None:
            return cl.Buffer(device.context, flags, size)
        return cl.Buffer(device.context, flags, hostbuf=host)
    except cl.Error as error:
        if kind_of_error(error) is DeviceLostError:
            raise device.fail(f"{size:,} bytes were not given", error) from error
        raise DeviceMemoryError(f"{size:,} bytes cannot be had on {device.label}: {describe_error(error)}") from error


def allocate(device: Device, size: int) -> Any:
    """Return a buffer of `size` bytes (at least 4, since OpenCL has no empty buffers)."""
    cl = import_pyopencl()
    if device.shares_host_memory and size >= SHARED_BYTES:
        return empty_output(device, (size,), np.uint8)[1]  # pages that an earlier call has already used
    return _make_buffer(device, cl.mem_flags.READ_WRITE, max(size, 4))


def upload(device: Device, array: NDArray[Any]) -> Any:
    """Return a read-only buffer with the contents of `array`, which must not change while the buffer is used."""
    cl = import_pyopencl()
    array = np.ascontiguousarray(array)
    flags = cl.mem_flags.READ_ONLY
    # float4 and similar types need an alignment that numpy does not guarantee: small tables are copied.
    if device.shares_host_memory and array.nbytes >= SHARED_BYTES:
        return _make_buffer(device, flags | cl.mem_flags.USE_HOST_PTR, array.nbytes, array)
    return _make_buffer(device, flags | cl.mem_flags.COPY_HOST_PTR, array.nbytes, array)


def copy_buffer(
    device: Device, source_d: Any, target_d: Any, size: int, offset: int = 0, source_offset: int = 0
) -> None:
    """Copy `size` bytes of a buffer, from byte `source_offset` on, to byte `offset` of another on the same device."""
    cl = import_pyopencl()
    try:
        with device.lock:
            queue = device.queue
            event = cl.enqueue_copy(
                queue, target_d, source_d, byte_count=size, src_offset=source_offset, dst_offset=offset
            )
            device.commands.add(f"the copy of {size:,} bytes", event, queue, source_d, target_d)
    except cl.Error as error:
        raise device.fail("copying failed", error) from error


def empty_output(device: Device, shape: tuple[int, ...], dtype: DTypeLike) -> tuple[NDArray[Any], Any]:
    """Return an uninitialised host array and a buffer for the device to write it; `download` fills the array."""
    cl = import_pyopencl()
    try:
        array = result_pages.empty(shape, dtype)
    except MemoryError as error:
        raise DeviceMemoryError(f"the memory of this computer does not suffice: {error}") from error
    if device.shares_host_memory and array.nbytes:
        return array, _make_buffer(device, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, array.nbytes, array)
    return array, allocate(device, array.nbytes)


def download(device: Device, array: NDArray[Any], array_d: Any, offset: int = 0) -> NDArray[Any]:
    """Wait for the device and return `array` with the contents of `array_d` from byte `offset` on."""
    cl = import_pyopencl()
    if not array.nbytes:
        return array
    what, queue = f"the transfer of {array.nbytes:,} bytes to the computer", device.queue
    try:
        if array_d.flags & cl.mem_flags.USE_HOST_PTR:
            # Mapping makes the host memory current; on CPU drivers it moves no data.
            mapped, event = cl.enqueue_map_buffer(
                queue, array_d, cl.map_flags.READ, offset, array.shape, array.dtype, is_blocking=False
            )
            device.commands.add(what, event, queue, array, array_d, mapped)
            wait(device)
            if mapped.ctypes.data != array.ctypes.data:
                array[...] = mapped
            mapped.base.release(queue)
        else:
            event = cl.enqueue_copy(queue, array, array_d, src_offset=offset, is_blocking=False)
            device.commands.add(what, event, queue, array, array_d)
            wait(device)
    except cl.Error as error:
        raise device.fail("reading failed", error) from error
    return array
