"""Build kernel files for a device, and keep what was built."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from clrecon.errors import DeviceError
from clrecon.kernels.sources import read_kernel_source
from clrecon.opencl import Device
from clrecon.opencl.quirks import import_pyopencl

__all__ = ["Program", "load_program"]


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
    options = tuple(f"-D{macro}={value}" for macro, value in sorted((variants or {}).items()))
    key = (name, options)
    if key not in device.programs:
        cl = import_pyopencl()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a compiler's chatter about code that builds
                built = cl.Program(device.context, read_kernel_source(name)).build(["-cl-std=CL1.2", *options])
            device.programs[key] = Program(name, built)
        except (cl.Error, RuntimeError) as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            first = next((line for line in lines if "error" in line.lower() and "cl/" in line), lines[0])
            raise DeviceError(f"cl/{name} does not build on {device.label}: {first}") from error
    program: Program = device.programs[key]
    return program
