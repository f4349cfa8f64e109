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

SHAPES = [(1, 1, 1), (3, 9, 7), (8, 8, 8), (9, 7, 8), (17, 16, 33), (8, 9, 100)]


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize("shape", SHAPES)
def test_ranges_and_states_equal_those_of_the_twin(device, shape, dtype):
    volume = random_volume(shape, dtype, high=100)
    volume.voxels[:, :, shape[2] // 2 :] = 99  # all inside, and all outside of higher levels
    measured = measure_bricks(device, upload(device, volume.voxels), volume.shape_ijk, volume.voxels.dtype)
    expected = twin.measure_bricks(volume.voxels)
    assert measured.shape == expected.shape[2::-1]
    assert np.array_equal(download(device, np.empty_like(expected), measured.ranges_d), expected)
    for level in (0, 50, 99, 100):
        for border in (0, 1):
            compared = compare_bricks(device, measured, volume.voxels.dtype.type(level), shape[2], border)
            states, extents = twin.compare_bricks(expected, level, shape[2], border)
            assert np.array_equal(download(device, np.empty_like(states), compared.states_d), states)
            assert np.array_equal(download(device, np.empty_like(extents), compared.extents_d), extents)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("shape", [(3, 9, 7), (9, 10, 33), (24, 17, 64), (5, 30, 100), (2, 3, 1030)])
def test_surface_is_the_same_with_and_without_bricks(device, shape, dtype, closed):
    """Blocks of equal values, so that there are bricks of all kinds at every place of a word."""
    random = np.random.default_rng(3)
    blocks = random.integers(0, 4, [-(-n // 6) for n in shape])
    voxels = np.kron(blocks, np.ones((6, 6, 6)))[tuple(slice(n) for n in shape)].astype(dtype)
    voxels[random.integers(0, 50, shape) == 0] = 2
    volume = Volume(voxels, OBLIQUE)
    with DeviceVolume(volume, device=device) as resident:
        measured = ["measure_bricks" in extract_isosurface(resident, 1).report["kernel_seconds"] for _ in range(9)]
        assert measured == [number == 1 and device.kernel_variants["LANES"] == "1" for number in range(9)]
        keep_bricks(resident, resident.whole(Stopwatch()))
        for iso_value in (1, 2, 3, 1.5):
            mesh = extract_isosurface(resident, iso_value, closed=closed)
            expected = extract_isosurface(volume, iso_value, device=device, closed=closed)
            assert np.array_equal(mesh.triangles, expected.triangles)
            assert np.array_equal(mesh.vertices, expected.vertices)
        assert "classify_bricks" in mesh.report["kernel_seconds"]


def test_a_single_extraction_measures_no_bricks(device):
    kernels = extract_isosurface(smooth_volume(), 100, device=device).report["kernel_seconds"]
    assert "classify_samples" in kernels and "measure_bricks" not in kernels


@pytest.mark.oclgrind
def test_bricks_stay_within_their_buffers(device):
    for shape in [(9, 3, 7), (3, 10, 33)]:
        volume = random_volume(shape)
        with DeviceVolume(volume, device=device) as resident:
            first = extract_isosurface(resident, 3)
            keep_bricks(resident, resident.whole(Stopwatch()))
            second = extract_isosurface(resident, 3)
        assert np.array_equal(first.triangles, second.triangles)
