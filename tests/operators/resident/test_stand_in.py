"""A device without room or lost in the middle; the CPU device takes over where no device was named."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from device_work import SIZE, WORK, label_boxes, mesh_arrays
from failing_devices import Failing, lost_error, pretended_gpu
from refusals import refused
from surface_volumes import smooth_volume
from variants import daily_rows, each_value

import clrecon
from clrecon.errors import DeviceError, DeviceFailedError, DeviceMemoryError
from clrecon.opencl import allocate, list_devices, take_device, with_fallback
from clrecon.operators.resident.device_volume import DeviceVolume

NEVER_LAST = 1 << 30


@pytest.fixture(scope="module")
def volume():
    """12 slices of int16 voxels, each of 14 x 21 x 2 = 588 bytes."""
    return smooth_volume((12, 14, 21))


@pytest.fixture(scope="module")
def labels(volume):
    """Labels 1 and 2 in two boxes of the volume."""
    return label_boxes(volume, np.s_[3:7, 4:12, 3:10], np.s_[7:10, 4:12, 3:10])


@pytest.fixture
def gpu(device):
    """The device under the name of a GPU, with the device itself as its stand-in."""
    return pretended_gpu(device)


@pytest.mark.fault_row(54)
@pytest.mark.parametrize(("work", "kind"), daily_rows(3, each_value(WORK, ["launch", "buffer"])))
def test_the_cpu_device_takes_over_from_a_failed_buffer_or_launch_on_with_the_same_result(
    device, gpu, volume, labels, monkeypatch, work, kind
):
    with DeviceVolume(volume, device=device) as resident:
        expected = WORK[work](resident, labels)
    with monkeypatch.context() as patch, DeviceVolume(volume, device=gpu) as resident:
        counted = Failing(patch, kind, first=0, label=gpu.label)
        WORK[work](resident, labels)
        assert resident.device is gpu
    count = counted.counts[kind]
    assert count > 0
    middle = count // 2 + 1
    firsts = {middle} if kind == "launch" else {1, middle, count}
    for first in sorted(firsts):
        gpu = pretended_gpu(device)
        with monkeypatch.context() as patch, DeviceVolume(volume, device=gpu) as resident:
            Failing(patch, kind, first=first, last=NEVER_LAST, label=gpu.label)
            found = WORK[work](resident, labels)
            assert resident.device is device
        for one, other in zip(found, expected, strict=True):
            assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


REPORTS: dict[str, Callable] = {
    "surface": lambda volume, labels, gpu: clrecon.extract_isosurface(volume, 100, device=gpu).report,
    "labels": lambda volume, labels, gpu: clrecon.extract_labels(volume, labels, 100, device=gpu)[1].report,
    "masks": lambda volume, labels, gpu: clrecon.extract_label_masks(labels, device=gpu)[1].report,
    "mip": lambda volume, labels, gpu: clrecon.render(volume, "mip", size=SIZE, device=gpu).report,
    "slices": lambda volume, labels, gpu: clrecon.render(volume, "slices", size=SIZE, device=gpu).report,
    "slice": lambda volume, labels, gpu: clrecon.cut_slice(volume, "coronal", SIZE, device=gpu).report,
}


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("work", REPORTS)
def test_warning_of_a_device_that_handed_over_names_the_reason_and_both_devices(
    device, gpu, volume, labels, monkeypatch, work
):
    Failing(monkeypatch, "buffer", first=3, last=NEVER_LAST, label=gpu.label)
    report = REPORTS[work](volume, labels, gpu)
    (warning,) = [text for text in report["warnings"] if "all was done on" in text]
    assert warning.endswith(f"injected: all was done on {device.label} instead of {gpu.label}")
    assert report["device"] == device.label


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("kind", ["buffer", "launch"])
def test_masks_of_labels_are_the_same_on_the_cpu_device_that_took_over(device, gpu, labels, monkeypatch, kind):
    expected = mesh_arrays(*clrecon.extract_label_masks(labels, device=device).values())
    Failing(monkeypatch, kind, first=12, last=NEVER_LAST, label=gpu.label)
    found = mesh_arrays(*clrecon.extract_label_masks(labels, device=gpu).values())
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one, other)


SMALL_WORK: dict[str, Callable] = {
    "surface": lambda volume, **where: clrecon.extract_isosurface(volume, 100, **where),
    "mip": lambda volume, **where: clrecon.render(volume, "mip", size=SIZE, **where),
    "slice": lambda volume, **where: clrecon.cut_slice(volume, "axial", SIZE, **where),
}


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("work", SMALL_WORK)
def test_a_device_that_is_too_small_for_one_slice_hands_over(device, gpu, volume, work):
    gpu.memory_bytes = 500  # of the 588 of a slice
    assert SMALL_WORK[work](volume, device=gpu).report["device"] == device.label


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("work", SMALL_WORK)
def test_memory_of_the_user_below_one_slice_is_refused_without_another_device(gpu, volume, work):
    with refused(DeviceError, 400):  # of the 588 bytes of a slice
        SMALL_WORK[work](volume, device=gpu, memory=400)
    assert gpu.handed_over == []


@pytest.mark.fault_row(54)
def test_a_device_that_the_user_named_fails_and_names_the_cpu_device(device, gpu, volume, monkeypatch):
    gpu.stand_in = None
    Failing(monkeypatch, "buffer", first=1, last=NEVER_LAST, label=gpu.label)
    cpu = max((each for each in list_devices() if each.type == "cpu"), key=lambda each: each.score)
    with refused(DeviceMemoryError, "injected") as caught:
        clrecon.extract_isosurface(volume, 100, device=gpu)
    assert str(caught.value).endswith(f"injected; {cpu.label} may do it: device={cpu.index}")


@pytest.mark.fault_row(54)
def test_a_cpu_device_without_room_fails_and_hands_nothing_over(device, volume, monkeypatch):
    Failing(monkeypatch, "buffer", first=1, last=NEVER_LAST)
    with refused(DeviceMemoryError, "injected"):
        clrecon.extract_isosurface(volume, 100, device=device)
    assert device.handed_over == []


@pytest.fixture
def cpu_and_gpu(device, gpu, monkeypatch):
    """The only devices are a CPU and a better GPU, and no variable names one."""
    gpu.stand_in = None
    monkeypatch.setattr("clrecon.opencl.select.list_devices", lambda: [device, gpu])
    for variable in ("CLRECON_DEVICE", "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    return device, gpu


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("name", [None, "auto", "AUTO"])
def test_a_device_that_nobody_named_has_the_cpu_device_for_a_stand_in(cpu_and_gpu, name):
    cpu, gpu = cpu_and_gpu
    taken = take_device(name)
    assert (taken.label, taken.stand_in) == (gpu.label, cpu)
    assert taken.context is gpu.context


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("name", ["gpu", "pretended", "the device itself", "the number of the CPU"])
def test_a_device_that_is_named_has_no_stand_in(cpu_and_gpu, name):
    cpu, gpu = cpu_and_gpu
    given = {"the device itself": gpu, "the number of the CPU": cpu.index}.get(name, name)
    assert take_device(given).stand_in is None


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("kind", ["gpu", "cpu"])
def test_a_device_that_the_environment_names_has_no_stand_in(cpu_and_gpu, monkeypatch, kind):
    monkeypatch.setenv("CLRECON_DEVICE", kind)
    taken = take_device(None)
    assert taken.type == kind
    assert taken.stand_in is None


SEVERAL_LAUNCHES = ("surface", "labels", "dvr")


@pytest.mark.fault_row(56)
@pytest.mark.parametrize("work", [*SEVERAL_LAUNCHES, "slices", "slice"])
def test_a_lost_device_gets_a_fresh_context_and_gives_the_same_result(device, gpu, volume, labels, monkeypatch, work):
    with DeviceVolume(volume, device=gpu) as resident:
        expected = WORK[work](resident, labels)
        lost = gpu.context
        resident.close()
        with monkeypatch.context() as patch:
            Failing(patch, "launch", first=2 if work in SEVERAL_LAUNCHES else 1, label=gpu.label, error=lost_error())
            found = WORK[work](resident, labels)
        assert resident.device is gpu
        assert gpu.context is not lost
    assert all(np.array_equal(one, other, equal_nan=True) for one, other in zip(found, expected, strict=True))


@pytest.mark.fault_row(56)
def test_a_device_that_is_lost_again_hands_over_to_the_cpu_device_with_a_warning(device, gpu, volume, monkeypatch):
    Failing(monkeypatch, "launch", first=2, last=NEVER_LAST, label=gpu.label, error=lost_error())
    report = clrecon.extract_isosurface(volume, 100, device=gpu).report
    assert report["device"] == device.label
    assert [text for text in report["warnings"] if "INVALID_COMMAND_QUEUE" in text and "all was done on" in text]


@pytest.mark.fault_row(56)
def test_a_device_that_was_lost_once_is_warned_of(device, gpu, volume, monkeypatch):
    Failing(monkeypatch, "launch", first=2, label=gpu.label, error=lost_error())
    report = clrecon.extract_isosurface(volume, 100, device=gpu).report
    assert report["device"] == gpu.label
    assert [text for text in report["warnings"] if "started again with a fresh context" in text]


def test_the_stand_in_of_a_failing_device_is_tried_once_and_the_first_failure_is_raised(device, gpu):
    asked = []

    with pytest.raises(DeviceFailedError, match=f"^{re.escape(gpu.label)} fails$"):
        for attempt in with_fallback(gpu):
            with attempt as (current, _):
                asked.append(current)
                allocate(current, 16)
                raise DeviceFailedError(f"{current.label} fails")
    assert asked == [gpu, device]
    assert gpu.handed_over == []
