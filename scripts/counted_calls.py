"""Counts of what is asked of the driver: a discrete card waits at each blocking read as long as its kernels take."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from clrecon.opencl import Landed, arrays, buffers
from clrecon.opencl.device import Commands, Device
from clrecon.opencl.program import Kernel
from clrecon.opencl.quirks import import_pyopencl


@contextmanager
def counting_calls() -> Iterator[Counter[str]]:
    """Count the launches, uploads, allocations, blocking reads and waits of a block, and the bytes that move.

    An upload is an array that goes to the device; buffers that use the computer's memory are neither uploads nor
    allocations.  A blocking read may fill several arrays.
    """
    cl = import_pyopencl()
    counts: Counter[str] = Counter()
    ask, write, fill = buffers.ask_driver, arrays.write_buffer, arrays._fill_all
    enqueue, forget = Kernel.enqueue, Commands.forget

    def count(what: str, size: int) -> None:
        counts[what] += 1
        counts[f"{what}, bytes"] += size

    def ask_counted(device: Device, flags: Any, size: int, host: Any) -> Any:
        if not flags & cl.mem_flags.USE_HOST_PTR:
            counts["allocations"] += 1
        if flags & cl.mem_flags.COPY_HOST_PTR:
            count("uploads", size)
        return ask(device, flags, size, host)

    def write_counted(device: Device, array: Any, array_d: Any, landed: Landed | None = None) -> None:
        count("uploads", array.nbytes)
        write(device, array, array_d, landed)

    def fill_counted(device: Device, wanted: Sequence[Any]) -> None:
        count("blocking reads", sum(array.nbytes for array, _, _ in wanted))
        fill(device, wanted)

    def enqueue_counted(kernel: Kernel, *arguments: Any) -> Any:
        counts["launches"] += 1
        return enqueue(kernel, *arguments)

    def forget_counted(commands: Commands, last: Any) -> None:
        counts["waits"] += 1
        forget(commands, last)

    buffers.ask_driver, arrays.write_buffer, arrays._fill_all = ask_counted, write_counted, fill_counted
    Kernel.enqueue, Commands.forget = enqueue_counted, forget_counted  # type: ignore[method-assign, assignment]
    try:
        yield counts
    finally:
        buffers.ask_driver, arrays.write_buffer, arrays._fill_all = ask, write, fill
        Kernel.enqueue, Commands.forget = enqueue, forget  # type: ignore[method-assign]
