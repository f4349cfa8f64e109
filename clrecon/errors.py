"""The errors that clrecon raises on purpose, each with the exit code of the command line.

Every message is one line that says what is wrong, where, with which numbers, and what to do about it.  Any other error
that reaches a user is a fault of clrecon.
"""

from __future__ import annotations

PARTLY_DONE = 8
"""Exit code of a command that has done some of its work; what could be written is there."""


class ClreconError(Exception):
    """Base of all errors that clrecon raises on purpose.

    Attributes
    ----------
    exit_code : int
        Exit code of ``clrecon`` when this error ends a command.
    """

    exit_code = 1


class NoDicomError(ClreconError):
    """The input holds no DICOM image that clrecon can use."""

    exit_code = 2


class NoSurfaceError(ClreconError):
    """The iso value crosses no cell of the volume, or nothing is left of the surface."""

    exit_code = 2


class UsageError(ClreconError, ValueError):
    """An argument is wrong: unknown name, impossible value, wrong shape."""

    exit_code = 3


class RefusedInputError(ClreconError):
    """The input is corrupt, or its geometry cannot be trusted."""

    exit_code = 4


class DeviceError(ClreconError):
    """No OpenCL device, a device that is not there, or a device that failed."""

    exit_code = 5


class DeviceFailedError(DeviceError):
    """The device failed, or is too small for the work: another device may do it."""


class DeviceMemoryError(DeviceFailedError):
    """The device has no room: with less data at a time it may work."""


class DeviceLostError(DeviceFailedError):
    """The device was lost in the middle of the work: with a fresh context it may work."""


class DeviceStoppedError(DeviceLostError):
    """A kernel was stopped, by a watchdog or for want of memory: in a fresh context with less data it may work."""


class DeviceTimeoutError(DeviceError):
    """The device made no progress for longer than the time limit."""


class OutputError(ClreconError):
    """The output cannot be written; an older file of that name is intact."""

    exit_code = 6


class UnreachableError(ClreconError):
    """Another computer does not answer, or no longer: another time the same command may work."""

    exit_code = 9


class Cancelled(ClreconError):
    """The caller wants to stop: raised by a ``progress`` function, and passed on unchanged.

    >>> def progress(stage, done, total):
    ...     if stop.is_set():
    ...         raise clrecon.Cancelled

    After this error nothing is written, older files are intact, and memory of the device is free again.
    """

    exit_code = 130

    def __init__(self, message: str = "cancelled"):
        super().__init__(message)
