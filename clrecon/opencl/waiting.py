"""Waiting for a device, in one place: signals are answered at once, and a device that hangs becomes an error.

The driver's own waiting functions answer no signal and know no time limit.  So a helper thread waits in the driver, and
the thread that asked waits for the helper with Python's means, which costs some tens of microseconds.  Short waits are
spared it by looking at the state of the command first.  For long waits, looks with sleeps between them cost more than
the helper: a sleep of any length ends too late, and on a CPU device each look takes time from the kernel.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

from clrecon.errors import DeviceTimeoutError
from clrecon.opencl.commands import Command, CommandFailedError
from clrecon.opencl.context import Device
from clrecon.opencl.quirks import import_pyopencl
from clrecon.system.time_limit import device_seconds
from clrecon.system.wording import name_parameter

SHORT_SECONDS = 1e-3
"""Waits up to this long need no helper thread: the thread looks again and again, and leaves its core to others."""

_leave_core = getattr(os, "sched_yield", lambda: time.sleep(0.0))

LOOK_SECONDS = 0.25
"""Time between two looks at what the device is doing; on Windows, signals wait as long."""

GRACE_SECONDS = 0.5
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
        """Begin to wait for an event."""
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
    """Wait until the device has finished all commands."""
    last = device.commands.last
    if last is None:
        return
    try:
        last.queue.flush()
        if not _ends_soon(last):
            _wait_long(device, last)
        device.commands.forget(last)
    except (import_pyopencl().Error, CommandFailedError) as error:
        raise device.fail(f"{last.what} failed", error, is_late=True) from error


def _ends_soon(command: Command) -> bool:
    event, end = command.event, time.perf_counter() + SHORT_SECONDS
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
            is_done = not isinstance(error, Exception) and helper.is_done(GRACE_SECONDS)
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
        if helper.is_done(min(LOOK_SECONDS, max(since + limit - time.monotonic(), 0.0))):
            return
        now, runs_now = time.monotonic(), device.commands.first_running()
        if runs_now is not running:
            since, running = now, runs_now
        elif now - since >= limit:
            raise DeviceTimeoutError(_describe_hang(device, "a command" if running is None else running.what, limit))


def _describe_hang(device: Device, what: str, limit: float) -> str:
    return (
        f"{what} has not ended on {device.label} for {limit:g} s, so it counts as hung: choose another"
        f" {name_parameter('device')}, take a smaller volume or picture, or give a longer"
        f" {name_parameter('timeout')} in seconds (0: none)"
    )


def settle(device: Device, error: BaseException) -> None:
    """Wait, after an error, until the device no longer works in memory that the caller frees.

    After an interrupt that is a short time, after a time limit none: what still runs then keeps its memory.
    """
    if isinstance(error, DeviceTimeoutError):
        return
    seconds = device_seconds() if isinstance(error, Exception) else GRACE_SECONDS
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
