"""Masks of bands of HU and of lists of voxels."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.opencl import upload
from clrecon.operators.masks.voxel_mask import check_shape, find_extents, mark_voxels, mask_bytes


@pytest.mark.parametrize(
    ("shape", "facts"),
    [((65_536, 2, 2), (2**16 - 1, "masks")), ((65_000, 65_000, 20), (2**31 - 1,))],
    ids=["rows too long", "too many voxels"],
)
def test_masks_too_large_are_refused_with_the_limit(shape, facts):
    with refused(UsageError, *facts):
        check_shape(shape)


SHAPE = (70, 3, 5)  # three words hold the 70 voxels of a row
ROWS = 3 * 5


@pytest.mark.parametrize(("pad", "words"), [(0, 3), (1, 3 + 1)])  # `pad` is a word more at the end of each row
def test_bytes_of_a_mask_are_those_of_its_words_and_of_the_extents_of_its_rows(pad, words):
    assert mask_bytes(SHAPE, pad) == {"mask of the voxels": 4 * words * ROWS, "row extents": 4 * ROWS}


@pytest.mark.parametrize("pad", [0, 1])
def test_bytes_of_a_mask_are_those_of_its_buffers(device, pad):
    if pad:
        mask = mark_voxels(device, np.array([[69, 2, 4]], np.int32), SHAPE, pad=pad)
    else:
        mask = find_extents(device, upload(device, np.zeros(3 * ROWS, np.uint32)), SHAPE)
    assert mask.needs() == mask_bytes(SHAPE, pad)
    assert (mask.mask_d.size, mask.row_extents_d.size) == tuple(mask.needs().values())
