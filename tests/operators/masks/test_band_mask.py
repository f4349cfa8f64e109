"""Masks of bands of HU and of lists of voxels."""

from __future__ import annotations

import numpy as np
from refusals import refused

from clrecon.errors import UsageError
from clrecon.opencl import upload
from clrecon.operators.masks.voxel_mask import check_shape, find_extents, mark_voxels, mask_bytes


def test_masks_too_large_are_refused():
    with refused(UsageError, 65535, "masks"):
        check_shape((65_536, 2, 2))
    with refused(UsageError, 2147483647):
        check_shape((65_000, 65_000, 20))


def test_bytes_of_a_mask_are_those_of_its_buffers(device):
    """Of 70 voxels in a row 3 words, and one behind it; the first and last word of each row in 4 bytes."""
    shape = (70, 3, 5)
    assert mask_bytes(shape) == {"mask of the voxels": 4 * 3 * 15, "row extents": 4 * 15}
    assert mask_bytes(shape, 1) == {"mask of the voxels": 4 * 4 * 15, "row extents": 4 * 15}
    made = find_extents(device, upload(device, np.zeros(3 * 15, np.uint32)), shape)
    padded = mark_voxels(device, np.array([[69, 2, 4]], np.int32), shape, pad=1)
    for mask, pad in ((made, 0), (padded, 1)):
        assert mask.needs() == mask_bytes(shape, pad)
        assert (mask.mask_d.size, mask.row_extents_d.size) == tuple(mask.needs().values())
