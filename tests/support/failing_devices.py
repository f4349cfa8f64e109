"""Devices that fail: buffers and launches that break as those of drivers do, and a GPU that is none."""

from __future__ import annotations

from typing import Any

import pytest

from clrecon.errors import DeviceError, DeviceMemoryError
from clrecon.opencl import Device, arrays
from clrecon.opencl.quirks import import_pyopencl


def pretended_gpu(device: Device) -> Device:
    """Return a GPU with its own memory that computes on the same hardware, and has the CPU device as its stand-in."""
    gpu = Device(device.index, device.cl_device.platform, device.cl_device)
    gpu.name, gpu.type, gpu.shares_host_memory, gpu.keeps_binaries = "a pretended GPU", "gpu", False, False
    gpu.has_own_memory, gpu.kernel_variants = True, device.kernel_variants
    return gpu.with_stand_in(device)


def lost_error() -> Exception:
    """Return the error of a driver whose device was lost."""
    cl = import_pyopencl()

    class Lost(cl.LogicError):  # type: ignore[misc, name-defined]
        code = -36

    return Lost("INVALID_COMMAND_QUEUE: injected")


def memory_error(code: int) -> Exception:
    """Return the error of a driver that has no memory for a kernel, with OpenCL's number for it."""
    cl = import_pyopencl()

    class NoMemory(cl.MemoryError):  # type: ignore[misc, name-defined]
        pass

    NoMemory.code = code
    return NoMemory(f"{cl.status_code.to_string(code)}: injected")


class StoppedEvent:
    """The event of a kernel that was accepted and then stopped."""

    command_execution_status = -5  # OUT_OF_RESOURCES

    def wait(self) -> None:
        """Return at once."""


class Failing:
    """Counts buffers and launches on a device, and lets some of one kind fail, from number `first` to `last`.

    kind: "buffer", "launch", or "stop": kernels are launched and fail while they run.
    first, last: Numbers from 1; 0: none fails.
    label: Only of the device with this label; None: of all.
    error: That of launches; default: no memory.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        kind: str,
        first: int,
        last: int | None = None,
        *,
        label: str | None = None,
        error: Exception | None = None,
    ):
        cl = import_pyopencl()
        self.kind, self.first, self.last = kind, first, first if last is None else last
        self.counts = {"buffer": 0, "launch": 0, "stop": 0}
        self.sizes: list[int] = []
        true_buffer, true_enqueue = arrays._make_buffer, cl.Kernel.__call__
        contexts: dict[Any, str] = {}

        def make_buffer(device: Device, flags: Any, size: int, host: Any = None) -> Any:
            contexts[device.context] = device.label
            self.sizes.append(size)
            if label in (None, device.label) and self._is_due("buffer"):
                raise DeviceMemoryError(f"{size:,} bytes cannot be had on {device.label}: injected")
            return true_buffer(device, flags, size, host)

        def call(kernel: Any, queue: Any, *arguments: Any, **options: Any) -> Any:
            if label in (None, contexts.get(queue.context)) and self._is_due("launch"):
                raise cl.MemoryError("injected") if error is None else error
            event = true_enqueue(kernel, queue, *arguments, **options)
            if label in (None, contexts.get(queue.context)) and self._is_due("stop"):
                event.wait()
                return StoppedEvent()
            return event

        monkeypatch.setattr(arrays, "_make_buffer", make_buffer)
        monkeypatch.setattr(cl.Kernel, "__call__", call)

    def _is_due(self, kind: str) -> bool:
        self.counts[kind] += 1
        return self.kind == kind and 0 < self.first <= self.counts[kind] <= self.last


class BurntDevice:
    """A device whose queue cannot be opened."""

    def __init__(self, device: Device, reason: str = "it caught fire") -> None:
        self._device = device
        self._reason = reason

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    @property
    def queue(self) -> Any:
        raise DeviceError(self._reason)
