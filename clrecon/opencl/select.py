"""Find the OpenCL devices of the machine, choose one of them, and work on a CPU device where it fails.

A device is checked at its first use.  The check itself stands in `clrecon.operators.first_use`, since it needs
operators; they hand it in when they are loaded.  A device that passed is not checked again by this version of clrecon
with this driver: a file in the folder of built kernels says so.  The file says too that a check has begun: where a
driver ends the process, the next process finds it and leaves the check to a child, whose end becomes words.

A CPU device takes over where a device fails that nobody named.  Who names a device (`device`, CLRECON_DEVICE,
PYOPENCL_CTX) wants that one: the error says which CPU device could do the work.  Who leaves the choice open wants the
result."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, Generic, TypeVar

from clrecon.errors import DeviceError, DeviceFailedError, DeviceLostError
from clrecon.opencl import quirks
from clrecon.opencl.cache import binary_key, cache_warnings, read_binary, store_binary
from clrecon.opencl.device import Device, describe_error
from clrecon.opencl.launching import settle
from clrecon.system.arguments import name_parameter
from clrecon.system.log import get_logger
from clrecon.system.packages import install_command
from clrecon.system.progress import device_seconds
from clrecon.version import package_version

log = get_logger(__name__)

VARIABLE = "CLRECON_DEVICE_CHECK"
"""Environment variable that switches the check off: ``off``."""

_PASSED = b"this device has passed its check"
_BEGUN = b"the check of this device has begun"
_WRONG = b"this device computes wrongly: "
_CRASHED = b"this device ended its check: "
"""What the file says; behind the last two follows what is wrong."""

_DIED = "a process ended while it checked this device"

_check: list[Callable[[Device], str]] = []
_command: list[str] = []
_lock = threading.RLock()
_under_check: list[Any] = []
"""Devices that this thread checks: what the check asks of them is no first use."""


def register(check: Callable[[Device], str], *command: str) -> None:
    """Set the check: a function that returns what is wrong with a device, empty if nothing is.

    *command: Arguments of the Python interpreter that make the same check; the index of a device follows.  The last
        line of its output is the answer as JSON.
    """
    _check[:] = [check]
    _command[:] = command


def find_fault(device: Device) -> str:
    """Return what is wrong with a device, empty if nothing is; at the first use of a device this runs the check."""
    if device.fault is not None or not _check or device.is_simulator:
        return device.fault or ""
    with _lock:
        if device in _under_check:
            return ""
        if device.fault is None:
            _under_check.append(device)
            try:
                device.fault = _find_fault(device)
            finally:
                _under_check.remove(device)
        return device.fault


def remembered_fault(device: Device) -> str:
    """Return what earlier processes found wrong with a device, empty if they found nothing; nothing runs on it."""
    if device.is_simulator or _is_off():
        return ""
    known = read_binary(_key(device)) or b""
    if known == _BEGUN:
        return _DIED
    fault = next((known[len(start) :] for start in (_WRONG, _CRASHED) if known.startswith(start)), b"")
    return fault.decode(errors="replace")


def _is_off() -> bool:
    return os.environ.get(VARIABLE, "").strip().lower() == "off"


def _find_fault(device: Device) -> str:
    if _is_off():
        device.remark(f"{device.label} was not checked at its first use ({VARIABLE}=off): its results may be wrong")
        return ""
    key = _key(device)
    known = read_binary(key) or b""
    if known == _PASSED:
        return ""
    if known == _BEGUN or known.startswith(_CRASHED) or _lacks_linker(device):
        fault, verdict = _check_apart(device)
    else:
        store_binary(key, _BEGUN)
        try:
            fault = _check[0](device)
        except BaseException:  # an interrupt or a time limit says nothing
            store_binary(key, b"")
            raise
        verdict = _WRONG + fault.encode() if fault else _PASSED
    log.info("%s checked at its first use: %s", device.label, fault or "it computes rightly")
    store_binary(key, verdict)
    return fault


def _check_apart(device: Device) -> tuple[str, bytes]:
    """Check a device in a process of its own; return what is wrong with it, and what to remember."""
    if getattr(sys, "frozen", False) or not sys.executable or not _command:
        return _DIED, _CRASHED + _DIED.encode()
    seconds = min(device_seconds(), threading.TIMEOUT_MAX)
    try:
        ended = subprocess.run(
            [sys.executable, *_command, str(device.index)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=seconds,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        why = f"its check does not end within {seconds:g} s" if isinstance(error, subprocess.TimeoutExpired) else _DIED
        return why, _CRASHED + why.encode()
    if ended.returncode == 0:
        fault = str(json.loads(ended.stdout.splitlines()[-1]))
        return fault, _WRONG + fault.encode() if fault else _PASSED
    names = {-number: number.name for number in signal.Signals}
    how = names.get(ended.returncode, f"exit code {ended.returncode}")
    fault = f"its driver ends the process ({how})"
    if _lacks_linker(device):
        fault += ", because there is no linker ld on the PATH"
    return fault, _CRASHED + fault.encode()


def _lacks_linker(device: Device) -> bool:
    """Tell whether this is a PoCL that may need the program ld and does not find it; newer ones bring a linker."""
    return "Portable Computing" in device.platform and sys.platform == "linux" and shutil.which("ld") is None


def _key(device: Device) -> str:
    driver = (device.platform, device.platform_version, device.driver, device.version, device.name)
    variants = (f"{macro}={value}" for macro, value in sorted(device.kernel_variants.items()))
    return binary_key("first use", package_version(), *driver, *device.build_options, *variants)


_LEAST_ADDRESS_SPACE = 1_000_000_000
"""Bytes of address space below which no driver is loaded: PoCL shows no device, hangs or ends the process."""


def _address_space() -> int | None:
    """Return the limit of this process's address space in bytes; None without one."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def driver_advice() -> str:
    """Return one sentence on how to get an OpenCL driver on this system."""
    system = platform.system()
    if system == "Linux":
        if platform.machine() == "x86_64":
            return f"install the CPU driver with `{install_command('pyopencl[pocl]')}` or `apt install pocl-opencl-icd`"
        return "install the CPU driver with `apt install pocl-opencl-icd`, or the GPU vendor's OpenCL package"
    if system == "Windows":
        runtime = install_command("intel-opencl-rt")
        return f"install the GPU vendor's graphics driver, or the Intel CPU runtime with `{runtime}`"
    if system == "Darwin":
        return "install PoCL with `conda install -c conda-forge pocl`, macOS before 15 brings OpenCL itself"
    return "install the OpenCL driver (ICD) of your device"


