"""Kernel files built for a device; built programs are kept."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from clrecon.errors import DeviceError
from clrecon.opencl.buffers import raw
from clrecon.opencl.cache import binary_key, read_binary, refuse_short_files, store_binary
from clrecon.opencl.device import Device, describe_error
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.sources import KernelArgument, definitions_of, find_signatures, read_kernel_source
from clrecon.system.log import get_logger

log = get_logger(__name__)

_TYPES: dict[str, Any] = {
    "char": np.int8, "uchar": np.uint8, "short": np.int16, "ushort": np.uint16, "int": np.int32, "uint": np.uint32,
    "long": np.int64, "ulong": np.uint64, "float": np.float32, "float4": np.dtype("V16"),
}  # fmt: skip

LAUNCHES_BEFORE_TYPES = 8
"""After so many launches pyopencl is told the types of a kernel's arguments: it then writes code that sets them in 2,
not 4 us each, which takes as long as several launches.
"""


def _take_buffer(value: Any) -> Any:
    buffer = raw(value)
    if isinstance(buffer, import_pyopencl().Buffer):
        return buffer
    raise TypeError(f"{value!r} is no buffer")


def _take_whole(kind: Any) -> Callable[[Any], Any]:
    low, high = int(np.iinfo(kind).min), int(np.iinfo(kind).max)

    def take_value(value: Any) -> Any:
        if low <= value <= high:
            number = kind(value)
            if value.__class__ is int or number == value:  # comparing takes as long as converting
                return number
        raise ValueError(f"{value!r} is no {kind.__name__}")

    return take_value


def _take_float4(numbers: Any) -> Any:
    if numbers.__class__ is np.ndarray and numbers.dtype == np.float32 and numbers.shape == (4,):
        return numbers
    vector = np.ascontiguousarray(numbers, np.float32)
    if vector.shape != (4,):
        raise ValueError(f"4 numbers are a float4, not an array of shape {vector.shape}")
    return vector


class Kernel:
    """A kernel of a built program, with its arguments in the kernel's order."""

    def __init__(self, cl_kernel: Any, arguments: tuple[KernelArgument, ...]):
        self.cl_kernel = cl_kernel
        self.name: str = cl_kernel.function_name
        self.arguments = arguments
        if cl_kernel.num_args != len(arguments):
            raise AssertionError(f"{self.name} has {cl_kernel.num_args} arguments, its source names {len(arguments)}")
        self._names = tuple(argument.name for argument in arguments)
        self._expected = frozenset(self._names)
        self._takers = tuple((argument.name, _taker(argument)) for argument in arguments)
        self._launches = 0

    def enqueue(self, queue: Any, items: int, group: int, values: tuple[Any, ...], first: int = 0) -> Any:
        """Launch the kernel over `items` work-items from number `first` on with the result of `order`; the caller holds
        the device's lock.
        """
        self._launches += 1
        if self._launches == LAUNCHES_BEFORE_TYPES:
            types = [None if argument.is_buffer else _TYPES[argument.type] for argument in self.arguments]
            self.cl_kernel.set_scalar_arg_dtypes(types)
        return self.cl_kernel(queue, (items,), (group,), *values, global_offset=(first,) if first else None)

    def order(self, values: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return the arguments as the driver takes them: in the kernel's order, with numbers in its types."""
        if values.keys() != self._expected:
            raise TypeError(self._describe_difference(values))
        try:
            return tuple([take(values[name]) for name, take in self._takers])
        except (TypeError, ValueError, OverflowError) as error:
            raise TypeError(self._describe_misfits(values)) from error

    def _describe_difference(self, values: Mapping[str, Any]) -> str:
        missing = [name for name in self._names if name not in values]
        surplus = [name for name in values if name not in self._expected]
        parts = [f"{what} {', '.join(names)}" for what, names in (("without", missing), ("with", surplus)) if names]
        return f"kernel {self.name} is launched {' and '.join(parts)}: it takes {', '.join(self._names)}"

    def _describe_misfits(self, values: Mapping[str, Any]) -> str:
        wrong = []
        for argument, (name, take) in zip(self.arguments, self._takers, strict=True):
            try:
                take(values[name])
            except (TypeError, ValueError, OverflowError):
                kind = "a buffer" if argument.is_buffer else argument.type
                wrong.append(f"{name} is {kind}, not {values[name]!r}")
        return f"kernel {self.name}: {'; '.join(wrong)}"


def _taker(argument: KernelArgument) -> Callable[[Any], Any]:
    if argument.is_buffer:
        return _take_buffer
    if argument.type == "float4":
        return _take_float4
    kind = _TYPES[argument.type]
    return np.float32 if kind is np.float32 else _take_whole(kind)


class Program:
    """Built kernel files; ``program["name"]`` is one of their kernels.  Without a `cl_program` it has none yet."""

    def __init__(
        self, name: str, cl_program: Any = None, signatures: Mapping[str, tuple[KernelArgument, ...]] | None = None
    ):
        self.name = name
        built = {} if cl_program is None else {kernel.function_name: kernel for kernel in cl_program.all_kernels()}
        self._kernels = {kernel: Kernel(built[kernel], (signatures or {})[kernel]) for kernel in built}

    def __getitem__(self, kernel: str) -> Kernel:
        return self._kernels[kernel]

    @property
    def kernel_names(self) -> list[str]:
        return sorted(self._kernels)


def load_program(device: Device, name: str, variants: Mapping[str, str] | None = None) -> Program:
    """Build a kernel file, ``"surface/marching_cubes.cl"``, with ``-D`` `variants`, never sizes, or return it built."""
    options = _options_of(device, variants or {})
    key = (name, options)
    with device.lock:
        if key not in device.programs and device.gathered is not None:
            device.gathered[name] = dict(variants or {})
            return Program(name)
        if key not in device.programs:
            device.programs[key] = _build(device, (name,), options)
        elif device.known_good is not None:
            device.known_good.record_when_due()
        program: Program = device.programs[key]
        return program


def _options_of(device: Device, variants: Mapping[str, str]) -> tuple[str, ...]:
    return (*device.build_options, *(f"-D{macro}={value}" for macro, value in sorted(variants.items())))


@contextmanager
def building_together(device: Device) -> Iterator[None]:
    """Build at the end of a ``with`` block, as one program, the kernel files that the block loads; it uses none.

    PoCL reads its own headers at each build, also of a program that it keeps, which takes 24 ms of processor time.
    Files that are built together get the variants of all, so no other variant may change one of them.
    """
    with device.lock:
        if device.gathered is not None or not device.builds_together:
            yield
            return
        files: dict[str, dict[str, str]] = {}
        device.gathered = files
        try:
            yield
        finally:
            device.gathered = None
        if files:
            united: dict[str, str] = {}
            for variants in files.values():
                united |= variants
            _check_united(united, files)
            program = _build(device, tuple(files), _options_of(device, united))
            device.programs.update({(name, _options_of(device, files[name])): program for name in files})


def _check_united(united: Mapping[str, str], files: Mapping[str, Mapping[str, str]]) -> None:
    for name, variants in files.items():
        different = (macro for macro in united if variants.get(macro) != united[macro])
        if changed := {macro for macro in different if re.search(rf"\b{macro}\b", read_kernel_source(name))}:
            raise AssertionError(f"cl/{name} would be built with {', '.join(sorted(changed))} of another file")


def _build(device: Device, names: tuple[str, ...], options: tuple[str, ...]) -> Program:
    source, start = read_kernel_source(*names), time.perf_counter()
    name = ", cl/".join(names)
    if device.first_header:
        source = read_kernel_source(device.first_header) + source
    if device.trace is not None:
        device.trace(f"the build of cl/{name}")
    if device.known_good is not None:
        refuse_short_files()
    try:
        with warnings.catch_warnings(), device.checked_cache(_key(device, source, options)):
            warnings.simplefilter("ignore")  # a compiler's remarks about code that builds
            from_binary = _build_from_binary(device, source, options) if device.keeps_binaries else None
            built = _build_from_source(device, source, options) if from_binary is None else from_binary
            program = Program(name, built, find_signatures(source, definitions_of(options)))
    except (import_pyopencl().Error, RuntimeError, OSError) as error:  # OSError: from a cache
        on = device.label + (f" with CLRECON_BUILD_OPTIONS={device.own_options}" if device.own_options else "")
        raise DeviceError(f"cl/{name} does not build on {on}: {_first_complaint(str(error))}") from error
    if not program.kernel_names:
        if device.known_good is not None:
            device.known_good.forget(_key(device, source, options))
        raise DeviceError(f"cl/{name} has no kernel on {device.label}: its cache was damaged, run again")
    origin = "source" if from_binary is None else "a kept binary"
    log.debug("cl/%s %s built from %s in %.3f s", name, options, origin, time.perf_counter() - start)
    return program


def _key(device: Device, source: str, options: tuple[str, ...]) -> str:
    driver = (device.platform, device.platform_version, device.driver, device.version, device.name)
    return binary_key(*driver, *options, source)


def _build_from_source(device: Device, source: str, options: tuple[str, ...]) -> Any:
    cl = import_pyopencl()
    # A program without its source: pyopencl keeps binaries beside pickles, and leaves a source that does not build in
    # the temporary folder.
    built = cl.Program(cl._cl._Program(device.context, source)).build(list(options))
    if device.keeps_binaries:
        with suppress(cl.Error):
            store_binary(_key(device, source, options), built.binaries[0])
    return built


def _build_from_binary(device: Device, source: str, options: tuple[str, ...]) -> Any:
    """Build the program from the binary that an earlier process kept; None without one, or if the driver refuses it."""
    cl = import_pyopencl()
    binary = read_binary(_key(device, source, options))
    if binary is None:
        return None
    try:
        return cl.Program(device.context, [device.cl_device], [binary]).build(list(options))
    except (cl.Error, RuntimeError) as error:
        log.info("a kept binary is refused by the driver (%s): it is built anew and replaced", describe_error(error))
        return None


def _first_complaint(log: str) -> str:
    """Return the first line of a build log with an error, with its place in our files if there is one."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    complaints = [line for line in lines if "error:" in line.lower()]
    placed = [line for line in complaints if ".cl:" in line or ".h:" in line]
    return next(iter([*placed, *complaints, *lines]), "the driver does not say why")
