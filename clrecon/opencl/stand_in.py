"""A CPU device that takes over where a device fails that nobody named.

Who names a device (`device`, CLRECON_DEVICE, PYOPENCL_CTX) wants that one: the error says which CPU device could do the
work.  Who leaves the choice open wants the result.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from clrecon.errors import DeviceError, DeviceFailedError, DeviceLostError
from clrecon.opencl.context import Device
from clrecon.opencl.first_use import find_fault
from clrecon.opencl.select import choose_device, find_candidates, list_devices
from clrecon.opencl.waiting import settle
from clrecon.system.log import get_logger
from clrecon.system.wording import name_parameter

Made = TypeVar("Made")


log = get_logger(__name__)


def take_device(name: str | int | Device | None) -> Device:
    """Choose the device for some work; one that nobody named has a stand-in, if the machine has a CPU device.

    name: As for `choose_device`.
    """
    device = choose_device(name)
    if isinstance(name, Device):
        return name
    _, is_automatic = find_candidates(name)
    cpu = _find_cpu(device) if is_automatic else None
    return device if cpu is None else device.with_stand_in(cpu)


def _find_cpu(device: Device) -> Device | None:
    """Return the best CPU device for the work of another device; None for a CPU device."""
    if device.type == "cpu":
        return None
    others = list_devices()
    usable = [cpu for cpu in others if cpu.type == "cpu" and not cpu.is_simulator and not cpu.shortcoming]
    return max(usable, key=lambda cpu: cpu.score, default=None)


def work_on(device: Device, work: Callable[[Device, list[str]], Made]) -> Made:
    """Do some work on a device: on a lost one once more with a fresh context, and at last on its stand-in.

    device: As `take_device` returns it.  Once its stand-in has taken over, that does all further work.
    work: Called with the device to work on, and with warnings for the report of the work.  It makes everything anew
        each time that it is called.
    """
    lost: list[str] = []
    first: DeviceFailedError | None = None
    while True:
        current = device.current
        try:
            return work(current, [*device.handed_over, *lost])
        except DeviceError as error:
            settle(current, error)
            if first is not None:  # nothing was gained
                device.handed_over.clear()
                raise first from error
            if not isinstance(error, DeviceFailedError):
                raise
            if isinstance(error, DeviceLostError) and not lost:
                lost.append(f"{error}: started again with a fresh context")
                log.info("%s", lost[-1])
            elif device.stand_in is not None and not device.handed_over and not find_fault(device.stand_in):
                first = error
                device.hand_over(f"{error}: all was done on {device.stand_in.label} instead of {device.label}")
                lost.clear()
            elif (cpu := _find_cpu(current)) is not None:
                raise type(error)(f"{error}; {cpu.label} may do it: {name_parameter('device', cpu.index)}") from error
            else:
                raise