def _find_platforms() -> list[Any]:
    """Return all pyopencl platforms; an empty list without a driver."""
    try:
        cl = quirks.import_pyopencl()
    except ImportError as error:
        advice = "install it again, or a missing loader (libOpenCL) with `apt install ocl-icd-libopencl1`"
        raise DeviceError(f"pyopencl cannot be imported ({error}): {advice}") from error
    limit = _address_space()
    if limit is not None and limit < _LEAST_ADDRESS_SPACE:
        raise DeviceError(
            f"no OpenCL driver can be loaded for want of memory: this process may take {limit / 1e9:.2f} GB (ulimit"
            f" -v), and drivers with their compilers take {_LEAST_ADDRESS_SPACE / 1e9:.1f} GB: raise that limit"
        )
    try:
        return list(cl.get_platforms())
    except cl.Error:  # PLATFORM_NOT_FOUND_KHR: a loader exists, but no driver
        return []


@lru_cache(maxsize=1)
def _discover() -> tuple[tuple[tuple[str, str, str], ...], tuple[Device, ...]]:
    """Return (name, version, note) of each platform and all devices; they are searched once in a process."""
    platforms: list[tuple[str, str, str]] = []
    devices: list[Device] = []
    for cl_platform in _find_platforms():
        cl = quirks.import_pyopencl()
        note = ""
        try:
            cl_devices = cl_platform.get_devices()
        except cl.Error as error:  # DEVICE_NOT_FOUND is the normal answer of a driver without its hardware
            cl_devices = []
            if "DEVICE_NOT_FOUND" not in str(error):
                note = describe_error(error)
        for cl_device in cl_devices:
            try:
                devices.append(Device(len(devices), cl_platform, cl_device))
            except cl.Error as error:  # one broken driver must not hide the others
                note = f"a device does not answer: {describe_error(error)}"
        count = f"{len(cl_devices)} device{'s' * (len(cl_devices) != 1)}"
        platforms.append((cl_platform.name.strip(), cl_platform.version.strip(), note or count))
    return tuple(platforms), tuple(devices)


def list_platforms() -> list[dict[str, str]]:
    """Return name, version and a note of every OpenCL platform, also of those without a device."""
    return [{"name": name, "version": version, "note": note} for name, version, note in _discover()[0]]


