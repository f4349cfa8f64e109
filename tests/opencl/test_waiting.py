"""The one place that waits for a device: errors of commands, the time limit, interrupts, and what commands use."""

from __future__ import annotations

import gc
import threading
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import DeviceFailedError, DeviceLostError, DeviceMemoryError, DeviceTimeoutError
from clrecon.opencl import Stopwatch, allocate, download, launch, load_program, settle, upload, wait
from clrecon.opencl import device as commands_module
from clrecon.opencl.device import Commands, _Opened, has_hung_commands
from clrecon.opencl.quirks import import_pyopencl
from clrecon.system.progress import time_limit


class Event:
    """An event whose state tests set; who waits for it waits for `end`."""

    def __init__(self, status: int = 1):
        self.command_execution_status = status
        self._ended = threading.Event()

    def end(self, status: int = 0) -> None:
        self.command_execution_status = status
        self._ended.set()

    def wait(self) -> None:
        self._ended.wait(20.0)


QUEUE = SimpleNamespace(flush=lambda: None)


@pytest.fixture
def own_commands(device, monkeypatch):
    """The device with commands of its own; its context stays, whatever fails."""
    wait(device)
    monkeypatch.setattr(device, "commands", Commands())
    monkeypatch.setattr(device, "_opened", _Opened())
    monkeypatch.setattr(device, "programs", {})
    yield
    commands_module._all.remove(device.commands)


pytestmark = pytest.mark.usefixtures("own_commands")


def test_buffers_of_a_kernel_live_until_it_is_over(device):
    """A CPU device works in numpy's memory, which must not be given back while a launch is in flight."""

    class Buffer:
        pass

    buffer, event = Buffer(), Event()
    alive = weakref.ref(buffer)
    device.commands.add("kernel one", event, QUEUE, buffer)
    del buffer
    device.give_up()
    gc.collect()
    assert alive() is not None
    assert has_hung_commands()
    event.end()
    assert not has_hung_commands()
    gc.collect()
    assert alive() is None


def test_kernels_that_have_ended_are_not_remembered(device):
    launched = Stopwatch()
    program = load_program(device, "primitives/scan.cl", {"SCAN_GROUP": str(device.group_size)})
    counts_d, sums_d = upload(device, np.arange(50, dtype=np.uint32)), allocate(device, 4)
    with launched.running(device):
        launch(device, program["sum_blocks"], device.group_size, counts=counts_d, block_sums=sums_d, n=50)
        assert device.commands.last.what == "kernel sum_blocks"
    assert device.commands.last is None
    download(device, np.empty(1, np.uint32), sums_d)
    assert device.commands.last is None


@pytest.mark.parametrize(
    ("status", "kind", "words"),
    [
        (-4, DeviceMemoryError, "MEM_OBJECT_ALLOCATION_FAILURE"),
        (-5, DeviceLostError, "OUT_OF_RESOURCES"),
        (-36, DeviceLostError, "INVALID_COMMAND_QUEUE"),
        (-14, DeviceFailedError, "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST"),
    ],
)
@pytest.mark.fault_row(56)
def test_a_kernel_that_fails_on_the_device_is_an_error(device, status, kind, words):
    device.commands.add("kernel one", Event(status), QUEUE)
    device.commands.add("kernel two", Event(0), QUEUE)
    with refused(kind, words) as caught:
        wait(device)
    assert type(caught.value) is kind
    assert device._opened.context is None
    assert device.commands.last is None


@pytest.mark.fault_row(56)
def test_only_a_device_without_progress_counts_as_hung(device):
    """Four kernels of 0.3 s take longer than the limit of 0.5 s, together."""
    events = [Event() for _ in range(4)]
    for number, event in enumerate(events):
        device.commands.add(f"kernel {number}", event, QUEUE)
        threading.Timer(0.3 * (number + 1), event.end).start()
    with time_limit(0.5):
        wait(device)
    assert device.commands.last is None


@pytest.mark.fault_row(56)
def test_a_device_without_progress_is_an_error_that_names_the_kernel(device):
    ended, hung, after = Event(0), Event(), Event()
    for number, event in enumerate((ended, hung, after)):
        device.commands.add(f"kernel {number}", event, QUEUE)
    with time_limit(0.2), refused(DeviceTimeoutError, 1, 0.2) as caught:
        wait(device)
    assert caught.value.exit_code == 5
    assert "(0: none)" in str(caught.value)
    assert has_hung_commands()
    wait(device)  # later work does not wait for it
    for event in (hung, after):
        event.end()
    assert not has_hung_commands()


@pytest.mark.parametrize("is_short", [True, False])
@pytest.mark.fault_row(56)
def test_an_interrupt_keeps_the_context_of_a_device_that_ends_in_time(device, monkeypatch, is_short):
    event, context = Event(), object()
    device.commands.add("kernel one", event, QUEUE)
    monkeypatch.setattr(device._opened, "context", context)
    monkeypatch.setattr("clrecon.opencl.launching._watch", _interrupt)
    if is_short:
        threading.Timer(0.1, event.end).start()
    with pytest.raises(KeyboardInterrupt):
        wait(device)
    assert (device._opened.context is context) == is_short
    assert has_hung_commands() == (not is_short)
    event.end()


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_after_an_error_running_kernels_are_waited_for(device):
    event = Event()
    device.commands.add("kernel one", event, QUEUE)
    device.give_up()
    threading.Timer(0.1, event.end).start()
    settle(device, ValueError("of the caller"))
    assert event.command_execution_status == 0
    device.commands.add("kernel two", Event(), QUEUE)
    with time_limit(0.1):
        settle(device, ValueError("of the caller"))
    assert has_hung_commands()


def test_a_driver_that_refuses_to_wait_is_an_error(device, monkeypatch):
    cl, event = import_pyopencl(), Event()
    monkeypatch.setattr(event, "wait", lambda: _refuse(cl))
    device.commands.add("kernel one", event, QUEUE)
    with refused(DeviceFailedError, "one", "refused"):
        wait(device)


def _refuse(cl) -> None:
    raise cl.RuntimeError("refused")
