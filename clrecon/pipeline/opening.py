"""Open the device and build its kernels while the input is read: drivers take as long to start as a CT to read."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import TYPE_CHECKING

from clrecon.pipeline.progress import Progress

if TYPE_CHECKING:
    from clrecon.opencl import Device

__all__ = ["DeviceOpening"]


def _open(name: str | int | Device | None) -> Device:
    from clrecon.opencl import choose_device
    from clrecon.operators.isosurface import prepare_isosurface

    device = choose_device(name)
    prepare_isosurface(device)
    return device


class DeviceOpening:
    """A device that is being opened beside other work.

    Parameters
    ----------
    name : str, int, Device or None
        As `clrecon.device` takes it.
    """

    def __init__(self, name: str | int | Device | None):
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="device")
        self._future: Future[Device] = self._pool.submit(_open, name)

    def watched(self, progress: Progress) -> Progress:
        """Return `progress` as it is, but raising what the opening raised as soon as it is known."""

        def report(stage: str, done: int, total: int) -> None:
            if self._future.done():
                self._future.result()
            progress(stage, done, total)

        return report

    def wait(self) -> Device:
        """Return the device.

        Raises
        ------
        DeviceError
            There is none of that name, or it cannot be opened.
        """
        return self._future.result()

    def __enter__(self) -> DeviceOpening:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True)
