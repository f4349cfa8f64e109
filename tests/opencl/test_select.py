"""Choosing a device: by name, by environment, by rank; never a simulator silently."""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import check_budget, choose_device, list_devices, list_platforms, select
from clrecon.opencl.device import _find_shortcoming
from clrecon.opencl.quirks import import_pyopencl


class FakeDevice:
    """What `choose_device` looks at."""

    def __init__(self, index, name, platform, kind, memory=2**30, simulator=False, software=False):
        self.index, self.name, self.platform, self.type = index, name, platform, kind
        self.usable_bytes, self.is_simulator, self.cl_device = memory, simulator, name
        self.max_allocation_bytes = memory // 4
        self.label = f"{name} ({platform})"
        self.shortcoming = self.fault = ""
        self.warnings: list[str] = []
        self.remark = self.warnings.append
        rank = 0 if software else {"gpu": 3, "accelerator": 2, "cpu": 1}.get(kind, 0)
        self.score = (rank, False, 1, (1,), memory, -index)


@pytest.fixture
def machine(monkeypatch):
    """A machine with a simulator in front, a CPU, two GPUs and a rasteriser."""
    devices = [
        FakeDevice(0, "Oclgrind Simulator", "Oclgrind", "gpu", 2**40, simulator=True),
        FakeDevice(1, "pthread-Xeon", "Portable Computing Language", "cpu", 2**35),
        FakeDevice(2, "Radeon", "AMD", "gpu", 2**33),
        FakeDevice(3, "H200", "NVIDIA CUDA", "gpu", 2**37),
        FakeDevice(4, "llvmpipe", "rusticl", "cpu", 2**36, software=True),
    ]
    monkeypatch.setattr(select, "list_devices", lambda: list(devices))
    monkeypatch.delenv("CLRECON_DEVICE", raising=False)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    return devices


def test_the_best_is_a_gpu_with_most_memory(machine):
    assert choose_device().name == "H200"
    assert choose_device("auto").name == "H200"


@pytest.mark.parametrize(
    ("wanted", "name"),
    [("2", "Radeon"), (2, "Radeon"), (" 2 ", "Radeon"), ("radeon", "Radeon"),
     ("nvidia", "H200"), ("cpu", "pthread-Xeon"),
     ("gpu", "H200"), ("llvmpipe", "llvmpipe"), ("oclgrind", "Oclgrind Simulator"), ("0", "Oclgrind Simulator")],
)  # fmt: skip
def test_a_device_is_found_by_index_type_or_part_of_its_name(machine, wanted, name):
    assert choose_device(wanted).name == name


def test_the_environment_names_a_device_and_the_argument_wins(machine, monkeypatch):
    monkeypatch.setenv("CLRECON_DEVICE", "radeon")
    assert choose_device().name == "Radeon"
    assert choose_device("cpu").name == "pthread-Xeon"


@pytest.mark.parametrize("wanted", ["9", "geforce", "²"])
def test_a_device_that_is_not_there_lists_what_is(machine, wanted, monkeypatch):
    with refused(DeviceError, wanted, "Radeon", 2):
        choose_device(wanted)
    monkeypatch.setenv("CLRECON_DEVICE", wanted)
    with refused(DeviceError, "CLRECON_DEVICE"):
        choose_device()


def test_a_simulator_is_never_chosen_silently(machine, monkeypatch):
    monkeypatch.setattr(select, "list_devices", lambda: machine[:1])
    with refused(DeviceError, "Oclgrind", "Simulator", 0):
        choose_device()
    assert choose_device("oclgrind").is_simulator


@pytest.mark.parametrize(
    ("wanted", "variables", "is_told"),
    [
        ("oclgrind", {}, False),
        ("simulator", {}, False),
        (None, {"CLRECON_DEVICE": "oclgrind"}, False),
        (None, {"PYOPENCL_CTX": "oclgrind"}, False),
        ("0", {}, True),
        (0, {}, True),
        (None, {"CLRECON_DEVICE": "0"}, True),
        ("auto", {"PYOPENCL_CTX": "0"}, True),
        (None, {"PYOPENCL_CTX": "0:0"}, True),
    ],
)
@pytest.mark.fault_row(50)
def test_a_simulator_that_nobody_named_is_told(machine, wanted, variables, is_told, monkeypatch):
    for name, text in variables.items():
        monkeypatch.setenv(name, text)
    context = SimpleNamespace(devices=["Oclgrind Simulator"])
    monkeypatch.setattr(import_pyopencl(), "create_some_context", lambda interactive: context)
    chosen = choose_device(wanted)
    assert chosen.is_simulator
    assert ["is a simulator" in text for text in chosen.warnings] == [True] * is_told


def test_a_device_that_cannot_work_is_passed_over(machine):
    machine[3].shortcoming = "it has no compiler"
    assert choose_device().name == "Radeon"
    assert choose_device("gpu").name == "Radeon"
    with refused(DeviceError, "H200", "NVIDIA"):
        choose_device("h200")


@pytest.mark.fault_row(57)
def test_what_is_remembered_chooses_the_device_that_is_shown(machine, monkeypatch):
    found = {"H200": "wrong sums"}
    monkeypatch.setattr(select, "remembered_fault", lambda device: found.get(device.name, ""))
    assert select.choose_remembered().name == "Radeon"
    assert select.choose_remembered("h200").name == select.choose_remembered("gpu").name == "H200"
    found.update({device.name: "wrong sums" for device in machine})
    assert select.choose_remembered().name == "H200"  # none is better


