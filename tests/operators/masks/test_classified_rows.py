"""The inside mask of GPUs against numpy: rows of whole vectors, and all others."""

from __future__ import annotations

import numpy as np
import pytest
from surface_volumes import random_volume

from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.opencl import Device, download, upload
from clrecon.operators.surface.marching_cubes import Classifier
from clrecon.operators.surface.slabs import SampleGrid, Slab


@pytest.fixture(scope="module")
def device_as_gpu(device):
    """The device with the kernels of GPUs."""
    gpu = Device(device.index, device.cl_device.platform, device.cl_device)
    gpu.kernel_variants, gpu.fault = {"LANES": "1", "WORDS_PER_ITEM": "1"}, ""
    return gpu


def inside_rows(inside, border, words):
    """Return the mask of samples (gk, gj, words), and the first and last words with a bit."""
    samples = np.pad(inside, border)
    padded = np.pad(samples, ((0, 0), (0, 0), (0, 32 * words - samples.shape[2])))
    mask = np.packbits(padded, axis=2, bitorder="little").view("<u4")
    is_set = mask != 0
    last = words - np.argmax(is_set[..., ::-1], axis=2)
    extents = np.stack([np.argmax(is_set, axis=2), np.where(is_set.any(axis=2), last, 0)], axis=2)
    return mask, extents


@pytest.mark.oclgrind
@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
@pytest.mark.parametrize("columns", [8, 31, 32, 40, 64, 65, 72, 128])
def test_inside_bits_and_extents_of_rows_equal_those_of_numpy(device_as_gpu, columns, dtype, closed):
    volume = random_volume((3, 5, columns), dtype=dtype, high=100)
    volume.voxels[1, 2] = 0  # a row without bits
    volume.voxels[0, :, -1] = 99  # rows whose last bit is set
    # The samples of a surface at 60 HU, all in one slab: a closed one has a border of a sample around the voxels.
    grid = SampleGrid(volume, choose_iso_rule(volume, 60, closed=closed))
    slab = Slab(grid, first=0, end=3 + 2 * closed)
    level = np.dtype(dtype).type(grid.rule.lowest_inside)

    made = Classifier(device_as_gpu, slab, [level]).mark_rest(upload(device_as_gpu, volume.voxels))

    mask, extents = inside_rows(volume.voxels >= level, grid.rule.border, grid.words)
    assert np.array_equal(download(device_as_gpu, np.empty_like(mask), made.mask_d), mask)
    assert np.array_equal(download(device_as_gpu, np.empty(extents.shape, np.uint16), made.row_extents_d), extents)


@pytest.mark.parametrize("first", [0, 7])
def test_rows_that_are_marked_as_their_voxels_land_equal_those_of_numpy(device, first):
    """What has not landed is no bone; 17 of 18 MiB have."""
    volume = random_volume((36 + first, 512, 512), dtype="int16", high=100)
    grid = SampleGrid(volume, choose_iso_rule(volume, 60, closed=True))
    slab = Slab(grid, first=first, end=grid.shape[2])
    voxels = volume.voxels[slice(*slab.voxel_slices)]
    landed_bytes = (17 << 20) + 99
    landing = np.zeros_like(voxels)
    landing.reshape(-1)[: landed_bytes // 2] = voxels.reshape(-1)[: landed_bytes // 2]

    classifier = Classifier(device, slab, [np.int16(grid.rule.lowest_inside)])
    classifier.mark_landed(upload(device, landing), landed_bytes)
    made = classifier.mark_rest(upload(device, voxels))

    mask, extents = inside_rows(volume.voxels >= grid.rule.lowest_inside, grid.rule.border, grid.words)
    assert np.array_equal(download(device, np.empty_like(mask[first:]), made.mask_d), mask[first:])
    found = download(device, np.empty(extents[first:].shape, np.uint16), made.row_extents_d)
    assert np.array_equal(found, extents[first:])
