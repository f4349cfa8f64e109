"""PoCL on a CPU that its compiler does not know: the name is found and replaced where it is sure, else left alone."""

from __future__ import annotations

import ctypes
import sys
from types import SimpleNamespace

import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import pocl
from clrecon.opencl.device import Device
from clrecon.opencl.pocl import CPU_NAMES, UNKNOWN, NameOfCpu, choose_name, has_unknown_cpu

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

POCL = "Portable Computing Language"
ZEN_5 = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic"
"""The version that PoCL has on a CPU that its compiler does not know: generic."""
TARGET = b"x86_64-unknown-linux-gnu"


class DriverStructure:
    """What a driver's structure of a device looks like: numbers, and pointers to strings.

    It is as large as what is searched: behind a smaller one lies whatever the process has freed, older structures too.
    """

    WORDS = 256

    def __init__(self, *texts: bytes):
        self.strings = [ctypes.create_string_buffer(text) for text in texts]
        addresses = [ctypes.addressof(string) for string in self.strings]
        self.words = (ctypes.c_uint64 * self.WORDS)(1, 0, 2**63, 8, *addresses, 4096, 2**48)
        self.address = ctypes.addressof(self.words)

    @property
    def texts(self) -> list[bytes]:
        return [string.value for string in self.strings]


def cpu_info(*flags: str) -> str:
    return f"processor\t: 0\nflags\t\t: fpu sse2 {' '.join(flags)} \npower management:\n"


@pytest.mark.parametrize("name", [name for name, _ in CPU_NAMES])
def test_cpu_gets_the_first_name_whose_flags_it_has(name):
    needed_flags = dict(CPU_NAMES)[name]
    another_flag = "avx512_vnni" if name == "skx" else "avx"  # which no name needs; only CPUs of AVX-512 have the first
    assert choose_name(cpu_info(*needed_flags, another_flag)) == name


@pytest.mark.parametrize(("name", "flag"), [(name, flag) for name, flags in CPU_NAMES for flag in sorted(flags)])
def test_cpu_that_lacks_one_flag_does_not_get_the_name(name, flag):
    assert choose_name(cpu_info(*(dict(CPU_NAMES)[name] - {flag}))) != name


def test_cpu_without_known_flags_gets_the_name_of_any_64_bit_cpu():
    assert choose_name("no flags at all") == "x86-64"


@pytest.mark.parametrize("name", [name for name, _ in CPU_NAMES])
def test_name_of_a_cpu_is_not_longer_than_the_one_that_it_replaces(name):
    assert len(name) <= len(UNKNOWN)


@linux_only
@pytest.mark.parametrize(
    ("machine", "platform", "version", "is_unknown"),
    [
        pytest.param("x86_64", POCL, ZEN_5, True, id="pthread device"),
        pytest.param("x86_64", POCL, ZEN_5.replace("pthread", "basic") + " ", True, id="basic device"),
        pytest.param("x86_64", POCL, ZEN_5.replace("generic", "znver3"), False, id="known Zen 3"),
        pytest.param("x86_64", POCL, ZEN_5.replace("generic", "skylake-avx512"), False, id="known Skylake"),
        pytest.param("x86_64", "rusticl", ZEN_5, False, id="another driver"),
        pytest.param("x86_64", POCL, ZEN_5.replace("x86_64", "aarch64"), False, id="target of another processor"),
        pytest.param("aarch64", POCL, ZEN_5, False, id="on another processor"),
    ],
)
def test_only_pocl_for_a_generic_cpu_on_x86_64_does_not_know_its_cpu(
    machine, platform, version, is_unknown, monkeypatch
):
    monkeypatch.setattr(pocl.platform, "machine", lambda: machine)
    assert has_unknown_cpu(platform, version) == is_unknown


@linux_only
def test_name_of_the_cpu_replaces_the_string_behind_the_target_and_nothing_else():
    before = [b"pthread", UNKNOWN, TARGET, UNKNOWN, b"AuthenticAMD"]
    structure = DriverStructure(*before)
    words = bytes(structure.words)

    cpu = NameOfCpu(structure.address)
    assert structure.texts == before  # nothing is written yet
    cpu.write()

    assert structure.texts == [b"pthread", UNKNOWN, TARGET, cpu.name.encode(), b"AuthenticAMD"]
    assert bytes(structure.words) == words


@linux_only
def test_name_of_the_cpu_that_another_device_object_has_written_is_found_and_written_again():
    structure = DriverStructure(TARGET, UNKNOWN)
    first = NameOfCpu(structure.address)
    first.write()

    second = NameOfCpu(structure.address)
    second.write()

    assert second.name == first.name
    assert structure.texts == [TARGET, first.name.encode()]


