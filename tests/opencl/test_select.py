"""Choosing a device: by name, by environment, by rank; never a simulator without a warning."""

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

    def __init__(self, index, name, platform, kind, *, memory, simulator=False, software=False):
        self.index, self.name, self.platform, self.type = index, name, platform, kind
        self.usable_bytes, self.is_simulator, self.cl_device = memory, simulator, name
        self.max_allocation_bytes = memory // 4
        self.label = f"{name} ({platform})"
        self.shortcoming = self.fault = ""
        self.warnings: list[str] = []
        self.remark = self.warnings.append
        rank = 0 if software else {"gpu": 3, "accelerator": 2, "cpu": 1}.get(kind, 0)
        self.score = (rank, False, 1, (1,), memory, -index)


SIMULATOR, CPU, RADEON, H200, RASTERISER = range(5)
"""Indices of the devices of `machine`."""
MIB = 2**20


@pytest.fixture
def machine(monkeypatch):
    """A machine with a simulator in front, a CPU, two GPUs and a rasteriser."""
    devices = [
        FakeDevice(SIMULATOR, "Oclgrind Simulator", "Oclgrind", "gpu", memory=2**40, simulator=True),
        FakeDevice(CPU, "pthread-Xeon", "Portable Computing Language", "cpu", memory=32_768 * MIB),
        FakeDevice(RADEON, "Radeon", "AMD", "gpu", memory=2**33),
        FakeDevice(H200, "H200", "NVIDIA CUDA", "gpu", memory=2**37),
        FakeDevice(RASTERISER, "llvmpipe", "rusticl", "cpu", memory=2**36, software=True),
    ]
    monkeypatch.setattr(select, "list_devices", lambda: list(devices))
    monkeypatch.delenv("CLRECON_DEVICE", raising=False)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    return devices


def test_gpu_with_most_memory_is_chosen_when_none_is_named(machine):
    assert [choose_device().name, choose_device("auto").name] == ["H200", "H200"]


@pytest.mark.parametrize(
    ("wanted", "name"),
    [("2", "Radeon"), (2, "Radeon"), (" 2 ", "Radeon"), ("radeon", "Radeon"),
     ("nvidia", "H200"), ("cpu", "pthread-Xeon"),
     ("gpu", "H200"), ("llvmpipe", "llvmpipe"), ("oclgrind", "Oclgrind Simulator"), ("0", "Oclgrind Simulator")],
)  # fmt: skip
def test_device_is_chosen_by_index_type_or_part_of_its_name(machine, wanted, name):
    assert choose_device(wanted).name == name


def test_device_named_by_the_environment_is_chosen(machine, monkeypatch):
    monkeypatch.setenv("CLRECON_DEVICE", "radeon")
    assert choose_device().name == "Radeon"


def test_device_named_by_the_argument_is_chosen_over_that_of_the_environment(machine, monkeypatch):
    monkeypatch.setenv("CLRECON_DEVICE", "radeon")
    assert choose_device("cpu").name == "pthread-Xeon"


@pytest.mark.parametrize("wanted", ["9", "geforce", "²"])
def test_unknown_device_is_refused_with_a_list_of_the_devices(machine, wanted):
    with refused(DeviceError, wanted, 0, "Oclgrind", 1, "pthread-Xeon", 2, "Radeon", 3, "H200", 4, "llvmpipe"):
        choose_device(wanted)


@pytest.mark.parametrize("wanted", ["9", "geforce", "²"])
def test_unknown_device_of_the_environment_is_refused_with_the_name_of_the_variable(machine, wanted, monkeypatch):
    monkeypatch.setenv("CLRECON_DEVICE", wanted)
    with refused(DeviceError, "CLRECON_DEVICE", wanted):
        choose_device()


def test_simulator_is_not_chosen_unless_it_is_named(machine, monkeypatch):
    simulator = machine[SIMULATOR]
    monkeypatch.setattr(select, "list_devices", lambda: [simulator])
    with refused(DeviceError, "Oclgrind", "Simulator", simulator.index):
        choose_device()
    assert choose_device("oclgrind") is simulator