def list_devices() -> list[Device]:
    """Return every OpenCL device of the machine, simulators included, in the order of the drivers.

    Returns
    -------
    list of Device
        Empty where no driver is installed.

    Raises
    ------
    DeviceError
        pyopencl itself cannot be imported.
    """
    return list(_discover()[1])


def _list_for_message(devices: list[Device]) -> str:
    return "; ".join(
        f"{device.index}: {device.label}" + (f", unusable: {device.shortcoming}" if device.shortcoming else "")
        for device in devices
    )


def _match(devices: list[Device], wanted: str) -> list[Device]:
    """Return devices that match `wanted`: by index, by type, or by a part of the platform's or device's name."""
    if re.fullmatch("[0-9]+", wanted):
        return [device for device in devices if device.index == int(wanted)]
    wanted = wanted.lower()
    of_type = [device for device in devices if device.type == wanted and not device.is_simulator]
    if of_type:
        return of_type
    return [device for device in devices if wanted in f"{device.platform} {device.name}".lower()]


def _named_by_pyopencl(cl: Any, devices: list[Device]) -> list[Device]:
    """Return the device that PYOPENCL_CTX asks for, in pyopencl's own notation."""
    try:
        asked = cl.create_some_context(interactive=False).devices
    except Exception as error:  # pyopencl raises RuntimeError, IndexError or its own errors here
        raise DeviceError(f"PYOPENCL_CTX={os.environ['PYOPENCL_CTX']!r}: {describe_error(error)}") from error
    return [device for device in devices if device.cl_device in asked]


def choose_device(name: str | int | Device | None = None) -> Device:
    """Choose the device to work on.

    Parameters
    ----------
    name : str, int or Device, optional
        Index as ``clrecon.devices()`` counts, "cpu" or "gpu", or a part of the name of a device or platform; if several
        match, the best is used.  None or "auto": the device named by CLRECON_DEVICE, else by PYOPENCL_CTX, else the
        best of all: GPUs before accelerators before CPUs before software rasterisers, then those with memory of their
        own, then by compute units, version of the driver, and memory.  A simulator is
        used only when it is named.

    Returns
    -------
    Device

    Raises
    ------
    DeviceError
        There is no driver, no device, or no device of that name (the message lists all devices); or the device fails
        the check at its first use, and was named.
    """
    if isinstance(name, Device):
        return _take_sound([name])
    devices, is_automatic = find_candidates(name)
    chosen = _take_sound(devices if is_automatic else devices[:1])
    if chosen.is_simulator and not _is_named(chosen, name):
        chosen.remark(
            f"{chosen.label} is a simulator, a thousand times slower than a device: it was chosen without its name, by"
            f" an index or PYOPENCL_CTX; name another with {name_parameter('device')}"
        )
    log.debug("device %d chosen of %d: %s", chosen.index, len(list_devices()), chosen.label)
    return chosen


def choose_remembered(name: str | int | None = None) -> Device:
    """Choose as `choose_device` does, by what earlier processes found at the first use; nothing runs on the device."""
    devices, is_automatic = find_candidates(name)
    sound = (device for device in devices if not remembered_fault(device))
    return next(sound, devices[0]) if is_automatic else devices[0]


_REASONS = (
    *("GPUs come before accelerators, CPUs and software", "it has memory of its own", "it has more compute units"),
    *("its driver is newer", "it has more memory", "it is listed first"),
)
"""What the entries of `Device.score` say of the better device."""


def explain_choice(name: str | int | None = None) -> str:
    """Return why `choose_remembered` takes its device, and before which one."""
    devices, is_automatic = find_candidates(name)
    chosen = choose_remembered(name)
    named = "" if is_automatic else "named, "
    others = [device for device in devices if device is not chosen and not (is_automatic and remembered_fault(device))]
    if not others:
        return f"{named}no other one"
    runner_up = max(others, key=lambda device: device.score)
    reasons = zip(_REASONS, chosen.score, runner_up.score, strict=True)
    return f"{named}before {runner_up.index}: {next(why for why, one, two in reasons if one != two)}"


def choose_unchecked(name: str | int | None = None) -> Device:
    """Choose as `choose_device` does, whether the device computes rightly or not; nothing runs on it."""
    return find_candidates(name)[0][0]


