"""Pictures in hard times: absurd numbers, failing devices, forked processes, threads, pages that are used again."""

from __future__ import annotations

import multiprocessing
import os
import threading
from typing import Any

import numpy as np
import pytest
from refusals import assert_one_line, refused

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.opencl import launching
from clrecon.operators.rays.ray_slabs import entry_slice
from clrecon.rendering import TransferFunction
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

pytestmark = pytest.mark.opencl

SIZE = (16, 16)
HARD = TransferFunction([(0, 1, 0, 0, 0.0), (200, 1, 1, 0, 0.6)])


def random_body(
    *, shape: tuple[int, int, int] = (12, 16, 20), spacing: tuple[float, float, float] = (0.9, 0.8, 1.2)
) -> Volume:
    """HU from 100 to 1499 at random, in air."""
    voxels = np.full(shape, -1000, np.int16)
    inner = voxels[2:-2, 3:-3, 4:-4]
    inner[...] = np.random.default_rng(1).integers(100, 1500, inner.shape)
    return Volume(voxels, np.diag([*spacing, 1.0]))


def camera_along_k(volume: Volume, *, scale: float) -> Camera:
    """A metre below the middle of the volume; a picture is twice `scale` mm high."""
    centre = 0.5 * (np.array(volume.shape_ijk) - 1) * volume.spacing
    return Camera(tuple(centre - [0, 0, 1000.0]), tuple(centre), (1, 0, 0), parallel_scale=scale)


MODES = pytest.mark.parametrize("mode", ["dvr", "mip", "mean", "surface"])


@MODES
def test_picture_of_slices_ten_million_columns_apart_is_made(device, mode):
    """Columns of 1e-4 mm, slices 1 m apart: steps of half the smallest spacing are 5e-8 of the way between two
    slices, and float32 would count without ever arriving."""
    volume = random_body(shape=(24, 16, 20), spacing=(1e-4, 1.0, 1000.0))
    picture = clrecon.render(volume, mode, camera=camera_along_k(volume, scale=1e-3), size=(4, 4), device=device)
    assert picture.image[..., :3].any()


@MODES
def test_a_given_ray_step_of_too_many_samples_is_refused(device, mode):
    volume = random_body(shape=(24, 16, 20), spacing=(1e-4, 1.0, 1000.0))
    with refused(UsageError, "step"):
        clrecon.render(volume, mode, ray_step=5e-5, size=(4, 4), device=device)


ABSURD = {
    "camera": lambda: Camera((0, -1e300, 0), (0, 0, 0), (0, 0, 1)),
    "focus": lambda: Camera((0, 0, 0), (0, 1e12, 0), (0, 0, 1)),
    "scale": lambda: Camera((0, -1, 0), (0, 0, 0), (0, 0, 1), parallel_scale=1e300),
    "unit": lambda: TransferFunction([(0, 1, 1, 1, 1)], unit_distance=1e300),
    "small unit": lambda: TransferFunction([(0, 1, 1, 1, 1)], unit_distance=1e-300),
}


@pytest.mark.parametrize("number", ABSURD)
def test_cameras_and_units_that_float32_cannot_hold_are_refused(number):
    with pytest.raises(UsageError) as error:
        ABSURD[number]()
    assert "1e+" in str(error.value) or "kilometres" in str(error.value)


TWO = np.array([1.0, 2.0])
REFUSED: dict[str, dict[str, Any]] = {
    "offset": {"mode": "slice", "offset_mm": "x"},
    "offsets": {"mode": "slice", "offset_mm": TWO},
    "combine": {"mode": "slice", "combine": TWO},
    "cpr": {"mode": "cpr", "curve": [(3, 3, 3), (5, 5, 9)], "cpr": TWO},
    "background": {"background": TWO},
    "background of a slice": {"mode": "slice", "background": TWO},
    "colour": {"mode": "surface", "color": TWO},
    "cue": {"mode": "surface", "depth_cue": TWO},
    "shadows": {"mode": "surface", "shadows": TWO},
    "jitter": {"jitter": "no"},
    "mode": {"mode": TWO},
    "step": {"ray_step": 10**400},
    "zoom": {"zoom": 1e-300},
}


@pytest.mark.parametrize("name", REFUSED)
def test_arrays_and_text_in_place_of_numbers_are_refused(device, name):
    settings = {"view": "axial"} if str(REFUSED[name].get("mode")).startswith("slice") else {}
    with pytest.raises(UsageError) as error:
        clrecon.render(random_body(), size=SIZE, device=device, **settings, **REFUSED[name])
    assert_one_line(error.value)


@pytest.mark.parametrize(("mode", "options"), [("dvr", {}), ("slice", {"view": "axial"})])
def test_a_background_by_an_array_is_that_by_name(device, mode, options):
    by_array, by_name = (
        clrecon.render(random_body(), mode, background=red, size=SIZE, device=device, **options).image
        for red in (np.array([1.0, 0.0, 0.0]), "red")
    )
    assert np.array_equal(by_array, by_name)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("mode", ["dvr", "mip", "surface"])
@pytest.mark.parametrize(
    "options",
    [
        {"ray_step": 1e300},
        {"clip": Clip([(0, 0, 1, -1e300)])},
        {"clip": Clip.plane((0, 0, 0), (0, 0, 1e300))},
        {"camera": camera_along_k(random_body(), scale=1e9)},
        {"camera": camera_along_k(random_body(), scale=1e-9)},
        {"camera": Camera((0, 0, 0), (1, 0, 0), (0, 0, 1e200), view_angle=179.0)},
    ],
    ids=["ray step", "clip offset", "clip normal", "wide", "narrow", "up and angle"],
)
def test_numbers_at_the_ends_of_their_ranges_make_opaque_pictures_without_a_warning(device, mode, options):
    picture = clrecon.render(random_body(), mode, size=SIZE, device=device, **options)
    assert picture.image[..., 3].min() == 255


