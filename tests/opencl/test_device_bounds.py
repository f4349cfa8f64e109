"""Bounds, defaults and messages of the layer of OpenCL, most of them without a device."""

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


def test_cache_folder_is_at_fault_from_one_byte_below_the_room_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = cache.ROOM_BYTES
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    assert cache.find_fault(tmp_path / "a") == ""
    free -= 1
    assert cache.find_fault(tmp_path / "a").startswith("has room for")


@pytest.mark.parametrize(
    ("system", "advice"),
    [("Linux", "pocl"), ("Windows", "intel-opencl-rt"), ("Darwin", "conda-forge"), ("Zephyr", "OpenCL driver (ICD)")],
)
def test_advice_on_drivers_is_for_the_operating_system(
    system: str, advice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(select.platform, "system", lambda: system)
    assert advice in select.driver_advice()


@pytest.mark.parametrize("limit_bytes", [5 * 10**17, None], ids=["5e8 GB", "unlimited"])
def test_error_without_a_device_names_the_limit_of_memory_if_there_is_one(
    limit_bytes: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(select, "list_devices", list)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit_bytes or resource.RLIM_INFINITY, 0))
    with refused(DeviceError, "OpenCL") as caught:
        select.find_candidates(None)
    assert ("500000000.00 GB" in str(caught.value)) == (limit_bytes is not None)


def fake_device(index: int, *, score: int, shortcoming: str = "") -> Any:
    return SimpleNamespace(
        index=index, label=f"D{index}", shortcoming=shortcoming, type="cpu", platform="P", name=f"D{index}",
        is_simulator=False, score=score,
    )  # fmt: skip