def _take_sound(devices: list[Device]) -> Device:
    """Return the first device that passes the check at its first use, with a warning that names those before it."""
    passed_over: list[str] = []
    for device in devices:
        fault = find_fault(device)
        if not fault:
            for text in passed_over:
                log.warning("%s", text)
                device.remark(text)
            return device
        passed_over.append(f"{device.label} is not used, its check failed: {fault}")
    remedy = "update its driver or choose another device; `clrecon selftest` tests every kernel"
    if any(_lacks_linker(device) for device in devices):
        remedy = "install one (Debian: apt install binutils libc6-dev libgcc-12-dev)"
    raise DeviceError(f"{'; '.join(passed_over)}: {remedy}")


def _is_named(device: Device, name: str | int | None) -> bool:
    """True where the caller or a variable asks for a device by a part of its name, in place of an index."""
    asked = [str(name or "").strip().lower(), os.environ.get("CLRECON_DEVICE", "").strip().lower()]
    wanted = next((text for text in asked if text not in ("", "auto")), os.environ.get("PYOPENCL_CTX", "").lower())
    return not re.fullmatch("[0-9]*", wanted) and wanted in f"{device.platform} {device.name}".lower()


def find_candidates(name: str | int | None) -> tuple[list[Device], bool]:
    """Return the devices that a name means, the best first, and whether no name was given."""
    devices = list_devices()
    if not devices:
        trouble = "".join(f" ({text})" for text in cache_warnings())
        limit = _address_space()
        if limit is not None:
            trouble += f" (this process may take {limit / 1e9:.2f} GB of memory, ulimit -v: a driver may need more)"
        raise DeviceError(f"no OpenCL device found{trouble}: {driver_advice()}")
    wanted, source = ("", "") if name is None else (str(name).strip(), "device")
    if wanted.lower() in ("", "auto"):
        wanted, source = os.environ.get("CLRECON_DEVICE", "").strip(), "CLRECON_DEVICE"
    if wanted.lower() not in ("", "auto"):
        matches = _match(devices, wanted)
        if not matches:
            raise DeviceError(f"{source} {wanted!r} is not there; found {_list_for_message(devices)}")
        usable = [device for device in matches if not device.shortcoming]
        if not usable:
            raise DeviceError(f"device {matches[0].label} cannot be used: {matches[0].shortcoming}")
        return sorted(usable, key=lambda device: (not device.is_simulator, device.score), reverse=True), False
    is_named = bool(os.environ.get("PYOPENCL_CTX"))
    if is_named:
        matches = _named_by_pyopencl(quirks.import_pyopencl(), devices)
    else:
        matches = [device for device in devices if not device.is_simulator and not device.shortcoming]
    if not matches:
        raise DeviceError(
            f"no device to choose among {_list_for_message(devices)} (simulators must be named with"
            f" {name_parameter('device')}): {driver_advice()}"
        )
    return sorted(matches, key=lambda device: device.score, reverse=True), not is_named


Given = TypeVar("Given")


def take_device(name: str | int | Device | None) -> Device:
    """Choose the device for some work; one that nobody named has a stand-in, if the machine has a CPU device."""
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


class Attempt(Generic[Given]):
    """One turn of a loop that tries again: errors of a kind that end its ``with`` block are left to the loop."""

    def __init__(self, given: Given, *caught: type[DeviceError]):
        self.given = given
        self._caught = caught
        self._error: DeviceError | None = None

    def __enter__(self) -> Given:
        return self.given

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> bool:
        self._error = error if isinstance(error, self._caught) else None
        return self._error is not None

    def take_error(self) -> DeviceError | None:
        """Return the error that ended the block, and let go of it: its frames hold buffers."""
        error, self._error = self._error, None
        return error


def with_fallback(device: Device) -> Iterator[Attempt[tuple[Device, list[str]]]]:
    """Yield attempts at some work: on a lost device once more with a fresh context, and at last on its stand-in.

        for attempt in with_fallback(take_device(name)):
            with attempt as (current, warnings):
                made = ...

    The block makes everything anew on `current`; `warnings` are for the report of the work.  Once the stand-in has
    taken over, it does all further work.
    """
    lost: list[str] = []
    first: DeviceFailedError | None = None
    while True:
        current = device.current
        attempt = Attempt((current, [*device.handed_over, *lost]), DeviceError)
        yield attempt
        error = attempt.take_error()
        if error is None:
            return
        settle(current, error)
        if first is not None:  # nothing was gained
            device.handed_over.clear()
            raise first from error
        if not isinstance(error, DeviceFailedError):
            raise error
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
            raise error
        del error  # its frames hold buffers
