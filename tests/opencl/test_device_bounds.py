"""Bounds, defaults and words of the layer of OpenCL, most of them without a device."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from house import ROOT
from refusals import refused

from clrecon.errors import DeviceError, UsageError
from clrecon.opencl import arrays, buffers, cache, launching, pocl, program, quirks, select, sources
from clrecon.opencl.device import HEADROOM_BYTES, Device, _find_shortcoming
from clrecon.opencl.program import load_program
from clrecon.opencl.sources import find_signatures
from clrecon.opencl.transfers import LEAST_BYTES


def test_a_cache_may_fill_the_disk_to_the_room_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = cache.ROOM_BYTES
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    assert cache.find_fault(tmp_path / "a") == ""
    free -= 1
    assert cache.find_fault(tmp_path / "a").startswith("has room for")


@pytest.mark.parametrize(
    ("system", "words"),
    [("Linux", "pocl"), ("Windows", "intel-opencl-rt"), ("Darwin", "conda-forge"), ("Zephyr", "OpenCL driver (ICD)")],
)
def test_each_system_has_its_advice(system: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(select.platform, "system", lambda: system)
    assert words in select.driver_advice()


def test_without_a_device_the_limit_of_memory_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(select, "list_devices", list)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (5 * 10**17, 0))
    with refused(DeviceError, "GB", "memory"):
        select.find_candidates(None)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, 0))
    with refused(DeviceError, "OpenCL", "device"):
        select.find_candidates(None)


def test_devices_that_a_name_means_are_told_with_what_they_lack(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(index: int, shortcoming: str, score: int) -> Any:
        return SimpleNamespace(
            index=index, label=f"D{index}", shortcoming=shortcoming, type="cpu", platform="P", name=f"D{index}",
            is_simulator=False, score=score,
        )  # fmt: skip

    good, better, bad = make(0, "", 1), make(1, "", 2), make(2, "no compiler", 9)
    monkeypatch.setattr(select, "list_devices", lambda: [good, better, bad])
    assert select.find_candidates("cpu") == ([better, good], False)
    with refused(DeviceError, "D2", "device"):
        select.find_candidates("2")
    with refused(DeviceError, "D0", "D1", 7, 0, 1):
        select.find_candidates("7")


@pytest.mark.parametrize("memory", [0, -1, True, 1.0, "1"])
def test_memory_is_a_whole_number_from_1(memory: Any) -> None:
    arrays.check_memory(None)
    arrays.check_memory(1)
    with refused(UsageError, "number"):
        arrays.check_memory(memory)


@pytest.mark.parametrize(("size", "shared"), [(LEAST_BYTES - 1, False), (LEAST_BYTES, True), (LEAST_BYTES + 1, True)])
def test_large_buffers_are_pages_of_the_host(size: int, shared: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "empty_output", lambda *given: (None, "pages"))
    monkeypatch.setattr(buffers, "ask_driver", lambda *given: "buffer")
    device: Any = SimpleNamespace(shares_host_memory=True)
    assert arrays.allocate(device, size) == ("pages" if shared else "buffer")


def test_a_card_keeps_a_quarter_512_mib_or_a_tenth() -> None:
    def usable(memory: int, own: bool = True) -> Any:
        return Device.usable_bytes.fget(SimpleNamespace(memory_bytes=memory, has_own_memory=own))  # type: ignore[attr-defined]

    gib = 1 << 30
    assert HEADROOM_BYTES == 1 << 29
    assert (usable(gib), usable(4 * gib), usable(100 * gib)) == (3 * gib // 4, 7 * gib // 2, 90 * gib)
    assert usable(gib, own=False) == gib


@pytest.mark.parametrize(
    ("version", "words"),
    [("OpenCL 1.1 x", "OpenCL 1.2 is needed"), ("OpenCL 1.2", ""), ("OpenCL 1.2.1", ""), ("OpenCL 1.10", "")],
)
def test_devices_need_opencl_1_2(version: str, words: str) -> None:
    device = SimpleNamespace(version=version, available=True, compiler_available=True, endian_little=True)
    found = _find_shortcoming(device)
    assert words in found and bool(words) == bool(found)


def test_a_command_is_looked_at_until_it_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [3, 2, 1, 0]

    class Event:
        @property
        def command_execution_status(self) -> int:
            return left.pop(0)

    monkeypatch.setattr(launching.time, "perf_counter", lambda: 5.0)
    assert launching._ends_soon(SimpleNamespace(event=Event())) and left == []  # type: ignore[arg-type]


def test_kernels_are_found_from_the_first_letter_on_and_where_conditions_keep_them() -> None:
    assert list(find_signatures("__kernel void a(int n) {}\n__kernel void b(int n) {}", {})) == ["a", "b"]
    inner = "#if 0\n#ifdef X\n__kernel void a(int n) {}\n#else\n__kernel void b(int n) {}\n#endif\n#else\n"
    assert list(find_signatures(f"{inner}__kernel void c(int n) {{}}\n#endif\n", {})) == ["c"]


def test_a_float4_has_four_numbers() -> None:
    four = np.zeros(4, np.float32)
    assert program._take_float4(four) is four and program._take_float4([1, 2, 3, 4]).tolist() == [1, 2, 3, 4]
    for wrong in (np.zeros(3, np.float32), np.zeros(5, np.float32), np.zeros((4, 1), np.float32)):
        with refused(ValueError, "float4", 4):
            program._take_float4(wrong)


@pytest.mark.parametrize("there", [pocl.UNKNOWN, b"a", b"znver4"])
def test_the_name_of_a_cpu_replaces_the_unknown_one_alone(there: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[bytes] = []
    memory = SimpleNamespace(read_text=lambda place: there, write=lambda place, text: written.append(text))
    monkeypatch.setattr(pocl, "_Memory", lambda: _Opened(memory))
    own: Any = SimpleNamespace(name="haswell", _place=7)
    if there == pocl.UNKNOWN:
        pocl.NameOfCpu.write(own)
        assert written == [b"haswell".ljust(len(pocl.UNKNOWN), b"\0")]
    else:
        with pytest.raises(LookupError, match="has changed"):
            pocl.NameOfCpu.write(own)
        assert written == []


class _Opened:
    def __init__(self, memory: Any):
        self.memory = memory

    def __enter__(self) -> Any:
        return self.memory

    def __exit__(self, *error: object) -> None:
        pass


@pytest.mark.parametrize(("value", "kept"), [("", False), (" ", False), ("1", True)])
def test_a_variable_set_to_nothing_is_none(value: str, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENCL_NO_CACHE", value)
    monkeypatch.setattr(quirks, "prepare_caches", lambda: None)
    quirks.import_pyopencl.__wrapped__()
    assert ("PYOPENCL_NO_CACHE" in os.environ) is kept


def test_kernels_lie_beside_the_sources_where_they_are_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def is_missing(name: str) -> Any:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(sources.resources, "files", is_missing)
    assert sources.kernel_root.__wrapped__() == ROOT / "cl"


@pytest.mark.parametrize(
    ("size", "simulator", "way"),
    [(LEAST_BYTES - 1, False, "copy"), (LEAST_BYTES, False, "pieces"), (LEAST_BYTES, True, "copy")],
)
def test_large_arrays_come_back_in_pieces(
    size: int, simulator: bool, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ways: list[str] = []
    opencl = SimpleNamespace(
        mem_flags=SimpleNamespace(USE_HOST_PTR=8), enqueue_copy=lambda *given, **more: ways.append("copy")
    )
    monkeypatch.setattr(arrays, "import_pyopencl", lambda: opencl)
    monkeypatch.setattr(arrays, "raw", lambda array_d: array_d)
    monkeypatch.setattr(arrays, "wait", lambda device: None)
    monkeypatch.setattr(arrays, "read_buffers", lambda device, large: ways.append("pieces"))
    device: Any = SimpleNamespace(is_simulator=simulator, queue=None, commands=SimpleNamespace(add=lambda *given: None))
    arrays._fill_all(device, [(np.zeros(size, np.uint8), SimpleNamespace(flags=0), 0)])
    assert ways == [way]


def test_the_log_says_how_long_a_build_took(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[Any, ...]] = []
    seconds = iter((5.0, 7.5))
    monkeypatch.setattr(program, "log", SimpleNamespace(debug=lambda *words: told.append(words)))
    monkeypatch.setattr(program, "time", SimpleNamespace(perf_counter=lambda: next(seconds)))
    monkeypatch.setattr(device, "programs", {})
    monkeypatch.setattr(device, "keeps_binaries", False)
    load_program(device, "primitives/compact.cl")
    assert told == [("cl/%s %s built from %s in %.3f s", "primitives/compact.cl", device.build_options, "source", 2.5)]
