"""`Device`: one OpenCL device with its context, its queue, its properties, and the commands that it has not finished.

Unfinished commands name the kernel of a device that hangs.  And what a command uses must not be freed before its end,
whatever becomes of the work that wanted it: CPU devices write into numpy's memory."""

from __future__ import annotations

import copy
import os
import re
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, TypeVar

from clrecon.errors import DeviceError, DeviceFailedError, DeviceLostError, DeviceMemoryError, DeviceStoppedError
from clrecon.opencl import quirks
from clrecon.opencl.cache import cache_warnings
from clrecon.opencl.pocl import KnownGood, NameOfCpu, has_unknown_cpu, known_good
from clrecon.opencl.quirks import import_pyopencl
from clrecon.system.log import get_logger
from clrecon.system.packages import install_command

Kept = TypeVar("Kept")


class CommandFailedError(Exception):
    """A command failed while the device worked on it, with OpenCL's number of the error."""

    def __init__(self, code: int):
        self.code = code
        super().__init__(import_pyopencl().status_code.to_string(code, "error %d"))


class Command(NamedTuple):
    """A kernel or a transfer that was enqueued; `what` is for messages, `held` are buffers and arrays that it uses."""

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

    def add(self, action: str, event: Any, queue: Any, *kept_alive: Any) -> Command:
        command = Command(action, event, queue, kept_alive)
        self._waiting.append(command)
        return command

    @property
    def last(self) -> Command | None:
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

    def give_up(self, *buffers: Any) -> None:
        """Nobody will wait for the commands any more; those that still run keep all that they use, and `buffers`."""
        with self._lock:
            commands = (*self._given_up, *self._waiting)
            self._given_up = [command for command in commands if command.is_running]
            self._waiting.clear()
            if self._given_up:
                _kept.append(buffers)

    @property
    def has_hung(self) -> bool:
        with self._lock:
            self._given_up = [command for command in self._given_up if command.is_running]
            return bool(self._given_up)


_all: list[Commands] = []

_kept: list[Any] = []


def has_hung_commands() -> bool:
    """True where a command that was given up still runs on any device: to free its context may take for ever."""
    any_hung = any(commands.has_hung for commands in _all)
    if not any_hung:
        _kept.clear()
    return any_hung


def keep_for_hung_commands(*objects: Any) -> None:
    """Keep objects from being freed while a command that was given up still runs."""
    if has_hung_commands():
        _kept.append(objects)


log = get_logger(__name__)

HEADROOM_BYTES = 1 << 29

GROUP_SIZE = 64
"""Work-group size: a whole wavefront of every GPU, and small enough to give a CPU's cores equal shares."""


_NO_MEMORY = (-4, -5, -6)
"""MEM_OBJECT_ALLOCATION_FAILURE, OUT_OF_RESOURCES, OUT_OF_HOST_MEMORY."""

_LOST = (-2, -34, -36, -9999)
"""DEVICE_NOT_AVAILABLE, INVALID_CONTEXT, INVALID_COMMAND_QUEUE, and what NVIDIA says after a fault of a kernel."""

_STOPPED_LATE = -5
"""OUT_OF_RESOURCES of a command that was accepted says that it was stopped: by a watchdog, by a fault, or because the
driver found memory for a buffer only when a kernel used it."""


def kind_of_error(error: Exception, *, is_late: bool = False) -> type[DeviceError]:
    """Return the class of error for an error of the driver; `is_late`: it came while the device worked."""
    try:
        code = int(error.code)  # type: ignore[attr-defined]
    except (AttributeError, IndexError, TypeError, ValueError):
        code = 0
    if is_late and code == _STOPPED_LATE:
        return DeviceStoppedError
    if code in _LOST:
        return DeviceLostError
    if code in _NO_MEMORY or isinstance(error, quirks.import_pyopencl().MemoryError):
        return DeviceMemoryError
    return DeviceFailedError