@pytest.mark.parametrize(
    ("wanted", "variables", "has_warning"),
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
def test_simulator_chosen_by_its_index_alone_has_a_warning(machine, wanted, variables, has_warning, monkeypatch):
    for name, text in variables.items():
        monkeypatch.setenv(name, text)
    context = SimpleNamespace(devices=["Oclgrind Simulator"])  # what pyopencl makes of PYOPENCL_CTX
    monkeypatch.setattr(import_pyopencl(), "create_some_context", lambda interactive: context)

    chosen = choose_device(wanted)

    assert chosen.is_simulator
    assert ["is a simulator" in warning for warning in chosen.warnings] == [True] * has_warning


@pytest.mark.parametrize("wanted", [None, "gpu"])
def test_device_with_a_shortcoming_is_passed_over_for_the_next_best(machine, wanted):
    machine[H200].shortcoming = "it has no compiler"
    assert choose_device(wanted).name == "Radeon"


def test_device_with_a_shortcoming_is_refused_when_it_is_named(machine):
    machine[H200].shortcoming = "it has no compiler"
    with refused(DeviceError, "H200", "NVIDIA", "compiler"):
        choose_device("h200")


@pytest.fixture
def wrong_h200(machine, monkeypatch):
    """The machine, after an earlier check has found that its H200 computes wrongly."""
    monkeypatch.setattr(select, "remembered_fault", lambda device: "wrong sums" if device.name == "H200" else "")
    return machine


@pytest.mark.fault_row(57)
def test_device_with_a_remembered_fault_is_passed_over(wrong_h200):
    assert select.choose_remembered().name == "Radeon"


@pytest.mark.fault_row(57)
@pytest.mark.parametrize("wanted", ["h200", "gpu"])
def test_device_with_a_remembered_fault_is_chosen_when_it_or_its_type_is_named(wrong_h200, wanted):
    assert select.choose_remembered(wanted).name == "H200"


@pytest.mark.fault_row(57)
def test_best_device_is_chosen_when_all_have_remembered_faults(machine, monkeypatch):
    monkeypatch.setattr(select, "remembered_fault", lambda device: "wrong sums")
    assert select.choose_remembered().name == "H200"


MEMORY_OF_ITS_OWN, COMPUTE_UNITS, DRIVER = 1, 2, 3
"""Places in the score of a device."""


@pytest.fixture
def sound_machine(machine, monkeypatch):
    """The machine, with no remembered fault."""
    monkeypatch.setattr(select, "remembered_fault", lambda device: "")
    return machine


@pytest.mark.parametrize(
    ("wanted", "explanation"),
    [
        (None, f"before {RADEON}: it has more memory"),
        ("gpu", f"named, before {RADEON}: it has more memory"),
        ("radeon", "named, no other one"),
    ],
)
def test_choice_is_explained_by_the_next_best_device_and_whether_it_was_named(sound_machine, wanted, explanation):
    assert select.explain_choice(wanted) == explanation


@pytest.mark.parametrize(
    ("place", "better", "explanation"),
    [
        (DRIVER, (2,), f"before {H200}: its driver is newer"),
        (COMPUTE_UNITS, 2, f"before {H200}: it has more compute units"),
        (MEMORY_OF_ITS_OWN, True, f"before {H200}: it has memory of its own"),
    ],
    ids=["newer driver", "more compute units", "own memory"],
)
def test_choice_is_explained_by_the_part_of_the_score_that_is_better(sound_machine, place, better, explanation):
    radeon = sound_machine[RADEON]
    radeon.score = (*radeon.score[:place], better, *radeon.score[place + 1 :])
    assert select.explain_choice() == explanation


def test_choice_of_a_cpu_before_a_rasteriser_is_explained_by_their_types(sound_machine, monkeypatch):
    _, cpu, _, _, rasteriser = sound_machine
    monkeypatch.setattr(select, "list_devices", lambda: [cpu, rasteriser])
    assert select.explain_choice() == f"before {RASTERISER}: GPUs come before accelerators, CPUs and software"


def test_device_with_a_remembered_fault_is_no_other_one_in_the_explanation(machine, monkeypatch):
    _, cpu, _, _, rasteriser = machine
    monkeypatch.setattr(select, "list_devices", lambda: [cpu, rasteriser])
    monkeypatch.setattr(select, "remembered_fault", lambda device: "wrong sums" if device is rasteriser else "")
    assert select.explain_choice() == "no other one"


H200_IS_WRONG = "H200 (NVIDIA CUDA) is not used, its check failed: 7 of 9 vertices of a ball lie beside it"


@pytest.fixture
def faulty_h200(machine):
    """The machine, whose H200 has failed the check at first use."""
    machine[H200].fault = "7 of 9 vertices of a ball lie beside it"
    return machine


@pytest.mark.fault_row(57)
def test_device_that_computes_wrongly_is_passed_over_with_a_warning(faulty_h200):
    chosen = choose_device()
    assert chosen.name == "Radeon"
    assert chosen.warnings == [H200_IS_WRONG]


@pytest.mark.fault_row(57)
def test_device_that_computes_wrongly_is_chosen_by_what_does_not_check_devices(faulty_h200):
    assert select.choose_unchecked().name == "H200"


@pytest.mark.fault_row(57)
@pytest.mark.parametrize("wanted", ["h200", "gpu", H200])
def test_device_that_computes_wrongly_is_refused_when_it_or_its_type_is_named(faulty_h200, wanted):
    words = f"^{re.escape(H200_IS_WRONG)}: update its driver or choose another"
    with pytest.raises(DeviceError, match=words) as caught:
        choose_device(wanted)
    assert caught.value.exit_code == 5  # devices, see docs/contract.md


@pytest.mark.fault_row(57)
def test_device_that_computes_wrongly_is_refused_when_the_environment_names_it(faulty_h200, monkeypatch):
    monkeypatch.setenv("CLRECON_DEVICE", "h200")
    with refused(DeviceError, "H200", 7, 9):
        choose_device()


@pytest.mark.fault_row(57)
def test_all_devices_but_the_simulator_are_refused_by_name_where_all_compute_wrongly(machine):
    for each in machine:
        each.fault = "every normal of a ball points elsewhere"
    with refused(DeviceError, "H200", "Radeon", "pthread-Xeon", "llvmpipe"):
        choose_device()


WORKING = {
    "available": 1,
    "compiler_available": 1,
    "version": "OpenCL 3.0 x",
    "endian_little": sys.byteorder == "little",
}
"""Properties of a device without a shortcoming."""


def test_working_device_has_no_shortcoming():
    assert _find_shortcoming(SimpleNamespace(**WORKING)) == ""


@pytest.mark.parametrize(
    ("changed", "shortcoming"),
    [({"available": False}, "not available"), ({"compiler_available": False}, "no compiler"),
     ({"version": "OpenCL 1.1 x"}, "OpenCL 1.2 is needed"),
     ({"endian_little": sys.byteorder != "little"}, "byte order")],
)  # fmt: skip
def test_shortcoming_of_a_device_is_named(changed, shortcoming):
    assert shortcoming in _find_shortcoming(SimpleNamespace(**{**WORKING, **changed}))


def test_error_without_a_device_says_how_to_get_a_driver(monkeypatch):
    monkeypatch.setattr(select, "list_devices", lambda: [])
    with refused(DeviceError, "OpenCL", "device", "install"):
        choose_device()


def test_error_without_a_device_names_the_limit_of_memory_of_the_process(monkeypatch):
    resource = pytest.importorskip("resource")
    limit_bytes = 2_500_000_000
    monkeypatch.setattr(select, "list_devices", list)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit_bytes, resource.RLIM_INFINITY))
    with refused(DeviceError, 2.5, "GB", "memory"):
        choose_device()


