"""Row 51: devices that lack what most have. They compute the same bytes, or are refused in words."""

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
from clrecon.opencl import Device, choose_device, kernel_files, memory_limits, read_kernel_source
from clrecon.opencl.quirks import has_event_times, import_pyopencl, language_option
from clrecon.operators.resident.device_volume import DeviceVolume

BEYOND = {
    "double precision": r"\bdouble\b|cl_khr_fp64",
    "a constant of double precision": r"(?<![\w.])(?:\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])",
    "images": r"\bimage[123]d\w*|\bsampler_t\b|\b(?:read|write)_image\w+",
    "64-bit atomics": r"\batom_\w+|cl_khr_int64\w+",
}


def beyond_the_core(source: str) -> list[str]:
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", source, flags=re.DOTALL)
    return [what for what, pattern in BEYOND.items() if re.search(pattern, code)]


@pytest.mark.parametrize("name", kernel_files())
@pytest.mark.fault_row(51)
def test_kernels_need_no_fp64_and_no_images(name):
    assert beyond_the_core(read_kernel_source(name)) == []


@pytest.mark.parametrize(
    "code", ["double a;", "x * 0.5", "x + 1e3", "__read_only image3d_t i", "sampler_t s", "atom_inc(a)"]
)
def test_what_kernels_must_not_need_is_found(code):
    assert len(beyond_the_core(f"/* a */ {code}")) == 1


class Lacking:
    """A device of a driver with some properties replaced."""

    def __init__(self, cl_device, **properties):
        self._cl_device, self._properties = cl_device, properties

    def __getattr__(self, name):
        return self._properties[name] if name in self._properties else getattr(self._cl_device, name)


def lacking(device: Device, **properties) -> Device:
    return Device(device.index, device.cl_device.platform, Lacking(device.cl_device, **properties))


@pytest.mark.fault_row(51)
def test_a_device_with_32_bit_sizes_has_at_most_4_gib(device):
    poor = lacking(device, address_bits=32, global_mem_size=1 << 36, max_mem_alloc_size=1 << 35)
    assert (poor.memory_bytes, poor.max_allocation_bytes) == ((1 << 32) - 1, (1 << 32) - 1)
    assert memory_limits(poor).buffer_bytes < 1 << 32
    assert lacking(device, address_bits=64, global_mem_size=1 << 36).memory_bytes == 1 << 36


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
def test_groups_are_as_large_as_the_device_allows(device, properties, size):
    assert lacking(device, **properties).group_size == size


@pytest.fixture(scope="module")
def volume():
    return smooth_volume((12, 14, 21))


@pytest.fixture(scope="module")
def labels(volume):
    return label_boxes(volume, np.s_[3:7, 4:12, 3:10], np.s_[7:10, 4:12, 3:10])


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(("size", "works"), daily_rows(1, [(1, ("surface",)), (7, ("labels", "slice"))]))
@pytest.mark.fault_row(51)
def test_small_groups_give_the_same_bytes(device, volume, labels, monkeypatch, size, works):
    """Drivers build a kernel anew for each size of its groups, so not all kinds of work are tried with all."""
    with DeviceVolume(volume, device=device) as resident:
        expected = {work: WORK[work](resident, labels) for work in works}
    monkeypatch.setattr(device, "max_work_group_size", size)
    with DeviceVolume(volume, device=device) as resident:
        found = {work: WORK[work](resident, labels) for work in works}
    for work in works:
        for one, other in zip(found[work], expected[work], strict=True):
            assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), work


@pytest.mark.fault_row(51)
def test_a_device_of_the_other_byte_order_is_refused_in_a_line(device, tmp_path, capsys, monkeypatch):
    other = lacking(device, endian_little=sys.byteorder != "little")
    monkeypatch.setattr("clrecon.opencl.select.list_devices", lambda: [other])
    monkeypatch.delenv("CLRECON_DEVICE", raising=False)
    write_series(tmp_path / "ct")
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "out.stl"), "--device", "cpu"]) == 5
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "cannot be used: its byte order is not that of this computer" in said
    assert not (tmp_path / "out.stl").exists()


@pytest.mark.fault_row(51)
def test_a_kernel_whose_groups_the_driver_refuses_is_an_error_in_a_line(device, volume, monkeypatch):
    monkeypatch.setattr(Device, "group_size", 1 << 20)
    with refused(Exception, "INVALID_WORK_GROUP_SIZE"):
        WORK["mip"](DeviceVolume(volume, device=choose_device(device)), None)


def graphics(device: Device, name: str, units: int, gib: int, unified: bool) -> Device:
    return lacking(
        device, name=name, type=import_pyopencl().device_type.GPU, max_compute_units=units, address_bits=64,
        global_mem_size=gib << 30, host_unified_memory=unified,
    )  # fmt: skip


def test_cards_come_before_parts_of_a_processor_and_units_before_memory(device):
    card = graphics(device, "a card", 40, 12, unified=False)
    larger = graphics(device, "a larger card", 80, 8, unified=False)
    part = graphics(device, "a part of the processor", 96, 32, unified=True)
    rasteriser = graphics(device, "llvmpipe (LLVM 15)", 128, 64, unified=False)
    ranked = sorted([rasteriser, device, card, part, larger], key=lambda each: each.score, reverse=True)
    assert ranked == [larger, card, part, device, rasteriser]
    assert [each.has_own_memory for each in ranked] == [True, True, False, False, False]


def test_a_card_leaves_memory_to_screens_and_a_part_of_the_processor_does_not(device):
    assert graphics(device, "a card", 40, 40, unified=False).usable_bytes == 36 << 30
    small = graphics(device, "a card", 4, 2, unified=False)
    assert small.usable_bytes == (2 << 30) - (512 << 20)
    assert graphics(device, "a tiny card", 1, 1, unified=False).usable_bytes == 3 << 28
    assert memory_limits(small, 2 << 30).total_bytes == small.usable_bytes
    assert graphics(device, "a part", 96, 32, unified=True).usable_bytes == 32 << 30
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
def test_old_drivers_of_intel_build_what_their_compiler_survives(platform, kind, driver, language):
    assert language_option(platform, kind, driver) == language


def test_times_of_apples_drivers_are_not_believed():
    assert [has_event_times(name) for name in ("Apple", "rusticl", "NVIDIA CUDA")] == [False, False, True]
