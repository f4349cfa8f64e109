"""Rows of voxels seen through a window (cl/rays/window.h): pictures as with single loads, and no voxel more read."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import tolerances
from raycast_scenes import DeviceCaster, look, premultiplied
from variants import daily_rows, each_value

from clrecon.geometry import Volume
from clrecon.opencl.arrays import download, empty_output, upload
from clrecon.opencl.buffers import raw
from clrecon.opencl.sources import read_kernel_source
from clrecon.operators.rays import ray_slabs
from clrecon.operators.resident import device_volume as resident
from clrecon.rendering import Lighting, TransferFunction

FUNCTION = TransferFunction([(-300, 0.9, 0.2, 0.1, 0.0), (200, 1, 0.7, 0.4, 0.15), (900, 1, 1, 0.9, 0.6)])
ALONG_J, ALONG_K, NEARLY_J = (0.0, 1.0, 0.0), (0.0, 0.05, -1.0), (0.02, 1.0, 0.03)

CHECKS = """
    __kernel void has_windows(__global int *found) { found[0] = HAS_WINDOWS; }
    #if HAS_WINDOWS
    __kernel void look_at_rows(__global const short *row, __global const int *at, __global const float *part,
                               __global float *values) {
        const size_t n = get_global_id(0);
        const int8 mixed = mix_pairs(take_pairs(row, choose_pairs(vload8(n, at))), weigh_pairs(vload8(n, part)));
        vstore8(convert_float8(mixed) / SHARES, n, values);
        /* One further to the right, taken one to the left. */
        const choice next = next_pairs(next_pairs(choose_pairs(vload8(n, at)), 1), -1);
        if (any(mix_pairs(take_pairs(row, next), weigh_pairs(vload8(n, part))) != mixed))
            vstore8((float8)(NAN), n, values);
    }
    #endif
"""


def noise_volume(shape: tuple[int, int, int]) -> Volume:
    """Random HU in voxels of 0.7 x 0.7 x 0.8 mm."""
    voxels = np.random.default_rng(5).integers(-1000, 1200, shape).astype(np.int16)
    return Volume(voxels, np.diag([0.7, 0.7, 0.8, 1.0]))


def build_checks(device):
    import pyopencl

    source = read_kernel_source("rays/window.h") + CHECKS
    return pyopencl.Program(device.context, source).build(["-DLANES=8", "-DVOXEL_IS_SHORT=1"])


def makes_windows(device) -> bool:
    found, found_d = empty_output(device, (1,), np.int32)
    build_checks(device).has_windows(device.queue, (1,), None, raw(found_d))
    return bool(download(device, found, found_d)[0])


@pytest.fixture
def windowed(device):
    """A device whose compiler makes windows."""
    if not makes_windows(device):
        pytest.skip("this driver's compiler makes no windows")
    return device


@pytest.mark.every_device
def test_windows_are_made_by_compilers_that_know_avx2_alone(device):
    """PoCL's does, where it knows the CPU."""
    import pyopencl

    source = "__kernel void has_avx2(__global int *found) {\n#ifdef __AVX2__\nfound[0] = 1;\n#endif\n}"
    found, found_d = empty_output(device, (1,), np.int32)
    found[0] = 0
    pyopencl.enqueue_copy(device.queue, raw(found_d), found)
    pyopencl.Program(device.context, source).build().has_avx2(device.queue, (1,), None, raw(found_d))
    assert makes_windows(device) == bool(download(device, found, found_d)[0])


@pytest.mark.every_device
def test_a_window_mixes_every_pair_of_neighbours_in_its_row_by_its_weight(windowed):
    rng = np.random.default_rng(2)
    row = np.concatenate([[-32768, 32767, -32768], rng.integers(-32768, 32768, 13)]).astype(np.int16)
    at = np.stack([rng.permutation(15)[:8] for _ in range(200)]).astype(np.int32)
    part = rng.random(at.shape).astype(np.float32)
    part[0], part[1] = 0.0, np.nextafter(np.float32(1.0), np.float32(0.0))
    values, values_d = empty_output(windowed, at.shape, np.float32)
    kept = [upload(windowed, array) for array in (row, at, part)]
    arrays_d = [raw(lent) for lent in kept]
    build_checks(windowed).look_at_rows(windowed.queue, (len(at),), None, *arrays_d, raw(values_d))
    low, high = row[at].astype(np.float64), row[at + 1].astype(np.float64)
    error = np.abs(download(windowed, values, values_d) - (low + part * (high - low)))
    assert (error <= tolerances.WINDOW_SHARE * np.abs(high - low) + 0.01).all()  # HU: values in float32


def leave_windows_out(monkeypatch) -> None:
    ray_variants = resident.ray_variants
    monkeypatch.setattr(resident, "ray_variants", lambda *args: {**ray_variants(*args), "NO_WINDOWS": "1"})


