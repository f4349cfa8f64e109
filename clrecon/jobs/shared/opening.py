"""Open the device and build its kernels while the input is read: drivers take as long to start as a CT to read."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import TYPE_CHECKING

from clrecon.errors import Cancelled

if TYPE_CHECKING:
    from clrecon.opencl import Device


def _choose(name: str | int | Device | None) -> Device:
    from clrecon.operators import take_device

    return take_device(name)


def _prepare(chosen: Future[Device], prepare: Callable[[Device], None]) -> None:
    from clrecon.opencl import work_on

    work_on(chosen.result(), lambda device, told: prepare(device))


class DeviceOpening:
    """A device that is chosen, opened and given its kernels beside the work of a ``with`` block.

    The order of errors does not depend on which side is faster: if both the block and the device fail, the device's
    error is raised.  Only a cancellation by the caller is passed on in any case.

    name: As `clrecon.device` takes it.
    prepare: Function that builds the kernels on a device.
    """

    def __init__(self, name: str | int | Device | None, prepare: Callable[[Device], None]):
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="device")
        self._chosen = self._pool.submit(_choose, name)
        self._prepared = self._pool.submit(_prepare, self._chosen, prepare)

    def wait(self) -> Device:
        """Return the device, ready to work; its stand-in may have taken over."""
        device = self._chosen.result()
        self._prepared.result()
        return device

    def __enter__(self) -> DeviceOpening:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        is_interrupted = error is not None and not isinstance(error, Exception)  # nobody waits for a compiler then
        try:
            if isinstance(error, Exception) and not isinstance(error, Cancelled):
                self._chosen.result()
        finally:
            self._pool.shutdown(wait=not is_interrupted, cancel_futures=True)