def describe_error(error: Exception) -> str:
    """Return the first line of a driver's error."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0]


def _version_numbers(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"[0-9]+", text))


def _find_shortcoming(cl_device: Any) -> str:
    """Return why clrecon cannot work on a device, empty if it can."""
    numbers = _version_numbers(cl_device.version)[:2]
    if not cl_device.available:
        return "it is not available"
    if not cl_device.compiler_available:
        return "it has no compiler"
    if numbers < (1, 2):
        return f"it has {cl_device.version.strip()}, OpenCL 1.2 is needed"
    if bool(cl_device.endian_little) != (sys.byteorder == "little"):
        return "its byte order is not that of this computer"
    return ""


class _Opened:
    """Context and queue of a device, None before its first use, and what is kept as long as they are."""

    def __init__(self) -> None:
        self.context: Any = None
        self.queue: Any = None
        self.kept: dict[Any, Any] = {}


class Device:
    """An OpenCL device; context and queue are made at first use.

    index: Index in ``clrecon.devices()``; this number chooses the device.
    type: "gpu", "accelerator", "cpu" or "custom".
    memory_bytes, max_allocation_bytes: All memory of the device, and the largest single buffer.
    has_own_memory: A graphics card, not a part of the processor that shares its memory.
    most_steps, kernel_variants, first_header, build_options, is_simulator: See ``clrecon.opencl.quirks``.
    shortcoming: Why the device cannot be used; empty if it can.
    fault: What the check at first use found wrong, empty if nothing; None before the check.
    keeps_binaries: The driver keeps no programs, so ``clrecon.opencl.cache`` keeps them for the next process.
    known_good: The check of the programs that PoCL keeps; None for other drivers, and where nothing is kept.
    lock: Held while a kernel gets its arguments and is enqueued: kernels are shared between threads.
    builds_together: False where each kernel file is built alone, so that the text of one can be replaced.
    gathered: Kernel files to be built together, with their variants, in a block of ``building_together``.
    stand_in: The CPU device that takes over if this one fails (``clrecon.opencl.select``); None where one was named.
    handed_over: The warning that says so, once it did.
    commands: What is in the queue; ``clrecon.opencl.launching`` waits for it.
    trace: Told in words what is built or launched, for the self-test, which says what a driver crashed in.
    """

    def __init__(self, index: int, cl_platform: Any, cl_device: Any):
        cl = quirks.import_pyopencl()
        self.index = index
        self.cl_device = cl_device
        self.name: str = cl_device.name.strip()
        self.platform: str = cl_platform.name.strip()
        kinds = cl.device_type
        flags = ((kinds.GPU, "gpu"), (kinds.ACCELERATOR, "accelerator"), (kinds.CPU, "cpu"))
        self.type: str = next((name for flag, name in flags if cl_device.type & flag), "custom")
        self.version: str = cl_device.version.strip()
        self.driver: str = cl_device.driver_version.strip()
        self.platform_version: str = cl_platform.version.strip()
        reach = (1 << cl_device.address_bits) - 1  # of a size_t in its kernels
        self.memory_bytes: int = min(cl_device.global_mem_size, reach)
        self.max_allocation_bytes: int = min(cl_device.max_mem_alloc_size, reach)
        self.compute_units: int = cl_device.max_compute_units
        self.has_own_memory: bool = quirks.has_own_memory(cl_device, self.type)
        self.max_work_group_size: int = min(cl_device.max_work_group_size, cl_device.max_work_item_sizes[0])
        self.is_simulator: bool = quirks.is_simulator(self.platform)
        self.shares_host_memory: bool = quirks.shares_host_memory(self.platform, self.type)
        self.has_event_times: bool = quirks.has_event_times(self.platform)
        self.most_steps: int | None = quirks.most_steps(self.name)
        self.fault: str | None = None
        self.keeps_binaries: bool = not quirks.keeps_programs(self.platform)
        self.known_good: KnownGood | None = known_good() if quirks.is_pocl(self.platform) else None
        self._remarks: list[str] = []
        self.kernel_variants: dict[str, str] = quirks.kernel_variants(
            self.platform, self.type, _version_numbers(self.driver)
        )
        self.first_header: str = quirks.first_header(self.platform, _version_numbers(self.driver))
        self.shortcoming: str = _find_shortcoming(cl_device)
        language = quirks.language_option(self.platform, self.type, _version_numbers(self.driver))
        self.own_options: str = os.environ.get("CLRECON_BUILD_OPTIONS", "")
        self.build_options: tuple[str, ...] = (language, *quirks.rounding_options(cl_device), *self.own_options.split())
        self._cpu: NameOfCpu | None = None
        if has_unknown_cpu(self.platform, self.version) and not self.shortcoming:
            self._name_cpu()
        self.lock = threading.RLock()
        self.commands = Commands()
        self.trace: Callable[[str], None] | None = None
        self.programs: dict[tuple[str, tuple[str, ...]], Any] = {}
        self.builds_together = True
        self.gathered: dict[str, dict[str, str]] | None = None
        self.stand_in: Device | None = None
        self.handed_over: list[str] = []
        self._opened = _Opened()
        self._process = os.getpid()

    def _name_cpu(self) -> None:
        """Prepare to name the CPU for a compiler that does not know it, see `clrecon.opencl.pocl`."""
        try:
            self._cpu = NameOfCpu(self.cl_device.int_ptr)
        except LookupError as error:
            self.shortcoming = (
                f"its compiler is older than this CPU and builds nothing for it ({error}): install PoCL 3.1 or newer"
                f" (pocl-opencl-icd of the system, or pocl of conda-forge) or `{install_command('intel-opencl-rt')}`"
            )
        else:
            self.build_options += (f"-DCPU_NAME={self._cpu.name}",)

    @property
    def warnings(self) -> list[str]:
        """What users of this device should know: caches that are not used, a simulator that nobody named."""
        of_kernels = [] if self.known_good is None else self.known_good.warnings
        return [*cache_warnings(), *self._remarks, *of_kernels]

    def remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)

    def checked_cache(self, key: str) -> AbstractContextManager[None]:
        """Return the context in which the driver may look for program ``key`` in its cache."""
        return nullcontext() if self.known_good is None else self.known_good.building(key)

    @property
    def score(self) -> tuple[int, bool, int, tuple[int, ...], int, int]:
        """Sort key of the automatic choice, see ``choose_device``."""
        rank = {"gpu": 3, "accelerator": 2, "cpu": 1}.get(self.type, 0)
        if quirks.is_software_gpu(self.name):
            rank = 0
        version = _version_numbers(self.driver)
        return rank, self.has_own_memory, self.compute_units, version, self.memory_bytes, -self.index

    @property
    def usable_bytes(self) -> int:
        """Memory that may be taken: a card keeps a tenth, 512 MiB or else a quarter, for screens and other programs."""
        headroom = max(self.memory_bytes // 10, min(HEADROOM_BYTES, self.memory_bytes // 4))
        return self.memory_bytes - headroom * self.has_own_memory

    @property
    def group_size(self) -> int:
        """Work-group size of all launches: 64, or less where the device allows less (Apple's CPU: 1)."""
        return min(GROUP_SIZE, self.max_work_group_size)

    @property
    def has_long_items(self) -> bool:
        """A work-item may do the share of a core: on CPUs, unless ``most_steps`` ends it."""
        return int(self.kernel_variants["LANES"]) > 1 and self.most_steps is None

    @property
    def label(self) -> str:
        """Platform and device name, for messages and reports."""
        return f"{self.name} ({self.platform})"

    @property
    def context(self) -> Any:
        """The pyopencl context of this device alone."""
        cl = quirks.import_pyopencl()
        self._refuse_fork()
        with self.lock:
            if self._opened.context is None:
                try:
                    if self._cpu is not None:
                        self._cpu.write()
                    self._opened.context = cl.Context([self.cl_device])
                except (cl.Error, LookupError) as error:
                    raise DeviceFailedError(f"device {self.label} cannot be opened: {describe_error(error)}") from error
                log.info("device opened: %s, %s, driver %s", self.label, self.version, self.driver)
            return self._opened.context

    @property
    def queue(self) -> Any:
        """The in-order command queue, with profiling."""
        cl = quirks.import_pyopencl()
        self._refuse_fork()
        with self.lock:
            if self._opened.queue is None:
                try:
                    profiling = cl.command_queue_properties.PROFILING_ENABLE
                    self._opened.queue = cl.CommandQueue(self.context, properties=profiling)
                except cl.Error as error:
                    raise DeviceFailedError(f"device {self.label} gives no queue: {describe_error(error)}") from error
            return self._opened.queue

    def of_context(self, make: Callable[[Device], Kept]) -> Kept:
        """Return what ``make`` makes of the device, once for each context."""
        with self.lock:
            if make not in self._opened.kept:
                self._opened.kept[make] = make(self)
            value: Kept = self._opened.kept[make]
            return value

    def _refuse_fork(self) -> None:
        """Refuse to work in a forked process: the driver's threads do not exist there, so it would wait for ever."""
        if self._process != os.getpid():
            raise DeviceError(
                f"{self.label} was opened by the process that this one was forked from, which no driver survives: start"
                " processes with multiprocessing.get_context('spawn'), or fork before the first use of a device"
            )

    def with_stand_in(self, stand_in: Device) -> Device:
        """Return the same device, opened only once for both, with a device that takes over if it fails."""
        device = copy.copy(self)
        device.stand_in, device.handed_over = stand_in, []
        return device

    @property
    def current(self) -> Device:
        """The device that works: this one, or the stand-in that took over."""
        return self.stand_in if self.stand_in is not None and self.handed_over else self

    def hand_over(self, warning: str) -> None:
        """Let the stand-in take over."""
        self.handed_over.append(warning)
        log.warning("%s", warning)

    def give_up(self) -> None:
        """Drop context and queue, so that the next use makes new ones; running commands keep what they use."""
        with self.lock:
            self.commands.give_up(self._opened.context, self._opened.queue, self._opened.kept, dict(self.programs))
            self._opened.context = self._opened.queue = None
            self._opened.kept = {}
            self.programs.clear()

    def fail(self, action: str, error: Exception, *, is_late: bool = False) -> DeviceError:
        """Return the error for a failed call, and give the context up: a lost device needs a new one.

        is_late: The driver had accepted the command before.
        """
        self.give_up()
        log.info("%s on %s: %s; its context is given up", action, self.label, describe_error(error))
        return kind_of_error(error, is_late=is_late)(f"{action} on {self.label}: {describe_error(error)}")

    def describe(self) -> dict[str, Any]:
        """Properties for listings and reports."""
        names = (
            *("index", "name", "platform", "type", "version", "driver", "platform_version"),
            *("memory_bytes", "max_allocation_bytes", "compute_units", "has_own_memory"),
        )
        facts = {name: getattr(self, name) for name in names}
        return facts | {"simulator": self.is_simulator, "shortcoming": self.shortcoming}

    def __repr__(self) -> str:
        return f"Device({self.index}: {self.label}, {self.type})"