def test_the_choice_is_explained(machine, monkeypatch):
    monkeypatch.setattr(select, "remembered_fault", lambda device: "")
    assert select.explain_choice() == "before 2: it has more memory"
    assert select.explain_choice("gpu") == "named, before 2: it has more memory"
    assert select.explain_choice("radeon") == "named, no other one"
    radeon = machine[2]
    for at, value, why in ((3, (2,), "its driver is newer"), (2, 2, "it has more compute units"),
                           (1, True, "it has memory of its own")):  # fmt: skip
        radeon.score = (*radeon.score[:at], value, *radeon.score[at + 1 :])
        assert select.explain_choice() == f"before 3: {why}"
    del machine[2:4]
    monkeypatch.setattr(select, "list_devices", lambda: machine)
    assert select.explain_choice() == "before 4: GPUs come before accelerators, CPUs and software"
    monkeypatch.setattr(select, "remembered_fault", lambda device: "wrong sums" if device.index == 4 else "")
    assert select.explain_choice() == "no other one"


@pytest.mark.fault_row(57)
def test_a_device_that_computes_wrongly_is_passed_over_or_refused(machine, monkeypatch):
    machine[3].fault = "7 of 9 vertices of a ball lie beside it"
    assert choose_device().name == "Radeon"
    words = "H200 (NVIDIA CUDA) is not used, it computes wrongly: 7 of 9 vertices of a ball lie beside it"
    assert machine[2].warnings == [words]
    assert select.choose_unchecked().name == "H200"
    for named in ("h200", "gpu", 3):
        with pytest.raises(DeviceError, match=f"^{re.escape(words)}: update its driver or choose another") as caught:
            choose_device(named)
        assert caught.value.exit_code == 5
    monkeypatch.setenv("CLRECON_DEVICE", "h200")
    with pytest.raises(DeviceError, match="computes wrongly"):
        choose_device()
    monkeypatch.delenv("CLRECON_DEVICE")
    for other in machine:
        other.fault = "every normal of a ball points elsewhere"
    with pytest.raises(DeviceError, match=r"^H200 .*; Radeon .*; pthread-Xeon .*; llvmpipe .*: update its driver"):
        choose_device()


@pytest.mark.parametrize(
    ("changed", "says"),
    [({"available": False}, "not available"), ({"compiler_available": False}, "no compiler"),
     ({"version": "OpenCL 1.1 x"}, "OpenCL 1.2 is needed"),
     ({"endian_little": sys.byteorder != "little"}, "byte order")],
)  # fmt: skip
def test_shortcomings_of_devices_are_named(changed, says):
    good = {
        "available": 1,
        "compiler_available": 1,
        "version": "OpenCL 3.0 x",
        "endian_little": sys.byteorder == "little",
    }
    assert _find_shortcoming(SimpleNamespace(**good)) == ""
    assert says in _find_shortcoming(SimpleNamespace(**{**good, **changed}))


def test_no_device_says_how_to_get_a_driver(monkeypatch):
    monkeypatch.setattr(select, "list_devices", lambda: [])
    with refused(DeviceError, "OpenCL", "device"):
        choose_device()


def test_no_device_under_a_limit_of_memory_names_it(monkeypatch):
    monkeypatch.setattr(select, "list_devices", list)
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (2_500_000_000, resource.RLIM_INFINITY))
    with refused(DeviceError, 2.5, "memory"):
        choose_device()


def test_the_budget_names_the_buffer_that_is_too_large(machine):
    cpu = machine[1]
    assert check_budget(cpu, {"volume": 2**20, "mesh": 2**21}) == 3 * 2**20
    with refused(DeviceError, "volume", 8193, 8192):
        check_budget(cpu, {"volume": 2**33 + 2**20})
    parts = {f"part {n}": 2**33 for n in range(5)}
    with refused(DeviceError, 40960, 8192, 32768):
        check_budget(cpu, parts)


def test_the_budget_names_the_limit_that_is_in_the_way(machine):
    cpu = machine[1]
    parts = {"volume": 2**20, "picture": 2**19}
    with refused(DeviceError, 2, 1, 524288, 1000000):  # fmt: skip
        check_budget(cpu, parts, 10**6)
    with refused(DeviceError, 1, "MiB"):  # one buffer alone is over it
        check_budget(cpu, {"volume": 2**22}, 2**20)
    assert check_budget(cpu, parts, 2**21) == 3 * 2**19
    huge = {f"part {n}": 2**33 for n in range(5)}
    for memory in (10**6, 2**36):  # where the device has no room either, allowing more would not help
        with refused(DeviceError, 32768, "MiB"):
            check_budget(cpu, huge, memory)


@pytest.mark.every_device
def test_devices_of_this_machine_describe_themselves(device):
    devices = list_devices()
    assert [d.index for d in devices] == list(range(len(devices)))
    facts = device.describe()
    assert facts["type"] in ("gpu", "accelerator", "cpu", "custom")
    assert facts["memory_bytes"] >= facts["max_allocation_bytes"] > 0
    assert device.platform in {platform["name"] for platform in list_platforms()}
    assert choose_device(device.index) is device