@pytest.fixture
def three_devices(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """All devices of the machine: a good CPU, a better one, and the best, which has no compiler."""
    devices = [fake_device(0, score=1), fake_device(1, score=2), fake_device(2, score=9, shortcoming="no compiler")]
    monkeypatch.setattr(select, "list_devices", lambda: devices)
    return devices


def test_candidates_of_a_type_are_the_usable_devices_by_falling_score(three_devices: list[Any]) -> None:
    good, better, _ = three_devices
    candidates, _ = select.find_candidates("cpu")
    assert candidates == [better, good]


@pytest.mark.usefixtures("three_devices")
def test_named_device_with_a_shortcoming_is_refused_with_its_label() -> None:
    with refused(DeviceError, "D2", "compiler"):
        select.find_candidates("2")


@pytest.mark.usefixtures("three_devices")
def test_unknown_device_index_is_refused_with_the_devices_and_what_one_lacks() -> None:
    with refused(DeviceError, 7, "D0", 0, "D1", 1, "D2", 2, "compiler"):
        select.find_candidates("7")


@pytest.mark.parametrize("memory", [0, -1, True, 1.0, "1"])
def test_memory_that_is_no_whole_number_from_1_is_refused(memory: Any) -> None:
    with refused(UsageError, "number"):
        arrays.check_memory(memory)


@pytest.mark.parametrize("memory", [None, 1])
def test_memory_of_one_byte_or_without_a_limit_is_accepted(memory: int | None) -> None:
    arrays.check_memory(memory)


@pytest.mark.parametrize(
    ("size", "memory"),
    [(LEAST_BYTES - 1, "buffer"), (LEAST_BYTES, "pages"), (LEAST_BYTES + 1, "pages")],
    ids=["a byte less than the least size", "the least size", "a byte more"],
)
def test_buffers_from_the_least_size_on_are_pages_of_the_host_where_the_device_shares_them(
    size: int, memory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "empty_output", lambda *given: (None, "pages"))
    monkeypatch.setattr(buffers, "ask_driver", lambda *given: "buffer")
    device: Any = SimpleNamespace(shares_host_memory=True)
    assert arrays.allocate(device, size) == memory


GIB = 1 << 30


@pytest.mark.parametrize(
    ("memory_bytes", "usable_bytes"),
    [
        pytest.param(1 * GIB, GIB - GIB // 4, id="small card keeps a quarter"),
        pytest.param(4 * GIB, 4 * GIB - HEADROOM_BYTES, id="usual card keeps the headroom"),
        pytest.param(100 * GIB, 100 * GIB - 10 * GIB, id="large card keeps a tenth"),
    ],
)
def test_card_with_its_own_memory_keeps_some_of_it_free(memory_bytes: int, usable_bytes: int) -> None:
    card = SimpleNamespace(memory_bytes=memory_bytes, has_own_memory=True)
    assert Device.usable_bytes.fget(card) == usable_bytes  # type: ignore[attr-defined]


def test_device_in_the_memory_of_the_host_may_use_all_of_it() -> None:
    part_of_processor = SimpleNamespace(memory_bytes=GIB, has_own_memory=False)
    assert Device.usable_bytes.fget(part_of_processor) == GIB  # type: ignore[attr-defined]


def shortcoming_of_version(version: str) -> str:
    """The shortcoming of a little-endian device that lacks nothing but perhaps a newer version of OpenCL."""
    return _find_shortcoming(
        SimpleNamespace(version=version, available=True, compiler_available=True, endian_little=True)
    )


def test_device_below_opencl_1_2_has_a_shortcoming() -> None:
    assert "OpenCL 1.2 is needed" in shortcoming_of_version("OpenCL 1.1 x")


@pytest.mark.parametrize("version", ["OpenCL 1.2", "OpenCL 1.2.1", "OpenCL 1.10"])
def test_device_of_opencl_1_2_or_later_has_no_shortcoming(version: str) -> None:
    assert shortcoming_of_version(version) == ""


def test_status_of_a_command_is_asked_until_it_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [3, 2, 1, 0]  # queued, submitted, running, ended

    class Event:
        @property
        def command_execution_status(self) -> int:
            return left.pop(0)

    monkeypatch.setattr(launching.time, "perf_counter", lambda: 5.0)
    assert launching._ends_soon(SimpleNamespace(event=Event())) and left == []  # type: ignore[arg-type]


def test_kernel_at_the_first_letter_of_its_source_is_found() -> None:
    assert list(find_signatures("__kernel void a(int n) {}\n__kernel void b(int n) {}", {})) == ["a", "b"]


def test_kernels_of_conditions_inside_a_false_condition_are_not_found() -> None:
    source = (
        "#if 0\n"
        "#ifdef X\n"
        "__kernel void a(int n) {}\n"
        "#else\n"
        "__kernel void b(int n) {}\n"
        "#endif\n"
        "#else\n"
        "__kernel void c(int n) {}\n"
        "#endif\n"
    )
    assert list(find_signatures(source, {})) == ["c"]


def test_array_of_four_float32_is_passed_as_float4_without_a_copy() -> None:
    four = np.zeros(4, np.float32)
    assert program._take_float4(four) is four


def test_list_of_four_numbers_becomes_a_float4() -> None:
    assert program._take_float4([1, 2, 3, 4]).tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize("shape", [(3,), (5,), (4, 1)])
def test_array_that_is_no_float4_is_refused(shape: tuple[int, ...]) -> None:
    with refused(ValueError, "float4", 4):
        program._take_float4(np.zeros(shape, np.float32))


class MemoryWithText:
    """The memory of the process, opened, with `text` at any place; what is written there is kept."""

    def __init__(self, text: bytes):
        self.text = text
        self.written: list[bytes] = []

    def __enter__(self) -> MemoryWithText:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def read_text(self, place: int) -> bytes:
        return self.text

    def write(self, place: int, text: bytes) -> None:
        self.written.append(text)


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> MemoryWithText:
    """The memory of the process, with the name of an unknown CPU."""
    memory = MemoryWithText(pocl.UNKNOWN)
    monkeypatch.setattr(pocl, "_Memory", lambda: memory)
    return memory


NAME_AT_ADDRESS_7: Any = SimpleNamespace(name="haswell", _place=7)


def test_name_of_a_cpu_is_written_over_the_unknown_one(memory: MemoryWithText) -> None:
    pocl.NameOfCpu.write(NAME_AT_ADDRESS_7)
    assert memory.written == [b"haswell".ljust(len(pocl.UNKNOWN), b"\0")]


@pytest.mark.parametrize("present", [b"a", b"znver4"])
def test_name_of_a_cpu_is_not_written_over_another_one(present: bytes, memory: MemoryWithText) -> None:
    memory.text = present
    with refused(LookupError, "changed"):
        pocl.NameOfCpu.write(NAME_AT_ADDRESS_7)
    assert memory.written == []


@pytest.mark.parametrize(("value", "kept"), [("", False), (" ", False), ("1", True)])
def test_blank_switch_of_the_pyopencl_cache_is_unset(value: str, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENCL_NO_CACHE", value)
    monkeypatch.setattr(quirks, "prepare_caches", lambda: None)
    quirks.import_pyopencl.__wrapped__()
    assert ("PYOPENCL_NO_CACHE" in os.environ) is kept


def test_kernels_are_read_beside_the_sources_where_they_are_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def is_missing(name: str) -> Any:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(sources.resources, "files", is_missing)
    assert sources.kernel_root.__wrapped__() == ROOT / "cl"


@pytest.mark.parametrize(
    ("size", "simulator", "way"),
    [(LEAST_BYTES - 1, False, "copy"), (LEAST_BYTES, False, "pieces"), (LEAST_BYTES, True, "copy")],
    ids=["a byte less than the least size", "the least size", "the least size, a simulator"],
)
def test_arrays_from_the_least_size_on_are_read_in_pieces_but_from_simulators(
    size: int, simulator: bool, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By stand-ins for both ways: a copy by the driver, and pieces by pinned memory; the choice alone is real."""
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


def test_log_has_the_seconds_and_the_options_of_a_build(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    before_and_after = iter((5.0, 7.5))
    monkeypatch.setattr(program, "log", SimpleNamespace(debug=lambda text, *values: logged.append(text % values)))
    monkeypatch.setattr(program, "time", SimpleNamespace(perf_counter=lambda: next(before_and_after)))
    monkeypatch.setattr(device, "programs", {})
    monkeypatch.setattr(device, "keeps_binaries", False)

    load_program(device, "primitives/compact.cl")

    assert logged == [f"cl/primitives/compact.cl {device.build_options} built from source in 2.500 s"]