@linux_only
def test_name_with_two_pointers_behind_the_target_is_found():
    structure = DriverStructure(TARGET, UNKNOWN)
    structure.words[100:102] = structure.words[4:6]  # the pointers to the target and to the name
    NameOfCpu(structure.address).write()
    _, name = structure.texts
    assert name != UNKNOWN


@linux_only
@pytest.mark.parametrize(
    "texts",
    [[b"pthread", b"generic"], [TARGET, b"pthread", b"generic"], [TARGET, b"znver3"], [TARGET, b"generic-with-more"],
     [b"x86_64-a", b"generic", b"x86_64-b", b"generic"]],
    ids=["no target", "no name behind the target", "known name", "longer name", "two targets"],
)  # fmt: skip
def test_structure_without_exactly_one_generic_name_behind_the_target_is_refused_and_unchanged(texts):
    structure = DriverStructure(*texts)
    with refused(LookupError, "CPUs", "names"):
        NameOfCpu(structure.address)
    assert structure.texts == texts


@linux_only
def test_address_without_memory_is_refused_and_does_not_end_the_process():
    unmapped = 4096
    with refused(LookupError, "Input/output"):
        NameOfCpu(unmapped)


@linux_only
def test_name_that_changed_after_it_was_found_is_not_overwritten():
    structure = DriverStructure(TARGET, UNKNOWN)
    cpu = NameOfCpu(structure.address)
    _, name = structure.strings
    name.value = b"znver5"
    with refused(LookupError, "changed"):
        cpu.write()
    assert structure.texts == [TARGET, b"znver5"]


def pocl_device_on_unknown_cpu(device: Device, address: int) -> Device:
    """A device of PoCL on an unknown CPU whose structure lies at `address`."""

    class Answers:
        version = ZEN_5
        int_ptr = address

        def __getattr__(self, name: str) -> object:
            return getattr(device.cl_device, name)

    return Device(0, SimpleNamespace(name=POCL, version="OpenCL 3.0 PoCL 3.0-rc2 LLVM 14.0.6"), Answers())


@linux_only
def test_device_whose_cpu_cannot_be_named_has_a_shortcoming_that_says_what_to_install(device, monkeypatch):
    monkeypatch.setattr(pocl.platform, "machine", lambda: "x86_64")
    structure = DriverStructure(b"nothing", b"of the kind")
    unusable = pocl_device_on_unknown_cpu(device, structure.address)
    assert unusable.shortcoming.startswith(
        "its compiler is older than this CPU and builds nothing for it (0 names of CPUs"
    )
    assert "pocl-opencl-icd" in unusable.shortcoming
    assert not any("CPU_NAME" in option for option in unusable.build_options)


@pytest.fixture
def cpu_structure(monkeypatch):
    """The structure of a device of PoCL on a processor that its compiler does not know."""
    monkeypatch.setattr(pocl.platform, "machine", lambda: "x86_64")
    return DriverStructure(TARGET, UNKNOWN)


@linux_only
def test_name_of_the_cpu_is_written_when_the_device_is_opened_and_is_a_build_option(device, cpu_structure, monkeypatch):
    named = pocl_device_on_unknown_cpu(device, cpu_structure.address)
    assert named.shortcoming == ""
    assert cpu_structure.texts == [TARGET, UNKNOWN]  # not opened yet
    texts_when_opened = []
    monkeypatch.setattr("pyopencl.Context", lambda devices: texts_when_opened.append(cpu_structure.texts))

    assert named.context is None  # opens the device

    [(_, name)] = texts_when_opened
    assert f"-DCPU_NAME={name.decode()}" in named.build_options


@linux_only
def test_device_is_refused_when_another_name_of_its_cpu_was_written_before_it_is_opened(
    device, cpu_structure, monkeypatch
):
    monkeypatch.setattr("pyopencl.Context", lambda devices: None)
    named = pocl_device_on_unknown_cpu(device, cpu_structure.address)
    _, name = cpu_structure.strings
    name.value = b"znver5"
    with refused(DeviceError, "CPU"):
        _ = named.context


@pytest.mark.every_device
def test_programs_are_kept_by_file_and_all_options_those_of_the_call_sorted(device, monkeypatch):
    from clrecon.opencl import load_program

    monkeypatch.setattr(device, "programs", {})
    load_program(device, "primitives/compact.cl", {"B": "2", "A": "1"})
    assert list(device.programs) == [("primitives/compact.cl", (*device.build_options, "-DA=1", "-DB=2"))]


@pytest.mark.every_device
def test_build_options_name_the_cpu_exactly_where_pocl_does_not_know_it(device):
    names_cpu = any("CPU_NAME" in option for option in device.build_options)
    assert names_cpu == has_unknown_cpu(device.platform, device.version)
