"""Devices that lack what most have (fault row 51): they compute the same bytes, or are refused with the reason."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from ct_files import write_series
from device_work import WORK, label_boxes
from refusals import refused
from surface_volumes import smooth_volume
from variants import daily_rows

from clrecon.cli.main import main
from clrecon.errors import DeviceError
from clrecon.opencl import Device, choose_device, kernel_files, memory_limits, read_kernel_source
from clrecon.opencl.quirks import has_event_times, import_pyopencl, language_option
from clrecon.operators.resident.device_volume import DeviceVolume

OPTIONAL_FEATURES = {
    "double precision": r"\bdouble\b|cl_khr_fp64",
    "a constant of double precision": r"(?<![\w.])(?:\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])",
    "images": r"\bimage[123]d\w*|\bsampler_t\b|\b(?:read|write)_image\w+",
    "64-bit atomics": r"\batom_\w+|cl_khr_int64\w+",
}


def optional_features_in(source: str) -> list[str]:
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", source, flags=re.DOTALL)
    return [feature for feature, pattern in OPTIONAL_FEATURES.items() if re.search(pattern, code)]


@pytest.mark.parametrize("name", kernel_files())
@pytest.mark.fault_row(51)
def test_kernels_need_no_double_precision_no_images_and_no_64_bit_atomics(name):
    assert optional_features_in(read_kernel_source(name)) == []


@pytest.mark.parametrize(
    ("code", "feature"),
    [
        ("double a;", "double precision"),
        ("x * 0.5", "a constant of double precision"),
        ("x + 1e3", "a constant of double precision"),
        ("__read_only image3d_t i", "images"),
        ("sampler_t s", "images"),
        ("atom_inc(a)", "64-bit atomics"),
    ],
)
def test_optional_feature_of_opencl_is_found_in_a_kernel(code, feature):
    assert optional_features_in(f"/* a */ {code}") == [feature]


class ReplacedProperties:
    """A device of a driver with some properties replaced."""

    def __init__(self, cl_device, **properties):
        self._cl_device, self._properties = cl_device, properties

    def __getattr__(self, name):
        return self._properties[name] if name in self._properties else getattr(self._cl_device, name)


def with_properties(device: Device, **properties) -> Device:
    return Device(device.index, device.cl_device.platform, ReplacedProperties(device.cl_device, **properties))


@pytest.mark.fault_row(51)
def test_memory_and_buffers_of_a_device_with_32_bit_addresses_stay_below_4_gib(device):
    poor = with_properties(device, address_bits=32, global_mem_size=1 << 36, max_mem_alloc_size=1 << 35)
    assert (poor.memory_bytes, poor.max_allocation_bytes) == ((1 << 32) - 1, (1 << 32) - 1)
    assert memory_limits(poor).buffer_bytes < 1 << 32


def test_memory_of_a_device_with_64_bit_addresses_is_what_the_driver_says(device):
    assert with_properties(device, address_bits=64, global_mem_size=1 << 36).memory_bytes == 1 << 36


@pytest.mark.parametrize(
    ("properties", "size"),
    [
        ({"max_work_group_size": 1}, 1),
        ({"max_work_group_size": 4096, "max_work_item_sizes": [7, 1, 1]}, 7),
        ({"max_work_group_size": 48, "max_work_item_sizes": [64, 64, 64]}, 48),
        ({"max_work_group_size": 1024, "max_work_item_sizes": [1024, 1024, 64]}, 64),
    ],
)
@pytest.mark.fault_row(51)
def test_groups_of_work_items_are_as_large_as_all_limits_of_the_device_allow(device, properties, size):
    assert with_properties(device, **properties).group_size == size


@pytest.fixture(scope="module")
def volume():
    """Smooth noise about 0 HU in 12 slices."""
    return smooth_volume((12, 14, 21))


@pytest.fixture(scope="module")
def labels(volume):
    """Two boxes that touch: label 1 below label 2."""
    return label_boxes(volume, np.s_[3:7, 4:12, 3:10], np.s_[7:10, 4:12, 3:10])


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(("size", "works"), daily_rows(1, [(1, ("surface",)), (7, ("labels", "slice"))]))
@pytest.mark.fault_row(51)
def test_results_with_small_work_groups_are_the_same_bytes(device, volume, labels, monkeypatch, size, works):
    """Drivers build a kernel anew for each size of its groups, so not all kinds of work are tried with all."""
    with DeviceVolume(volume, device=device) as resident:
        expected = {work: WORK[work](resident, labels) for work in works}
    monkeypatch.setattr(device, "max_work_group_size", size)
    with DeviceVolume(volume, device=device) as resident:
        found = {work: WORK[work](resident, labels) for work in works}

    for work in works:
        assert expected[work], f"{work} has no arrays"
        for array, expected_array in zip(found[work], expected[work], strict=True):
            assert np.array_equal(array, expected_array, equal_nan=array.dtype.kind == "f"), work


@pytest.mark.fault_row(51)
def test_device_of_the_other_byte_order_is_refused_in_one_line_and_no_mesh_written(
    device, tmp_path, capsys, monkeypatch
):
    other = with_properties(device, endian_little=sys.byteorder != "little")
    monkeypatch.setattr("clrecon.opencl.select.list_devices", lambda: [other])
    monkeypatch.delenv("CLRECON_DEVICE", raising=False)
    write_series(tmp_path / "ct")

    exit_code = main(["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "out.stl"), "--device", "cpu"])

    assert exit_code == DeviceError.exit_code
    [line] = capsys.readouterr().err.splitlines()
    assert "cannot be used: its byte order is not that of this computer" in line
    assert not (tmp_path / "out.stl").exists()


@pytest.mark.fault_row(51)
def test_work_group_that_the_driver_refuses_is_an_error_with_the_drivers_code(device, volume, monkeypatch):
    monkeypatch.setattr(Device, "group_size", 1 << 20)
    with refused(Exception, "INVALID_WORK_GROUP_SIZE"):
        WORK["mip"](DeviceVolume(volume, device=choose_device(device)), None)


def fake_gpu(device: Device, name: str, *, units: int, gib: int, unified: bool) -> Device:
    return with_properties(
        device, name=name, type=import_pyopencl().device_type.GPU, max_compute_units=units, address_bits=64,
        global_mem_size=gib << 30, host_unified_memory=unified,
    )  # fmt: skip


def test_cards_rank_before_gpus_of_processors_and_compute_units_before_memory(device):
    cpu = device
    card = fake_gpu(device, "a card", units=40, gib=12, unified=False)
    larger_card = fake_gpu(device, "a larger card", units=80, gib=8, unified=False)
    part_of_processor = fake_gpu(device, "a part of the processor", units=96, gib=32, unified=True)
    rasteriser = fake_gpu(device, "llvmpipe (LLVM 15)", units=128, gib=64, unified=False)

    ranked = sorted([rasteriser, cpu, card, part_of_processor, larger_card], key=lambda each: each.score, reverse=True)

    assert ranked == [larger_card, card, part_of_processor, cpu, rasteriser]


@pytest.mark.parametrize(
    ("name", "unified", "has_own_memory"),
    [("a card", False, True), ("a part of the processor", True, False), ("llvmpipe (LLVM 15)", False, False)],
)
def test_only_a_card_has_memory_of_its_own(device, name, unified, has_own_memory):
    assert fake_gpu(device, name, units=8, gib=8, unified=unified).has_own_memory == has_own_memory


@pytest.mark.parametrize(
    ("gib", "usable_mib"),
    [
        pytest.param(40, 36 * 1024, id="40 GiB, a tenth free"),
        pytest.param(2, 2 * 1024 - 512, id="2 GiB, 512 MiB free"),
        pytest.param(1, 768, id="1 GiB, a quarter free"),
    ],
)
def test_card_leaves_some_of_its_memory_to_screens(device, gib, usable_mib):
    card = fake_gpu(device, "a card", units=40, gib=gib, unified=False)
    assert card.usable_bytes == usable_mib << 20


def test_allowed_memory_does_not_raise_the_usable_memory_of_a_card(device):
    card = fake_gpu(device, "a card", units=4, gib=2, unified=False)
    assert memory_limits(card, memory=2 << 30).total_bytes == card.usable_bytes < 2 << 30


def test_gpu_of_a_processor_may_use_all_of_its_memory(device):
    assert fake_gpu(device, "a part", units=96, gib=32, unified=True).usable_bytes == 32 << 30


def test_cpu_may_use_all_of_its_memory(device):
    assert device.usable_bytes == device.memory_bytes


@pytest.mark.parametrize(
    ("platform", "kind", "driver", "language"),
    [
        ("Intel(R) OpenCL HD Graphics", "gpu", (22, 43, 24595), "-cl-std=CL2.0"),
        ("Intel(R) OpenCL Graphics", "gpu", (23, 0), "-cl-std=CL1.2"),
        ("Intel(R) OpenCL", "cpu", (2022, 2), "-cl-std=CL1.2"),
        ("Intel(R) OpenCL", "cpu", (18, 1), "-cl-std=CL1.2"),
        ("NVIDIA CUDA", "gpu", (580, 159), "-cl-std=CL1.2"),
    ],
)
def test_only_old_intel_gpu_drivers_whose_compiler_crashes_otherwise_build_opencl_2_0(platform, kind, driver, language):
    assert language_option(platform, kind, driver) == language


@pytest.mark.parametrize(("platform", "has_times"), [("Apple", False), ("rusticl", False), ("NVIDIA CUDA", True)])
def test_event_times_of_apple_and_rusticl_are_not_used(platform, has_times):
    assert has_event_times(platform) == has_times