@pytest.mark.parametrize("away", [-3e5, 3e5], ids=["beyond", "far before"])
def test_picture_in_slabs_is_the_same_with_a_parallel_camera_300_m_before_or_beyond_the_volume(device, away):
    """Its position only measures depths: slabs come in the order of the rays."""
    volume = random_body(shape=(40, 16, 20))
    centre = 0.5 * (np.array(volume.shape_ijk) - 1) * volume.spacing
    forward = np.array([0.0, 0.6, 0.8])

    def take_in_slabs(distance):
        place = centre - distance * forward
        camera = Camera(tuple(place), tuple(place + 100.0 * forward), (0, -1, 0), parallel_scale=20.0)
        assert entry_slice(volume, camera) < -40  # rays go up
        picture = clrecon.render(volume, camera=camera, memory=34_000, transfer_function=HARD, size=SIZE, device=device)
        assert picture.report["slabs"] > 2
        return picture.image

    assert np.array_equal(take_in_slabs(away), take_in_slabs(0.0))


@pytest.mark.parametrize("mode", ["dvr", "mip", "surface", "slices"])
def test_after_a_failure_the_next_picture_is_made_on_a_fresh_device(device, monkeypatch, mode):
    import pyopencl as cl

    with clrecon.VolumeRenderer(random_body(), device=device) as renderer:
        good = renderer.render(mode, size=SIZE, view=(20, 30)).image
        lost = renderer.device.context

        monkeypatch.setattr(launching, "wait", lambda device: _fail(device, cl))
        with refused(DeviceError, "gone"):
            renderer.render(mode, size=SIZE, view=(20, 30))
        monkeypatch.undo()
        assert renderer.device.context is not lost
        assert np.array_equal(renderer.render(mode, size=SIZE, view=(20, 30)).image, good)
        whole_d = renderer._resident._whole_d
        # Strict drivers refuse what belongs to the lost context.
        assert (whole_d is None and mode == "slices") or whole_d.context == renderer.device.context


def _fail(device, cl):
    device.queue.finish()
    raise device.fail("a kernel failed", cl.RuntimeError("the device is gone"))


@pytest.mark.parametrize(
    ("mode", "options"), [("dvr", {}), ("mip", {}), ("surface", {}), ("slices", {}), ("slice", {"view": "axial"})]
)
def test_a_device_with_too_little_memory_is_refused_with_its_bytes(device, monkeypatch, mode, options):
    monkeypatch.setattr(device, "memory_bytes", 1000)
    with refused(DeviceError, 1000, "bytes"):
        clrecon.render(random_body(), mode, size=SIZE, device=device, **options)


def test_a_device_with_small_buffers_makes_a_picture_in_slabs(device, monkeypatch):
    volume = random_body()
    monkeypatch.setattr(device, "max_allocation_bytes", volume.voxels.nbytes - 1)  # a byte less than the whole needs
    assert clrecon.render(volume, size=(8, 8), device=device).report["slabs"] > 1


def test_the_largest_picture_is_refused_with_the_buffer_that_is_too_large(device):
    """Nothing is taken before the sum is known; which buffer is too large depends on the device, and PoCL's largest
    on the memory that is free when it starts."""
    with pytest.raises(DeviceError, match="picture|states of the rays"):
        clrecon.render(random_body(), size=(16384, 16384), device=device, memory=2**28)


def test_pictures_are_not_changed_by_later_ones(device):
    """Their pages are lent from a pool, and later pictures of the same size come from the same pool."""
    with clrecon.VolumeRenderer(random_body(), device=device) as renderer:
        kept = renderer.render("mip", size=(640, 512), view=(10, 20))
        arrays: tuple[np.ndarray, ...] = (kept.image, kept.depth, kept.values)
        copies = [array.copy() for array in arrays]
        for azimuth in range(4):
            renderer.render("dvr", size=(640, 512), view=(azimuth, 0))
    clrecon.render(random_body(), "surface", size=(640, 512), device=device)
    for array, copy in zip(arrays, copies, strict=True):
        assert np.array_equal(array, copy, equal_nan=array.dtype.kind == "f")


def test_three_threads_that_share_a_renderer_get_the_picture_of_their_own_function(device):
    functions = [HARD, HARD.shifted(100.0), HARD.shifted(300.0)]
    with clrecon.VolumeRenderer(random_body(), device=device) as renderer:
        alone = [renderer.render(transfer_function=f, size=SIZE, jitter=True).image for f in functions]
        wrong: list[object] = []

        def render_six_times(number: int) -> None:
            try:
                for _ in range(6):
                    image = renderer.render(transfer_function=functions[number], size=SIZE, jitter=True).image
                    if not np.array_equal(image, alone[number]):
                        wrong.append(number)
            except Exception as error:  # noqa: BLE001
                wrong.append(error)

        threads = [threading.Thread(target=render_six_times, args=(number,)) for number in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


def render_bytes(index: int) -> bytes:
    """The picture of a body on the device with this index."""
    return clrecon.render(random_body(), size=SIZE, device=index).image.tobytes()


def test_process_started_by_spawn_as_on_macos_and_windows_draws_the_same_picture(device) -> None:
    here = render_bytes(device.index)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(render_bytes, (device.index,)) == here


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_is_told_so_and_does_not_wait_forever(device, monkeypatch):
    clrecon.render(random_body(), size=SIZE, device=device)
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with refused(DeviceError, "spawn"):
        clrecon.render(random_body(), size=SIZE, device=device)