@pytest.fixture
def cpu(machine):
    """The CPU of the machine: 32,768 MiB of memory, 8,192 MiB in one buffer; messages count in MiB."""
    return machine[CPU]


def test_bytes_of_buffers_within_the_budget_are_added_up(cpu):
    assert check_budget(cpu, {"volume": 1 * MIB, "mesh": 2 * MIB}) == 3 * MIB


def test_buffer_larger_than_the_device_allows_is_refused_with_both_sizes(cpu):
    with refused(DeviceError, "volume", 8193, 8192):
        check_budget(cpu, {"volume": 8193 * MIB})


FIVE_LARGE_BUFFERS = {f"part {n}": 8192 * MIB for n in range(5)}


def test_buffers_larger_than_the_device_together_are_refused_with_their_sum(cpu):
    with refused(DeviceError, 5 * 8192, 8192, 32768):
        check_budget(cpu, FIVE_LARGE_BUFFERS)


def test_buffers_larger_than_the_allowed_memory_together_are_refused_with_the_limit(cpu):
    with refused(DeviceError, 2, 1, 524288, 1000000):  # MiB, rounded up and down, and bytes of the picture and allowed
        check_budget(cpu, {"volume": 1 * MIB, "picture": MIB // 2}, memory=1_000_000)


def test_buffer_larger_than_the_allowed_memory_is_refused(cpu):
    with refused(DeviceError, "volume", 4, 1, "MiB"):
        check_budget(cpu, {"volume": 4 * MIB}, memory=1 * MIB)


def test_buffers_within_the_allowed_memory_are_accepted(cpu):
    assert check_budget(cpu, {"volume": 1 * MIB, "picture": MIB // 2}, memory=2 * MIB) == 3 * MIB // 2


@pytest.mark.parametrize("allowed_bytes", [10**6, 2**36])
def test_buffers_larger_than_the_device_are_refused_with_its_memory_whatever_is_allowed(cpu, allowed_bytes):
    """To allow more would not help."""
    with refused(DeviceError, 32768, "MiB"):
        check_budget(cpu, FIVE_LARGE_BUFFERS, memory=allowed_bytes)


def test_devices_of_this_machine_are_numbered_in_their_order():
    devices = list_devices()
    assert [each.index for each in devices] == list(range(len(devices)))


@pytest.mark.every_device
def test_device_of_this_machine_has_a_known_type_memory_and_a_listed_platform(device):
    facts = device.describe()
    assert facts["type"] in ("gpu", "accelerator", "cpu", "custom")
    assert facts["memory_bytes"] >= facts["max_allocation_bytes"] > 0
    assert device.platform in {platform["name"] for platform in list_platforms()}


@pytest.mark.every_device
def test_device_of_this_machine_is_chosen_by_its_index(device):
    assert choose_device(device.index) is device
