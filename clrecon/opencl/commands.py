"""The commands that a device has not finished, and what they use.

They name the kernel of a device that hangs.  And what a command uses must not be freed before its end, whatever becomes
of the work that wanted it: CPU devices write into numpy's memory.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

from clrecon.opencl.quirks import import_pyopencl


class CommandFailedError(Exception):
    """A command failed while the device worked on it.

    code: OpenCL's number of the error.
    """

    def __init__(self, code: int):
        self.code = code
        super().__init__(import_pyopencl().status_code.to_string(code, "error %d"))


class Command(NamedTuple):
    """A kernel or a transfer that was enqueued.

    what: For messages, such as "kernel emit_vertices".
    held: Buffers and arrays that the command uses.
    """

    what: str
    event: Any
    queue: Any
    held: tuple[Any, ...]

    @property
    def is_running(self) -> bool:
        """True where the command has neither ended nor failed."""
        try:
            return bool(self.event.command_execution_status > 0)
        except import_pyopencl().Error:  # the device is lost
            return False


class Commands:
    """The commands of one device that are not known to have ended, in the order of its queue."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._waiting: list[Command] = []
        self._given_up: list[Command] = []
        _all.append(self)

    def add(self, what: str, event: Any, queue: Any, *held: Any) -> None:
        """Add a command that was enqueued."""
        self._waiting.append(Command(what, event, queue, held))

    @property
    def last(self) -> Command | None:
        """The command that ends last."""
        try:
            return self._waiting[-1]
        except IndexError:
            return None

    def first_running(self) -> Command | None:
        """Return the command that the device works on; None where it has nothing to do."""
        with self._lock:
            commands = (*self._given_up, *self._waiting)
        return next((command for command in commands if command.is_running), None)

    def forget(self, last: Command) -> None:
        """Forget the commands up to `last`, which has ended, so that all before have ended too."""
        with self._lock:
            commands = self._waiting
            count = commands.index(last) + 1 if last in commands else 0
            ended, self._waiting = commands[:count], commands[count:]
        failed = min((command.event.command_execution_status for command in ended), default=0)
        if failed < 0:
            raise CommandFailedError(failed)

    def forget_ended(self) -> None:
        """Forget all commands that have ended, however they did."""
        with self._lock:
            self._waiting = [command for command in self._waiting if command.is_running]

    def give_up(self, *kept: Any) -> None:
        """Nobody will wait for the commands any more; those that still run keep all that they use, and `kept`."""
        with self._lock:
            commands = (*self._given_up, *self._waiting)
            self._given_up = [command for command in commands if command.is_running]
            self._waiting.clear()
            if self._given_up:
                _kept.append(kept)

    @property
    def has_hung(self) -> bool:
        """True where a command that was given up still runs."""
        with self._lock:
            self._given_up = [command for command in self._given_up if command.is_running]
            return bool(self._given_up)


_all: list[Commands] = []

_kept: list[Any] = []


def has_hung_commands() -> bool:
    """True where a command that was given up still runs on any device.

    To free what belongs to its context, or to end the driver, may then take for ever.
    """
    found = any(commands.has_hung for commands in _all)
    if not found:
        _kept.clear()
    return found


def keep_for_hung_commands(*objects: Any) -> None:
    """Keep objects from being freed while a command that was given up still runs."""
    if has_hung_commands():
        _kept.append(objects)
