"""Build kernel files for a device, and keep what was built."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from clrecon.errors import DeviceError
from clrecon.opencl.binaries import binary_key, read_binary, store_binary
from clrecon.opencl.context import Device, describe_error
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.sources import read_kernel_source
from clrecon.system.log import get_logger

__all__ = ["Program", "load_program"]

log = get_logger(__name__)


class Program:
    """A built kernel file; ``program["name"]`` is one of its kernels."""

    def __init__(self, name: str, cl_program: Any):
        self.name = name
        self._kernels = {kernel.function_name: kernel for kernel in cl_program.all_kernels()}

    def __getitem__(self, kernel: str) -> Any:
        return self._kernels[kernel]

    @property
    def kernel_names(self) -> list[str]:
        """Names of the kernels of this file."""
        return sorted(self._kernels)


def load_program(device: Device, name: str, variants: Mapping[str, str] | None = None) -> Program:
    """Build kernel file `name` for `device`, or return what an earlier call built.

    Parameters
    ----------
    device : Device
    name : str
        Such as ``"isosurface/marching_cubes.cl"``.
    variants : mapping of str to str, optional
        ``-D`` definitions; only for variants such as the element type, never for sizes.

    Raises
    ------
    DeviceError
        The driver's compiler refuses; the message holds its first complaint, the log follows in ``__cause__``.
    """
    chosen = (f"-D{macro}={value}" for macro, value in sorted((variants or {}).items()))
    options = (*device.build_options, *chosen)
    key = (name, options)
    with device.lock:
        if key not in device.programs:
            device.programs[key] = _build(device, name, options)
        program: Program = device.programs[key]
        return program


def _build(device: Device, name: str, options: tuple[str, ...]) -> Program:
    source, start = read_kernel_source(name), time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a compiler's chatter about code that builds
            kept = _build_from_binary(device, source, options) if device.keeps_binaries else None
            built = _build_from_source(device, source, options) if kept is None else kept
            program = Program(name, built)
    except (import_pyopencl().Error, RuntimeError, OSError) as error:  # OSError: the driver's or pyopencl's cache
        raise DeviceError(f"cl/{name} does not build on {device.label}: {_first_complaint(str(error))}") from error
    if not program.kernel_names:
        raise DeviceError(f"cl/{name} has no kernel on {device.label}: its cache is damaged, empty it")
    origin = "source" if kept is None else "a kept binary"
    log.debug("cl/%s %s built from %s in %.3f s", name, options, origin, time.perf_counter() - start)
    return program


_STANDARD = ("-cl-std=CL1.2",)


def _key(device: Device, source: str, options: tuple[str, ...]) -> str:
    driver = (device.platform, device.platform_version, device.driver, device.version, device.name)
    return binary_key(*driver, *_STANDARD, *options, source)


def _build_from_source(device: Device, source: str, options: tuple[str, ...]) -> Any:
    cl = import_pyopencl()
    built = cl.Program(device.context, source).build([*_STANDARD, *options])
    if device.keeps_binaries:
        with suppress(cl.Error):
            store_binary(_key(device, source, options), built.binaries[0])
    return built


def _build_from_binary(device: Device, source: str, options: tuple[str, ...]) -> Any:
    """The program from the binary that an earlier process kept; None where there is none or the driver refuses it."""
    cl = import_pyopencl()
    binary = read_binary(_key(device, source, options))
    if binary is None:
        return None
    try:
        return cl.Program(device.context, [device.cl_device], [binary]).build([*_STANDARD, *options])
    except (cl.Error, RuntimeError) as error:
        log.info("a kept binary is refused by the driver (%s): it is built anew and replaced", describe_error(error))
        return None


def _first_complaint(log: str) -> str:
    """The first line of a build log that says what is wrong, with its place in our files if there is one."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    complaints = [line for line in lines if "error:" in line.lower()]
    placed = [line for line in complaints if ".cl:" in line or ".h:" in line]
    return next(iter([*placed, *complaints, *lines]), "the driver does not say why")
