"""Launches of kernels with rounded-up sizes, and the time that they take."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from clrecon.opencl.context import Device
from clrecon.opencl.program import Kernel
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.waiting import settle, wait


class Stopwatch:
    """Wall seconds by part (upload, build, kernels, download) and device seconds by kernel.

    Drivers compile a kernel, or read it from their cache, at its first launch.  So the part "kernels" is the time that
    the device reports from start to end of each kernel, and the rest of the wall time of a ``running`` block is
    "build". Where a driver's event times are useless, all of it is "kernels".
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"upload": 0.0, "build": 0.0, "kernels": 0.0, "download": 0.0}
        self.by_kernel: dict[str, float] = {}
        self._events: list[tuple[str, Any]] = []

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add the wall time of the block to `part`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] += time.perf_counter() - start

    def record(self, kernel: str, event: Any) -> None:
        """Keep the event of a launch until it is over."""
        self._events.append((kernel, event))

    @contextmanager
    def running(self, device: Device) -> Iterator[None]:
        """Time a block that launches kernels, and wait for them at its end, also after an error."""
        start = time.perf_counter()
        try:
            yield
        except BaseException as error:
            self._events.clear()
            settle(device, error)
            raise
        try:
            wait(device)
        except BaseException:
            self._events.clear()
            raise
        wall = time.perf_counter() - start
        busy = 0.0
        has_times = device.has_event_times
        for kernel, event in self._events:
            try:
                spent = 1e-9 * (event.profile.end - event.profile.start)
            except import_pyopencl().Error:  # a driver without event times: the mesh is still right
                has_times = False
                break
            self.by_kernel[kernel] = self.by_kernel.get(kernel, 0.0) + spent
            busy += spent
        self._events.clear()
        if not has_times:
            busy = wall
        self.seconds["kernels"] += min(busy, wall)
        self.seconds["build"] += max(wall - busy, 0.0)


def launch(
    device: Device,
    kernel: Kernel,
    items: int,
    /,
    *,
    stopwatch: Stopwatch | None = None,
    **arguments: Any,
) -> None:
    """Enqueue `kernel` over at least `items` work-items.

    kernel: Kernel of a program, see `load_program`.
    items: Number of work-items; rounded up to whole groups of `Device.group_size`, so kernels check their bounds first.
    stopwatch: Records the time.
    **arguments: The kernel's arguments, by their names in its source: buffers, numbers, and four numbers for a float4.
        Numbers are converted to the types in the source.
    """
    cl = import_pyopencl()
    group = device.group_size
    rounded = -(-items // group) * group
    values = kernel.order(arguments)
    if device.trace is not None:
        device.trace(f"kernel {kernel.name} ({rounded:,} items)")
        _check_written(kernel, values)
    try:
        with device.lock:
            queue = device.queue
            event = kernel.enqueue(queue, rounded, group, values)
            device.commands.add(f"kernel {kernel.name}", event, queue, values)
    except cl.Error as error:
        what = f"kernel {kernel.name} ({rounded:,} items in groups of {group}) failed"
        raise device.fail(what, error) from error
    if device.trace is not None:
        wait(device)  # what crashes or hangs is then the kernel that was told last
    if stopwatch is not None:
        stopwatch.record(kernel.name, event)


def _check_written(kernel: Kernel, values: Sequence[Any]) -> None:
    """Refuse buffers for reading alone where the kernel writes: CPU drivers do not notice, others may."""
    cl = import_pyopencl()
    for argument, value in zip(kernel.arguments, values, strict=True):
        if argument.is_written and value.get_info(cl.mem_info.FLAGS) & cl.mem_flags.READ_ONLY:
            raise TypeError(f"kernel {kernel.name} writes {argument.name}, whose buffer is for reading alone")
