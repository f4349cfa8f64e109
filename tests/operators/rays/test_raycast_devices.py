"""The raycaster against its numpy twin, on one device against others, and against itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import conftest
import numpy as np
import pytest
import tolerances
from raycast_scenes import (
    DeviceCaster,
    TwinCaster,
    ball,
    blobs,
    centre_of,
    even_volume,
    look,
    premultiplied,
    uneven_volume,
)
from soft_function import SOFT
from variants import daily

from clrecon.geometry import Volume
from clrecon.opencl.sources import read_kernel_source
from clrecon.proof.rays.render import hash_pixels, jitter_pixels
from clrecon.rendering import UNSHADED, Lighting, TransferFunction
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (48, 36)
STEEP = TransferFunction([(-200, 0.8, 0.1, 0.1, 0), (100, 1, 0.6, 0.3, 0), (130, 1, 0.9, 0.7, 0.9), (800, 1, 1, 1, 1)])
LEVOY = TransferFunction(SOFT.points, unit_distance=2.0, gradient_opacity=[(20.0, 0.0), (150.0, 1.0), (600.0, 0.3)])
LIT = Lighting()
FADING = Lighting(ambient=0.2, diffuse=0.7, specular=0.4, specular_power=12.5, soft_gradient=150.0)
FIXED = Lighting(ambient=0.15, diffuse=0.7, specular=0.4, specular_power=20.0, direction=(0.4, -1.0, 0.8))


def noise(points: np.ndarray) -> np.ndarray:
    return np.random.default_rng(11).integers(-1000, 1500, len(points)).astype(float)


def scene(volume: Volume, mode: str = "dvr", function: Any = None, /, **settings: Any) -> tuple[Volume, dict[str, Any]]:
    """A volume, and the settings of a picture of it in one of the modes."""
    view = {name: settings.pop(name) for name in ("perspective", "towards", "half_height") if name in settings}
    camera = look(
        volume,
        view.get("towards", (0.4, 1.0, -0.3)),
        half_height=view.get("half_height", 10.0),
        perspective=view.get("perspective", False),
    )
    return volume, {"mode": mode, "transfer_function": function, "camera": camera, "size": SIZE, **settings}


def cut(volume: Volume) -> Clip:
    centre = centre_of(volume)
    return Clip.box(centre - 5.0, centre + (6.0, 7.0, 4.0)) & Clip.plane(centre, (0.5, 0.4, 1.0))


def clipped(volume: Volume, *args: Any, **settings: Any) -> tuple[Volume, dict[str, Any]]:
    return scene(volume, *args, clip=cut(volume), **settings)


def blobs_of_18_mm(steps: str, **how: Any) -> Volume:
    return even_volume(blobs, steps, extent=18.0, **how)


SCENES: dict[str, Callable[[], tuple[Volume, dict[str, Any]]]] = {
    "soft": lambda: scene(blobs_of_18_mm("anisotropic", dtype=np.int16), "dvr", SOFT, lighting=LIT),
    "unlit": lambda: scene(blobs_of_18_mm("mirrored"), "dvr", SOFT, perspective=True, lighting=UNSHADED),
    "fading": lambda: scene(blobs_of_18_mm("oblique", dtype=np.int16), "dvr", SOFT, lighting=FADING),
    "fixed light": lambda: scene(blobs_of_18_mm("oblique"), "dvr", SOFT, perspective=True, lighting=FIXED),
    "steep": lambda: scene(blobs_of_18_mm("sheared", dtype=np.int16), "dvr", STEEP, lighting=LIT, ray_step=0.17),
    "steep jitter": lambda: clipped(blobs_of_18_mm("mirrored"), "dvr", STEEP, lighting=FIXED, jitter=True),
    "steep uneven": lambda: scene(uneven_volume(blobs), "dvr", STEEP, lighting=LIT, half_height=20.0, ray_step=0.19),
    "gradient opacity": lambda: scene(blobs_of_18_mm("oblique"), "dvr", LEVOY, lighting=LIT),
    "clipped": lambda: clipped(blobs_of_18_mm("sheared"), "dvr", SOFT, lighting=FIXED, perspective=True),
    "jitter": lambda: scene(blobs_of_18_mm("even"), "dvr", SOFT, lighting=UNSHADED, jitter=True, ray_step=1),
    "coarse": lambda: scene(blobs_of_18_mm("even"), "dvr", SOFT, lighting=LIT, ray_step=3.1),
    "uneven": lambda: scene(uneven_volume(blobs), "dvr", SOFT, lighting=LIT, perspective=True, half_height=20.0),
    "uneven clipped": lambda: clipped(uneven_volume(blobs), "dvr", SOFT, lighting=FIXED, towards=(0.2, 0.1, 1.0)),
    "hollow": lambda: scene(
        even_volume(ball(3.0, 2.0), "anisotropic", extent=40.0, dtype=np.int16), "dvr", SOFT, lighting=LIT
    ),
    "mip": lambda: scene(even_volume(noise, "oblique", extent=12.0, dtype=np.int16), "mip"),
    "minip": lambda: scene(even_volume(noise, "sheared", extent=12.0, dtype=np.int16), "minip", perspective=True),
    "mip uneven": lambda: scene(uneven_volume(noise), "mip", half_height=20.0),
    "mip clipped": lambda: clipped(blobs_of_18_mm("mirrored"), "mip", perspective=True),
    "mean": lambda: scene(even_volume(noise, "oblique", extent=12.0, dtype=np.int16), "mean", perspective=True),
    "mean clipped": lambda: clipped(blobs_of_18_mm("mirrored"), "mean"),
    "drr": lambda: scene(even_volume(noise, "oblique", extent=12.0, dtype=np.int16), "drr", perspective=True),
    "drr clipped": lambda: clipped(blobs_of_18_mm("mirrored"), "drr"),
    "drr uneven": lambda: scene(uneven_volume(blobs), "drr", half_height=20.0),
    "mean uneven": lambda: scene(uneven_volume(blobs), "mean", half_height=20.0),
}  # fmt: skip


def assert_alike(found: Any, expected: Any, mode: str) -> None:
    """Two pictures by float32 and float64, or by two compilers."""
    share = tolerances.RAY_TWIN_SHARE
    if mode == "dvr":
        assert expected.image[..., 3].max() > 100  # of 255: something is shown; measured 249 on
        away = np.abs(premultiplied(found.image) - premultiplied(expected.image)).max(axis=-1)
        assert (away <= 2.0).mean() >= 1.0 - share, f"{(away > 2.0).sum()} pixels differ, by up to {away.max():.1f}"
        assert away.max() <= tolerances.RAY_TWIN_WORST_255
    else:
        there = np.isfinite(expected.values)
        assert (np.isfinite(found.values) != there).mean() <= share
        away = np.abs(found.values - expected.values)[there & np.isfinite(found.values)]
        assert (away <= tolerances.RAY_TWIN_HU).mean() >= 1.0 - share, f"up to {away.max():.3g} HU"
    if mode not in ("mean", "drr"):
        hit = np.isfinite(expected.depth) & np.isfinite(found.depth)
        assert hit.mean() > 0.05  # measured 0.18 on
        assert (np.isfinite(expected.depth) != np.isfinite(found.depth)).mean() <= share
        for name in ("depth", "expected_depth"):
            away = np.abs(getattr(found, name) - getattr(expected, name))[hit]
            assert (away <= tolerances.RAY_TWIN_DEPTH_MM).mean() >= 1.0 - tolerances.RAY_TWIN_DEPTH_SHARE, name


@pytest.mark.parametrize("name", daily(10, SCENES))
def test_raycast_of_every_scene_equals_its_twin(device, name):
    volume, settings = SCENES[name]()
    assert_alike(DeviceCaster(device)(volume, **settings), TwinCaster()(volume, **settings), settings["mode"])


@pytest.mark.every_device
@pytest.mark.usefixtures("users_kernels")
@pytest.mark.parametrize("name", ["soft", "mip", "drr"])
def test_raycast_by_kernels_of_users_equals_its_twin(device, name):
    volume, settings = SCENES[name]()
    assert_alike(DeviceCaster(device)(volume, **settings), TwinCaster()(volume, **settings), settings["mode"])


@pytest.mark.every_device
def test_flat_places_are_lit_as_by_the_twin(device):
    """A mask of two values: where it is flat, differences of float32 are noise."""
    cube = lambda p: np.where(np.abs(p).max(axis=1) < 7.0, 2613.0, -300.0)  # noqa: E731
    volume, settings = scene(even_volume(cube, "oblique", extent=18.0, dtype=np.int16), "dvr", SOFT, lighting=FIXED)
    assert_alike(DeviceCaster(device)(volume, **settings), TwinCaster()(volume, **settings), "dvr")


@pytest.mark.oclgrind
@pytest.mark.parametrize(
    ("mode", "function", "even"),
    [
        *(("dvr", SOFT, even) for even in (True, False)),
        ("dvr", LEVOY, True),
        pytest.param("dvr", LEVOY, False, marks=pytest.mark.first_device),  # each without the other is on all
        *((mode, None, even) for mode in ("mip", "mean", "drr") for even in (True, False)),
    ],
)
def test_raycast_of_few_voxels_equals_its_twin(device, mode, function, even):
    """Small enough for a simulator: odd sizes, rays past the volume, clip planes, a light that stands still."""
    if even:
        volume = even_volume(blobs, "oblique", extent=6.0, dtype=np.int16)
    else:
        volume = uneven_volume(blobs, shape=(9, 7), gaps=(1.0, 0.4, 1.9, 1.0))
    camera = look(volume, (0.4, 1.0, -0.3), half_height=5.0, perspective=True)
    clip = Clip.plane(centre_of(volume), (0.3, 0.2, 1.0))
    settings = {"mode": mode, "camera": camera, "size": (11, 9), "clip": clip, "ray_step": 0.5}
    if mode == "dvr":
        settings |= {"transfer_function": function, "lighting": FIXED, "jitter": True}
    found, expected = DeviceCaster(device)(volume, **settings), TwinCaster()(volume, **settings)
    if mode == "dvr":
        away = np.abs(premultiplied(found.image) - premultiplied(expected.image))
        assert expected.image.any() and away.max() <= 2.0
    else:
        assert np.array_equal(np.isnan(found.values), np.isnan(expected.values))
        assert np.nanmax(np.abs(found.values - expected.values)) <= tolerances.RAY_TWIN_HU


@pytest.mark.release  # each is compared with the twin
@pytest.mark.parametrize("name", ["soft", "steep", "gradient opacity", "uneven", "mip", "mean", "drr"])
def test_all_devices_give_the_picture_of_the_first(name):
    from skimage.metrics import structural_similarity

    devices, _ = conftest.Devices.get()
    if len(devices) < 2:
        pytest.skip("only one OpenCL device")
    volume, settings = SCENES[name]()
    first, *others = [DeviceCaster(device)(volume, **settings) for device in devices]
    for other in others:
        a, b = premultiplied(first.image), premultiplied(other.image)
        assert (np.abs(a - b).max(axis=-1) <= 2.0).mean() >= 1.0 - tolerances.RAY_TWIN_SHARE
        assert structural_similarity(a, b, channel_axis=-1, data_range=255.0) > 0.99  # measured 0.9999998 in "soft"
        assert_alike(other, first, settings["mode"])


@pytest.mark.every_device
def test_jitter_of_pixels_has_the_bits_of_numpy(device):
    import pyopencl

    width, height = 37, 19
    source = (
        read_kernel_source("rays/jitter.h")
        + """
    __kernel void jitter_all(__global uint *hashes, __global float *parts, const uint width) {
        const uint x = get_global_id(0), y = get_global_id(1);
        hashes[y * width + x] = hash_pixel(x, y);
        parts[y * width + x] = jitter_pixel(x, y);
    }"""
    )
    context = device.context
    queue = pyopencl.CommandQueue(context)
    hashes, parts = np.empty((height, width), np.uint32), np.empty((height, width), np.float32)
    flags = pyopencl.mem_flags.WRITE_ONLY
    hashes_d, parts_d = (pyopencl.Buffer(context, flags, array.nbytes) for array in (hashes, parts))
    program = pyopencl.Program(context, source).build()
    program.jitter_all(queue, (width, height), (1, 1), hashes_d, parts_d, np.uint32(width))
    pyopencl.enqueue_copy(queue, hashes, hashes_d)
    pyopencl.enqueue_copy(queue, parts, parts_d)
    queue.finish()
    y, x = np.mgrid[:height, :width]
    assert np.array_equal(hashes, hash_pixels(x, y))
    assert np.array_equal(parts, jitter_pixels(width, height))


@pytest.mark.every_device
def test_pictures_of_one_camera_are_the_same_each_time(device):
    volume, settings = SCENES["steep"]()
    first, again = (DeviceCaster(device)(volume, **settings) for _ in range(2))
    assert np.array_equal(first.image, again.image)
    assert np.array_equal(first.depth, again.depth, equal_nan=True)


@pytest.mark.every_device
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 8), (9, 7), (65, 33)])
def test_pictures_of_1_to_65_x_33_pixels_have_all_their_pixels(device, size):
    volume = even_volume(lambda p: np.zeros(len(p)), "oblique", extent=12.0, dtype=np.int16)
    fog = TransferFunction([(-10, 1, 1, 1, 0.2), (10, 1, 1, 1, 0.2)])
    camera = Camera.fit(volume, view=(20.0, 30.0), zoom=6.0, size=size)
    found, expected = (
        cast(volume, "dvr", fog, camera=camera, size=size) for cast in (DeviceCaster(device), TwinCaster())
    )
    assert found.image.shape == (size[1], size[0], 4)
    assert expected.image[..., 3].max() > 100  # of 255: something is shown; measured 249 on
    assert (
        np.abs(found.image[..., 3].astype(int) - expected.image[..., 3]).max() <= tolerances.RAY_SAME_255
    )  # measured 0
