"""One volume on a device for surfaces, pictures, slices and labels: shared, lost with the device, or taken in slabs."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import tolerances
from device_work import SIZE, WORK, centre_line, label_boxes
from failing_devices import Failing, memory_error
from refusals import refused
from surface_volumes import OBLIQUE, smooth_volume
from variants import daily_rows, each_value

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.labels import LabelMap, resample
from clrecon.opencl import Stopwatch
from clrecon.operators.rays.ray_pictures import TransferTables
from clrecon.operators.resident.device_volume import DeviceVolume


@pytest.fixture(scope="module")
def volume():
    """Smooth noise about 0 HU in 22 slices."""
    return smooth_volume((22, 26, 45))


@pytest.fixture(scope="module")
def labels(volume):
    """Two boxes that touch: label 1 below label 2."""
    return label_boxes(volume, np.s_[3:12, 4:20, 5:30], np.s_[12:20, 4:20, 5:30])


PICTURES = {"dvr", "dvr labels", "ray surface", "drr", "slices"}
"""Where rays go through slabs, float32 sums may round otherwise."""


def assert_equal(found, expected, work: str) -> None:
    """Arrays of a result are those expected to the bit, or, of `PICTURES`, but for rounding."""
    for one, other in zip(found, expected, strict=True):
        if work in PICTURES and one.dtype == np.uint8:
            assert np.abs(one.astype(int) - other.astype(int)).max() <= tolerances.RAY_SAME_255
        elif work in PICTURES:
            assert np.allclose(one, other, rtol=1e-5, atol=1e-3, equal_nan=True)
        else:
            assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


@pytest.mark.parametrize(("work", "kind"), daily_rows(6, each_value(WORK, ["buffer", "launch"])))
def test_result_is_the_same_after_a_buffer_or_launch_failed_at_several_places(
    device, volume, labels, monkeypatch, work, kind
):
    with monkeypatch.context() as patch, DeviceVolume(volume, device=device) as resident:
        counted = Failing(patch, kind, 0)
        expected = WORK[work](resident, labels)
    count = counted.counts[kind]
    assert count > 0
    for fails in range(1, count + 1, max(1, count // 6)):  # each of fewer than 12, and at least six of more
        with monkeypatch.context() as patch, DeviceVolume(volume, device=device) as resident:
            failing = Failing(patch, kind, fails)
            found = WORK[work](resident, labels)
            assert failing.counts[kind] > fails
        assert_equal(found, expected, work)


@pytest.mark.parametrize(
    ("fails", "work"),
    [
        (1, lambda volume: clrecon.render(volume, "mip", size=SIZE)),
        (1, lambda volume: clrecon.cut_slice(volume, "coronal", SIZE)),
        (2, lambda volume: clrecon.extract_isosurface(volume, 100)),
    ],
    ids=["mip", "slice", "surface"],
)
def test_a_buffer_that_fails_is_warned_of_with_the_slabs_that_follow(device, volume, monkeypatch, fails, work):
    with DeviceVolume(volume, device=device) as resident:
        Failing(monkeypatch, "buffer", fails)
        warnings = work(resident).report["warnings"]
    assert any("injected: continued with slabs of" in warning for warning in warnings)


@pytest.mark.parametrize("code", [-4, -5], ids=["MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_RESOURCES"])
@pytest.mark.parametrize("work", ["mip", "surface", "slice"])
def test_work_whose_kernel_gets_no_memory_at_its_launch_is_done_in_slabs_and_says_so(
    device, volume, monkeypatch, work, code
):
    """Drivers of cards find memory for a buffer only when a kernel uses it."""
    do_work = {
        "mip": lambda v: clrecon.render(v, "mip", size=SIZE),
        "surface": lambda v: clrecon.extract_isosurface(v, 100),
        "slice": lambda v: clrecon.cut_slice(v, "coronal", SIZE),
    }[work]
    Failing(monkeypatch, "launch", first=1, error=memory_error(code))
    with DeviceVolume(volume, device=device) as resident:
        report = do_work(resident).report
    assert report["slabs"] > 1
    (warning,) = (warning for warning in report["warnings"] if "continued with slabs of" in warning)
    assert str(memory_error(code)) in warning


@pytest.mark.parametrize("work", ["mip", "surface"])
def test_work_whose_kernel_is_stopped_while_it_runs_is_the_same_in_slabs_of_half_and_says_so(
    device, volume, monkeypatch, work
):
    """By a watchdog, or because the driver finds memory only then."""
    do_work = {"mip": clrecon.render, "surface": clrecon.extract_isosurface}[work]
    options = {"mip": {"style": "mip", "size": SIZE}, "surface": {"iso_value": 100}}[work]
    expected = do_work(volume, device=device, **options)
    Failing(monkeypatch, "stop", first=1)
    found = do_work(volume, device=device, **options)
    assert found.report["slabs"] == 2
    (warning,) = (warning for warning in found.report["warnings"] if "continued with slabs of" in warning)
    assert "OUT_OF_RESOURCES" in warning
    arrays = ("values",) if work == "mip" else ("vertices", "normals", "triangles")
    for array in arrays:
        assert np.array_equal(getattr(found, array), getattr(expected, array), equal_nan=True)


@pytest.mark.parametrize("work", WORK)
def test_a_device_without_any_room_is_refused_and_holds_nothing(device, volume, labels, monkeypatch, work):
    with DeviceVolume(volume, device=device) as resident:
        Failing(monkeypatch, "buffer", first=1, last=10**6)
        with refused(DeviceError, "bytes", "injected"):
            WORK[work](resident, labels)
        assert resident.uploaded_bytes == 0


def test_a_mesh_a_rendering_three_slices_a_curved_one_and_slices_in_space_upload_the_volume_once(device, volume):
    with DeviceVolume(volume, device=device) as resident:
        clrecon.extract_isosurface(resident, 100)
        clrecon.render(resident, preset="muscle", size=SIZE)
        for plane in ("axial", "coronal", "sagittal"):
            clrecon.cut_slice(resident, plane, SIZE)
        clrecon.reformat_curve(resident, centre_line(volume), size=SIZE)
        clrecon.render(resident, "slices", size=SIZE)
        assert resident.uploaded_bytes == volume.voxels.nbytes


def test_one_slice_uploads_less_than_half_of_the_volume(device, volume):
    with DeviceVolume(volume, device=device) as resident:
        clrecon.cut_slice(resident, "axial", SIZE)
        assert resident.uploaded_bytes < volume.voxels.nbytes / 2


def test_forty_slices_upload_the_volume_no_more_than_twice_and_keep_it(device, volume):
    with DeviceVolume(volume, device=device) as resident:
        for offset in np.linspace(-8.0, 8.0, 40):
            clrecon.cut_slice(resident, "axial", SIZE, offset_mm=offset)
        assert resident.uploaded_bytes <= 2 * volume.voxels.nbytes
        assert resident.is_held


@pytest.mark.parametrize("work", WORK)
def test_a_volume_on_which_other_work_was_done_gives_what_a_fresh_one_does(device, volume, labels, work):
    with DeviceVolume(volume, device=device) as own:
        expected = WORK[work](own, labels)
    with DeviceVolume(volume, device=device) as shared:
        for other in WORK.values():
            other(shared, labels)
        assert_equal(WORK[work](shared, labels), expected, "exact")


def test_a_turntable_of_labels_brings_the_map_to_the_grid_once(device, volume, monkeypatch):
    coarse = LabelMap(np.ones((6, 8, 12), np.uint8), volume.affine @ np.diag([3.5, 3.0, 3.5, 1.0]))
    calls = []
    true_take = resample._take_nearest
    monkeypatch.setattr(resample, "_take_nearest", lambda *both: calls.append(1) or true_take(*both))
    with clrecon.VolumeRenderer(volume, device=device) as renderer:
        for azimuth in range(0, 360, 60):
            renderer.render(preset="muscle", labels=coarse, view=(azimuth, 0), size=SIZE)
    assert len(calls) == 1


def test_kept_buffers_make_room_for_a_surface_after_a_picture(device, volume):
    """Enough memory for any of them alone, not for what all would like to keep."""
    voxel_bytes = volume.voxels.nbytes
    with DeviceVolume(volume, device=device, memory=3 * voxel_bytes) as resident:
        first = clrecon.extract_isosurface(resident, 100)
        clrecon.render(resident, preset="muscle", size=SIZE)
        again = clrecon.extract_isosurface(resident, 100)
        assert resident.uploaded_bytes >= voxel_bytes
    assert np.array_equal(first.vertices, again.vertices)


def test_kept_buffers_count_for_the_mesh_of_another_operator(device, volume):
    """The mesh fits beside the volume, and not beside what ray pictures keep: that goes, and no slabs are needed."""
    with DeviceVolume(volume, device=device) as alone:
        needed = sum(clrecon.extract_isosurface(alone, 100).report["device_bytes"].values())
    with DeviceVolume(volume, device=device, memory=needed + 64_000) as resident:
        resident.whole(Stopwatch())
        resident.keep("of ray pictures", None, 200_000, object)
        mesh = clrecon.extract_isosurface(resident, 100)
        assert mesh.report["slabs"] == 1
        assert not mesh.report["warnings"]
        assert resident.kept_bytes("of ray pictures") == 0


def test_tables_of_a_transfer_function_stay_from_picture_to_picture_in_slabs(device, volume, monkeypatch):
    tables = []
    true_of = TransferTables.of
    monkeypatch.setattr(TransferTables, "of", lambda *which: tables.append(which) or true_of(*which))
    memory = volume.voxels.nbytes // 2 + 48 * SIZE[0] * SIZE[1]
    with clrecon.VolumeRenderer(volume, device=device, memory=memory) as renderer:
        pictures = [
            renderer.render(preset="muscle", view=(azimuth, 0), size=SIZE, smooth_light=0.0) for azimuth in (0, 30, 60)
        ]
    assert all(picture.report["slabs"] > 1 for picture in pictures)
    assert len(tables) == 1


def test_slices_in_space_keep_to_the_memory_where_the_volume_is_held(device, volume):
    """Volume and picture do not fit together: the volume goes, and the slices that are shown come."""
    size = (96, 80)
    with DeviceVolume(volume, device=device) as resident:
        expected = clrecon.render(resident, "slices", slices=[3, 9], size=size, view=(20, 30))
    with DeviceVolume(volume, device=device, memory=volume.voxels.nbytes + 6 * size[0] * size[1]) as resident:
        resident.whole(Stopwatch())
        found = clrecon.render(resident, "slices", slices=[3, 9], size=size, view=(20, 30))
        assert not resident.is_held
    assert np.array_equal(found.image, expected.image)


@pytest.mark.parametrize(
    "call",
    [
        lambda resident, device: clrecon.extract_isosurface(resident, 100, device=device),
        lambda resident, device: clrecon.render(resident, memory=10**9),
        lambda resident, device: clrecon.VolumeRenderer(resident, device=device),
        lambda resident, device: clrecon.SurfaceExtractor(resident, memory=10**9),
        lambda resident, device: clrecon.cut_slice(resident, device=device),
    ],
    ids=["surface", "picture", "renderer", "extractor", "slice"],
)
def test_device_or_memory_beside_a_device_volume_is_refused(device, volume, call):
    with DeviceVolume(volume, device=device) as resident, refused(UsageError, "device", "memory"):
        call(resident, device)


@pytest.mark.parametrize("wrong", [None, np.zeros((2, 3, 4), np.int16)], ids=["none", "array"])
def test_a_device_volume_of_what_is_no_volume_is_refused(device, wrong):
    with refused(UsageError, "Volume"):
        DeviceVolume(wrong, device=device)


def test_a_device_volume_with_no_memory_is_refused(device, volume):
    with refused(UsageError, "bytes"):
        DeviceVolume(volume, device=device, memory=0)


def test_a_buffer_that_fails_is_logged(device, volume, monkeypatch, caplog):
    with DeviceVolume(volume, device=device) as resident, caplog.at_level("INFO", "clrecon"):
        Failing(monkeypatch, "buffer", 1)
        clrecon.render(resident, "mip", size=SIZE)
    assert any("rays: no room on" in record.getMessage() for record in caplog.records)


def test_pickling_a_device_volume_is_refused(device, volume):
    with DeviceVolume(volume, device=device) as resident, refused(TypeError, "DeviceVolume"):
        pickle.dumps(resident)


def test_an_extractor_leaves_a_volume_that_was_given_on_the_device_until_its_own_end(device, volume):
    with DeviceVolume(volume, device=device) as resident:
        with clrecon.SurfaceExtractor(resident) as extractor:
            extractor.extract(100)
        assert resident.is_held
    assert not resident.is_held


def test_a_renderer_leaves_a_volume_that_was_given_on_the_device_until_its_own_end(device, volume):
    with DeviceVolume(volume, device=device) as resident:
        with clrecon.VolumeRenderer(resident) as renderer:
            renderer.render("mip", size=SIZE)
        assert resident.is_held
    assert not resident.is_held


def test_a_renderer_shows_each_of_two_label_maps_in_its_own_colours_in_turn(device, volume, labels):
    swapped = LabelMap(np.where(labels.voxels == 1, 2, np.where(labels.voxels == 2, 1, 0)).astype(np.uint8), OBLIQUE)
    colors = {1: (1.0, 0.0, 0.0), 2: (0.0, 0.0, 1.0)}
    with clrecon.VolumeRenderer(volume, device=device) as renderer:
        first, second, first_again, second_again = (
            renderer.render(preset="muscle", labels=each, label_colors=colors, size=SIZE).image
            for each in (labels, swapped, labels, swapped)
        )
    assert not np.array_equal(first, second)
    assert np.array_equal(first, first_again)
    assert np.array_equal(second, second_again)
