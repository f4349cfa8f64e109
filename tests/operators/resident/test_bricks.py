"""Bricks: measured and compared as their twin does, and no surface depends on them."""

from __future__ import annotations

import numpy as np
import pytest
from surface_volumes import OBLIQUE, random_volume, smooth_volume
from variants import VOXEL_TYPES

from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch, download, upload
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import compare_bricks, measure_bricks
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.extraction import keep_bricks
from clrecon.proof.volumes import volume_twins as twin

BRICKS = pytest.mark.parametrize("shape", [(1, 1, 1), (3, 9, 7), (8, 8, 8), (9, 7, 8), (17, 16, 33), (8, 9, 100)])


def measured_bricks(device, shape, dtype):
    """Random values, all 99 in the second half of each row; bricks as the device and as the twin measure them."""
    volume = random_volume(shape, dtype=dtype, high=100)
    volume.voxels[:, :, shape[2] // 2 :] = 99
    measured = measure_bricks(device, upload(device, volume.voxels), volume.shape_ijk, volume.voxels.dtype)
    return measured, twin.measure_bricks(volume.voxels)


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@BRICKS
def test_lowest_and_highest_values_of_bricks_equal_the_twin(device, shape, dtype):
    measured, expected = measured_bricks(device, shape, dtype)
    assert measured.shape == expected.shape[2::-1]
    assert np.array_equal(download(device, np.empty_like(expected), measured.ranges_d), expected)


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@BRICKS
def test_bricks_compared_with_levels_equal_the_twin(device, shape, dtype):
    """Below all values, among them, at the highest and above it, with and without a border."""
    measured, ranges = measured_bricks(device, shape, dtype)
    for level in (0, 50, 99, 100):
        for border in (0, 1):
            compared = compare_bricks(device, measured, np.dtype(dtype).type(level), ni=shape[2], border=border)
            states, extents = twin.compare_bricks(ranges, level, ni=shape[2], border=border)
            assert np.array_equal(download(device, np.empty_like(states), compared.states_d), states), level
            assert np.array_equal(download(device, np.empty_like(extents), compared.extents_d), extents), level


def volume_of_blocks(shape, dtype):
    """Blocks of equal values, so that there are bricks of all kinds at every place of a word."""
    random = np.random.default_rng(3)
    blocks = random.integers(0, 4, [-(-n // 6) for n in shape])
    voxels = np.kron(blocks, np.ones((6, 6, 6)))[tuple(slice(n) for n in shape)].astype(dtype)
    voxels[random.integers(0, 50, shape) == 0] = 2
    return Volume(voxels, OBLIQUE)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("shape", [(3, 9, 7), (9, 10, 33), (24, 17, 64), (5, 30, 100), (2, 3, 1030)])
def test_surface_is_the_same_with_and_without_bricks(device, shape, dtype, closed):
    volume = volume_of_blocks(shape, dtype)
    with DeviceVolume(volume, device=device) as resident:
        keep_bricks(resident, resident.whole(Stopwatch()))
        for iso_value in (1, 2, 3, 1.5):
            mesh = extract_isosurface(resident, iso_value, closed=closed)
            expected = extract_isosurface(volume, iso_value, device=device, closed=closed)
            assert "classify_bricks" in mesh.report["kernel_seconds"]
            assert np.array_equal(mesh.triangles, expected.triangles)
            assert np.array_equal(mesh.vertices, expected.vertices)


def test_bricks_of_a_resident_volume_are_measured_for_its_second_surface_on_gpus_alone(device):
    with DeviceVolume(volume_of_blocks((9, 10, 33), "int16"), device=device) as resident:
        measured = ["measure_bricks" in extract_isosurface(resident, 1).report["kernel_seconds"] for _ in range(9)]
    is_gpu = device.kernel_variants["LANES"] == "1"
    assert measured == [False, is_gpu, *[False] * 7]


def test_a_single_extraction_measures_no_bricks(device):
    kernels = extract_isosurface(smooth_volume(), 100, device=device).report["kernel_seconds"]
    assert "classify_samples" in kernels
    assert "measure_bricks" not in kernels


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", [(9, 3, 7), (3, 10, 33)])
def test_triangles_of_a_small_volume_are_the_same_with_and_without_bricks(device, shape):
    with DeviceVolume(random_volume(shape), device=device) as resident:
        middle = 3  # of values from 0 to 5
        without = extract_isosurface(resident, middle)
        keep_bricks(resident, resident.whole(Stopwatch()))
        assert np.array_equal(extract_isosurface(resident, middle).triangles, without.triangles)
