"""Waiting for a device, in one place: errors of commands, the time limit, interrupts, and what commands use."""

from __future__ import annotations

import gc
import threading
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import DeviceFailedError, DeviceLostError, DeviceMemoryError, DeviceStoppedError, DeviceTimeoutError
from clrecon.opencl import Stopwatch, allocate, download, launch, load_program, settle, upload, wait
from clrecon.opencl import device as commands_module
from clrecon.opencl.device import Commands, _Opened, has_hung_commands
from clrecon.opencl.quirks import import_pyopencl
from clrecon.system.progress import time_limit

RUNNING, ENDED = 1, 0
"""States of a command, as OpenCL numbers them; a negative one is an error."""


class Event:
    """The event of a command, whose state tests set; who waits for it waits for `end`."""

    def __init__(self, status: int = RUNNING):
        self.command_execution_status = status
        self._ended = threading.Event()

    def end(self, status: int = ENDED) -> None:
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


class Buffer:
    pass


def test_buffer_of_a_running_kernel_is_kept_alive_until_the_kernel_ends(device):
    """A CPU device works in numpy's memory, which must not be given back while a launch is in flight."""
    buffer, event = Buffer(), Event()
    buffer_if_alive = weakref.ref(buffer)
    device.commands.add("kernel one", event, QUEUE, buffer)
    del buffer
    device.give_up()

    gc.collect()
    assert buffer_if_alive() is not None
    event.end()
    has_hung_commands()  # looks at the event
    gc.collect()
    assert buffer_if_alive() is None


def test_kernel_on_a_device_that_was_given_up_counts_as_hung_until_it_ends(device):
    event = Event()
    device.commands.add("kernel one", event, QUEUE)
    device.give_up()
    assert has_hung_commands()
    event.end()
    assert not has_hung_commands()


def launch_sum_blocks(device):
    """Launch a kernel of the scan; returns the buffer of its result."""
    program = load_program(device, "primitives/scan.cl", {"SCAN_GROUP": str(device.group_size)})
    counts_d, sums_d = upload(device, np.arange(50, dtype=np.uint32)), allocate(device, 4)
    launch(device, program["sum_blocks"], device.group_size, counts=counts_d, block_sums=sums_d, n=50)
    return sums_d


def test_last_command_is_the_launched_kernel_until_a_stopwatch_has_waited_for_it(device):
    with Stopwatch().running(device):
        launch_sum_blocks(device)
        assert device.commands.last.what == "kernel sum_blocks"
    assert device.commands.last is None


def test_no_command_is_remembered_after_a_download(device):
    sums_d = launch_sum_blocks(device)
    download(device, np.empty(1, np.uint32), sums_d)
    assert device.commands.last is None


@pytest.mark.parametrize(
    ("status", "kind", "name_of_status"),
    [
        (-4, DeviceMemoryError, "MEM_OBJECT_ALLOCATION_FAILURE"),
        (-5, DeviceStoppedError, "OUT_OF_RESOURCES"),
        (-36, DeviceLostError, "INVALID_COMMAND_QUEUE"),
        (-14, DeviceFailedError, "EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST"),
    ],
)
@pytest.mark.fault_row(56)
def test_kernel_that_fails_on_the_device_raises_the_error_of_its_status_and_closes_the_device(
    device, status, kind, name_of_status
):
    device.commands.add("kernel one", Event(status), QUEUE)
    device.commands.add("kernel two", Event(ENDED), QUEUE)
    with refused(kind, name_of_status) as caught:
        wait(device)
    assert type(caught.value) is kind
    assert device._opened.context is None
    assert device.commands.last is None


@pytest.mark.fault_row(56)
def test_time_limit_applies_to_each_kernel_and_not_to_their_sum(device):
    """Four kernels of 0.3 s take longer than the limit of 0.5 s, together."""
    events = [Event() for _ in range(4)]
    for number, event in enumerate(events):
        device.commands.add(f"kernel {number}", event, QUEUE)
        threading.Timer(0.3 * (number + 1), event.end).start()
    with time_limit(0.5):
        wait(device)
    assert device.commands.last is None


@pytest.mark.fault_row(56)
def test_kernel_over_the_time_limit_is_an_error_that_names_it_the_limit_and_how_to_lift_it(device):
    for number, event in enumerate([Event(ENDED), Event(), Event()]):  # kernel 0 has ended, 1 and 2 run on
        device.commands.add(f"kernel {number}", event, QUEUE)
    with time_limit(0.2), refused(DeviceTimeoutError, "kernel", 1, 0.2) as caught:
        wait(device)
    assert caught.value.exit_code == 5  # devices, see docs/contract.md
    assert "(0: none)" in str(caught.value)


def test_kernels_over_the_time_limit_count_as_hung_until_they_end(device):
    running = [Event(), Event()]
    for event in running:
        device.commands.add("kernel", event, QUEUE)
    with time_limit(0.2), pytest.raises(DeviceTimeoutError):
        wait(device)
    assert has_hung_commands()
    for event in running:
        event.end()
    assert not has_hung_commands()


def test_later_work_does_not_wait_for_a_kernel_over_the_time_limit(device):
    event = Event()
    device.commands.add("kernel one", event, QUEUE)
    with time_limit(0.2), pytest.raises(DeviceTimeoutError):
        wait(device)
    with time_limit(0.2):
        wait(device)  # raises no second timeout
    assert event.command_execution_status == RUNNING
    event.end()


@pytest.fixture
def interrupted(monkeypatch):
    """Who watches the device is interrupted at once."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("clrecon.opencl.launching._watch", interrupt)


@pytest.mark.usefixtures("interrupted")
@pytest.mark.parametrize("ends_in_time", [True, False])
@pytest.mark.fault_row(56)
def test_interrupt_keeps_the_context_of_a_device_only_if_its_kernel_ends_in_time(device, monkeypatch, ends_in_time):
    event, context = Event(), object()
    device.commands.add("kernel one", event, QUEUE)
    monkeypatch.setattr(device._opened, "context", context)
    if ends_in_time:
        threading.Timer(0.1, event.end).start()  # seconds; an interrupted kernel has 0.5

    with pytest.raises(KeyboardInterrupt):
        wait(device)

    assert (device._opened.context is context) == ends_in_time
    assert has_hung_commands() == (not ends_in_time)
    event.end()


def test_running_kernel_is_waited_for_after_an_error_of_the_caller(device):
    event = Event()
    device.commands.add("kernel one", event, QUEUE)
    device.give_up()
    threading.Timer(0.1, event.end).start()
    settle(device, ValueError("of the caller"))
    assert event.command_execution_status == ENDED


def test_kernel_over_the_time_limit_after_an_error_of_the_caller_counts_as_hung(device):
    event = Event()
    device.commands.add("kernel one", event, QUEUE)
    with time_limit(0.1):
        settle(device, ValueError("of the caller"))
    assert has_hung_commands()
    event.end()


def test_error_of_a_driver_that_refuses_to_wait_names_the_kernel(device, monkeypatch):
    def refuse() -> None:
        raise import_pyopencl().RuntimeError("refused")

    event = Event()
    monkeypatch.setattr(event, "wait", refuse)
    device.commands.add("kernel one", event, QUEUE)
    with refused(DeviceFailedError, "one", "refused"):
        wait(device)
