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


class Structure:
    """What a driver's structure of a device looks like: numbers, and pointers to strings."""

    def __init__(self, *texts: bytes):
        self.strings = [ctypes.create_string_buffer(text) for text in texts]
        addresses = [ctypes.addressof(string) for string in self.strings]
        self.words = (ctypes.c_uint64 * 64)(1, 0, 2**63, 8, *addresses, 4096, 2**48)
        self.address = ctypes.addressof(self.words)

    @property
    def texts(self) -> list[bytes]:
        return [string.value for string in self.strings]


def flags(*names: str) -> str:
    return f"processor\t: 0\nflags\t\t: fpu sse2 {' '.join(names)} \npower management:\n"


@pytest.mark.parametrize("name", [name for name, _ in CPU_NAMES])
def test_the_name_is_the_best_that_the_flags_allow(name):
    needs = dict(CPU_NAMES)[name]
    assert choose_name(flags(*needs, "avx512_vnni" if name == "skx" else "avx")) == name
    for lacking in needs:
        assert choose_name(flags(*(needs - {lacking}))) != name


def test_names_fit_where_the_unknown_one_was():
    assert all(len(name) <= len(UNKNOWN) for name, _ in CPU_NAMES)
    assert choose_name("no flags at all") == "x86-64"


@linux_only
def test_only_pocl_on_a_cpu_that_it_does_not_know_is_touched(monkeypatch):
    monkeypatch.setattr(pocl.platform, "machine", lambda: "x86_64")
    assert has_unknown_cpu(POCL, ZEN_5) and has_unknown_cpu(POCL, ZEN_5.replace("pthread", "basic") + " ")
    for known in ("znver3", "skylake-avx512"):
        assert not has_unknown_cpu(POCL, ZEN_5.replace("generic", known))
    assert not has_unknown_cpu("rusticl", ZEN_5)
    assert not has_unknown_cpu(POCL, ZEN_5.replace("x86_64", "aarch64"))
    monkeypatch.setattr(pocl.platform, "machine", lambda: "aarch64")
    assert not has_unknown_cpu(POCL, ZEN_5)


@linux_only
def test_the_name_behind_the_target_is_replaced_and_nothing_else():
    before = [b"pthread", UNKNOWN, b"x86_64-unknown-linux-gnu", UNKNOWN, b"AuthenticAMD"]
    made = Structure(*before)
    cpu = NameOfCpu(made.address)
    assert made.texts == before
    words = bytes(made.words)
    for _ in range(2):  # a second device object of the same driver finds the name that the first one wrote
        cpu.write()
        assert made.texts == [*before[:3], cpu.name.encode(), before[4]]
        assert NameOfCpu(made.address).name == cpu.name
    assert bytes(made.words) == words


@linux_only
@pytest.mark.parametrize(
    "texts",
    [[b"pthread", b"generic"], [b"x86_64-unknown-linux-gnu", b"pthread", b"generic"],
     [b"x86_64-unknown-linux-gnu", b"znver3"], [b"x86_64-unknown-linux-gnu", b"generic-with-more"],
     [b"x86_64-a", b"generic", b"x86_64-b", b"generic"]],
)  # fmt: skip
def test_what_is_not_exactly_so_is_left_alone(texts):
    made = Structure(*texts)
    with refused(LookupError, "CPUs", "names"):
        NameOfCpu(made.address)
    assert made.texts == texts


@linux_only
def test_memory_that_is_not_there_is_an_error_and_no_crash():
    with refused(LookupError, "Input/output"):
        NameOfCpu(4096)


@linux_only
def test_a_name_that_has_changed_meanwhile_is_left_alone():
    made = Structure(b"x86_64-unknown-linux-gnu", UNKNOWN)
    cpu = NameOfCpu(made.address)
    made.strings[1].value = b"znver5"
    with refused(LookupError, "changed"):
        cpu.write()
    assert made.texts[1] == b"znver5"


def make_device(device: Device, address: int) -> Device:
    """A device of PoCL on an unknown CPU whose structure lies at `address`."""

    class Answers:
        version = ZEN_5
        int_ptr = address

        def __getattr__(self, name: str) -> object:
            return getattr(device.cl_device, name)

    return Device(0, SimpleNamespace(name=POCL, version="OpenCL 3.0 PoCL 3.0-rc2 LLVM 14.0.6"), Answers())


@linux_only
def test_a_device_whose_cpu_cannot_be_named_says_what_to_install(device, monkeypatch):
    monkeypatch.setattr(pocl.platform, "machine", lambda: "x86_64")
    made = Structure(b"nothing", b"of the kind")
    found = make_device(device, made.address)
    assert found.shortcoming.startswith(
        "its compiler is older than this CPU and builds nothing for it (0 names of CPUs"
    )
    assert "pocl-opencl-icd" in found.shortcoming
    assert not any("CPU_NAME" in option for option in found.build_options)


@linux_only
def test_a_device_names_its_cpu_when_it_is_opened_and_not_before(device, monkeypatch):
    monkeypatch.setattr(pocl.platform, "machine", lambda: "x86_64")
    made = Structure(b"x86_64-unknown-linux-gnu", UNKNOWN)
    found = make_device(device, made.address)
    assert found.shortcoming == "" and made.texts[1] == UNKNOWN
    [option] = [option for option in found.build_options if "CPU_NAME" in option]
    opened = []
    monkeypatch.setattr("pyopencl.Context", lambda devices: opened.append(made.texts[1].decode()))
    assert found.context is None
    assert [f"-DCPU_NAME={name}" for name in opened] == [option]
    made.strings[1].value = b"znver5"
    with refused(DeviceError, "CPU"):
        _ = found.context


@pytest.mark.every_device
def test_programs_get_what_tells_caches_apart(device, monkeypatch):
    from clrecon.opencl import load_program

    monkeypatch.setattr(device, "programs", {})
    load_program(device, "primitives/compact.cl", {"B": "2", "A": "1"})
    assert list(device.programs) == [("primitives/compact.cl", (*device.build_options, "-DA=1", "-DB=2"))]
    names_cpu = any("CPU_NAME" in option for option in device.build_options)
    assert names_cpu == has_unknown_cpu(device.platform, device.version)
