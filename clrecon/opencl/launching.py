"""Launches of kernels, the time that they take, and waiting for the device.

A wait answers signals at once, and a device that hangs becomes an error.  The driver's own waiting functions answer no
signal and know no time limit.  So a helper thread waits in the driver, and the thread that asked waits for the helper
with Python's means, which costs some tens of microseconds.  Short waits are spared it by looking at the state of the
command first.  For long waits, looks with sleeps between them cost more than the helper: a sleep of any length ends too
late, and on a CPU device each look takes time from the kernel."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from queue import SimpleQueue
from typing import Any

from clrecon.errors import DeviceTimeoutError
from clrecon.opencl.device import Command, CommandFailedError, Device
from clrecon.opencl.program import Kernel, Program
from clrecon.opencl.quirks import import_pyopencl
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import device_seconds

_SHORT_SECONDS = 1e-3
"""Waits up to this long need no helper thread: the thread looks again and again, and leaves its core to others."""

_leave_core = getattr(os, "sched_yield", lambda: time.sleep(0.0))

_LOOK_SECONDS = 0.25
"""Time between two looks at what the device is doing; on Windows, signals wait as long."""

_GRACE_SECONDS = 0.5
"""After an interrupt, commands that end within this time are waited for, so that the device stays as it is."""


class _Helper:
    """A thread that waits in the driver for one event after another."""

    def __init__(self) -> None:
        self._events: SimpleQueue[Any] = SimpleQueue()
        self._done = threading.Lock()  # held while it waits
        self._done.acquire()
        self.error: Exception | None = None
        threading.Thread(target=self._work, name="clrecon waiting", daemon=True).start()

    def begin(self, event: Any) -> None:
        self.error = None
        self._events.put(event)

    def is_done(self, seconds: float) -> bool:
        """Return whether the event ends within that time."""
        return self._done.acquire(timeout=seconds)

    def _work(self) -> None:
        while True:
            event = self._events.get()
            try:
                event.wait()
            except import_pyopencl().Error as error:
                self.error = error
            del event
            self._done.release()


_idle: deque[tuple[int, _Helper]] = deque()
"""Helpers without work, with the process that they belong to: a forked one has none of the threads."""


def _take_helper() -> _Helper:
    with suppress(IndexError):
        process, helper = _idle.pop()
        if process == os.getpid():
            return helper
        _idle.clear()
    return _Helper()


def wait(device: Device) -> None:
    last = device.commands.last
    if last is not None:
        wait_for(device, last)


def wait_for(device: Device, last: Command) -> None:
    try:
        last.queue.flush()
        if not _ends_soon(last):
            _wait_long(device, last)
        device.commands.forget(last)
    except (import_pyopencl().Error, CommandFailedError) as error:
        raise device.fail(f"{last.what} failed", error, is_late=True) from error


def _ends_soon(command: Command) -> bool:
    event, end = command.event, time.perf_counter() + _SHORT_SECONDS
    while event.command_execution_status > 0:
        _leave_core()
        if time.perf_counter() > end:
            return False
    return True


def _wait_long(device: Device, last: Command) -> None:
    helper = _take_helper()
    helper.begin(last.event)
    is_done = False
    try:
        _watch(device, helper)
        is_done = True
    except BaseException as error:
        try:
            is_done = not isinstance(error, Exception) and helper.is_done(_GRACE_SECONDS)
        finally:
            if not is_done:
                device.give_up()
        raise
    finally:
        if is_done:
            _idle.append((os.getpid(), helper))
    if helper.error is not None and last.event.command_execution_status > 0:  # else its state says why
        raise helper.error


def _watch(device: Device, helper: _Helper) -> None:
    """Wait for a helper as long as the device makes progress."""
    since, running = time.monotonic(), None
    while True:
        limit = device_seconds()
        if helper.is_done(min(_LOOK_SECONDS, max(since + limit - time.monotonic(), 0.0))):
            return
        now, runs_now = time.monotonic(), device.commands.first_running()
        if runs_now is not running:
            since, running = now, runs_now
        elif now - since >= limit:
            raise DeviceTimeoutError(_describe_hang(device, "a command" if running is None else running.what, limit))


def _describe_hang(device: Device, action: str, limit: float) -> str:
    return (
        f"{action} has not ended on {device.label} for {limit:g} s, so it counts as hung: choose another"
        f" {name_parameter('device')}, take a smaller volume or picture, or give a longer"
        f" {name_parameter('timeout')} in seconds (0: none)"
    )


def settle(device: Device, error: BaseException) -> None:
    """Wait, after an error, until the device no longer works in memory that the caller frees; not for a hung one."""
    if isinstance(error, DeviceTimeoutError):
        return
    seconds = device_seconds() if isinstance(error, Exception) else _GRACE_SECONDS
    end, pause = time.monotonic() + seconds, 1e-4
    while (command := device.commands.first_running()) is not None:
        with suppress(import_pyopencl().Error):
            command.queue.flush()
        if time.monotonic() >= end:
            device.give_up()
            return
        time.sleep(pause)
        pause = min(1.5 * pause, 0.02)
    device.commands.forget_ended()


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
        """Add the wall time of the block to `part`; kernels that it launches count in the next `running` block."""
        start = time.perf_counter()
        outer = _running.get()
        _running.set(self)
        try:
            yield
        finally:
            if _running.get() is self:
                _running.set(outer)
            self.seconds[part] += time.perf_counter() - start

    def record(self, kernel: str, event: Any) -> None:
        """Keep the event of a launch until it is over."""
        self._events.append((kernel, event))

    @contextmanager
    def running(self, device: Device) -> Iterator[None]:
        """Time the kernels that a block launches, and wait for them at its end, also after an error."""
        start = time.perf_counter()
        outer = _running.get()
        _running.set(self)
        try:
            yield
        except BaseException as error:
            self._events.clear()
            settle(device, error)
            raise
        finally:
            if _running.get() is self:  # a generator that ends late leaves another's block alone
                _running.set(outer)
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


_running: ContextVar[Stopwatch | None] = ContextVar("running", default=None)
"""The stopwatch in whose `running` block this thread is."""


def launch(
    device: Device, kernel: Kernel, items: int, most: int | None = None, begin: int = 0, /, **arguments: Any
) -> None:
    """Enqueue `kernel` over at least `items` work-items; the stopwatch that is running has its time.

    items: Rounded up to whole groups of `Device.group_size`, so kernels check their bounds first.
    most: Items of a launch; if there are more, several follow each other.
    begin: Number of the first item.
    **arguments: The kernel's arguments, by their names in its source: buffers, numbers, and four numbers for a float4.
        Numbers are converted to the types in the source.
    """
    cl = import_pyopencl()
    group = device.group_size
    rounded = -(-items // group) * group
    part = max(rounded if most is None else most // group * group, group)
    values = kernel.order(arguments)
    if device.trace is not None:
        device.trace(f"kernel {kernel.name} ({rounded:,} items)")
        _check_written(kernel, values)
    for first in range(0, max(rounded, 1), part):
        try:
            with device.lock:
                queue = device.queue
                event = kernel.enqueue(queue, min(part, rounded - first), group, values, begin + first)
                device.commands.add(f"kernel {kernel.name}", event, queue, values, arguments)
                if part < rounded:
                    queue.flush()  # what a driver sends together counts as one for watchdogs
        except cl.Error as error:
            action = f"kernel {kernel.name} ({rounded:,} items in groups of {group}) failed"
            raise device.fail(action, error) from error
        if device.trace is not None:
            wait(device)  # what crashes or hangs is then the kernel that was told last
        if (stopwatch := _running.get()) is not None:
            stopwatch.record(kernel.name, event)


def launcher(device: Device, program: Program) -> Callable[..., None]:
    """Return what launches kernels of a program by name: `launch` with ``(name, items, **arguments)``."""

    def run(kernel: str, items: int, **arguments: Any) -> None:
        launch(device, program[kernel], items, **arguments)

    return run


def _check_written(kernel: Kernel, values: Sequence[Any]) -> None:
    """Refuse buffers for reading alone where the kernel writes: CPU drivers do not notice, others may."""
    cl = import_pyopencl()
    for argument, value in zip(kernel.arguments, values, strict=True):
        if argument.is_written and value.get_info(cl.mem_info.FLAGS) & cl.mem_flags.READ_ONLY:
            raise TypeError(f"kernel {kernel.name} writes {argument.name}, whose buffer is for reading alone")