@pytest.mark.seconds
@pytest.mark.parametrize(
    ("columns", "towards", "perspective"),
    daily_rows(3, each_value([14, 16, 17, 40], [ALONG_J, ALONG_K, NEARLY_J], [False, True])),
)
def test_pictures_of_random_voxels_are_the_same_with_and_without_windows(
    windowed, monkeypatch, columns, towards, perspective
):
    volume = noise_volume((24, 20, columns))
    # A pixel is half a voxel, or more voxels lie beside each other than a window has.
    cameras = [look(volume, towards, half_height=half_height, perspective=perspective) for half_height in (9.0, 60.0)]
    views = [{"camera": camera, "size": (64, 48), "lighting": Lighting()} for camera in cameras]
    with_windows = [DeviceCaster(windowed)(volume, "dvr", FUNCTION, **view) for view in views]
    leave_windows_out(monkeypatch)
    without = [DeviceCaster(windowed)(volume, "dvr", FUNCTION, **view) for view in views]
    for found, expected in zip(with_windows, without, strict=True):
        assert expected.image[..., 3].max() > 100  # of 255: something is shown; measured 124 on
        assert np.abs(premultiplied(found.image) - premultiplied(expected.image)).max() <= tolerances.RAY_SAME_255
        assert np.array_equal(np.isnan(found.depth), np.isnan(expected.depth))


@pytest.mark.parametrize("towards", [(1.0, 0.0, 0.0), (1.0, 0.02, 0.03), (0.3, 1.0, 0.02), (0.3, 0.02, 1.0)])
@pytest.mark.parametrize("shape", [(1, 20, 40), (2, 20, 40), (3, 20, 40), (20, 1, 40), (20, 2, 40), (20, 3, 40)])
def test_pictures_of_few_rows_or_slices_are_the_same_with_and_without_windows(windowed, monkeypatch, shape, towards):
    """Inner places lie between the second voxel from each side: of three and fewer there are none."""
    volume = noise_volume(shape)
    view = {"camera": look(volume, towards, half_height=2.0), "size": (32, 32), "lighting": Lighting(), "ray_step": 0.1}
    found = DeviceCaster(windowed)(volume, "dvr", FUNCTION, **view)
    leave_windows_out(monkeypatch)
    expected = DeviceCaster(windowed)(volume, "dvr", FUNCTION, **view)
    assert expected.image[..., 3].max() > 100  # of 255: something is shown; measured 124 on
    assert np.abs(premultiplied(found.image) - premultiplied(expected.image)).max() <= tolerances.RAY_SAME_255
    assert np.array_equal(found.depth, expected.depth, equal_nan=True)


@pytest.mark.parametrize("slices", [1, 2, 4, 6])
@pytest.mark.parametrize("towards", [(0.0, 1.0, 0.0), (0.0, 1.0, 0.1), (0.0, 0.3, -1.0)])
def test_slabs_with_a_single_slice_at_the_end_give_the_picture_of_the_whole(windowed, monkeypatch, towards, slices):
    volume = noise_volume((13, 20, 40))
    view = {"camera": look(volume, towards, half_height=6.0), "size": (48, 41), "lighting": Lighting(), "ray_step": 0.2}
    whole = DeviceCaster(windowed)(volume, "dvr", FUNCTION, **view)
    planned: list[int] = []
    monkeypatch.setattr(ray_slabs, "plan_ray_slabs", lambda *_, **__: planned.append(slices) or slices)
    parts = DeviceCaster(windowed)(volume, "dvr", FUNCTION, **view)
    assert planned == [slices]
    assert whole.image[..., 3].max() > 100  # of 255: something is shown; measured 253
    assert np.abs(premultiplied(whole.image) - premultiplied(parts.image)).max() <= tolerances.RAY_SAME_255
    for name in ("depth", "expected_depth"):
        found, expected = getattr(parts, name), getattr(whole, name)
        assert np.allclose(found, expected, atol=tolerances.RAY_TWIN_DEPTH_MM, equal_nan=True)


BETWEEN_GUARDS = """
import ctypes, mmap, sys
import numpy as np
import clrecon
from clrecon.geometry import Volume
from clrecon.rendering.views.camera import Camera
for shape in (tuple(int(n) for n in text.split(",")) for text in sys.argv[2:]):
    size = 2 * int(np.prod(shape))
    assert size % mmap.PAGESIZE == 0
    pages = mmap.mmap(-1, 3 * size)
    voxels = np.frombuffer(pages, np.int16, size // 2, size).reshape(shape)
    voxels[:] = np.random.default_rng(3).integers(-1000, 1200, shape)
    first = voxels.ctypes.data
    libc = ctypes.CDLL(None, use_errno=True)
    for guard in (first - size, first + size):
        assert libc.mprotect(ctypes.c_void_p(guard), ctypes.c_size_t(size), 0) == 0
    volume = Volume(voxels, np.diag([0.7, 0.7, 0.8, 1.0]))
    assert volume.voxels.ctypes.data == first
    seen = 0
    with clrecon.VolumeRenderer(volume, device=int(sys.argv[1])) as renderer:
        for view in ("anterior", "superior", "left", (3, 2), (183, 88)):
            for angle in (None, 30.0):
                picture = renderer.render(preset="bone", view=view, view_angle=angle, size=(80, 60))
                seen += int((picture.image > 0).sum())
    print(shape, "seen", seen > 0, flush=True)
import os; os._exit(0)
"""


@pytest.mark.seconds
@pytest.mark.skipif(sys.platform != "linux", reason="guards of memory are made with Linux's calls")
def test_no_voxel_beyond_the_volume_is_read(windowed):
    shapes = ["128,128,32", "512,64,16", "64,64,128", "2,512,512", "512,2,512"]
    command = [sys.executable, "-c", BETWEEN_GUARDS, str(windowed.index), *shapes]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    seen = [f"({shape.replace(',', ', ')}) seen True" for shape in shapes]
    assert (done.returncode, done.stdout.splitlines()) == (0, seen), done.stderr[-2000:]
