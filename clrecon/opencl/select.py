"""Find the OpenCL devices of the machine and choose one of them."""

from __future__ import annotations

import os
import platform
import re
from functools import lru_cache
from typing import Any

from clrecon.errors import DeviceError
from clrecon.opencl import quirks
from clrecon.opencl.cache.folders import cache_warnings
from clrecon.opencl.context import Device, describe_error
from clrecon.opencl.first_use import find_fault, remembered_fault
from clrecon.system.installing import install_command
from clrecon.system.log import get_logger
from clrecon.system.wording import name_parameter

log = get_logger(__name__)


LEAST_ADDRESS_SPACE = 1_000_000_000
"""Address space, in bytes, below which no driver is loaded.  Two versions of PoCL take 0.83 GB before anything is
built; with less they show no device, wait for ever, or end the process."""


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
        raise DeviceError(f"pyopencl cannot be imported ({error}): reinstall clrecon") from error
    limit = _address_space()
    if limit is not None and limit < LEAST_ADDRESS_SPACE:
        raise DeviceError(
            f"no OpenCL driver can be loaded for want of memory: this process may take {limit / 1e9:.2f} GB (ulimit"
            f" -v), and drivers with their compilers take {LEAST_ADDRESS_SPACE / 1e9:.1f} GB: raise that limit"
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
            found = cl_platform.get_devices()
        except cl.Error as error:  # DEVICE_NOT_FOUND is the normal answer of a driver without its hardware
            found = []
            if "DEVICE_NOT_FOUND" not in str(error):
                note = describe_error(error)
        for cl_device in found:
            try:
                devices.append(Device(len(devices), cl_platform, cl_device))
            except cl.Error as error:  # one broken driver must not hide the others
                note = f"a device does not answer: {describe_error(error)}"
        count = f"{len(found)} device{'s' * (len(found) != 1)}"
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
        best of all: GPUs before accelerators before CPUs before software rasterisers, then by memory.  A simulator is
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
        passed_over.append(f"{device.label} is not used, it computes wrongly: {fault}")
    raise DeviceError(
        f"{'; '.join(passed_over)}: update its driver or choose another device; `clrecon selftest` tests every kernel"
    )


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
            f" {name_parameter('device')}):"
            f" {driver_advice()}"
        )
    return sorted(matches, key=lambda device: device.score, reverse=True), not is_named
